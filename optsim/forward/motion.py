# pyright: reportUnknownMemberType=false, reportMissingTypeStubs=false
"""Has a pixel changed between two coded frames? Frame subtraction after the codes are divided out.

The paper subtracts two frames compensated with their codes, thresholds and dilates (section 3.1). Two
exposures of one pixel differ even where nothing moves: by noise, and by what the calibration does not
know. So the difference is compared with its own standard deviation, and a saturated sample is what it
is: a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np

from optsim.quantities import Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class Bounds:
    """What one coded frame says of the mean irradiance of each pixel.

    Parameters
    ----------
    low, high : ndarray of shape (v, u), float32
        Bounds on the irradiance, W m^-2: equal where the pixel was measured; ``high`` is infinite where it
        saturated, ``low`` is minus infinite where a saturated neighbour's light could not be removed.
    variance : ndarray of shape (v, u), float32
        Variance of a finite bound by noise and model error, (W m^-2)^2.
    exposure : ndarray of shape (v, u), float32
        Sum over the slots of the weights, slots.
    shot : ndarray of shape (v, u), float32
        Growth of the variance with the irradiance, W m^-2.
    valid : ndarray of shape (v, u), bool
        False where the frame says nothing.
    """

    low: Floats
    high: Floats
    variance: Floats
    exposure: Floats
    shot: Floats
    valid: Bools


def bounds(
    signal: Floats,
    exposure: Floats,
    variance: Floats,
    electron: Floats,
    saturated: Bools,
    tainted: Bools,
    valid: Bools,
    *,
    gain_uncertainty: float,
    exposure_uncertainty: float,
    map_residual_px: float,
) -> Bounds:
    """Divide a frame by its code and say how far the quotient can be trusted.

    Model error: ``gain_uncertainty E``, plus ``exposure_uncertainty E`` over the exposure, plus the change
    of the signal over ``map_residual_px``; added in squares, as independent.

    Parameters
    ----------
    signal : ndarray of shape (v, u), float32
        Sum over the slots of weight times irradiance, W m^-2 slots.
    exposure : ndarray of shape (v, u), float32
        Sum over the slots of the weights, slots.
    variance : ndarray of shape (v, u), float32
        Noise variance of the signal, its unit squared.
    electron : ndarray of shape (v, u), float32
        Signal of one electron, W m^-2 slots: its shot noise per unit of signal.
    saturated, tainted, valid : ndarray of shape (v, u), bool
        Signal is a lower bound; signal holds light of a saturated neighbour; signal means something.
    gain_uncertainty : float
        Relative standard uncertainty of a pixel's responsivity.
    exposure_uncertainty : float
        Standard uncertainty of the exposure, slots (for example of what a dark panel leaks).
    map_residual_px : float
        Standard uncertainty of the pixel's place, panel pixels.
    """
    usable = valid & (exposure > 1e-6)
    per_slot = np.where(usable, exposure, np.float32(1))
    mean = np.where(usable, signal / per_slot, 0).astype(np.float32)
    error = variance / per_slot**2
    error += (gain_uncertainty * mean) ** 2 + (exposure_uncertainty * mean / per_slot) ** 2
    error += (map_residual_px * _slope(signal) / per_slot) ** 2
    infinite = np.float32(np.inf)
    low = np.where(tainted & ~saturated, -infinite, mean)
    high = np.where(saturated, infinite, mean)
    shot = (electron / per_slot).astype(np.float32)
    return Bounds(low, high, error.astype(np.float32), per_slot, shot, usable)


def _slope(image: Floats) -> Floats:
    """Root mean square of the steps to the four neighbours, per axis combined, per pixel.

    One-sided steps: a central difference would not see a mosaic that alternates from pixel to pixel.
    """
    squared = np.zeros_like(image)
    for axis in (0, 1):
        padding = [(1, 1) if a == axis else (0, 0) for a in (0, 1)]
        steps = np.diff(np.pad(image, padding, mode="edge"), axis=axis) ** 2
        before, after = (steps[:-1], steps[1:]) if axis == 0 else (steps[:, :-1], steps[:, 1:])
        squared += (before + after) / 2
    return np.sqrt(squared)


def changed(first: Bounds, second: Bounds, threshold_sigma: float) -> tuple[Bools, Bools]:
    """Compare two frames: motion only where their intervals lie apart.

    If nothing moved, both frames saw the same light; so the shot noise of two measured samples is that of
    their pooled estimate. That of each by itself is too small wherever noise made the sample small.

    Parameters
    ----------
    first, second : Bounds
        Two frames.
    threshold_sigma : float
        Gap that counts, in standard deviations of the difference. For two measured samples of a static
        pixel with Gaussian noise the false-alarm rate is ``erfc(threshold_sigma / sqrt 2)``.

    Returns
    -------
    changed : ndarray of shape (v, u), bool
        The pixel is not the same.
    undecided : ndarray of shape (v, u), bool
        Nothing to compare: no sample, or both are bounds on the same side.
    """
    undecided = ~(first.valid & second.valid)
    undecided |= np.isinf(first.high) & np.isinf(second.high)
    undecided |= np.isinf(first.low) & np.isinf(second.low)
    gap = np.maximum(first.low - second.high, second.low - first.high)
    sigma = np.sqrt(np.maximum(_pooled_variance(first, second), 1e-30))
    return (gap > threshold_sigma * sigma) & ~undecided, undecided


def _pooled_variance(first: Bounds, second: Bounds) -> Floats:
    measured = np.isfinite(first.low) & np.isfinite(first.high)
    measured &= np.isfinite(second.low) & np.isfinite(second.high)
    means = [np.where(measured, frame.high, 0) for frame in (first, second)]
    pooled = (means[0] * first.exposure + means[1] * second.exposure) / (first.exposure + second.exposure)
    total = first.variance + second.variance
    for frame, mean in zip((first, second), means, strict=True):
        total = total + frame.shot * (np.maximum(pooled, 0) - np.maximum(mean, 0))
    return total


def without_specks(mask: Bools, least_px: int) -> Bools:
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


def grown(mask: Bools, reach_px: int) -> Bools:
    """Dilate by a square: every pixel within ``reach_px`` rows and columns of the mask."""
    if reach_px == 0:
        return mask
    from scipy import ndimage

    return cast("Callable[..., Bools]", ndimage.maximum_filter)(mask, size=2 * reach_px + 1)
