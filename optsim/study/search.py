"""The largest change that costs at most a loss, in few measurements: bracketing, then interpolation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

# How near the loss must be, of the loss asked for.
NEAR = 0.1
_MOST_STEPS = 8
# Bounds of a step: as a factor outwards, and as shares of a bracket inwards.
_OUT, _IN = (1.4, 5.0), (0.15, 0.85)
# A refused change ends the search when it is so near to one that can be.
_CLOSE = 1.1


@dataclass(frozen=True)
class Limit:
    """Result of a search.

    Parameters
    ----------
    value : float
        The largest change, positive.
    half : float or None
        Half of its 95 % interval, from that of the loss and the slope there; None where it is unknown.
    status : {"found", "not reached", "refused beyond"}
        Whether the loss is reached there; not up to the largest change tried; or larger ones cannot be built.
    loss : float
        Loss at the value.
    slope : float or None
        Loss per change at the value.
    steps : int
        Measurements.
    """

    value: float
    half: float | None
    status: Literal["found", "not reached", "refused beyond"]
    loss: float
    slope: float | None
    steps: int


Loss = Callable[[float], tuple[float, float | None] | None]
"""Change -> loss and half of its interval; None where the change is refused."""


def largest_change(loss: Loss, wanted: float, first: float, most: float) -> Limit:
    """Search the largest change whose loss is at most ``wanted``.

    Between two measurements the square root of the loss is taken to be straight: losses by small changes
    grow with their square.
    """
    low, high = (0.0, 0.0), None
    low_half: float | None = None
    refused = math.inf
    change = min(first, most)
    for step in range(1, _MOST_STEPS + 1):
        found = loss(change)
        if found is None:
            refused = change
            if low[0] and refused < _CLOSE * low[0]:
                return Limit(low[0], None, "refused beyond", low[1], None, step)
            change = (low[0] + refused) / 2
            continue
        value, half = found
        if abs(value - wanted) <= NEAR * wanted:
            return _at(change, value, half, low if value > low[1] else None, wanted, step)
        if value > wanted:
            high = (change, value, half)
        else:
            low, low_half = (change, value), half
            if change >= most:
                return Limit(change, None, "not reached", value, None, step)
        change = _next(low, high, wanted, min(most, refused), refused)
        if high is None and refused < math.inf and refused < _CLOSE * low[0]:
            return Limit(low[0], None, "refused beyond", low[1], None, step)
    if high is None:
        status = "refused beyond" if refused < math.inf else "not reached"
        return Limit(low[0], low_half, status, low[1], None, _MOST_STEPS)
    return _at(_between(low, high[:2], wanted), wanted, high[2], low, wanted, _MOST_STEPS)


def _next(
    low: tuple[float, float],
    high: tuple[float, float, float | None] | None,
    wanted: float,
    most: float,
    refused: float,
) -> float:
    """Choose the next change: inside a bracket, or outwards by the square law."""
    if high is not None:
        share = (_between(low, high[:2], wanted) - low[0]) / (high[0] - low[0])
        return low[0] + min(max(share, _IN[0]), _IN[1]) * (high[0] - low[0])
    factor = math.sqrt(wanted / low[1]) if low[1] > 0 else _OUT[1]
    outwards = low[0] * min(max(factor, _OUT[0]), _OUT[1])
    return (low[0] + refused) / 2 if outwards >= refused else min(outwards, most)


def _between(low: tuple[float, float], high: tuple[float, float], wanted: float) -> float:
    """Where the straight line of the loss's square root reaches the loss."""
    ends = math.sqrt(max(low[1], 0)), math.sqrt(high[1])
    return low[0] + (math.sqrt(wanted) - ends[0]) / (ends[1] - ends[0]) * (high[0] - low[0])


def _at(
    change: float,
    value: float,
    half: float | None,
    low: tuple[float, float] | None,
    wanted: float,
    steps: int,
) -> Limit:
    """Move a change that is near to where the loss is as wanted, with its interval."""
    below = low if low and low[0] < change else (0.0, 0.0)
    roots = math.sqrt(value), math.sqrt(max(below[1], 0))
    slope = 2 * roots[0] * (roots[0] - roots[1]) / (change - below[0])
    corrected = change - (value - wanted) / slope
    return Limit(corrected, None if half is None else half / slope, "found", wanted, slope, steps)
