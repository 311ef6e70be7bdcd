# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
"""Multi-scale SSIM of PU21-encoded luminance."""

from __future__ import annotations

from typing import ClassVar, Literal, cast

import numpy as np
from scipy import ndimage  # type: ignore[import-untyped]

from optsim.core.quantities import Doubles
from optsim.metrics.classes import Class
from optsim.metrics.frame_metric import SLOTS, FrameEstimate, FrameMetric

# Wang, Simoncelli and Bovik, Asilomar 2003, for five scales; fewer share their sum.
_WEIGHTS = (0.0448, 0.2856, 0.3001)
_C1, _C2 = (0.01 * 256) ** 2, (0.03 * 256) ** 2
_RADIUS_PX, _SIGMA_PX = 5, 1.5


class Pu21MsSsim(FrameMetric):
    """Multi-scale structural similarity of whole pictures, on the three finest of the published five scales.

    Five scales need 176 pixels each way, which small panels lack. Contrast and structure are compared on
    all scales, luminance on the coarsest. Pictures below 44 pixels have no score.
    """

    kind: Literal["pu21_ms_ssim"] = "pu21_ms_ssim"
    unit: ClassVar[str] = "SSIM"
    higher_is_better: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name with encoding, range, scales and slots."""
        return f"PU21-MS-SSIM[banding_glare, range=256, {len(_WEIGHTS)} scales, {SLOTS} slots]"

    def measure(self, frame: FrameEstimate) -> dict[Class, float | None]:
        """Score whole pictures; classes have no pictures of their own."""
        if min(frame.scored.shape) < (2 * _RADIUS_PX + 1) << (len(_WEIGHTS) - 1):
            return dict.fromkeys(frame.reference.classes)
        slots = frame.reference.slots
        found = [ms_ssim(frame.reference.pu21[slot], frame.pu21[slot], _WEIGHTS) for slot in slots]
        return {**dict.fromkeys(frame.reference.classes), "all": float(np.mean(found))}


def ms_ssim(reference: Doubles, estimate: Doubles, weights: tuple[float, ...]) -> float:
    """Multi-scale SSIM of two pictures (v, u) of range 256; ``weights`` are normalised to a sum of 1."""
    score = 1.0
    for scale, weight in enumerate(weights):
        if scale:
            reference, estimate = _halved(reference), _halved(estimate)
        luminance, contrast = _similarities(reference, estimate)
        local = contrast * luminance if scale == len(weights) - 1 else contrast
        # A negative mean of structure has no real power: no similarity.
        score *= max(float(local.mean()), 0.0) ** (weight / sum(weights))
    return score


def _similarities(a: Doubles, b: Doubles) -> tuple[Doubles, Doubles]:
    """Luminance term, and contrast and structure term, in windows that lie within the picture."""
    mean_a, mean_b = _smooth(a), _smooth(b)
    var_a, var_b = _smooth(a * a) - mean_a**2, _smooth(b * b) - mean_b**2
    covariance = _smooth(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    return luminance, (2 * covariance + _C2) / (var_a + var_b + _C2)


def _smooth(picture: Doubles) -> Doubles:
    smooth = cast("Doubles", ndimage.gaussian_filter(picture, _SIGMA_PX, radius=_RADIUS_PX))
    return smooth[_RADIUS_PX:-_RADIUS_PX, _RADIUS_PX:-_RADIUS_PX]


def _halved(picture: Doubles) -> Doubles:
    rows, cols = (size // 2 for size in picture.shape)
    return picture[: 2 * rows, : 2 * cols].reshape(rows, 2, cols, 2).mean(axis=(1, 3))
