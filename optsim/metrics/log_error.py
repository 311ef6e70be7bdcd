"""Root mean square error in photographic stops: relative errors, with equal weight in window and shadow."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.core.quantities import Doubles
from optsim.metrics.metric import Metric


class LogRmse(Metric):
    """RMS of log2((t + e) / (r + e)), in stops; luminances below zero count as zero.

    Parameters
    ----------
    e_cd_m2
        Absolute luminance below which errors fade out; 0.01 cd/m^2 has no source, it is a sensible default.
    """

    kind: Literal["log_rmse"] = "log_rmse"
    e_cd_m2: float = Field(default=0.01, gt=0)
    unit: ClassVar[str] = "stops"
    higher_is_better: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """Name with its offset and unit."""
        return f"log-RMSE[e={self.e_cd_m2:g} cd/m2] (stops)"

    def encode(self, luminance_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Encode as stops above 1 cd/m^2, whatever the scene's white."""
        return np.log2(np.maximum(luminance_cd_m2, 0.0) + self.e_cd_m2)

    def finish(self, total: float, count: int) -> float | None:
        """Return stops; None without samples."""
        return math.sqrt(total / count) if count else None
