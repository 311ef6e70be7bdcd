"""Readout window of a panel pixel: the CCD pixel at its centre, or a square of pixels around it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Ints


def places(image: NDArray[Any], row: Ints, col: Ints, side: int) -> Iterator[NDArray[Any]]:
    """Yield the pixels of all windows, one position in the window after another.

    Parameters
    ----------
    image : ndarray of shape (..., y, x)
        Image of the CCD.
    row, col : ndarray of shape (v, u), int64
        CCD pixels at the centres of the windows.
    side : int
        Side of a window, CCD pixels, odd.

    Yields
    ------
    ndarray of shape (..., v, u)
        Pixels at one position; beyond the CCD's border the nearest pixel's.

    Raises
    ------
    ValueCheckError
        When a window's centre is off the image: it is of another CCD.
    """
    height, width = image.shape[-2:]
    last = int(row.max()), int(col.max())
    if min(int(row.min()), int(col.min())) < 0 or last[0] >= height or last[1] >= width:
        raise ValueCheckError(
            f"frame: got {height} x {width} CCD pixels, expected at least {last[0] + 1} x {last[1] + 1}, by "
            "the pixels that the calibration reads; cure: take that of this camera and readout window"
        )
    for down in range(-(side // 2), side // 2 + 1):
        for right in range(-(side // 2), side // 2 + 1):
            yield image[..., (row + down).clip(0, height - 1), (col + right).clip(0, width - 1)]


def mean_reading(image: NDArray[Any], row: Ints, col: Ints, side: int) -> NDArray[Any]:
    """Mean of each window, (..., v, u): whole numbers as float32. Arguments as of :func:`places`."""
    dtype = np.float32 if image.dtype.kind in "ui" else image.dtype
    total, *others = (seen.astype(dtype) for seen in places(image, row, col, side))
    for seen in others:
        total += seen
    return total / side**2 if others else total


def brightest(image: NDArray[Any], row: Ints, col: Ints, side: int) -> NDArray[Any]:
    """Brightest pixel of each window, (..., v, u). Arguments as of :func:`places`."""
    return np.maximum.reduce(list(places(image, row, col, side)))
