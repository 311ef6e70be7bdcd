"""Random binary code: each pixel open or closed at random in each slot."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.coding.periodic import OPEN, PeriodicScheme, square
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bytes


class RandomBinary(PeriodicScheme):
    """Every pixel open or closed at random in every slot, independently of all others.

    The code of Reddy, Veeraraghavan and Chellappa, "P2C2: Programmable pixel compressive camera for high
    speed imaging", CVPR 2011 (doi:10.1109/CVPR.2011.5995542), here in one tile that repeats over panel and
    frames. A pixel that would never open is drawn anew. So the share actually open is a little larger if it
    is small: ``open_share / (1 - (1 - open_share) ** coded_slots)``.

    Parameters
    ----------
    open_share : float
        Probability that a pixel is open in a slot; a half is a sensible default (no source).
    tile_px : int
        Side of the tile, panel pixels.
    """

    TEMPORAL: ClassVar[bool] = True
    kind: Literal["random_binary"] = "random_binary"
    open_share: float = Field(default=0.5, gt=0, le=1)
    tile_px: int = Field(default=8, ge=1, le=64)

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """One frame of a square tile.

        Raises
        ------
        ConfigError
            When fewer than one slot of a pixel would be open on average.
        """
        if self.open_share * coded_slots < 1:
            raise ConfigError(
                f"open_share: got {self.open_share:g}, expected at least {1 / coded_slots:.3g}, one of the "
                f"{coded_slots} coded slots; raise it"
            )
        is_open = np.zeros((self.tile_px**2, slots), np.bool_)
        while (never := ~is_open.any(axis=1)).any():
            is_open[never, :coded_slots] = rng.random((never.sum(), coded_slots)) < self.open_share
        return square(is_open * np.uint8(OPEN))
