"""Has a pixel changed between two coded frames? Frame subtraction after the codes are divided out.

The paper subtracts two frames compensated with their codes, thresholds and dilates (section 3.1). Two
exposures of one pixel differ even where nothing moves: by noise, and by what the calibration does not
know. So the difference is compared with its own standard deviation, and a saturated sample is what it
is: a lower bound. In the dark a pixel's own noise hides all but the strongest change, and the mean over its
surroundings, in which noise averages out, is compared too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np

from optsim.core.quantities import Bools, Floats
from optsim.optics.neighbourhoods import Reals, sum_around
from optsim.optics.stray_light import stray_light


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
    shared : ndarray of shape (v, u), float32
        Part of it that may be the same in neighbouring pixels, so that their mean has it too: model error.
    stray : ndarray of shape (v, u)
        Variance, beside the other, by light that doesn't depend on the pixels' own codes. Squares count it; a
        pixel's own change is so much greater where it is seen at all.
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
    shared: Floats
    stray: Reals
    exposure: Floats
    shot: Floats
    valid: Bools

    @property
    def measured(self) -> Bools:
        """Where there is a sample, and it is more than a bound."""
        return self.valid & np.isfinite(self.low) & np.isfinite(self.high)

    def replaced(self, where: Bools, by: Bounds) -> Bounds:
        """With what another frame says of some pixels."""
        mixed: dict[str, Any] = {
            f.name: np.where(where, getattr(by, f.name), getattr(self, f.name)) for f in fields(self)
        }
        return Bounds(**mixed)


def bounds(
    signal: Floats,
    exposure: Floats,
    variance: Floats,
    alike: Floats,
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
        Variance of the signal by noise and what pixels have in common, its unit squared.
    alike : ndarray of shape (v, u), float32
        Part of it that pixels may have in common: rounding, and not knowing whose light crosstalk brings.
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
    shared = alike / per_slot**2
    shared += (gain_uncertainty * mean) ** 2 + (exposure_uncertainty * mean / per_slot) ** 2
    shared += (map_residual_px * _slope(signal) / per_slot) ** 2
    whole = (variance - alike) / per_slot**2 + shared
    infinite = np.float32(np.inf)
    low = np.where(tainted & ~saturated, -infinite, mean)
    high = np.where(saturated, infinite, mean)
    shot = (electron / per_slot).astype(np.float32)
    stray = stray_light(signal, exposure, variance, electron, usable & ~saturated & ~tainted) / per_slot
    return Bounds(
        low,
        high,
        whole.astype(np.float32),
        shared.astype(np.float32),
        stray**2,
        per_slot,
        shot,
        usable,
    )


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


def changed(
    first: Bounds,
    second: Bounds,
    threshold_sigma: float,
    *,
    reaches_px: Sequence[int] = (1, 2),
    least_change: float = 0.0,
) -> tuple[Bools, Bools]:
    """Compare two frames: motion only where their intervals lie apart, of pixels or of their surroundings.

    If nothing moved, both frames saw the same light; so the shot noise of two measured samples is that of
    their pooled estimate. That of each by itself is too small wherever noise made the sample small.

    What is too dark for a single pixel's noise shows in the mean over its surroundings: of the differences
    there, weighted by how well each is known. Noise averages out; model error doesn't (it counts as the
    same in all of them).

    Parameters
    ----------
    first, second : Bounds
        Two frames.
    threshold_sigma : float
        Gap that counts, in standard deviations of the difference. For two measured samples of a static
        pixel with Gaussian noise the false-alarm rate of each test is ``erfc(threshold_sigma / sqrt 2)``.
    reaches_px : sequence of int
        Half sides of the squares around a pixel that are compared too.
    least_change : float
        Change of such a square that counts, relative to its light. Of a single pixel every change counts.

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
    pair = _pair(first, second)
    sigma = np.sqrt(np.maximum(pair.noise + pair.shared, 1e-30))
    moved = (gap > threshold_sigma * sigma) & ~undecided
    for reach_px in reaches_px:
        # What is known to have changed would be seen again in all squares around it.
        rest = replace(pair, measured=pair.measured & ~moved)
        together = _changed_together(rest, threshold_sigma, least_change, reach_px)
        moved |= together
        undecided &= ~together
    return moved, undecided


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two samples of each pixel, as far as both were measured.

    Parameters
    ----------
    measured : ndarray of shape (v, u), bool
        Whether they were.
    difference : ndarray of shape (v, u)
        First less second; 0 elsewhere.
    mean : ndarray of shape (v, u)
        Their pooled estimate, no less than dark.
    shared, stray : ndarray of shape (v, u)
        Variance of the difference by model error, and by stray light.
    read, shot : ndarray of shape (v, u)
        Variance of the difference by noise without light, and its growth with the irradiance.
    """

    measured: Bools
    difference: Reals
    mean: Reals
    shared: Reals
    stray: Reals
    read: Reals
    shot: Reals

    @property
    def noise(self) -> Reals:
        """Variance of the difference by noise, if both saw the mean."""
        return self.read + self.shot * self.mean


def _pair(first: Bounds, second: Bounds) -> _Pair:
    frames = (first, second)
    measured = first.measured & second.measured
    means = [np.where(measured, frame.high, 0) for frame in frames]
    pooled = (means[0] * first.exposure + means[1] * second.exposure) / (first.exposure + second.exposure)
    reads = [
        np.maximum(f.variance - f.shared - f.shot * np.maximum(own, 0), 0)
        for f, own in zip(frames, means, strict=True)
    ]
    return _Pair(
        measured,
        means[0] - means[1],
        np.maximum(pooled, 0),
        first.shared + second.shared,
        first.stray + second.stray,
        reads[0] + reads[1],
        first.shot + second.shot,
    )


def _changed_together(pair: _Pair, threshold_sigma: float, least_change: float, reach_px: int) -> Bools:
    """Whether the weighted mean difference of the pixels around is more than its error."""
    around = partial(sum_around, reach_px=reach_px)
    light = around(pair.mean * pair.measured) / np.maximum(around(pair.measured.astype(np.float32)), 1)
    # Weights know no pixel's own noise: it would pull the mean towards what chance made certain.
    common = pair.shared + pair.stray
    even = (pair.read + pair.shot * light + common).astype(np.float64)
    weights = np.where(pair.measured, 1 / np.maximum(even, 1e-30), 0)
    noise = around(weights**2 * pair.noise)
    shared = around(weights * np.sqrt(common))
    change = np.abs(around(weights * pair.difference))
    enough = change > least_change * around(weights * pair.mean)
    return enough & (change > threshold_sigma * np.sqrt(noise + shared**2))
