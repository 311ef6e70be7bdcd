"""Student's intervals: the half width of a mean's, and the quantiles behind them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from scipy import special  # type: ignore[import-untyped]

CONFIDENCE = 0.95


def quantile(freedom: float, probability: float) -> float:
    """Return a quantile of Student's distribution."""
    return float(cast("float", special.stdtrit(freedom, probability)))


def half_width(values: Sequence[float], n_together: int = 1) -> float | None:
    """Half of the 95 % interval of the mean of independent values; None for fewer than two.

    Parameters
    ----------
    values : sequence of float
        Independent values.
    n_together : int
        Number of intervals that hold together with 95 % (Bonferroni).
    """
    if (n := len(values)) < 2:
        return None
    times = quantile(n - 1, 1 - (1 - CONFIDENCE) / 2 / n_together)
    return times * float(np.std(values, ddof=1)) / math.sqrt(n)
