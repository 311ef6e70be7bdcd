# pyright: reportMissingTypeStubs=false
"""Several videos of the same coded image, joined by their errors on samples that they did not see."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import Annotated, Literal, cast

import numpy as np
from pydantic import Field

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import Bools, CodedFrame, Doubles, Floats
from optsim.decoding.coded_images import CodedImage, CodedImageDecoder, ImageDecoder
from optsim.decoding.partial import Partial
from optsim.decoding.partial_decoders import (
    GaussianMixture,
    Interpolation,
    SparseCoding,
    TotalVariation,
    VelocityMixture,
)

# Turns in which every sample is left out once; period of what is left out, so that patches share weights.
_TURNS, _TILE = 4, 8
_TINY = np.float32(1e-12)
_LEAST, _MOST = np.float32(1e-9), np.float32(1e9)  # of relative squared errors

_Member = Annotated[
    SparseCoding | GaussianMixture | VelocityMixture | Interpolation | TotalVariation,
    Field(discriminator="kind"),
]


class Joined(CodedImageDecoder):
    """Mean of several decoders, pixel by pixel by how well each predicts samples that it did not see.

    A decoder in closed form states these errors itself. Others decode the image again in four turns, each
    without a quarter of the samples. The shares are inverse to the smoothed squared errors; no truth enters.

    Parameters
    ----------
    decoders : list of decoder
        At least two decoders of coded images, with their keys.
    smooth_px : float
        Standard deviation of the Gaussian that smooths the errors, panel pixels.
    power : float
        Of the squared errors, to which shares are inverse.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights, for all of them.
    """

    kind: Literal["joined"] = "joined"
    decoders: tuple[_Member, ...] = Field(default=(SparseCoding(), VelocityMixture()), min_length=2)
    smooth_px: float = Field(default=3.0, gt=0, le=20)
    power: float = Field(default=1.5, ge=0, le=8)

    def image_decoder(self, calibration: Calibration) -> ImageDecoder:
        """Prepare all decoders for a calibration."""
        whole = [each.image_decoder(calibration) for each in self.decoders]
        quick = [each.quick().image_decoder(calibration) for each in self.decoders]

        def decoded(frame: CodedFrame, image: CodedImage) -> Partial:
            parts = [decode(frame, image) for decode in whole]
            errors = [
                held_out(frame, image, again) if part.held_out is None else part.held_out
                for part, again in zip(parts, quick, strict=True)
            ]
            shares = self._shares(image, parts, errors)
            video = sum(share * part.irradiance_w_m2 for share, part in zip(shares, parts, strict=True))
            weight = sum(share * part.blend_weight for share, part in zip(shares, parts, strict=True))
            return replace(
                parts[0],
                irradiance_w_m2=np.asarray(video, np.float32),
                blend_weight=np.asarray(weight, np.float32),
                valid=reduce(np.logical_or, (part.valid for part in parts)),
                uncertainty_w_m2=None,
            )

        return decoded

    def _shares(self, image: CodedImage, parts: list[Partial], errors: list[Floats]) -> list[Floats]:
        """Shares of the decoders, (v, u) each; they sum to 1 where any has a video."""
        exposure = np.maximum(image.exposure, _TINY)
        power = (np.square(image.signal) + image.variance) / np.square(exposure)
        smooth = self._smooth(power, image.usable)
        scale = np.maximum(smooth, _TINY * (smooth.max(initial=0) or 1))
        errors_px: list[Floats] = []
        for part, error in zip(parts, errors, strict=True):
            there = np.isfinite(error) & image.usable
            relative = self._smooth(np.where(there, error, 0) / scale, there)
            errors_px.append(np.where(part.blend_weight > 0, np.maximum(relative, _LEAST), np.inf))
        best = np.minimum(np.min(errors_px, axis=0), _MOST)
        weights = [np.isfinite(each) * (best / each) ** self.power for each in errors_px]
        total = np.maximum(np.sum(weights, axis=0), _TINY)
        return [(each / total).astype(np.float32) for each in weights]

    def _smooth(self, image: Floats | Doubles, there: Bools) -> Floats:
        """Mean of an image around each pixel, of the pixels that are there."""
        from scipy import ndimage

        blur = cast("Callable[[Floats, float], Floats]", ndimage.gaussian_filter)
        found = blur(np.where(there, image, 0).astype(np.float32), self.smooth_px)
        return (found / np.maximum(blur(there.astype(np.float32), self.smooth_px), _TINY)).astype(np.float32)


def held_out(frame: CodedFrame, image: CodedImage, decode: ImageDecoder) -> Floats:
    """Squared error of each sample's mean light as a decoder predicts it without it, (v, u); else NaN."""
    rng = np.random.default_rng(0)
    turn = rng.permutation(_TILE**2).reshape(_TILE, _TILE) % _TURNS
    rows, cols = image.usable.shape
    turn = np.tile(turn, (-(-rows // _TILE), -(-cols // _TILE)))[:rows, :cols]
    found = np.full(image.usable.shape, np.nan, np.float32)
    for each in range(_TURNS):
        left_out = (turn == each) & image.usable
        there = image.usable & ~left_out
        part = decode(
            frame,
            replace(
                image,
                signal=image.signal * there,
                exposure=image.exposure * there,
                variance=image.variance * there,
                weights=image.weights * there[:, :, None],
                usable=there,
            ),
        )
        seen = left_out & (part.blend_weight > 0)
        signal = np.einsum("vut,tvu->vu", image.weights, part.irradiance_w_m2)
        off = (signal - image.signal) / np.maximum(image.exposure, _TINY)
        found[seen] = np.square(off[seen])
    return found
