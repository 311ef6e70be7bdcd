# pyright: reportMissingTypeStubs=false
"""Fringing fields: what a pixel's neighbours do to its rim.

The voltage of a pixel does not end at its border, and the liquid crystal is elastic: so the retardance is
blurred across it. Intensity is a bent function of retardance, hence pixels interact; but across a border
between black and white it is known how, whatever the neighbours beyond: with a Gaussian blur of standard
deviation sigma, at a distance x into the black pixel,

    share of the white one's reflectance = sin^2(pi/2 Phi(-x / sigma))

That share is taken for all levels and times, row by column: weights are mixed with those of the
neighbours, linearly. What that leaves out, on grey levels, in corners, in passing from level to level and in
light of which white is no half wave, :mod:`optsim.optics.fringe_correction` finds.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from scipy.special import ndtr

from optsim.core.quantities import Doubles, Floats

R = TypeVar("R", Floats, Doubles)
_STEPS = 2000


def border_shares(sigma_px: float, pitch: int) -> Doubles:
    """Shares of the previous, own and next pixel in the reflectance of each fine cell along an axis.

    Parameters
    ----------
    sigma_px : float
        Standard deviation of the blur of the retardance, panel pixels; at most 0.25, where the rim of the
        next but one pixel is still out of reach.
    pitch : int
        Fine cells to a pixel.

    Returns
    -------
    ndarray of shape (pitch, 3), float64
        Shares of the pixel before, of the pixel itself and of the pixel after; each row sums to 1.
    """
    x = (np.arange(_STEPS * pitch) + 0.5) / (_STEPS * pitch)
    spill = np.sin(np.pi / 2 * ndtr(-x / sigma_px)) ** 2 if sigma_px > 0 else np.zeros_like(x)
    before = spill.reshape(pitch, _STEPS).mean(axis=1)
    after = before[::-1]
    return np.stack([before, 1 - before - after, after], axis=1)


def fine_image(panel: Doubles | Floats, borders: Doubles | Floats) -> Doubles | Floats:
    """Panel values on the fine grid, (v, u, ...) to (y, x, ...), with the neighbours' shares."""
    for axis in (0, 1):
        lines = np.moveaxis(panel, axis, 0)
        # Beyond the panel's edge the nearest pixel counts.
        rulers = np.concatenate([lines[:1], lines[:-1]]), lines, np.concatenate([lines[1:], lines[-1:]])
        shares = borders.T.reshape(3, -1, *[1] * (lines.ndim - 1))
        cells = sum(share * ruler[:, None] for share, ruler in zip(shares, rulers, strict=True))
        panel = np.moveaxis(np.reshape(cells, (-1, *lines.shape[1:])), 0, axis)
    return panel


def fine_image_adjoint(fine: Doubles, borders: Doubles) -> Doubles:
    """Transpose of :func:`fine_image`, (y, x) to (v, u): each sample goes to the pixels that rule over it."""
    for axis in (0, 1):
        lines = np.moveaxis(fine, axis, 0)
        cells = lines.reshape(-1, len(borders), lines.shape[1])
        before, own, after = (np.tensordot(shares, cells, (0, 1)) for shares in borders.T)
        own[:-1] += before[1:]
        own[1:] += after[:-1]
        # Beyond the panel's edge the nearest pixel counts.
        own[0] += before[0]
        own[-1] += after[-1]
        fine = np.moveaxis(own, 0, axis)
    return fine


def whole_cells(panel: R, pitch: int) -> R:
    """Panel values on the fine grid, (v, u) to (y, x), each pixel's own in all of its cells."""
    return panel.repeat(pitch, axis=0).repeat(pitch, axis=1)


def add_whole_cells(fine: Doubles, panel: Doubles) -> None:
    """Add panel values, (v, u), to all cells of each pixel, (y, x), without an array of them."""
    pitch = len(fine) // len(panel)
    wide = panel.repeat(pitch, axis=1)
    for y in range(pitch):
        fine[y::pitch] += wide
