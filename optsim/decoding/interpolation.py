# pyright: reportMissingTypeStubs=false
"""Video from one coded image by interpolation between its samples: the floor that priors must beat."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, cast

import numpy as np
from pydantic import Field

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import CodedFrame, Floats
from optsim.decoding.coded_images import CodedImage, CodedImageDecoder, ImageDecoder, covered
from optsim.decoding.partial import Partial

# Gaussians are cut here, in standard deviations; pixels without a sample within it are invalid.
_CUT = 4.0


class Interpolation(CodedImageDecoder):
    """Normalised convolution of the samples in space and time.

    H. Knutsson and C.-F. Westin, CVPR 1993, doi:10.1109/CVPR.1993.341081. A pixel's mean irradiance while it
    was open is a sample in each slot. Its certainty grows with the share of the exposure in that slot.

    Parameters
    ----------
    sigma_px, sigma_slots : float
        Standard deviations of the Gaussian weights of the samples; the defaults are this project's
        choice for bumps of three slots (no source).
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    """

    kind: Literal["interpolation"] = "interpolation"
    sigma_px: float = Field(default=1.0, gt=0, le=20)
    sigma_slots: float = Field(default=1.5, gt=0, le=20)

    def image_decoder(self, calibration: Calibration) -> ImageDecoder:
        """Prepare for a calibration."""

        def decoded(frame: CodedFrame, image: CodedImage) -> Partial:
            # Squared: the leak of a dark panel, equal in every slot, has little information on any of them.
            certainty = image.weights**2
            certainty /= np.maximum(certainty.sum(axis=2, keepdims=True), np.float32(1e-12))
            mean = image.signal / np.maximum(image.exposure, np.float32(1e-6))
            known = self._smoothed(certainty)
            video = self._smoothed(certainty * mean[:, :, None])
            video /= np.maximum(known, np.float32(1e-12))
            # Slots with the shutter closed don't count: a missing sample there is no fault.
            found = (known[:, :, : calibration.coded_slots] > 0).all(axis=2)
            moving = (frame.code.moving & found).astype(np.float32)
            return covered(frame, image, video * moving[:, :, None], moving, np.ones_like(moving))

        return decoded

    def _smoothed(self, stack: Floats) -> Floats:
        from scipy import ndimage

        blur = cast("Callable[..., Floats]", ndimage.gaussian_filter)
        return blur(stack, (self.sigma_px, self.sigma_px, self.sigma_slots), mode="constant", truncate=_CUT)
