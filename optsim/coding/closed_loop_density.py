"""Closed-loop density (Nayar and Branzoi): each pixel's exposure follows the brightness that it read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field

from optsim.calibration.calibration import Calibration
from optsim.coding.exposure_control import as_levels, controlled_slots
from optsim.coding.periodic import bumps
from optsim.core.config import Part
from optsim.core.quantities import Bytes, CodedFrame, ExposureCode, Ints


class ClosedLoopDensity(Part):
    """Each pixel opens as long as fills its well to the target, by the newest frame that has arrived.

    Nayar and Branzoi, "Adaptive dynamic range imaging: optical control of pixel exposures over space and
    time", ICCV 2003, who attenuate each pixel by a liquid crystal. Here its density is the number of open
    slots (:func:`~optsim.coding.exposure_control.controlled_slots`): one run in the middle of the coded
    slots, so that all pixels have the same mean time. Until a frame arrives all coded slots are open. The
    code follows no motion, so where a bright mover was, exposures stay short for the latency.

    Parameters
    ----------
    target_share : float
        Reading to aim at, above black and relative to saturation; 0.6 leaves room for a scene that brightens
        by two thirds (a sensible default, no source).
    """

    kind: Literal["closed_loop_density"] = "closed_loop_density"
    target_share: float = Field(default=0.6, gt=0, lt=1)

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """Exposures that it may choose, side by side in one frame of a tile, for probes of the camera."""
        del rng
        lengths = np.rint(np.geomspace(1, coded_slots, 4)).astype(np.int64)
        return as_levels(_centred(lengths[None], slots, coded_slots))[None]

    def init(self, calibration: Calibration, rng: np.random.Generator) -> Calibration:
        """Return the calibration: the newest frame and its own code tell the rest."""
        del rng
        return calibration

    def next(
        self, index: int, arrived: Sequence[CodedFrame], state: Calibration
    ) -> tuple[ExposureCode, Calibration]:
        """Code of the next frame, from the newest that has arrived."""
        del index
        lengths = np.full(state.shape, state.coded_slots)
        if arrived:
            lengths = controlled_slots(state, arrived[-1], self.target_share)
        levels = as_levels(_centred(lengths, state.slots_per_frame, state.coded_slots))
        return ExposureCode(levels, np.zeros(state.shape, np.bool_)), state


def _centred(lengths: Ints, slots: int, coded_slots: int) -> Bytes:
    """Levels (v, u, slot) of runs in the middle of the coded slots."""
    return bumps(slots, (coded_slots - lengths) // 2, lengths)
