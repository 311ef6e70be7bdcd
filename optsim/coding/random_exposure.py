"""One short exposure a pixel, at a time that differs from pixel to pixel (Hitomi et al.)."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.coding.tiles import TiledScheme, bump
from optsim.errors import ConfigError
from optsim.quantities import Bytes


class RandomExposure(TiledScheme):
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
        if self.bump_slots > coded_slots:
            raise ConfigError(
                f"bump_slots: got {self.bump_slots}, expected at most the {coded_slots} coded slots"
            )
        n = self.tile_px**2
        starts = np.rint(np.linspace(0, coded_slots - self.bump_slots, n)).astype(int)
        bumps = np.stack([bump(slots, int(first), self.bump_slots) for first in rng.permutation(starts)])
        return bumps.T.reshape(1, slots, self.tile_px, self.tile_px)
