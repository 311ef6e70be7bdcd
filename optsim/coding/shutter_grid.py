"""Shutter grid (Bub et al.; Gupta et al.): pixels of small grids open one after the other."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.coding.periodic import PeriodicScheme, square, turns
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bytes, Ints


class ShutterGrid(PeriodicScheme):
    """The pixels of a k x k grid open one after the other in a dyadic order, each for its share of the frame.

    Bub, Tecza, Helmes, Lee and Kohl, "Temporal pixel multiplexing for simultaneous high-speed,
    high-resolution imaging", Nature Methods 7, 209 (2010, doi:10.1038/nmeth.1429), and Gupta, Agrawal,
    Veeraraghavan and Narasimhan, "Flexible voxels for motion-aware videography", ECCV 2010
    (doi:10.1007/978-3-642-15549-9_8). Successive openings lie far apart, as Gupta's, so that several
    space-time resolutions can be chosen after capture (:func:`firing_order`).

    Parameters
    ----------
    grid_px : int
        Side of the grid, panel pixels; 4 is Bub's. All exposures have the same length, the share of the coded
        slots rounded up. If the share is no whole number, successive exposures overlap by at most a slot.
    """

    TEMPORAL: ClassVar[bool] = True
    kind: Literal["shutter_grid"] = "shutter_grid"
    grid_px: int = Field(default=4, ge=2, le=64)

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """One frame of a square tile.

        Raises
        ------
        ConfigError
            When the grid has more pixels than there are coded slots.
        """
        del rng
        if self.grid_px**2 > coded_slots:
            raise ConfigError(
                f"grid_px: got {self.grid_px}, expected at most {math.isqrt(coded_slots)}: its pixels take "
                f"turns in {coded_slots} coded slots; lower it"
            )
        return square(turns(self.grid_px**2, slots, coded_slots)[firing_order(self.grid_px)])


def firing_order(side: int) -> Ints:
    """Turn of each pixel of a square grid, row by row: array of shape (pixel,), int64.

    The order of ordered dither: B. E. Bayer, "An optimum method for two-level rendition of continuous-tone
    pictures", ICC 1973. Gupta's has the same aim; its order within each level was not compared.

    In a grid of a power of two, the turns of one pixel in every 2 x 2 fill a quarter of the frame, those of
    one in every 4 x 4 a sixteenth, and so on. So each quarter of the frame has an image of half the
    resolution. Other grids are cut from the next power of two and keep its order.
    """
    turn = np.zeros((1, 1), np.int64)
    while len(turn) < side:
        turn = np.block([[4 * turn, 4 * turn + 2], [4 * turn + 3, 4 * turn + 1]])
    return turn[:side, :side].ravel().argsort().argsort()
