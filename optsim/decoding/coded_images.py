# pyright: reportMissingTypeStubs=false
"""Input of the patch decoders, and the average of their overlapping patches."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Self, cast

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import LEAST_EXPOSURE, Crosstalk, demixed_frames, nearest
from optsim.core.quantities import Bools, CodedFrame, Floats
from optsim.decoding.partial import Partial, PartialDecoder, positive_mean

# Side of the neighbourhood in which errors are nearly equal: that of the shipped priors' patches.
_AROUND = 8
# Share of measured pixels below which patches can't fill the gaps: sparse coding decodes 0.4 measured as well
# as all, 0.1 with dark gaps (no source for the value between).
_TOO_FEW = 0.25


@dataclass(frozen=True, eq=False)
class CodedImage:
    """A coded frame on the panel grid, one sample a pixel; zero where a pixel is unusable.

    Gaps with under a quarter usable pixels take the nearest usable sample.
    """

    signal: Floats  # (v, u), sum over the slots of weight times irradiance.
    exposure: Floats  # (v, u), sum of the weights.
    variance: Floats  # (v, u), noise variance of the signal.
    weights: Floats  # (v, u, slot), effective.
    usable: Bools  # (v, u), pixels with a signal.
    saturated: Bools  # (v, u), pixels of which only a lower bound is known.


ImageDecoder = Callable[[CodedFrame, "CodedImage"], Partial]


class CodedImageDecoder(PartialDecoder, ABC):
    """A decoder that makes a video of each coded image by itself.

    Parameters
    ----------
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    """

    crosstalk: Crosstalk = "undone"

    @abstractmethod
    def image_decoder(self, calibration: Calibration) -> ImageDecoder:
        """Prepare for a calibration; what it returns decodes one coded image at a time."""

    def quick(self) -> Self:
        """Return a faster decoder with nearly the same errors, for the turns of :class:`Joined`."""
        return self

    def partials(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Partial]:
        """Decode as :meth:`decode`, with the blend weights of the union."""
        decoded = self.image_decoder(calibration)
        for frame, image in coded_images(frames, calibration, self.crosstalk):
            yield decoded(frame, image)


def coded_images(
    frames: Iterable[CodedFrame], calibration: Calibration, crosstalk: Crosstalk
) -> Iterator[tuple[CodedFrame, CodedImage]]:
    """Read demixed frames as :func:`~optsim.calibration.demixed.demixed_frames` returns them."""
    for frame, sample in demixed_frames(frames, calibration, crosstalk):
        usable = sample.valid & (sample.exposure > LEAST_EXPOSURE)
        yield (
            frame,
            _gaps_filled(
                CodedImage(
                    np.where(usable, sample.signal, 0).astype(np.float32),
                    np.where(usable, sample.exposure, 0).astype(np.float32),
                    np.where(usable, sample.variance, 0).astype(np.float32),
                    np.ascontiguousarray(np.moveaxis(np.where(usable, sample.weights, 0), 0, -1)),
                    usable,
                    sample.saturated,
                )
            ),
        )


def _gaps_filled(image: CodedImage) -> CodedImage:
    """Repeat the nearest sample, in place, in gaps too wide for a patch to bridge; small ones stay zero."""
    if image.usable.any() and not image.usable.all():
        gap = ~image.usable & (box_mean(image.usable, _AROUND) < _TOO_FEW)
        rows, cols = (each[gap] for each in nearest(image.usable))
        for part in (image.signal, image.exposure, image.variance, image.weights):
            part[gap] = part[rows, cols]
    return image


def covered(
    frame: CodedFrame,
    image: CodedImage,
    total: Floats,
    count: Floats,
    full: Floats,
    variance: Floats | None = None,
) -> Partial:
    """Average the patches over each pixel; the blend weight is the share of possible patches decoded.

    Patches over a pixel share samples and prior: the variance of their mean is taken as the mean of their
    variances, which no correlation can exceed. A saturated pixel, and a moving one without a sample, counts
    as interpolated, with a standard deviation equal to its value.
    """
    total /= np.maximum(count, 1)[:, :, None]
    spread = None
    if variance is not None:
        spread = np.ascontiguousarray(np.moveaxis(np.sqrt(variance, out=variance), -1, 0))
    video = np.ascontiguousarray(np.moveaxis(total, -1, 0))
    seen = count > 0
    error = _error_variance(image, video, seen)[seen]
    # One slot at a time stays in the processor's cache.
    for slot in video:
        slot[seen] = positive_mean(slot[seen], error)
    moving = frame.code.moving
    interpolated = moving & (image.saturated | ~image.usable)
    if spread is not None:
        spread[:, interpolated] = np.maximum(spread[:, interpolated], video[:, interpolated])
    return Partial(
        frame.index,
        video,
        (count / full).astype(np.float32),
        image.usable & moving & seen,
        interpolated,
        moving,
        total.shape[2],
        spread,
    )


def _error_variance(image: CodedImage, video: Floats, seen: Bools) -> Floats:
    """Squared error of dark pixels, estimated from negative light around them."""
    # No light is negative, so next to zero half of the squared errors can be seen. A patch decoder also can't
    # do better than the noise of all samples around a pixel.
    # Values of slots with the shutter closed are no errors.
    slots = np.flatnonzero(image.weights.any(axis=(0, 1)))
    squares = np.zeros(seen.shape, np.float32)
    for slot in slots:
        squares += np.square(np.minimum(video[slot], 0))
    squares /= max(1, len(slots))
    shown = box_mean(squares, _AROUND) / np.maximum(box_mean(seen, _AROUND), 1 / _AROUND**2)
    variance, exposure = box_mean(image.variance, _AROUND), box_mean(image.exposure, _AROUND)
    gathered = np.zeros_like(variance)
    np.divide(variance, _AROUND**2 * exposure**2, out=gathered, where=exposure > 1e-6)
    return (2 * shown + gathered).astype(np.float32)


def box_mean(image: Floats | Bools, side: int) -> Floats:
    """Mean over the square around each pixel, mirrored at the border: (v, u), float32."""
    from scipy import ndimage

    mean = cast("Callable[..., Floats]", ndimage.uniform_filter)
    return mean(image.astype(np.float32, copy=False), side)
