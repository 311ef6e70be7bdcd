"""Random exposure (Hitomi et al.): one short exposure a pixel, at a random time."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.coding.periodic import PeriodicScheme, bumps, check_fits, even_starts, square
from optsim.core.quantities import Bytes


class RandomExposure(PeriodicScheme):
    """A single bump a pixel; start times evenly spread over a tile, at random places in it.

    The single bump and the patch-wise decoder are those of Hitomi, Gu, Gupta, Mitsunaga and Nayar, "Video
    from a single coded exposure photograph", ICCV 2011 (doi:10.1109/ICCV.2011.6126254). Repeating one tile
    lets all patches of a phase share one measurement matrix.

    Parameters
    ----------
    bump_slots : int
        Length of the exposure in slots; 3 of 36 is a sensible default (no source).
    tile_px : int
        Side of the tile, panel pixels.
    """

    TEMPORAL: ClassVar[bool] = True
    kind: Literal["random_exposure"] = "random_exposure"
    bump_slots: int = Field(default=3, ge=1)
    tile_px: int = Field(default=8, ge=1, le=64)

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """One frame of a square tile.

        Raises
        ------
        ConfigError
            When the bump does not fit into the coded slots.
        """
        check_fits("bump_slots", self.bump_slots, coded_slots)
        n = self.tile_px**2
        starts = rng.permutation(even_starts(n, self.bump_slots, coded_slots))
        return square(bumps(slots, starts, np.full(n, self.bump_slots)))
