"""Change detection: test whether a pixel's irradiance changed between two coded frames.

The paper subtracts two frames compensated with their codes, thresholds and dilates (section 3.1). Two
exposures of a static pixel still differ, by noise and by calibration errors. So the difference is compared
with its own standard deviation, and a saturated reading is treated as a lower bound. In the dark a pixel's
noise hides all but the strongest change. So means over its surroundings, where noise averages out, are
compared too.
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
class IrradianceInterval:
    """Interval of each pixel's mean irradiance, from one coded frame.

    Parameters
    ----------
    low, high : ndarray of shape (v, u), float32
        Bounds on the irradiance, W m^-2: equal where the pixel was measured; ``high`` is infinite where it
        saturated, ``low`` is minus infinite where a saturated neighbour's light could not be removed.
    variance : ndarray of shape (v, u), float32
        Variance of a finite bound by noise and model error, (W m^-2)^2.
    shared : ndarray of shape (v, u), float32
        Part of it that neighbouring pixels may share, so that it remains in their mean: model error.
    stray : ndarray of shape (v, u)
        Additional variance by light that doesn't depend on the pixels' own codes. Only means over squares use
        it: a detectable change of a single pixel is far greater.
    exposure : ndarray of shape (v, u), float32
        Sum over the slots of the weights, slots.
    shot : ndarray of shape (v, u), float32
        Growth of the variance with the irradiance, W m^-2.
    valid : ndarray of shape (v, u), bool
        False where the frame has no measurement.
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
        """Pixels that were measured on both sides, not only bounded."""
        return self.valid & np.isfinite(self.low) & np.isfinite(self.high)

    def replaced(self, where: Bools, by: IrradianceInterval) -> IrradianceInterval:
        """Replace some pixels by those of another frame."""
        mixed: dict[str, Any] = {
            f.name: np.where(where, getattr(by, f.name), getattr(self, f.name)) for f in fields(self)
        }
        return IrradianceInterval(**mixed)


