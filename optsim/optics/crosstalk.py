"""Crosstalk kernels: the share of neighbouring panel pixels' light in each pixel's reading on the CCD.

A panel pixel is read at the CCD pixel nearest to its centre (the pixel map). The centres differ by up to half
a CCD pixel. At ratios such as 2.88 this offset is different at every panel pixel, and the neighbours' share
varies with it by several times. It varies over the field too, as lenses blur more in the corners. So every
panel pixel has its own kernel, a smooth function of its offset and its position. It is fitted to isolated
bright dots: of the laboratory's images in a calibration, of the true operator in the simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.optics.fringing import fine_image
from optsim.optics.readings import mean_reading
from optsim.optics.relay import RelayOperator

# Half width of a kernel, panel pixels: there diffraction tails reach 1e-4 of the light.
REACH = 3
# Spacing of the lit dots of the true operator, wider than any kernel.
_SPACING = 13
# Polynomial in the offset, which is at most half a CCD pixel or a sixth of a panel pixel; scaled to about 1.
# On the prototype a fifth order leaves 0.1 slots of a neighbourhood of 1 : 36 exposures, a third order 0.15.
_ORDER = 5
_SCALE = 6.0
# Orders in the position, from -1 to 1 over the panel, and in the product of both.
_FIELD_ORDER, _JOINT_ORDER = 4, 2


def _powers(order: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(order + 1) for j in range(order + 1 - i)]


_OFFSET = [(*offset, 0, 0) for offset in _powers(_ORDER)]
_PLACE = [(0, 0, *place) for place in _powers(_FIELD_ORDER)[1:]]
_BOTH = [(*offset, *place) for offset in _powers(_JOINT_ORDER)[1:] for place in _powers(_JOINT_ORDER)[1:]]
_EVERY_POWER = _OFFSET + _PLACE + _BOTH
# Sets of terms for a fit, largest first, and the dots it needs per term.
_CHOICES = (_EVERY_POWER, _OFFSET + _PLACE, _OFFSET + _PLACE[:5], _OFFSET)
_DOTS_A_TERM = 2
# Dots per term of the fit, if the panel has room for them.
_ENOUGH = 20
# Ridge, relative to the weight of the data: offsets that never occur (an integer ratio) stay out of the fit.
_RIDGE = 1e-4


@dataclass(frozen=True, eq=False)
class Dots:
    """Readings of all panel pixels for a lattice of single bright ones.

    Parameters
    ----------
    rows, cols : ndarray of shape (n,), int64
        Lit rows and columns; the lattice is their product.
    seen : ndarray of shape (v, u), float64
        Reading over that of the whole panel lit, leak subtracted.
    """

    rows: Ints
    cols: Ints
    seen: Doubles


def crosstalk_kernels(dots: Sequence[Dots], offset_px: Doubles, good: Bools, reach: int = REACH) -> Floats:
    """Kernel of every panel pixel, by least squares over all dots.

    Parameters
    ----------
    dots : sequence of Dots
        Lattices, wider than the kernel.
    offset_px : ndarray of shape (v, u, 2), float64
        Centre of the CCD pixel minus that of the panel pixel, along v and u, panel pixels.
    good : ndarray of shape (v, u), bool
        Pixels with a valid reading.
    reach : int
        Half width of the kernel, which is 2 reach + 1 wide.

    Returns
    -------
    ndarray of shape (v, u, k, k), float32
        Element (reach + dv, reach + du) of pixel (v, u) is its share of the light of (v + dv, u + du); each
        kernel sums to 1, as the answer to a flat does.

    Raises
    ------
    ValueError
        When a neighbour has no usable dot.
    """
    n_dots = sum(lattice.rows.size * lattice.cols.size for lattice in dots)
    powers = next((c for c in _CHOICES if n_dots >= _DOTS_A_TERM * len(c)), _OFFSET)
    terms, n = _terms(offset_px, powers), len(powers)
    rows, cols = good.shape
    coefficients = np.empty((n, 2 * reach + 1, 2 * reach + 1))
    for dv in range(-reach, reach + 1):
        for du in range(-reach, reach + 1):
            left, right = np.zeros((n, n)), np.zeros(n)
            for lattice in dots:
                v, u = (a.ravel() for a in np.meshgrid(lattice.rows - dv, lattice.cols - du, indexing="ij"))
                inside = (v >= 0) & (v < rows) & (u >= 0) & (u < cols)
                v, u = v[inside], u[inside]
                usable = good[v, u] & good[v + dv, u + du]
                v, u = v[usable], u[usable]
                left += terms[v, u].T @ terms[v, u]
                right += terms[v, u].T @ lattice.seen[v, u]
            if left[0, 0] == 0:
                raise ValueError(f"no dot shows the neighbour at ({dv}, {du}) of any valid pixel")
            ridge = _RIDGE * left[0, 0] * np.eye(n)
            ridge[0, 0] = 0
            coefficients[:, reach + dv, reach + du] = np.linalg.solve(left + ridge, right)
    kernels = np.tensordot(terms, coefficients, axes=1)
    kernels /= kernels.sum(axis=(2, 3), keepdims=True)
    return kernels.astype(np.float32)


def seen_by_ccd_pixels(
    panel: Doubles,
    operator: RelayOperator,
    borders: Doubles,
    centre_row: Ints,
    centre_col: Ints,
    side: int = 1,
) -> Doubles:
    """Light of a panel pattern in each panel pixel's reading, without veil: array (v, u).

    Parameters
    ----------
    panel : ndarray of shape (v, u), float64
        The pattern, from 0 to 1.
    operator, borders, centre_row, centre_col, side
        As of :func:`true_dots`.
    """
    image = operator.project(operator.blur.apply(fine_image(panel, borders)))
    return mean_reading(image, centre_row, centre_col, side)


def true_dots(
    operator: RelayOperator, borders: Doubles, centre_row: Ints, centre_col: Ints, reach: int, side: int = 1
) -> list[Dots]:
    """Dot lattices seen through fringing and the true operator, without veil: enough for a fit.

    Parameters
    ----------
    operator : RelayOperator
        From the fine panel grid to the CCD.
    borders : ndarray of shape (fine cells to a panel pixel, 3), float64
        From :func:`optsim.optics.fringing.border_shares`.
    centre_row, centre_col : ndarray of shape (v, u), int64
        Pixel map: CCD row and column of each panel pixel.
    reach : int
        Least distance of a dot from the panel's edge.
    side : int
        Side of the readout window, CCD pixels.
    """
    rows, cols = centre_row.shape
    ccd_pixels = centre_row, centre_col, side
    flat = np.maximum(seen_by_ccd_pixels(np.ones((rows, cols)), operator, borders, *ccd_pixels), 1e-30)
    found: list[Dots] = []
    n_dots = 0
    # One lattice suffices on a large panel; on a small one it has fewer dots than the fit has terms.
    for shift in range(_SPACING**2):
        v, u = _places(rows, reach, shift // _SPACING), _places(cols, reach, shift % _SPACING)
        if v.size and u.size:
            lit = np.zeros((rows, cols))
            lit[np.ix_(v, u)] = 1
            found.append(Dots(v, u, seen_by_ccd_pixels(lit, operator, borders, *ccd_pixels) / flat))
            n_dots += v.size * u.size
        if n_dots >= _ENOUGH * len(_EVERY_POWER):
            break
    return found


def _terms(offset_px: Doubles, powers: Sequence[tuple[int, ...]]) -> Doubles:
    rows, cols = offset_px.shape[:2]
    y, x = np.linspace(-1, 1, rows), np.linspace(-1, 1, cols)
    terms = np.empty((rows, cols, len(powers)))
    for k, (i, j, m, n) in enumerate(powers):
        terms[..., k] = (offset_px[..., 0] * _SCALE) ** i * (offset_px[..., 1] * _SCALE) ** j
        terms[..., k] *= y[:, None] ** m * x**n
    return terms


def _places(n: int, reach: int, shift: int) -> Ints:
    """Positions of the dots along an axis; the first lattice is as central as possible."""
    first = ((n - 2 * reach) % _SPACING // 2 + shift) % _SPACING
    return np.arange(reach + first, n - reach, _SPACING)
