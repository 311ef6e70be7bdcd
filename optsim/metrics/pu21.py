"""PU21: absolute luminance encoded in steps of about equal visibility, and its PSNR.

Source: R. K. Mantiuk and M. Azimi, *PU21: A novel perceptually uniform encoding for adapting existing
quality metrics for HDR*, Picture Coding Symposium 2021, doi:10.1109/PCS50896.2021.9477471; parameters and
peak from the authors' code (github.com/gfxdisp/pu21, ``pu21_encoder.m`` and ``pu21_metric.m``), variant
``banding_glare``, the only one that they recommend.
"""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike

from optsim.core.quantities import Doubles
from optsim.metrics.metric import Metric

LOWEST_CD_M2 = 0.005
HIGHEST_CD_M2 = 10_000.0
_P = (0.353487901, 0.3734658629, 8.277049286e-05, 0.9062562627, 0.09150303166, 0.9099517204, 596.3148142)


def pu21_encode(luminance_cd_m2: ArrayLike) -> Doubles:
    """Encode absolute luminance; values outside 0.005 .. 10 000 cd/m^2 are clamped to that range."""
    power = np.clip(np.asarray(luminance_cd_m2, np.float64), LOWEST_CD_M2, HIGHEST_CD_M2) ** _P[3]
    ratio = (_P[0] + _P[1] * power) / (1.0 + _P[2] * power)
    return np.maximum(_P[6] * (ratio ** _P[4] - _P[5]), 0.0)


def pu21_decode(encoded: ArrayLike) -> Doubles:
    """Luminance, cd/m^2, of encoded values: the inverse of :func:`pu21_encode` within its range."""
    ratio = np.maximum(np.asarray(encoded, np.float64) / _P[6] + _P[5], 0.0) ** (1.0 / _P[4])
    return (np.maximum(ratio - _P[0], 0.0) / (_P[1] - _P[2] * ratio)) ** (1.0 / _P[3])


class Pu21Psnr(Metric):
    """PSNR of PU21-encoded luminance, peak 256 as in the authors' code.

    Blind above 10 000 cd/m^2 and below 0.005 cd/m^2: the share of the reference there is counted.
    """

    kind: Literal["pu21_psnr"] = "pu21_psnr"
    unit: ClassVar[str] = "dB"
    higher_is_better: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name with variant and peak: the peak alone moves the number by 7.3 dB."""
        return "PU21-PSNR[banding_glare, peak=256]"

    def encode(self, luminance_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Encode on the PU21 scale, whatever the scene's white."""
        return pu21_encode(luminance_cd_m2)

    def finish(self, total: float, count: int) -> float | None:
        """Return decibels; None without samples or without any difference."""
        return 10.0 * math.log10(256.0**2 * count / total) if count and total > 0 else None

    def clamped(self, luminance_cd_m2: Doubles) -> int:
        """Count samples that the encoding clamps."""
        return int(np.count_nonzero((luminance_cd_m2 > HIGHEST_CD_M2) | (luminance_cd_m2 < LOWEST_CD_M2)))
