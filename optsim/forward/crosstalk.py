"""What the picked CCD pixel of a panel pixel sees of that pixel's neighbours, by the true relay operator."""

from __future__ import annotations

import numpy as np

from optsim.forward.relay import RelayOperator
from optsim.quantities import Doubles, Ints

# Farthest neighbours, in panel pixels, that the kernel keeps; what lies beyond is spread over it.
_REACH = 3
# Distance of the lit dots: at any ratio it shifts their phase on the CCD's pixels from dot to dot.
_SPACING = 13


def crosstalk_kernel(operator: RelayOperator, pitch: int, pick_row: Ints, pick_col: Ints) -> Doubles:
    """Mean image of a single bright panel pixel in the picked pixels around it, veil left out.

    Parameters
    ----------
    operator : RelayOperator
        From the fine panel grid to the CCD.
    pitch : int
        Fine cells to a panel pixel.
    pick_row, pick_col : ndarray of shape (v, u), int64
        CCD pixel at the centre of each panel pixel.

    Returns
    -------
    ndarray of shape (k, k), float64
        Sums to 1; element (reach + dv, reach + du) is what pixel (v + dv, u + du) sees of pixel (v, u).
        Averaged over the phases between the two grids. k is 7, or less on a panel too small for that.
    """
    rows, cols = pick_row.shape
    reach = min(_REACH, (min(rows, cols) - 1) // 2)
    v, u = _dots(rows, reach), _dots(cols, reach)
    dots = np.zeros((rows, cols))
    dots[np.ix_(v, u)] = 1
    light = operator.blur.apply(dots.repeat(pitch, axis=0).repeat(pitch, axis=1))
    seen = operator.project(light)[pick_row, pick_col]
    shifts = range(-reach, reach + 1)
    kernel = np.array([[seen[np.ix_(v + dv, u + du)].mean() for du in shifts] for dv in shifts])
    return kernel / kernel.sum()


def _dots(n: int, reach: int) -> Ints:
    """Places of the dots along an axis, as near to the middle as they come."""
    return np.arange(reach + (n - 2 * reach) % _SPACING // 2, n - reach, _SPACING)
