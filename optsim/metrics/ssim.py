# pyright: reportUnknownVariableType=false
"""SSIM of PU21-encoded luminance, by scikit-image."""

from __future__ import annotations

import warnings
from typing import ClassVar, Literal, cast

import numpy as np

from optsim.core.quantities import Doubles
from optsim.metrics.classes import Class
from optsim.metrics.frame_metric import SLOTS, FrameEstimate, FrameMetric


class Pu21Ssim(FrameMetric):
    """Structural similarity (Wang et al., IEEE TIP 13 (4), 2004), local values averaged over each class.

    The range of 256 is that of the authors of PU21. Pictures smaller than the window of 11 pixels have none.
    """

    kind: Literal["pu21_ssim"] = "pu21_ssim"
    unit: ClassVar[str] = "SSIM"
    higher_is_better: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name with encoding, range, window and slots."""
        return f"PU21-SSIM[banding_glare, range=256, gaussian 1.5 px, {SLOTS} slots]"

    def measure(self, frame: FrameEstimate) -> dict[Class, float | None]:
        """Average the map of local similarity."""
        from skimage.metrics import structural_similarity

        if min(frame.scored.shape) < 11:
            return dict.fromkeys(frame.reference.classes)
        total = np.zeros(frame.scored.shape)
        for slot in frame.reference.slots:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FutureWarning)
                _, values = cast(
                    "tuple[float, Doubles]",
                    structural_similarity(
                        frame.reference.pu21[slot],
                        frame.pu21[slot],
                        data_range=256.0,
                        gaussian_weights=True,
                        sigma=1.5,
                        use_sample_covariance=False,
                        full=True,
                    ),
                )
            total += values
        return frame.mean(total / len(frame.reference.slots))
