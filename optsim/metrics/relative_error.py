"""Relative mean squared error, as renderers report it."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from optsim.core.quantities import Doubles
from optsim.metrics.metric import Metric


class RelMse(Metric):
    """Mean of (t - r)^2 / (r^2 + e^2), estimate t and reference r; a few dark pixels can dominate it.

    Parameters
    ----------
    e_cd_m2
        Absolute luminance below which errors count as absolute; 1 cd/m^2 has no source.
    """

    kind: Literal["rel_mse"] = "rel_mse"
    e_cd_m2: float = Field(default=1.0, gt=0)
    unit: ClassVar[str] = "ratio"
    higher_is_better: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """Name with its offset."""
        return f"relMSE[e={self.e_cd_m2:g} cd/m2]"

    def encode(self, luminance_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Keep luminance as it is."""
        return luminance_cd_m2

    def errors(self, estimate_cd_m2: Doubles, reference_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Squared difference over the squared reference, of each sample."""
        return (estimate_cd_m2 - reference_cd_m2) ** 2 / (reference_cd_m2**2 + self.e_cd_m2**2)

    def finish(self, total: float, count: int) -> float | None:
        """Return the mean; None without samples."""
        return total / count if count else None
