"""Pooling of noisy and unmeasured pixels with their neighbours."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import cast

import numpy as np
from scipy import ndimage  # type: ignore[import-untyped]

from optsim.core.quantities import Bools, Doubles, Floats
from optsim.decoding.partial import positive_mean

# Linear interpolation between the samples of one exposure of a 2 x 2 mosaic, without the pixel itself.
_AROUND = {(0, 1): 0.5, (0, -1): 0.5, (1, 0): 0.5, (-1, 0): 0.5} | dict.fromkeys(
    [(1, 1), (1, -1), (-1, 1), (-1, -1)], 0.25
)
# Six passes more change the PSNR of `night_street` by 0.05 dB.
_PASSES = 4
_LEAST = 1e-30  # of variances, W^2 m^-4: divisions
# Standard deviation of the window for neighbours' differences, pixels, and a first guess of these, over the
# light, for the weights of the pairs. Photographs of
# `validation/static_hdr` change by 0.1 dB with half the window, and by as much with a guess of 0.05 or 0.5.
_WINDOW_PX = 2.0
_GUESS = 0.2
# Standard deviations beyond which a difference is an edge, whatever the window measures.
_SURELY = 2.0
_MOST = 100.0  # largest mean square of the differences, over that of the light


def pooled(
    mean: Floats, variance: Callable[[Floats], Floats], measured: Bools, floor: Floats, contrast: float
) -> tuple[Floats, Floats]:
    """Mean of each pixel and its measured neighbours (up to eight), and its variance.

    Normalised convolution (H. Knutsson and C.-F. Westin, CVPR 1993, doi:10.1109/CVPR.1993.341081): a pixel's
    certainty is one over its variance. A neighbour's certainty is lower by the local difference between
    neighbours: the mean square of the differences minus their noise, as in local statistics (J.-S. Lee, IEEE
    PAMI 2, 1980, doi:10.1109/TPAMI.1980.4766994). So noise is averaged where it dominates, and texture above
    it stays. Means are not made positive before, and variances are those of the pooled light, not of each
    pixel's own: both would bias the dark.
    """
    means, known = np.pad(mean, 1), np.pad(measured, 1)
    evidence = [share * known[around] for share, around in _neighbours(mean.shape)]
    lowest = np.where(floor > 0, floor, np.float32(-np.inf))

    def one_pass(estimate: Floats) -> tuple[Floats, Doubles, Doubles, Floats]:
        """Estimate, its variance under agreement, their agreement, and the pixel's own variance."""
        light = np.maximum(estimate, 0)
        own = np.maximum(variance(light), _LEAST)
        texture = _texture(mean, light, own, measured)
        variances, there, lights = (np.pad(image, 1) for image in (own, estimate, light))
        certainty, total = 1 / own.astype(np.float64), mean / own.astype(np.float64)
        misfit = np.zeros_like(certainty)
        for share, (_, around) in zip(evidence, _neighbours(mean.shape), strict=True):
            apart = np.abs(there[around] - estimate)
            beyond_noise = apart.astype(np.float64) ** 2 - _SURELY**2 * (own + variances[around])
            # An unmeasured pixel's neighbours differ from it by a Laplacian, as for total variation (L. I.
            # Rudin, S. Osher and E. Fatemi, Physica D 60, 1992, doi:10.1016/0167-2789(92)90242-F).
            differ = np.where(
                measured,
                np.maximum(texture * _squares(light, lights[around]), beyond_noise),
                contrast * light * apart,
            )
            weight = share / np.maximum(variances[around] + differ, _LEAST)
            certainty += weight
            total += weight * means[around]
            misfit += weight * (means[around] - estimate) ** 2
        surprise = misfit / np.maximum(sum(evidence), 1)
        return np.maximum((total / certainty).astype(np.float32), lowest), 1 / certainty, surprise, own

    estimate, spread, surprise, own = one_pass(mean)
    for _ in range(_PASSES - 1):
        estimate, spread, surprise, own = one_pass(estimate)
    spread = spread.astype(np.float32)
    light = np.where(measured, positive_mean(estimate, spread), np.maximum(estimate, 0))
    error = np.where(estimate <= lowest, light**2, spread * np.maximum(surprise, 1))
    return light, np.minimum(error, own).astype(np.float32)


def _texture(mean: Floats, light: Floats, own: Floats, measured: Bools) -> Doubles:
    """Mean square of neighbours' differences without their noise, over the squares of both lights."""
    # Least squares in a window, each pair weighted by one over the variance of its squared difference.
    means, lights, variances = (np.pad(image, 1) for image in (mean, light, own))
    known = np.pad(measured, 1)
    excess, squares = np.zeros(mean.shape), np.zeros(mean.shape)
    for share, around in _neighbours(mean.shape):
        scale = _squares(light, lights[around])
        noise = own.astype(np.float64) + variances[around]
        weight = (
            share * (measured & known[around]) / np.maximum(noise + _GUESS**2 * scale, _LEAST) ** 2 * scale
        )
        excess += weight * ((mean.astype(np.float64) - means[around]) ** 2 - noise)
        squares += weight * scale
    window = cast("Callable[..., Doubles]", ndimage.gaussian_filter)
    above, below = (window(image, _WINDOW_PX, truncate=3) for image in (excess, squares))
    return np.clip(np.divide(above, below, out=np.zeros_like(below), where=below > 0), 0, _MOST)


def _squares(one: Floats, other: Floats) -> Doubles:
    return one.astype(np.float64) ** 2 + other.astype(np.float64) ** 2


def _neighbours(shape: tuple[int, ...]) -> Iterator[tuple[float, tuple[slice, slice]]]:
    """Weight of each neighbour, and its place in an image padded by one."""
    rows, cols = shape
    for (row, col), share in _AROUND.items():
        yield share, (slice(1 + row, 1 + row + rows), slice(1 + col, 1 + col + cols))
