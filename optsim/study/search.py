"""The largest change that costs at most a loss, in few measurements: bracketing, then interpolation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

# How near the loss must be, of the loss asked for.
NEAR = 0.1
_MOST_STEPS = 12
# From then on brackets are halved, and changes doubled: interpolation did not help.
_HALVED = 5
# Bounds of a step: as a factor outwards, and as shares of a bracket inwards.
_OUT, _IN = (1.4, 5.0), (0.15, 0.85)
# Ends of a bracket, or a refused change and one that can be, are as near as this at the end of a search.
_CLOSE = 1.1
# A jump between such ends is a step from this share of the loss on: a fifth power does not jump so far.
_JUMP = 0.5
# Losses by small changes grow with their square, and by no less than the first or more than the fourth power.
_POWERS, _SQUARE = (1.0, 4.0), 2.0
COSTS = ("found", "step", "not converged")
"""Statuses of limits beyond which more than the loss was measured."""


@dataclass(frozen=True)
class Limit:
    """Result of a search."""

    value: float  # The largest change, positive; with ``above``, the last measured one below.
    # 95 % interval, where that of the loss reaches the loss asked for; None where it is nowhere, or has none.
    ends: tuple[float, float | None] | None
    # The loss is reached there, jumps there, or lies between two changes that are not yet near; isn't
    # reached up to the largest change tried; or larger changes cannot be built.
    status: Literal["found", "step", "not converged", "not reached", "refused beyond"]
    loss: float  # At the value: of "found" as asked for, else as measured.
    slope: float | None  # Loss per change at the value.
    steps: int  # Measurements.
    # Of a step, or without convergence: the next measured change, and its loss.
    above: tuple[float, float] | None = None


Loss = Callable[[float], tuple[float, float | None] | None]
"""Change -> loss and half of its interval; None where the change is refused."""
_Seen = dict[float, tuple[float, float | None]]


def largest_change(loss: Loss, wanted: float, first: float, most: float) -> Limit:
    """Search the largest change whose loss is at most ``wanted``."""
    low, high = (0.0, 0.0), None
    seen: _Seen = {}
    refused = math.inf
    change, step = min(first, most), 0
    for step in range(1, _MOST_STEPS + 1):
        found = loss(change)
        if found is None:
            refused = change
            if low[0] and refused < _CLOSE * low[0]:
                return Limit(low[0], None, "refused beyond", low[1], None, step)
            change = (low[0] + refused) / 2
            continue
        seen[change] = found
        value = found[0]
        if abs(value - wanted) <= NEAR * wanted:
            return _found(seen, wanted, step)
        if value > wanted:
            high = (change, value)
        else:
            low = (change, value)
            if change >= most:
                return Limit(change, None, "not reached", value, None, step)
        if high and high[0] < _CLOSE * low[0]:
            break
        change = _next(low, high, wanted, min(most, refused), refused, halve=step > _HALVED)
        if high is None and refused < math.inf and refused < _CLOSE * low[0]:
            return Limit(low[0], None, "refused beyond", low[1], None, step)
    if high is None:
        status = "refused beyond" if refused < math.inf else "not reached"
        return Limit(low[0], None, status, low[1], None, step)
    jump, status = high[1] - low[1], "not converged"
    if high[0] < _CLOSE * low[0]:
        if jump < _JUMP * wanted:
            return _found(seen, wanted, step)
        noise = math.hypot(*(seen[change][1] or 0.0 for change in (low[0], high[0])))
        status = "step" if jump > noise else status
    return Limit(low[0], None, status, low[1], None, step, high)


def _next(
    low: tuple[float, float],
    high: tuple[float, float] | None,
    wanted: float,
    most: float,
    refused: float,
    *,
    halve: bool,
) -> float:
    """Choose the next change: inside a bracket, or outwards by the square law."""
    if high is not None:
        ends = math.sqrt(max(low[1], 0)), math.sqrt(high[1])
        share = 0.5 if halve else (math.sqrt(wanted) - ends[0]) / (ends[1] - ends[0])
        return low[0] + min(max(share, _IN[0]), _IN[1]) * (high[0] - low[0])
    factor = math.sqrt(wanted / low[1]) if low[1] > 0 else _OUT[1]
    outwards = low[0] * min(max(factor, 2 if halve else _OUT[0]), _OUT[1])
    return (low[0] + refused) / 2 if outwards >= refused else min(outwards, most)


def _found(seen: _Seen, wanted: float, steps: int) -> Limit:
    """Return where the curve of the loss is as wanted, and its interval where the curve's own ends are."""
    power = _power(seen, wanted)
    value = _crossing({change: loss for change, (loss, _) in seen.items()}, wanted, power, last=False)
    below = {change: loss - half for change, (loss, half) in seen.items() if half is not None}
    above = {change: loss + half for change, (loss, half) in seen.items() if half is not None}
    assert value is not None  # A loss near to the one asked for is above 0.
    ends = None
    if len(below) == len(seen):
        least = _crossing(above, wanted, power, last=False)
        ends = value if least is None else least, _crossing(below, wanted, power, last=True)
    return Limit(value, ends, "found", wanted, power * wanted / value, steps)


def _power(seen: _Seen, wanted: float) -> float:
    """Power by which the loss grows: from the measurement nearest to the loss to its nearest neighbour."""
    at = min(seen, key=lambda change: abs(seen[change][0] - wanted))
    others = [c for c, (loss, _) in seen.items() if loss > 0 and abs(math.log(c / at)) > math.log(_CLOSE)]
    if not others or seen[at][0] <= 0:
        return _SQUARE
    near = min(others, key=lambda change: abs(math.log(change / at)))
    power = math.log(seen[near][0] / seen[at][0]) / math.log(near / at)
    return min(max(power, _POWERS[0]), _POWERS[1])


def _crossing(curve: dict[float, float], wanted: float, power: float, *, last: bool) -> float | None:
    """Change at which a curve first, or last, rises to a loss; None if never."""
    # The root of the loss is straight between measurements, and beyond them from 0 through the last one.
    points = [(0.0, 0.0), *((change, max(loss, 0) ** (1 / power)) for change, loss in sorted(curve.items()))]
    goal = wanted ** (1 / power)
    under = [at for at, (_, root) in enumerate(points) if root < goal]
    at = under[-1] if last else next(at for at in under if at + 1 not in under)
    change, root = points[at]
    if at + 1 == len(points):
        return change * goal / root if root > 0 else None
    then, next_root = points[at + 1]
    return change + (goal - root) / (next_root - root) * (then - change)
