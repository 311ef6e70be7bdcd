"""One image a frame, from the last few in which a pixel was static (equation 7 of the paper)."""

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

# Reaches of the squares whose means are compared: the largest shows small changes of large dark surfaces.
_REACHES_PX = 1, 2, 4


class HdrMerge(PartialDecoder):
    """Merge all unsaturated samples of a pixel since it last changed.

    The estimate is weighted least squares, ``sum(W I / var) / sum(W^2 / var)``, or ``sum(I) / sum(W)`` where
    shot noise dominates. It is then replaced by its mean given non-negative light. The variances are
    predicted from the pooled estimate: weights that follow a sample's own noise would bias dark pixels.
    Beside a much brighter pixel they are the variances of the crosstalk (``attribution_variance``), which
    trust long exposures and not short ones. Any code works, the paper's mosaic or another.

    The uncertainty includes ``sum(W^2 / var) ** -0.5``, the errors of responsivity and residual glare, and
    the error of a readout window narrower than its panel pixel
    (:func:`~optsim.decoding.readout_window.missed`). It leaves out other calibration errors and undetected
    motion.

    Each pixel is then averaged with its neighbours as far as noise justifies
    (:func:`~optsim.decoding.neighbour_pooling.pooled`). Static pixels of a mosaic need this most;
    its inventors interpolate (S. K. Nayar and T. Mitsunaga, CVPR 2000, doi:10.1109/CVPR.2000.855857). For
    texture below the noise, white from pixel to pixel, the uncertainty is too small: by 1.4 at most in tests.

    A pixel that saturates in every frame gets its irradiance from the glare that it causes, region by region
    (:func:`~optsim.decoding.hidden_light.estimate_by_glare`), or else the saturation level. The standard
    deviation of a filled value equals the value. ``moving`` marks changes since the frame before; pixels
    without a comparison count as changed.

    Parameters
    ----------
    n_frames : int
        Frames looked back, the present one included; 4 is the period of the mosaic.
    threshold_sigma : float
        A frame that differs from newer ones by more is not merged, nor are older ones.
    moving_sigma : float
        The same where the code was chosen for motion: a change is likely there. 3 wins 0.6 dB at night, and
        loses 0.2 dB where half of the picture moves (no source).
    speck_px : int
        Differing regions of fewer pixels count as noise. A false alarm may leave a dark pixel only its
        shortest exposure, so single pixels are rejected.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the frames or added to the weights.
    taint_tolerance : float
        Pixels are invalid where neighbours that never had an unsaturated sample make more than this share of
        the kernel: these may hide any amount of light. 0.005 is a sensible default (no source).
    neighbours : bool
        Whether pixels are averaged with their neighbours.
    contrast : float
        Relative difference expected between an unmeasured pixel and its neighbours; a sensible default (no
        source). Between measured pixels the image itself gives the difference.
    paper_literal : bool
        Equation (7) as printed, divided by 4: the mean of I / S over the frames, pixel by pixel with
        row-summed weights. Saturation and change are not tested; for comparison.
    """

    kind: Literal["hdr_merge"] = "hdr_merge"
    n_frames: int = Field(default=4, ge=1, le=16)
    threshold_sigma: float = Field(default=4.0, gt=0)
    moving_sigma: float = Field(default=3.0, gt=0)
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
            if frame.earlier:
                yield _no_image(frame.index, calibration)
                continue
            samples = [kept.sample for kept in recent]
            if self.paper_literal:
                alive = [kept.sample.valid for kept in recent]
                together = _literal(samples, _least(samples, alive))
            else:
                threshold = self._threshold(frame.code.moving)
                alive = _unchanged([kept.bounds for kept in recent], threshold, self.speck_px)
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

    def _threshold(self, moving: Bools) -> Floats:
        """Threshold of change of each pixel: the lower one where motion, not the scheme, chose the code."""
        chosen = moving & ~moving.all()
        return np.where(chosen, self.moving_sigma, self.threshold_sigma).astype(np.float32)

    def _light(self, frames: Merged) -> tuple[Floats, Floats]:
        """Non-negative irradiance of all pixels, and the variance of the measured ones."""
        found = frames.found
        variance = frames.variance(np.maximum(frames.mean, 0))
        light = frames.mean if self.paper_literal else positive_mean(frames.mean, variance)
        light = _filled(light, found, frames.floor)
        if self.paper_literal or not self.neighbours:
            return light, variance

        def at(irradiance: Floats) -> Floats:
            return np.where(found, frames.variance(irradiance), light**2)

        # Pooling must not contradict saturation where the pixel itself doesn't.
        floor = np.where(found, np.minimum(light, frames.floor), frames.floor)
        return pooled(np.where(found, frames.mean, light), at, found, floor, self.contrast)


@dataclass(frozen=True, eq=False)
class _Kept:
    sample: DemixedFrame
    bounds: IrradianceInterval


def _no_image(index: int, calibration: Calibration) -> Partial:
    """Stand for an earlier frame's image: dark and not valid."""
    no, dark = np.zeros(calibration.shape, np.bool_), np.zeros(calibration.shape, np.float32)
    return Partial(index, dark[None], dark, no, no, no, calibration.slots_per_frame, dark[None])


def _unchanged(recent: Sequence[IrradianceInterval], threshold_sigma: Floats, speck_px: int) -> list[Bools]:
    """Pixels of each frame, newest first, that agree with all newer samples."""
    newest = recent[0]
    alive = np.ones_like(newest.valid)
    result = [alive]
    for older in recent[1:]:
        moved, _ = changed(newest, older, threshold_sigma, reaches_px=_REACHES_PX)
        alive = alive & ~remove_specks(moved, speck_px)
        result.append(alive)
        # Where the newest is only a bound, compare older ones with the newest unsaturated sample.
        newest = newest.replaced(alive & older.measured & ~newest.measured, older)
    return result


def _literal(samples: Sequence[DemixedFrame], floor: Floats) -> Merged:
    """Mean of I / S over the frames, clipped at zero, with the variance of the samples."""
    quotients = [s.signal / np.maximum(s.exposure, 1e-6) for s in samples]
    variances = [s.variance / np.maximum(s.exposure, 1e-6) ** 2 for s in samples]
    variance = (np.mean(variances, axis=0) / len(samples)).astype(np.float32)
    mean = np.maximum(np.mean(quotients, axis=0), 0).astype(np.float32)
    return Merged(mean, lambda _: variance, samples[0].valid, floor, np.zeros_like(mean))


def _least(samples: Sequence[DemixedFrame], alive: Sequence[Bools]) -> Floats:
    """Greatest lower bound from saturated samples."""
    return np.max([np.where(ok, s.floor, 0) for s, ok in zip(samples, alive, strict=True)], axis=0)


def _filled(mean: Floats, found: Bools, floor: Floats) -> Floats:
    """Nearest neighbour where no sample is, but no less than the lower bound."""
    if found.all():
        return mean
    guess = mean[nearest(found)] if found.any() else mean
    return np.where(found, mean, np.maximum(guess, floor)).astype(np.float32)