def irradiance_interval(
    signal: Floats,
    exposure: Floats,
    variance: Floats,
    common: Floats,
    electron: Floats,
    saturated: Bools,
    tainted: Bools,
    valid: Bools,
    *,
    gain_uncertainty: float,
    exposure_uncertainty: float,
    map_residual_px: float,
) -> IrradianceInterval:
    """Divide a frame by its exposure, with the error of the quotient.

    Model error: ``gain_uncertainty E``, plus ``exposure_uncertainty E`` over the exposure, plus the change of
    the signal over ``map_residual_px``; added in squares, as independent.

    Parameters
    ----------
    signal : ndarray of shape (v, u), float32
        Sum over the slots of weight times irradiance, W m^-2 slots.
    exposure : ndarray of shape (v, u), float32
        Sum over the slots of the weights, slots.
    variance : ndarray of shape (v, u), float32
        Variance of the signal by noise and errors that pixels share, its unit squared.
    common : ndarray of shape (v, u), float32
        Part of it that pixels may share: rounding, and the ambiguous origin of crosstalk.
    electron : ndarray of shape (v, u), float32
        Signal of one electron, W m^-2 slots: its shot noise per unit of signal.
    saturated, tainted, valid : ndarray of shape (v, u), bool
        Signal is a lower bound; signal includes light of a saturated neighbour; signal is valid.
    gain_uncertainty : float
        Relative standard uncertainty of a pixel's responsivity.
    exposure_uncertainty : float
        Standard uncertainty of the exposure, slots (for example by the leak of a dark panel).
    map_residual_px : float
        Standard uncertainty of the pixel's position, panel pixels.
    """
    usable = valid & (exposure > 1e-6)
    per_slot = np.where(usable, exposure, np.float32(1))
    mean = np.where(usable, signal / per_slot, 0).astype(np.float32)
    shared = common / per_slot**2
    shared += (gain_uncertainty * mean) ** 2 + (exposure_uncertainty * mean / per_slot) ** 2
    shared += (map_residual_px * _slope(signal) / per_slot) ** 2
    whole = (variance - common) / per_slot**2 + shared
    infinite = np.float32(np.inf)
    low = np.where(tainted & ~saturated, -infinite, mean)
    high = np.where(saturated, infinite, mean)
    shot = (electron / per_slot).astype(np.float32)
    stray = stray_light(signal, exposure, variance, electron, usable & ~saturated & ~tainted) / per_slot
    return IrradianceInterval(
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
    """Root mean square of the steps to the four neighbours, combined over the axes, per pixel."""
    # One-sided steps: a central difference would miss a mosaic that alternates from pixel to pixel.
    squared = np.zeros_like(image)
    for axis in (0, 1):
        padding = [(1, 1) if a == axis else (0, 0) for a in (0, 1)]
        steps = np.diff(np.pad(image, padding, mode="edge"), axis=axis) ** 2
        before, after = (steps[:-1], steps[1:]) if axis == 0 else (steps[:, :-1], steps[:, 1:])
        squared += (before + after) / 2
    return np.sqrt(squared)


def changed(
    first: IrradianceInterval,
    second: IrradianceInterval,
    threshold_sigma: float | Floats,
    *,
    reaches_px: Sequence[int] = (1, 2),
    least_change: float = 0.0,
) -> tuple[Bools, Bools]:
    """Compare two frames: a pixel changed if its intervals, or those of its surroundings, do not overlap.

    If nothing moved, both frames had the same light. So the shot noise of two measured values is that of
    their pooled estimate. The estimate from each alone is too small wherever noise made the value small.

    A change hidden in a single pixel's noise shows in the mean difference over its surroundings, weighted by
    precision. Noise averages out. Model error doesn't: it counts as equal in all of them.

    Parameters
    ----------
    first, second : IrradianceInterval
        Two frames.
    threshold_sigma : float or ndarray of shape (v, u)
        Gap that counts as a change, in standard deviations of the difference. For two measured values of a
        static pixel with Gaussian noise the false-alarm rate of each test is ``erfc(threshold_sigma / sqrt
        2)``.
    reaches_px : sequence of int
        Half sides of the squares around a pixel whose means are compared too.
    least_change : float
        Least relative change of such a square. For a single pixel every change counts.

    Returns
    -------
    changed : ndarray of shape (v, u), bool
        The pixel has changed.
    undecided : ndarray of shape (v, u), bool
        Nothing to compare: no measurement, or two bounds on the same side.
    """
    undecided = ~(first.valid & second.valid)
    undecided |= np.isinf(first.high) & np.isinf(second.high)
    undecided |= np.isinf(first.low) & np.isinf(second.low)
    gap = np.maximum(first.low - second.high, second.low - first.high)
    pair = _pair(first, second)
    sigma = np.sqrt(np.maximum(pair.noise + pair.shared, 1e-30))
    moved = (gap > threshold_sigma * sigma) & ~undecided
    for reach_px in reaches_px:
        # A changed pixel would trigger all squares around it again.
        rest = replace(pair, measured=pair.measured & ~moved)
        together = _changed_together(rest, threshold_sigma, least_change, reach_px)
        moved |= together
        undecided &= ~together
    return moved, undecided


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two measurements of each pixel, where both exist; arrays (v, u)."""

    measured: Bools  # Whether both exist.
    difference: Reals  # First minus second; 0 elsewhere.
    mean: Reals  # Their pooled estimate, not negative.
    shared: Reals  # Variance of the difference by model error.
    stray: Reals  # The same by stray light.
    read: Reals  # Variance of the difference by noise without light.
    shot: Reals  # Growth of this variance with the irradiance.

    @property
    def noise(self) -> Reals:
        """Variance of the difference by noise, if both had the mean irradiance."""
        return self.read + self.shot * self.mean


def _pair(first: IrradianceInterval, second: IrradianceInterval) -> _Pair:
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


def _changed_together(
    pair: _Pair, threshold_sigma: float | Floats, least_change: float, reach_px: int
) -> Bools:
    """Whether the weighted mean difference over the surroundings exceeds its error."""
    around = partial(sum_around, reach_px=reach_px)
    light = around(pair.mean * pair.measured) / np.maximum(around(pair.measured.astype(np.float32)), 1)
    # The weights exclude each pixel's own noise: it would bias the mean towards values that chance made
    # small.
    common = pair.shared + pair.stray
    even = (pair.read + pair.shot * light + common).astype(np.float64)
    weights = np.where(pair.measured, 1 / np.maximum(even, 1e-30), 0)
    noise = around(weights**2 * pair.noise)
    shared = around(weights * np.sqrt(common))
    change = np.abs(around(weights * pair.difference))
    enough = change > least_change * around(weights * pair.mean)
    return enough & (change > threshold_sigma * np.sqrt(noise + shared**2))
