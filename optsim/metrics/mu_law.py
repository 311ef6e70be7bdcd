"""PSNR behind the mu-law curve of HDR papers, on light over the scene's declared white."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.core.quantities import Doubles
from optsim.metrics.metric import Metric


class MuLawPsnr(Metric):
    """PSNR of T(H) = ln(1 + mu H) / ln(1 + mu), H = luminance over white; light below zero counts as zero.

    Papers divide by the reference's maximum or 99th percentile instead. Here the divisor is stated by the
    scene, so that one hot pixel cannot move the score. Above white T goes on beyond 1, without a clip.

    Parameters
    ----------
    mu
        Compression; 5000 in the literature (Kalantari and Ramamoorthi, ACM TOG 36 (4), 2017).
    """

    kind: Literal["mu_law_psnr"] = "mu_law_psnr"
    mu: float = Field(default=5000.0, gt=0)
    unit: ClassVar[str] = "dB"
    higher_is_better: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name with its curve, divisor and peak."""
        return f"mu-law-PSNR[mu={self.mu:g}, H=L/white, peak=1]"

    def encode(self, luminance_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Compress the ratio to white."""
        return np.log1p(np.maximum(luminance_cd_m2, 0.0) * (self.mu / white_cd_m2)) / math.log1p(self.mu)

    def finish(self, total: float, count: int) -> float | None:
        """Return decibels; None without samples or without any difference."""
        return 10.0 * math.log10(count / total) if count and total > 0 else None
