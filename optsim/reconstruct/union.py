"""Moving pixels from one decoder, the others from the HDR merge (equation 1 of the paper)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import tee
from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import Field, field_validator

from optsim.calibrate.calibration import Calibration
from optsim.config import Part
from optsim.quantities import CodedFrame, Reconstruction
from optsim.reconstruct.average import Average
from optsim.reconstruct.branches import (
    GaussianMixture,
    HdrMerge,
    Interpolation,
    MotionDeblurring,
    SparseCoding,
    TotalVariation,
)

_Moving = Annotated[
    SparseCoding | GaussianMixture | Average | Interpolation | TotalVariation | MotionDeblurring,
    Field(discriminator="kind"),
]


class Union(Part):
    """Join the two branches along the mask that the code was made with.

    Equation (1) cuts hard. Patches reach past the mask, so there is more to go on: outside it, the
    video fades out with the number of patches that cover a pixel. ``moving`` is the mask itself.
    Where the two are mixed so are their standard deviations, as if both made the same error: an upper bound.
    Without a word from the video's decoder there is none of the union's.

    Parameters
    ----------
    static, moving : decoder
        The two branches.
    """

    kind: Literal["union"] = "union"
    static: HdrMerge = HdrMerge()
    moving: _Moving = SparseCoding()

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
        branches = zip(
            self.static.layers(first, calibration), self.moving.layers(second, calibration), strict=True
        )
        for still, video in branches:
            # Inside the mask all patches are there, so the opacity is 1.
            share = np.where(still.valid, video.opacity, np.sign(video.opacity))
            joined = still.irradiance_w_m2 + share * (video.irradiance_w_m2 - still.irradiance_w_m2)
            spread = None
            if still.uncertainty_w_m2 is not None and video.uncertainty_w_m2 is not None:
                spread = (1 - share) * still.uncertainty_w_m2 + share * video.uncertainty_w_m2
            yield Reconstruction(
                still.index,
                joined.astype(np.float32, copy=False),
                np.where(share > 0, video.valid | still.valid, still.valid),
                still.interpolated & (share == 0),
                video.moving,
                spread,
            )
