"""Frames of static light, merged pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import (
    LEAST_EXPOSURE,
    Crosstalk,
    DemixedFrame,
    SaturationPrior,
    demix,
    noise_variance,
    predicted_variance,
)
from optsim.core.quantities import Bools, Doubles, Floats
from optsim.decoding.hidden_light import estimate_by_glare
from optsim.decoding.joint_merge import solved_together

# Saturated neighbours and the samples between them are estimated from each other. Where that doesn't converge
# (to these standard deviations) they are solved jointly, with all pixels to which they add such a share of
# light.
_PASSES = 3
_SETTLED_SIGMAS = 0.1
_COUPLED = 0.01
# Rounds of estimating hidden regions from glare, and rounds with a factor for each region; tolerance of both,
# and frames needed.
_GLARE_ROUNDS, _APART, _SAME_FACTOR, _PERIOD = 6, 2, 0.02, 4


@dataclass(frozen=True, eq=False)
class Merged:
    """Joint estimate of each pixel from several frames; arrays (v, u)."""

    mean: Floats  # Irradiance, W m^-2; noise may make it negative.
    # Variance of the mean for an irradiance like ``mean``, nowhere negative, W^2 m^-4.
    variance: Callable[[Floats], Floats]
    found: Bools  # Pixels with an unsaturated sample.
    floor: Floats  # Lower bound from saturated samples, W m^-2.
    tainted: Floats  # Share of the kernel on pixels of unknown light.


def merged(
    calibration: Calibration,
    samples: Sequence[DemixedFrame],
    alive: Sequence[Bools],
    floor: Floats,
    crosstalk: Crosstalk,
) -> Merged:
    """Merge the frames in which a pixel was static."""
    usable = [
        ok & s.valid & ~s.saturated & (s.exposure > LEAST_EXPOSURE)
        for s, ok in zip(samples, alive, strict=True)
    ]
    found = np.logical_or.reduce(usable)
    certainty = _sum([s.exposure for s in samples], usable)
    mean = _ratio(_sum([s.signal for s in samples], usable), certainty)
    change = np.zeros_like(mean)
    by_glare = np.zeros(mean.shape)
    guess = partial(_pass, calibration, usable=usable, found=found, crosstalk=crosstalk)
    for _ in range(_PASSES):
        samples, certainty, change = guess(samples, mean, floor=floor)
        mean += change
    if crosstalk == "undone":
        # Until a mosaic's whole period has measured a light, the bounds of its pixels follow their codes.
        hidden = ~found & (floor > 0) & np.logical_and.reduce(alive)
        for done in range(_GLARE_ROUNDS if hidden.any() and len(samples) >= _PERIOD else 0):
            # Regions compete: further separate factors would fit the errors of earlier rounds.
            factor, by_glare = estimate_by_glare(
                calibration, samples, alive, usable, mean, floor, hidden, apart=done < _APART
            )
            floor = floor * factor
            if np.abs(factor - 1).max() < _SAME_FACTOR:
                break
            samples, certainty, change = guess(samples, mean, floor=floor)
            mean += change
        together = _unsettled(calibration, samples, alive, found, mean, np.abs(change) * np.sqrt(certainty))
        if together.any():
            mean = solved_together(calibration, samples, alive, usable, mean, floor, together)
            # The hidden regions change the stray light of all pixels.
            _, certainty, change = guess(samples, mean, floor=floor)
            mean += np.where(together, 0, change)
    tainted = np.zeros_like(mean)
    for sample, use in zip(samples, usable, strict=True):
        unknown = (sample.saturated & ~found).astype(np.float32)
        tainted = np.maximum(tainted, np.where(use, calibration.spread(unknown[None])[0], 0))

    def variance(light: Floats) -> Floats:
        each = _variances(calibration, samples, light, crosstalk)
        certainty = _sum([s.exposure**2 / v for s, v in zip(samples, each, strict=True)], usable)
        return (_ratio(np.ones(light.shape), certainty) + by_glare**2).astype(np.float32)

    return Merged(mean, variance, found, floor, tainted)


def _pass(
    calibration: Calibration,
    samples: Sequence[DemixedFrame],
    mean: Floats,
    *,
    usable: Sequence[Bools],
    found: Bools,
    floor: Floats,
    crosstalk: Crosstalk,
) -> tuple[Sequence[DemixedFrame], Doubles, Floats]:
    """Demix the frames by the pooled estimate; its certainty, one over its variance, and its change."""
    light = np.maximum(mean, 0)
    if crosstalk == "undone":
        # Subtract the crosstalk of saturated pixels by the pooled estimate of their light.
        known = SaturationPrior(np.where(found, mean, np.float32(np.nan)), np.where(found, 0, floor))
        samples = [demix(calibration, s, known) for s in samples]
    pairs = list(zip(samples, _variances(calibration, samples, light, crosstalk), strict=True))
    certainty = _sum([s.exposure**2 / variance for s, variance in pairs], usable)
    top = _sum([s.signal * s.exposure / variance for s, variance in pairs], usable)
    return samples, certainty, np.where(found, _ratio(top, certainty) - mean, np.float32(0))


def _variances(
    calibration: Calibration, samples: Sequence[DemixedFrame], light: Floats, crosstalk: Crosstalk
) -> list[Floats]:
    """Variances of the frames' signals for this light, which is nowhere negative."""
    if crosstalk == "undone":
        return [predicted_variance(calibration, s.exposure, light) for s in samples]
    return [noise_variance(calibration, light * s.exposure) for s in samples]


def _unsettled(
    calibration: Calibration,
    samples: Sequence[DemixedFrame],
    alive: Sequence[Bools],
    found: Bools,
    mean: Floats,
    sigmas: Doubles,
) -> Bools:
    """Pixels whose estimate changes by saturated neighbours or contradicts saturation, and those around."""
    bright = np.zeros(calibration.shape, np.bool_)
    short = bright.copy()
    for sample, ok in zip(samples, alive, strict=True):
        saturated = ok & sample.valid & sample.saturated
        light = np.where(ok & found, np.maximum(mean, 0) * sample.exposure, sample.signal)
        short |= found & saturated & (calibration.mix(light) < sample.measured)
        bright |= saturated

    def around(pixels: Bools) -> Bools:
        return calibration.spread(pixels[None].astype(np.float32))[0] > _COUPLED

    result = found & around(short | (sigmas > _SETTLED_SIGMAS) & around(bright))
    # Pixels that no frame measured follow from their surroundings.
    return result | bright & ~found & around(result)


def _ratio(top: Doubles, bottom: Doubles) -> Floats:
    return np.divide(top, bottom, out=np.zeros_like(top), where=bottom > 0).astype(np.float32)


def _sum(images: Sequence[Floats], usable: Sequence[Bools]) -> Doubles:
    total = np.zeros(usable[0].shape)
    for image, ok in zip(images, usable, strict=True):
        total += np.where(ok, image, 0)
    return total
