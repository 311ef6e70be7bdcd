"""One picture a frame, from the last few in which a pixel stood still (equation 7 of the paper)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import (
    LEAST_EXPOSURE,
    Crosstalk,
    DemixedFrame,
    demixed_frames,
    demixed_interval,
    nearest,
)
from optsim.core.quantities import Bools, CodedFrame, Floats
from optsim.decoding.frame_merge import Merged, merged
from optsim.decoding.neighbour_pooling import pooled
from optsim.decoding.partial import Partial, PartialDecoder, positive_mean
from optsim.decoding.readout_window import missed
from optsim.optics.motion import IrradianceInterval, changed
from optsim.optics.neighbourhoods import remove_specks


class HdrMerge(PartialDecoder):
    """Merge all unsaturated samples of a pixel since it last changed.

    The estimate is the weighted least-squares one, ``sum(W I / var) / sum(W^2 / var)``, which is
    ``sum(I) / sum(W)`` where shot noise rules, and then the mean of what it may be without negative light.
    The variances are predicted from the pooled estimate, not from each sample: weights that follow a sample's
    own noise would bias dark pixels. Beside a pixel that gets far more light they are those of the crosstalk
    (``attribution_variance``): there long exposures are trusted, short ones not.
    Any code counts, the paper's mosaic or another. The uncertainty holds ``sum(W^2 / var) ** -0.5``, that of
    the responsivity, what is left of glare, and what a narrow pick may miss of light that changes within a
    pixel (:func:`~optsim.decoding.readout_window.missed`); it holds no other errors of the calibration, nor
    motion that nobody noticed.

    Then each pixel is averaged with its neighbours, as far as noise makes that worth while
    (:func:`~optsim.decoding.neighbour_pooling.pooled`). Pixels of a mosaic that stands still need it most;
    its inventors interpolate (S. K. Nayar and T. Mitsunaga, CVPR 2000, doi:10.1109/CVPR.2000.855857). Of
    texture below its noise, white from pixel to pixel, the uncertainty is too small: by 1.4 at most in tests.

    A pixel that saturates in every frame gets its irradiance from the glare it causes, region by region
    (:func:`~optsim.decoding.hidden_light.told_by_glare`), or else the saturation level. The standard
    deviation of a filled value equals the value. ``moving`` is what changed since the frame before; all that
    nobody compared counts as changed.

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
    neighbours : bool
        Whether pixels are averaged with their neighbours.
    contrast : float
        How much neighbours' light differs from a pixel's that was not measured, over the light; a sensible
        default (no source). Between measured pixels the picture itself tells.
    paper_literal : bool
        Equation (7) as printed, divided by 4: the mean of I / S over the frames, without a test for
        saturation or for change, with row-summed weights, each pixel by itself; for comparison.
    """

    kind: Literal["hdr_merge"] = "hdr_merge"
    n_frames: int = Field(default=4, ge=1, le=16)
    threshold_sigma: float = Field(default=4.0, gt=0)
    speck_px: int = Field(default=2, ge=1)
    crosstalk: Crosstalk = "undone"
    taint_tolerance: float = Field(default=0.005, ge=0)
    neighbours: bool = True
    contrast: float = Field(default=0.05, gt=0, le=10)
    paper_literal: bool = False

    def partials(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Partial]:
        """As :meth:`decode`: one image a frame."""
        recent: deque[_Kept] = deque(maxlen=self.n_frames)
        crosstalk: Crosstalk = "row_summed" if self.paper_literal else self.crosstalk
        everywhere = np.ones(calibration.shape, np.bool_)
        for frame, sample in demixed_frames(frames, calibration, crosstalk):
            recent.appendleft(_Kept(sample, demixed_interval(calibration, sample)))
            samples = [kept.sample for kept in recent]
            if self.paper_literal:
                alive = [kept.sample.valid for kept in recent]
                together = _literal(samples, _least(samples, alive))
            else:
                alive = _unchanged([kept.bounds for kept in recent], self.threshold_sigma, self.speck_px)
                together = merged(calibration, samples, alive, _least(samples, alive), crosstalk)
            valid = sample.valid & (together.tainted <= self.taint_tolerance)
            valid &= np.logical_or.reduce(
                [ok & (s.exposure > LEAST_EXPOSURE) for s, ok in zip(samples, alive, strict=True)]
            )
            light, variance = self._light(together)
            systematic = (calibration.gain_uncertainty * light) ** 2
            systematic += missed(light, variance, calibration.ratio / calibration.reading_px) ** 2
            error = np.sqrt(variance + systematic)
            yield Partial(
                frame.index,
                light[None],
                np.ones(calibration.shape, np.float32),
                valid,
                ~together.found & sample.valid,
                ~alive[1] if len(alive) > 1 and not self.paper_literal else everywhere,
                calibration.slots_per_frame,
                np.where(together.found, error, light).astype(np.float32)[None],
            )

    def _light(self, frames: Merged) -> tuple[Floats, Floats]:
        """Light everywhere, none negative, and the variance of what was found."""
        found = frames.found
        variance = frames.variance(np.maximum(frames.mean, 0))
        light = frames.mean if self.paper_literal else positive_mean(frames.mean, variance)
        light = _filled(light, found, frames.least)
        if self.paper_literal or not self.neighbours:
            return light, variance

        def at(irradiance: Floats) -> Floats:
            return np.where(found, frames.variance(irradiance), light**2)

        # Neighbours never contradict saturation, as far as the pixel itself doesn't.
        least = np.where(found, np.minimum(light, frames.least), frames.least)
        return pooled(np.where(found, frames.mean, light), at, found, least, self.contrast)


@dataclass(frozen=True, eq=False)
class _Kept:
    sample: DemixedFrame
    bounds: IrradianceInterval


def _unchanged(recent: Sequence[IrradianceInterval], threshold_sigma: float, speck_px: int) -> list[Bools]:
    """Which pixels of each frame, newest first, agree with all that is known of them since."""
    newest = recent[0]
    alive = np.ones_like(newest.valid)
    result = [alive]
    for older in recent[1:]:
        moved, _ = changed(newest, older, threshold_sigma)
        alive = alive & ~remove_specks(moved, speck_px)
        result.append(alive)
        # Where the newest is only a bound, the newest real sample is the better judge of older ones.
        newest = newest.replaced(alive & older.measured & ~newest.measured, older)
    return result


def _literal(samples: Sequence[DemixedFrame], least: Floats) -> Merged:
    """Mean of I / S over the frames, no less than none; its variance is that of the samples."""
    quotients = [s.signal / np.maximum(s.exposure, 1e-6) for s in samples]
    variances = [s.variance / np.maximum(s.exposure, 1e-6) ** 2 for s in samples]
    variance = (np.mean(variances, axis=0) / len(samples)).astype(np.float32)
    mean = np.maximum(np.mean(quotients, axis=0), 0).astype(np.float32)
    return Merged(mean, lambda _: variance, samples[0].valid, least, np.zeros_like(mean))


def _least(samples: Sequence[DemixedFrame], alive: Sequence[Bools]) -> Floats:
    """Greatest of what saturated samples say that there is at least."""
    return np.max([np.where(ok, s.least, 0) for s, ok in zip(samples, alive, strict=True)], axis=0)


def _filled(mean: Floats, found: Bools, least: Floats) -> Floats:
    """Nearest neighbour where nothing was found, but no less than there is at least."""
    if found.all():
        return mean
    guess = mean[nearest(found)] if found.any() else mean
    return np.where(found, mean, np.maximum(guess, least)).astype(np.float32)
