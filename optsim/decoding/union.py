# pyright: reportMissingTypeStubs=false
"""Moving pixels from one decoder, the others from the HDR merge (equation 1 of the paper)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from itertools import tee
from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import Field, field_validator

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import FrameWithHighlights
from optsim.core.config import Part
from optsim.core.extensions import AS_IT_IS, DECODERS, or_offered
from optsim.core.quantities import Bools, CodedFrame, Floats, Reconstruction
from optsim.decoding.coded_images import box_mean
from optsim.decoding.joined import Joined
from optsim.decoding.partial import Partial, PartialDecoder
from optsim.decoding.partial_decoders import AnyPartialDecoder, HdrMerge, SparseCoding
from optsim.optics.neighbourhoods import dilated

_Moving = Annotated[
    AnyPartialDecoder | Joined,
    Field(discriminator="kind"),
    or_offered(DECODERS, PartialDecoder),
    AS_IT_IS,
]
# Least share of the image for which a video is decoded.
_LEAST_SHARE = 0.05
_SMOOTH_PX = 3
# Reach of a saturated sample in a video: the side of the shipped priors' patches, panel pixels.
_AROUND = 8


class Union(Part):
    """Join two partial reconstructions: the video where the light changed, the merge elsewhere.

    The code's mask is dilated and as old as the frames behind it. At decoding, the frame's own sample is
    known, so equation (1) is not followed. Where the sample agrees with those before, the merge of all has
    less error than the video. Where it doesn't, one frame is left to merge. There a video from any code has
    less error: the four exposures of a mosaic differ in time too. Near saturated samples too few of them
    are left, so there only the video's own code gives a video. Undetected motion is likely near detected
    motion, so the video's share falls with the distance from the nearest change. Where all pixels of a patch
    stay open, their code tells no times apart, and the merge is used. Where the video ends, it fades out with
    the number of patches over a pixel. ``moving`` marks where it has its full share.

    The glare of pixels that saturate in every frame reaches dark pixels. The merge estimates the light of
    these saturated pixels, and their glare is subtracted from the video's samples.

    Standard deviations are blended like the light, as if both made the same error: an upper bound.
    Where the video's decoder states no uncertainty, pixels with any video have 0, which means unknown.

    Parameters
    ----------
    static, moving : decoder
        The decoders of static and of moving pixels.
    video : {"changed", "coded"}
        Where the video is used: near a change, or wherever its code was chosen, as in equation
        (1). A merge of one frame, the first frame and the paper's own merge detect no change. Then both are
        the same.
    fade_px : float
        Distance from a change over which the video's share falls to 1/e, panel pixels. The share of least
        error falls so in 2 on ``window_room``, in 6 on ``half_moving``; 4 lies between (no source).
    """

    kind: Literal["union"] = "union"
    static: HdrMerge = HdrMerge()
    moving: _Moving = SparseCoding()
    video: Literal["changed", "coded"] = "changed"
    fade_px: float = Field(default=4.0, gt=0)

    @field_validator("moving", mode="before")
    @classmethod
    def _sparse_coding_unless_said(cls, value: object) -> object:
        """Read a table without a kind as the paper's decoder."""
        if not isinstance(value, dict):
            return value
        return {"kind": "sparse_coding", **cast("dict[str, Any]", value)}

    def decode(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Reconstruction]:
        """Decode frame by frame, each from itself and those before."""
        first, second = tee(frames)
        merged: deque[tuple[Partial, Floats]] = deque()

        def changing() -> Iterator[CodedFrame]:
            for frame, still in zip(first, self.static.partials(second, calibration), strict=True):
                near, where = np.ones(still.moving.shape, np.float32), frame.code.moving
                if self.video == "changed" and not still.moving.all():
                    where = where | ~dilated(calibration.observe(frame).saturated, _AROUND)
                    near = where * _nearness(still.moving, self.fade_px) * _timed(frame, calibration)
                merged.append((still, near))
                code = replace(frame.code, moving=where & (near >= _LEAST_SHARE))
                # The merge estimates what always saturates by its glare.
                yield FrameWithHighlights(
                    **vars(replace(frame, code=code)), highlights_w_m2=still.irradiance_w_m2[0]
                )

        for video in self.moving.partials(changing(), calibration):
            still, near = merged.popleft()
            # Inside the mask all patches exist, so the blend weight is 1.
            share = np.where(still.valid, near * video.blend_weight, np.sign(video.blend_weight))
            joined = still.irradiance_w_m2 + share * (video.irradiance_w_m2 - still.irradiance_w_m2)
            spread = _mixed(still.uncertainty_w_m2, video.uncertainty_w_m2, share)
            yield Reconstruction(
                still.index,
                joined.astype(np.float32, copy=False),
                np.where(share > 0, video.valid | still.valid, still.valid),
                np.where(share > 0, video.interpolated, still.interpolated),
                video.moving,
                None if spread is None else np.broadcast_to(spread, joined.shape),
            )


def _mixed(still: Floats | None, video: Floats | None, share: Floats) -> Floats | None:
    """Blend standard deviations by the video's share of the image; 0 where one isn't known."""
    if still is None:
        return None
    other = np.zeros_like(still) if video is None else video
    known = ((share <= 0) | (other > 0)) & ((share >= 1) | (still > 0))
    return np.where(known, (1 - share) * still + share * other, 0).astype(np.float32)


def _timed(frame: CodedFrame, calibration: Calibration) -> Floats:
    """1 where the codes of a patch tell times apart, and 0 where all its pixels are always open, (v, u)."""
    opened = np.count_nonzero(frame.code.levels, axis=0) / np.float32(calibration.coded_slots)
    return (2 - 2 * box_mean(opened.astype(np.float32), _AROUND + 1)).clip(0, 1)


def _nearness(changed: Bools, fade_px: float) -> Floats:
    """1 at changes, and falling exponentially with the distance from them, (v, u)."""
    from scipy import ndimage

    if not changed.any():
        return np.zeros(changed.shape, np.float32)
    distances = cast("Callable[[Bools], Floats]", ndimage.distance_transform_edt)
    # Smoothed: only some pixels of a moving edge pass the threshold, and the blend would look beaded.
    near = box_mean(np.exp(-distances(~changed) / fade_px).astype(np.float32), _SMOOTH_PX)
    return near.clip(0, 1)  # its running sums leave rounding behind
