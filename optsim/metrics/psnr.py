"""Peak signal-to-noise ratio on linear light, with the scene's declared white as its peak."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from optsim.core.quantities import Doubles
from optsim.metrics.metric import Metric


class Psnr(Metric):
    """PSNR of linear light; the peak is the scene's declared white, never the maximum found.

    Errors of the brightest parts dominate it: read it together with an encoded or logarithmic error.
    """

    kind: Literal["psnr"] = "psnr"
    unit: ClassVar[str] = "dB"
    higher_is_better: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name with its peak."""
        return "PSNR[peak=white]"

    def encode(self, luminance_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Divide by white."""
        return luminance_cd_m2 / white_cd_m2

    def finish(self, total: float, count: int) -> float | None:
        """Return decibels; None without samples or without any difference (the ratio has no value)."""
        return 10.0 * math.log10(count / total) if count and total > 0 else None
