# pyright: reportMissingTypeStubs=false
"""Neighbouring pixels: sums over squares, connected regions, dilation."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from optsim.core.quantities import Bools, Ints

Reals = NDArray[np.floating]


def sum_around(image: Reals, reach_px: int) -> Reals:
    """Sum over the square within ``reach_px`` rows and columns of each pixel, dark beyond the border."""
    from scipy import ndimage

    line = np.ones(2 * reach_px + 1)
    # Direct sums: a running one would leave rounding errors in the dark beside a lamp.
    for axis in (0, 1):
        image = cast("Callable[..., Reals]", ndimage.correlate1d)(image, line, axis=axis, mode="constant")
    return image


def remove_specks(mask: Bools, least_px: int) -> Bools:
    """Remove connected regions (8 neighbours) of fewer than ``least_px`` pixels."""
    if least_px <= 1:
        return mask
    labels, n = regions(mask)
    sizes = np.bincount(labels.ravel(), minlength=n + 1)
    keep = sizes >= least_px
    keep[0] = False
    return keep[labels]


def regions(mask: Bools) -> tuple[Ints, int]:
    """Label connected regions (8 neighbours) from 1 in an array (v, u), 0 elsewhere; and count them."""
    from scipy import ndimage

    return cast("Callable[..., tuple[Ints, int]]", ndimage.label)(mask, structure=np.ones((3, 3), int))


def dilated(mask: Bools, reach_px: int) -> Bools:
    """Dilate by a square: every pixel within ``reach_px`` rows and columns of the mask."""
    if reach_px == 0:
        return mask
    from scipy import ndimage

    return cast("Callable[..., Bools]", ndimage.maximum_filter)(mask, size=2 * reach_px + 1)
