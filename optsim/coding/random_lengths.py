"""Random lengths (Portz et al.): one exposure a pixel and frame, of its own length, that moves on."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from optsim.coding.periodic import PeriodicScheme, bumps, check_fits, square
from optsim.core.quantities import Bytes


class RandomLengths(PeriodicScheme):
    """A pixel's exposures have one length and follow each other, one a frame; offsets start at random.

    After Portz, Zhang and Jiang, "Random coded sampling for high-speed HDR video", ICCP 2013. Their sensor
    reads each pixel at its own times: one exposure follows the other, and no light is lost. Adapted: a CCD
    behind a panel is read once a frame. The exposures of a frame would add up to an open shutter, so one of
    them passes. In the next frame it begins at the slot where this one ended, and so around the coded slots.
    Lengths are evenly spread over a tile at random places.

    Parameters
    ----------
    shortest_slots, longest_slots : int
        Range of the lengths in slots. The authors' exposures take four high-speed frames on average, as do 1
        to 7 (the range is a sensible default, no source).
    tile_px : int
        Side of the tile, panel pixels.
    """

    TEMPORAL: ClassVar[bool] = True
    kind: Literal["random_lengths"] = "random_lengths"
    shortest_slots: int = Field(default=1, ge=1)
    longest_slots: int = Field(default=7, ge=1)
    tile_px: int = Field(default=8, ge=1, le=64)

    @model_validator(mode="after")
    def _ascending(self) -> RandomLengths:
        if self.shortest_slots > self.longest_slots:
            raise ValueError(
                f"shortest_slots: got {self.shortest_slots}, expected at most longest_slots, which is "
                f"{self.longest_slots}; lower it, or raise the other"
            )
        return self

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """As many frames of a square tile as slots: the shortest exposures then have been everywhere.

        Raises
        ------
        ConfigError
            When the longest bump does not fit into the coded slots.
        """
        check_fits("longest_slots", self.longest_slots, coded_slots)
        lengths = np.linspace(self.shortest_slots, self.longest_slots + 1, self.tile_px**2, endpoint=False)
        lengths = rng.permutation(lengths.astype(int))
        places = coded_slots - lengths + 1
        starts = rng.integers(0, places)
        frames = [square(bumps(slots, (starts + n * lengths) % places, lengths)) for n in range(coded_slots)]
        return np.concatenate(frames)
