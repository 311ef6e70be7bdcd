"""Closed-loop exposure and rate (Zhang et al.): by brightness each pixel, by motion each moving region."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field, field_validator

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import Crosstalk
from optsim.coding.change_test import Changes
from optsim.coding.exposure_control import as_levels, controlled_slots
from optsim.coding.growth import region_displacements
from optsim.coding.periodic import bumps
from optsim.core.config import Part
from optsim.core.quantities import Bools, Bytes, CodedFrame, Doubles, ExposureCode, Ints
from optsim.optics.neighbourhoods import dilated

# As of the motion-adaptive scheme: the least change of squares of pixels that counts.
_LEAST_CHANGE = 0.2


@dataclass(frozen=True, eq=False)
class RateState:
    """State of the scheme between frames.

    Parameters
    ----------
    changes : Changes
        What the frames that have arrived tell of motion.
    phases : ndarray of shape (v, u)
        When each pixel opens: 0 is as early as its exposure may begin, 1 as late.
    """

    changes: Changes
    phases: Doubles


class ClosedLoopRate(Part):
    """Each pixel opens as its brightness asks, but no longer than its region's motion allows.

    Zhang, Newman, Wang, Thakur, Rattray, Etienne-Cummings and Wilson, "A closed-loop, all-electronic
    pixel-wise adaptive imaging system for high dynamic range videography", IEEE Trans. Circuits Syst. I 67,
    1803 (2020, arXiv:1906.10045): exposure and sampling rate of each pixel follow brightness and motion.
    Adapted: their sensor reads a pixel as often as its exposure ends, a CCD behind a panel once a frame. So a
    shorter exposure is one bump at a random time, and neighbours give the rate. As by Yuan et al. (ICIP 2013)
    it is the longest in which the region moves by little; exposures by brightness are those of
    ``closed_loop_density``. A decoder that tells moving pixels apart fits, such as ``union``.

    Parameters
    ----------
    target_share : float
        Reading to aim at, above black and relative to saturation (a sensible default, no source).
    bump_slots : tuple of int
        Lengths that a moving region chooses from; one beyond the coded slots is all of them (sensible
        defaults, no source).
    blur_px : float
        Most motion within a bump, panel pixels; a half is what a pixel hardly tells (no source). A region
        whose displacement is unknown gets the shortest.
    threshold_sigma, speck_px, dilation_px
        Mask of moving pixels as in ``motion_adaptive``.
    margin_px : int
        Reach of a moving region's code beyond it: a patch of the decoder less one, plus 1 for light that
        spreads.
    tile_px : int
        Side of the tile of random times, panel pixels.
    crosstalk : {"undone", "row_summed"}
        Correction of the neighbours' light before frames are compared.
    """

    kind: Literal["closed_loop_rate"] = "closed_loop_rate"
    target_share: float = Field(default=0.6, gt=0, lt=1)
    bump_slots: tuple[int, ...] = (3, 6, 12, 36)
    blur_px: float = Field(default=0.5, gt=0)
    threshold_sigma: float = Field(default=4.0, gt=0)
    speck_px: int = Field(default=4, ge=1)
    dilation_px: int = Field(default=3, ge=0)
    margin_px: int = Field(default=8, ge=0)
    tile_px: int = Field(default=8, ge=1, le=64)
    crosstalk: Crosstalk = "undone"

    @field_validator("bump_slots")
    @classmethod
    def _ascending(cls, lengths: tuple[int, ...]) -> tuple[int, ...]:
        if not lengths or lengths[0] < 1 or any(a >= b for a, b in pairwise(lengths)):
            raise ValueError("expected ascending numbers of open slots, the first at least 1")
        return lengths

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """Exposures that it may choose, side by side in one frame of a tile, for probes of the camera."""
        phases = self._phases(rng)
        lengths = np.resize(np.array([1, *self._choices(coded_slots)]), phases.shape)
        return as_levels(_runs(lengths, phases, slots, coded_slots))[None]

    def init(self, calibration: Calibration, rng: np.random.Generator) -> RateState:
        """Choose the random times once.

        Raises
        ------
        ConfigError
            When crosstalk is to be undone and cannot be.
        """
        rows, cols = (np.arange(n) % self.tile_px for n in calibration.shape)
        return RateState(Changes.of(calibration, self.crosstalk), self._phases(rng)[rows[:, None], cols])

    def next(
        self, index: int, arrived: Sequence[CodedFrame], state: RateState
    ) -> tuple[ExposureCode, RateState]:
        """Code of the next frame: brightness by the newest that has arrived, motion by the last three."""
        del index
        changes, calibration = state.changes, state.changes.calibration
        changes = changes.after(arrived, self.threshold_sigma, _LEAST_CHANGE)
        lengths = np.full(calibration.shape, calibration.coded_slots)
        moving = np.zeros(calibration.shape, np.bool_)
        if arrived:
            most, moving = self._allowed(changes)
            lengths = np.minimum(controlled_slots(calibration, arrived[-1], self.target_share), most)
        runs = _runs(lengths, state.phases, calibration.slots_per_frame, calibration.coded_slots)
        return ExposureCode(as_levels(runs), moving), replace(state, changes=changes)

    def _allowed(self, changes: Changes) -> tuple[Ints, Bools]:
        """Longest exposure that motion allows, around moving regions too, and the regions that it limits."""
        calibration = changes.calibration
        mask, before = changes.masks(self.speck_px, self.dilation_px)
        choices = self._choices(calibration.coded_slots)
        own = np.full(calibration.shape, calibration.coded_slots)
        places, displacements = region_displacements(mask, before)
        speeds = np.hypot(*displacements.T) / calibration.slots_per_frame
        for place, speed in zip(places, speeds, strict=True):
            own[place] = max((n for n in choices if n * speed <= self.blur_px), default=choices[0])
        around = own.copy()
        for length in reversed(choices):
            around[dilated(own == length, self.margin_px) & (around > length)] = length
        return around, own < calibration.coded_slots

    def _choices(self, coded_slots: int) -> list[int]:
        return sorted({min(n, coded_slots) for n in self.bump_slots})

    def _phases(self, rng: np.random.Generator) -> Doubles:
        """Evenly spread times at random places of a tile."""
        return rng.permutation(np.linspace(0, 1, self.tile_px**2)).reshape(self.tile_px, self.tile_px)


def _runs(lengths: Ints, phases: Doubles, slots: int, coded_slots: int) -> Bytes:
    """Levels (v, u, slot) of exposures of these lengths at these times."""
    return bumps(slots, np.rint(phases * (coded_slots - lengths)).astype(np.int64), lengths)
