"""Projections of a video onto a coded image, and smoothing, in turn: what two decoders share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from pydantic import Field

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import nearest
from optsim.core.compiled import compiled
from optsim.core.quantities import CodedFrame, Floats
from optsim.decoding.coded_images import CodedImage, CodedImageDecoder, ImageDecoder, covered
from optsim.decoding.partial import Partial
from optsim.decoding.tv_smoothing import smoothed

_SLOTS_LIKE_PIXELS = 24
_WHITE = 99.0  # percentile of the means that is brought to 1 before the total variation is weighed

# Largest sum of errors added to a measurement, relative to it, where another step joins the smoothing.
_MOST = 4.0


class ProjectedVideo(CodedImageDecoder, ABC):
    """A decoder that alternates between the measurements and a smoother video.

    Parameters
    ----------
    weight : float
        Weight of the total variation, for light whose brighter parts are about 1.
    time_weight : float or None
        Weight of a difference from slot to slot against one from pixel to pixel; None: a 24th of the number
        of slots, at most 1.
    rounds, inner_rounds : int
        Projections, and steps of the smoothing in each.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    """

    weight: float = Field(default=0.2, gt=0, le=10)
    time_weight: float | None = Field(default=None, ge=0, le=10)
    rounds: int = Field(default=40, ge=1, le=1000)
    inner_rounds: int = Field(default=4, ge=1, le=100)

    def image_decoder(self, calibration: Calibration) -> ImageDecoder:
        """Prepare for a calibration."""

        def decoded(frame: CodedFrame, image: CodedImage) -> Partial:
            # Pixels that no slot opens are smoothed with the others.
            moving = (frame.code.moving & image.usable.any()).astype(np.float32)
            means = image.signal / np.maximum(image.exposure, np.float32(1e-6))
            lit = means[image.exposure > 0]
            white = np.float32(np.percentile(lit, _WHITE)) if lit.size else np.float32(0)
            video = np.zeros_like(image.weights)
            if moving.any() and white > 0:
                # Each pixel's mean in all slots is a start that agrees with the measurement.
                start = (means / white).astype(np.float32)
                if not image.usable.all():
                    start = start[nearest(image.usable)]
                video = self._video(image, np.repeat(start[:, :, None], video.shape[2], axis=2), white)
                video *= white * moving[:, :, None]
            return covered(frame, image, video, moving, np.ones_like(moving))

        return decoded

    @abstractmethod
    def _video(self, image: CodedImage, start: Floats, white: np.float32) -> Floats:
        """Video of a coded image in units of white, (v, u, slot), from a start."""

    def _alternated(
        self,
        image: CodedImage,
        video: Floats,
        white: np.float32,
        more: Callable[[Floats], Floats] | None = None,
    ) -> Floats:
        """Project onto the measurements and lower the total variation in turn, with another step if given."""
        measured = (image.signal / white).astype(np.float32)
        weights, slots = image.weights, image.weights.shape[2]
        energy = np.einsum("vut,vut->vu", weights, weights) + image.variance / white**2
        gain = np.where(energy > 0, 1 / np.maximum(energy, np.float32(1e-12)), 0).astype(np.float32)
        target = np.zeros_like(measured)
        # What another step can't reach would else add up without bound.
        most = np.float32(0 if more is None else _MOST)
        time_weight = min(1.0, slots / _SLOTS_LIKE_PIXELS) if self.time_weight is None else self.time_weight
        for _ in range(self.rounds):
            _bring(video, weights, measured, gain, target, most)
            video = smoothed(video, self.weight, self.inner_rounds, time_weight=time_weight)
            if more is not None:
                video = more(video)
        return video


@compiled(fastmath={"reassoc", "contract", "nsz"})
def _bring(
    video: Floats, weights: Floats, measured: Floats, gain: Floats, target: Floats, most: np.float32
) -> None:
    """Project a video onto the measurements minus the error so far."""
    rows, cols, slots = video.shape
    for v in range(rows):
        for u in range(cols):
            light, open_ = video[v, u], weights[v, u]
            seen = np.float32(0)
            for t in range(slots):
                seen += open_[t] * light[t]
            target[v, u] += measured[v, u] - seen
            if most > 0:
                limit = most * abs(measured[v, u])
                target[v, u] = min(max(target[v, u], measured[v, u] - limit), measured[v, u] + limit)
            change = (target[v, u] - seen) * gain[v, u]
            for t in range(slots):
                light[t] += open_[t] * change
