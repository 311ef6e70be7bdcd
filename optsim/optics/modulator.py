"""The liquid-crystal panel: its numbers, its Mueller matrix and its fixed patterns."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from pydantic import Field

from optsim.config import Part
from optsim.forward.mueller import depolariser, mirror, retarder_45
from optsim.quantities import Bools, Bytes, Doubles, Floats

_PATTERN = 0x70616E65  # separates the panel's fixed patterns from the sensor's


class Modulator(Part):
    """A reflective panel as one equivalent retarder at 45 degrees, with first-order response.

    Parameters
    ----------
    pitch_m : float
        Pixel pitch, m.
    rows, cols : int
        Pixels of the whole panel.
    field_rate_hz : float
        Patterns a second: one slot lasts one field.
    mirror_reflectivity : float
        Of the pixels' mirrors.
    fill_factor : float
        Share of a pitch cell that its mirror covers. The gaps reflect nothing; the fine grid is too coarse to
        show them, so their loss is spread evenly.
    tau_on_s, tau_off_s : float
        Time constants towards larger and smaller retardance.
    drive_exponent : float
        Exponent of retardance against level.
    depolarised_share : float
        Share of the reflected light that is no longer polarised; half of it passes the analyser.
    nonuniformity_rms : float
        Rms of the relative reflectivity over the panel, smooth.
    stuck_share : float
        Share of the pixels that stand still, dark or bright.
    """

    pitch_m: float = Field(gt=0)
    rows: int = Field(ge=1)
    cols: int = Field(ge=1)
    field_rate_hz: float = Field(gt=0)
    mirror_reflectivity: float = Field(gt=0, le=1)
    fill_factor: float = Field(gt=0, le=1)
    tau_on_s: float = Field(ge=0)
    tau_off_s: float = Field(ge=0)
    drive_exponent: float = Field(gt=0)
    depolarised_share: float = Field(ge=0, le=1)
    nonuniformity_rms: float = Field(ge=0, le=0.2)
    stuck_share: float = Field(ge=0, le=1)

    @property
    def reflectivity(self) -> float:
        """Of a whole pitch cell."""
        return self.mirror_reflectivity * self.fill_factor

    def mueller(self, retardance_rad: float) -> Doubles:
        """Mueller matrix of the panel in reflection, the mirror's flip included once.

        The round-trip retardance is that of one equivalent retarder before the mirror: with the flip
        after it, retardance 0 stays dark and pi is bright between crossed polarisers.
        """
        retarder = mirror() @ retarder_45(retardance_rad)
        return self.reflectivity * depolariser(self.depolarised_share) @ retarder

    def gain(self, rows: int, cols: int, serial_number: int) -> Floats:
        """Relative reflectivity of the used pixels, (v, u), mean about 1."""
        return _smooth_pattern(rows, cols, self.nonuniformity_rms, serial_number)

    def stuck(self, rows: int, cols: int, serial_number: int) -> tuple[Bools, Bytes]:
        """Pixels that stand still, (v, u), and the level, 0 or 255, that each would stand at."""
        rng = np.random.default_rng([serial_number, _PATTERN, 1])
        stuck = rng.random((rows, cols)) < self.stuck_share
        return stuck, rng.integers(0, 2, (rows, cols), dtype=np.uint8) * np.uint8(255)


@lru_cache(maxsize=8)
def _smooth_pattern(rows: int, cols: int, rms: float, serial_number: int) -> Floats:
    """One plus a random mixture of the 15 lowest cosines of the rectangle, of a given rms."""
    rng = np.random.default_rng([serial_number, _PATTERN, 0])
    y = (np.arange(rows) + 0.5) / rows
    x = (np.arange(cols) + 0.5) / cols
    pattern = np.zeros((rows, cols))
    for i in range(4):
        for j in range(4):
            if i or j:
                pattern += rng.standard_normal() * np.outer(np.cos(np.pi * i * y), np.cos(np.pi * j * x))
    spread = pattern.std()
    return (1 + rms * pattern / (spread if spread > 0 else 1)).astype(np.float32)
