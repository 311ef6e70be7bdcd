# pyright: reportMissingTypeStubs=false
"""One picture a frame, from the last few in which a pixel stood still (equation 7 of the paper)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, cast

import numpy as np
from pydantic import Field

from optsim.calibrate.calibration import Calibration
from optsim.calibrate.sample import (
    LEAST_EXPOSURE,
    Brightness,
    Crosstalk,
    Sample,
    nearest,
    noise_variance,
    predicted_variance,
    sample_bounds,
    sampled,
    separate,
)
from optsim.forward.motion import Bounds, changed
from optsim.forward.neighbourhoods import without_specks
from optsim.quantities import Bools, CodedFrame, Doubles, Floats
from optsim.reconstruct.hidden_light import told_by_glare
from optsim.reconstruct.joint_merge import solved_together
from optsim.reconstruct.layer import Branch, Layer, positive_mean

# Saturated neighbours and the samples between them are estimated from each other. Where that doesn't settle
# (to these standard deviations) they are found together, with all to which they bring such a share of light.
_PASSES = 3
_SETTLED_SIGMAS = 0.1
_COUPLED = 0.01
# How often glare is asked how bright hidden regions are, and how often each by itself; when that has settled;
# and how many frames it takes.
_GLARE_ROUNDS, _APART, _SAME_FACTOR, _PERIOD = 6, 2, 0.02, 4


class HdrMerge(Branch):
    """Merge all unsaturated samples of a pixel since it last changed.

    The estimate is the weighted least-squares one, ``sum(W I / var) / sum(W^2 / var)``, which is
    ``sum(I) / sum(W)`` where shot noise rules, and then the mean of what it may be without negative light.
    The variances are predicted from the pooled estimate, not from each sample: weights that follow a sample's
    own noise would bias dark pixels. Beside a pixel that gets far more light they are those of the crosstalk
    (:func:`~optsim.calibrate.sample.attribution_variance`): there long exposures are trusted, short ones not.
    Any code counts, the paper's mosaic or another. The uncertainty, ``sum(W^2 / var) ** -0.5``, holds no
    other errors of the calibration, nor motion that nobody noticed; but it holds what is left of glare, and
    what a narrow pick may miss of light that changes within a pixel.

    What saturates in every frame is as bright as its glare says, region by region
    (:func:`~optsim.reconstruct.hidden_light.told_by_glare`), or just bright enough to saturate. What is
    filled is as uncertain as bright.

    Parameters
    ----------
    n_frames : int
        Frames looked back, the present one included; 4 is the period of the mosaic.
    threshold_sigma : float
        A frame that differs from newer ones by more is not merged, nor any before it.
    speck_px : int
        Differing regions of fewer pixels are taken for noise. A false alarm may leave a dark pixel nothing
        but its shortest exposure, so single pixels are not believed.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the frames or added to the weights.
    taint_tolerance : float
        Pixels are not valid where the kernel brings more than this share of neighbours that never had an
        unsaturated sample: these may hide any amount of light. 0.005 is a sensible default (no source).
    paper_literal : bool
        Equation (7) as printed, divided by 4: the mean of I / S over the frames, without a test for
        saturation or for change, with row-summed weights; for comparison.
    """

    kind: Literal["hdr_merge"] = "hdr_merge"
    n_frames: int = Field(default=4, ge=1, le=16)
    threshold_sigma: float = Field(default=4.0, gt=0)
    speck_px: int = Field(default=2, ge=1)
    crosstalk: Crosstalk = "undone"
    taint_tolerance: float = Field(default=0.005, ge=0)
    paper_literal: bool = False

    def layers(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Layer]:
        """As :meth:`decode`: one image a frame."""
        recent: deque[_Kept] = deque(maxlen=self.n_frames)
        crosstalk: Crosstalk = "row_summed" if self.paper_literal else self.crosstalk
        for frame, sample in sampled(frames, calibration, crosstalk):
            recent.appendleft(_Kept(sample, sample_bounds(calibration, sample)))
            samples = [kept.sample for kept in recent]
            if self.paper_literal:
                least = _least(samples, [kept.sample.valid for kept in recent])
                mean, variance, found = _literal(samples)
                valid, alive = sample.valid, [kept.sample.valid for kept in recent]
            else:
                alive = _unchanged([kept.bounds for kept in recent], self.threshold_sigma, self.speck_px)
                least = _least(samples, alive)
                mean, variance, found, tainted, least = _merged(calibration, samples, alive, least, crosstalk)
                valid = sample.valid & (tainted <= self.taint_tolerance)
                mean = positive_mean(mean, variance)
            valid &= np.logical_or.reduce(
                [ok & (s.exposure > LEAST_EXPOSURE) for s, ok in zip(samples, alive, strict=True)]
            )
            mean = _filled(mean, found, least)
            error = np.sqrt(variance + within_pixels(mean, calibration.ratio) ** 2)
            yield Layer(
                frame.index,
                mean[None],
                np.ones(calibration.shape, np.float32),
                valid,
                ~found & sample.valid,
                np.zeros(calibration.shape, np.bool_),
                calibration.slots_per_frame,
                np.where(found, error, np.abs(mean)).astype(np.float32)[None],
            )


@dataclass(frozen=True, eq=False)
class _Kept:
    sample: Sample
    bounds: Bounds


def _unchanged(recent: Sequence[Bounds], threshold_sigma: float, speck_px: int) -> list[Bools]:
    """Which pixels of each frame, newest first, agree with all that is known of them since."""
    newest = recent[0]
    alive = np.ones_like(newest.valid)
    result = [alive]
    for older in recent[1:]:
        moved, _ = changed(newest, older, threshold_sigma)
        alive = alive & ~without_specks(moved, speck_px)
        result.append(alive)
        # Where the newest is only a bound, the newest real sample is the better judge of older ones.
        newest = newest.replaced(alive & older.measured & ~newest.measured, older)
    return result


def _merged(
    calibration: Calibration,
    samples: Sequence[Sample],
    alive: Sequence[Bools],
    least: Floats,
    crosstalk: Crosstalk,
) -> tuple[Floats, Floats, Bools, Floats, Floats]:
    """Pooled estimate, its variance, where there is one, the unknown share of the kernel, and least light."""
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
        samples, certainty, change = guess(samples, mean, least=least)
        mean += change
    if crosstalk == "undone":
        # Before all frames of a mosaic's period have seen a light, its pixels' bounds follow their codes.
        hidden = ~found & (least > 0) & np.logical_and.reduce(alive)
        for done in range(_GLARE_ROUNDS if hidden.any() and len(samples) >= _PERIOD else 0):
            # Regions compete: told apart more often, they are so by the errors of the rounds before.
            factor, by_glare = told_by_glare(
                calibration, samples, alive, usable, mean, least, hidden, apart=done < _APART
            )
            least = least * factor
            if np.abs(factor - 1).max() < _SAME_FACTOR:
                break
            samples, certainty, change = guess(samples, mean, least=least)
            mean += change
        together = _unsettled(calibration, samples, alive, found, mean, np.abs(change) * np.sqrt(certainty))
        if together.any():
            mean = solved_together(calibration, samples, alive, usable, mean, least, together)
            # What they are changes the stray light of all.
            _, certainty, change = guess(samples, mean, least=least)
            mean += np.where(together, 0, change)
    tainted = np.zeros_like(mean)
    for sample, use in zip(samples, usable, strict=True):
        unknown = (sample.saturated & ~found).astype(np.float32)
        tainted = np.maximum(tainted, np.where(use, calibration.spread(unknown[None])[0], 0))
    variance = _ratio(np.ones(mean.shape), certainty) + by_glare**2
    return mean, variance.astype(np.float32), found, tainted, least


def _pass(
    calibration: Calibration,
    samples: Sequence[Sample],
    mean: Floats,
    *,
    usable: Sequence[Bools],
    found: Bools,
    least: Floats,
    crosstalk: Crosstalk,
) -> tuple[Sequence[Sample], Doubles, Floats]:
    """Separate the frames by the pooled estimate; its certainty, one over its variance, and its change."""
    light = np.maximum(mean, 0)
    if crosstalk == "undone":
        # Saturated pixels leak into their neighbours what the pooled estimate says that they got.
        known = Brightness(np.where(found, mean, np.float32(np.nan)), np.where(found, 0, least))
        samples = [separate(calibration, s, known) for s in samples]
        variances = [predicted_variance(calibration, s.exposure, light) for s in samples]
    else:
        variances = [noise_variance(calibration, light * s.exposure) for s in samples]
    pairs = list(zip(samples, variances, strict=True))
    certainty = _sum([s.exposure**2 / variance for s, variance in pairs], usable)
    top = _sum([s.signal * s.exposure / variance for s, variance in pairs], usable)
    return samples, certainty, np.where(found, _ratio(top, certainty) - mean, np.float32(0))


def _unsettled(
    calibration: Calibration,
    samples: Sequence[Sample],
    alive: Sequence[Bools],
    found: Bools,
    mean: Floats,
    sigmas: Doubles,
) -> Bools:
    """Where the estimate still changes by saturated neighbours or contradicts saturation, and around it."""
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
    # What no frame measured is found from what lies around it.
    return result | bright & ~found & around(result)


def within_pixels(irradiance: Floats, ratio: float) -> Floats:
    """How far the middle of each pixel is off its mean, where light changes within pixels.

    A pick is a ratio narrower than its panel pixel. Of light that curves by E'' over a pixel the mean over a
    width w is E''/2 w^2/12 more than in the middle, along each axis; the curvature is that between pixels.

    Parameters
    ----------
    irradiance : ndarray of shape (v, u), float32
        W m^-2.
    ratio : float
        CCD pixels to a panel pixel.
    """
    from scipy import ndimage

    laplace = cast("Callable[..., Floats]", ndimage.laplace)
    return np.abs(laplace(irradiance, mode="nearest")) * np.float32((1 - ratio**-2) / 24)


def _ratio(top: Doubles, bottom: Doubles) -> Floats:
    return np.divide(top, bottom, out=np.zeros_like(top), where=bottom > 0).astype(np.float32)


def _sum(images: Sequence[Floats], usable: Sequence[Bools]) -> Doubles:
    total = np.zeros(usable[0].shape)
    for image, ok in zip(images, usable, strict=True):
        total += np.where(ok, image, 0)
    return total


def _literal(samples: Sequence[Sample]) -> tuple[Floats, Floats, Bools]:
    """Mean of I / S over the frames, no less than none, and its variance."""
    quotients = [s.signal / np.maximum(s.exposure, 1e-6) for s in samples]
    variances = [s.variance / np.maximum(s.exposure, 1e-6) ** 2 for s in samples]
    variance = np.mean(variances, axis=0) / len(samples)
    mean = np.maximum(np.mean(quotients, axis=0), 0)
    return mean.astype(np.float32), variance.astype(np.float32), samples[0].valid


def _least(samples: Sequence[Sample], alive: Sequence[Bools]) -> Floats:
    """Greatest of what saturated samples say that there is at least."""
    return np.max([np.where(ok, s.least, 0) for s, ok in zip(samples, alive, strict=True)], axis=0)


def _filled(mean: Floats, found: Bools, least: Floats) -> Floats:
    """Nearest neighbour where nothing was found, but no less than there is at least."""
    if found.all():
        return mean
    guess = mean[nearest(found)] if found.any() else mean
    return np.where(found, mean, np.maximum(guess, least)).astype(np.float32)
