"""Symmetric mean absolute percentage error: a relative error that no outlier can dominate."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.core.quantities import Doubles
from optsim.metrics.metric import Metric


class Smape(Metric):
    """Mean of |t - r| / (|t| + |r| + e), estimate t and reference r, between 0 and 1.

    Parameters
    ----------
    e_cd_m2
        Absolute luminance below which errors fade out; that of the log error.
    """

    kind: Literal["smape"] = "smape"
    e_cd_m2: float = Field(default=0.01, gt=0)
    unit: ClassVar[str] = "ratio"
    higher_is_better: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """Name with its offset."""
        return f"SMAPE[e={self.e_cd_m2:g} cd/m2]"

    def encode(self, luminance_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Keep luminance as it is."""
        return luminance_cd_m2

    def errors(self, estimate_cd_m2: Doubles, reference_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Absolute difference over the sum of magnitudes, of each sample."""
        magnitudes = np.abs(estimate_cd_m2) + np.abs(reference_cd_m2) + self.e_cd_m2
        return np.abs(estimate_cd_m2 - reference_cd_m2) / magnitudes

    def finish(self, total: float, count: int) -> float | None:
        """Return the mean; None without samples."""
        return total / count if count else None
