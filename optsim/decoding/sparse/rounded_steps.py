"""Steps of a pursuit that :func:`.correlate` renews, and bounds of their errors.

Correlations start from a rounded residual and lose the shares of one rounded direction after the other. All
use one rounded matrix. So the result equals that matrix times (residual + drift), where the drift is the
known sum of the vectors' rounding errors. The matrix's own rounding adds at most its largest error times the
norm of the residual, however many steps were taken (Cauchy and Schwarz). Its products with orthonormal
directions, which give the distances, are together no longer than it is (Bessel).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Doubles, Floats
from optsim.priors.correlation_bounds import LARGEST, SCALE, Pairs

# Rounding of float32 sums, relative to a signal.
_ROUNDING = 1e-6


class Steps(NamedTuple):
    """Next step of each slot, as :func:`.correlate` takes it, and the errors so far."""

    moves: Pairs  # (slot, row)
    terms: Floats  # (slot, 4)
    drift: Doubles  # (slot, row)
    rounding: Doubles  # (slot,), of float32 correlations
    doubt: Doubles  # (slot,), squared lengths of all that rounding added to directions


@compiled()
def make_steps(slots: int, rows: int, pairs: int) -> Steps:
    """Make zero steps for all slots."""
    return Steps(
        np.zeros((slots, 2 * pairs), np.int16),
        np.zeros((slots, 4), np.float32),
        np.zeros((slots, rows)),
        np.zeros(slots),
        np.zeros(slots),
    )


# The hottest functions take whole arrays and a slot: each slice would cost two atomic counts.
@compiled(makes_arrays=False)
def look(slot: int, residual: Doubles, length: float, grid: tuple[float, float], steps: Steps) -> None:
    """Set a step that computes correlations, first set to zero, from the residual itself."""
    for m in range(steps.drift.shape[1]):
        steps.drift[slot, m] = 0
    step, _ = _round_unit(residual, slot, length, 1.0, slot, steps)
    steps.rounding[slot] = length * _ROUNDING
    steps.terms[slot, 0], steps.terms[slot, 1] = length * grid[0] * step, 0
    steps.terms[slot, 2] = _drifted(slot, length, grid[1], steps) + steps.rounding[slot]


@compiled(makes_arrays=False)
def follow(
    slot: int,
    directions: Doubles,
    which: int,
    share: float,
    left: float,
    count: int,
    grid: tuple[float, float],
    steps: Steps,
) -> None:
    """Set a step that subtracts a share of a direction from correlations, and its part from distances."""
    terms = steps.terms
    step, error = _round_unit(directions, which, 1.0, -share, slot, steps)
    unit = grid[0] * step
    terms[slot, 0], terms[slot, 1] = -share * unit, -unit * unit
    steps.rounding[slot] += (abs(share) + left) * _ROUNDING
    terms[slot, 2] = _drifted(slot, left, grid[1], steps) + steps.rounding[slot]
    # Products of an atom, or of what rounding added to it, with all directions are at most as long as it is.
    steps.doubt[slot] += (error + _ROUNDING) ** 2
    off = grid[1] + (1 + grid[1]) * np.sqrt(steps.doubt[slot])
    terms[slot, 3] = 2 * off + off * off + count * _ROUNDING


@compiled(fastmath={"reassoc", "contract"}, makes_arrays=False)
def _drifted(slot: int, left: float, grid_error: float, steps: Steps) -> float:
    """Largest error of a correlation with a residual of some length, without its float32 rounding."""
    square = 0.0
    for m in range(steps.drift.shape[1]):
        square += steps.drift[slot, m] ** 2
    return (1 + grid_error) * np.sqrt(square) + grid_error * left


@compiled(fastmath={"reassoc", "contract", "nnan", "nsz"}, makes_arrays=False)
def _round_unit(
    vectors: Doubles, which: int, length: float, factor: float, slot: int, steps: Steps
) -> tuple[float, float]:
    """Round one of several vectors, divided by its length, to 16 bits; return step and largest error."""
    # The unit vector is ``step`` times the slot's moves, up to a vector of at most the length ``error``. A
    # factor times that vector is added to the drift.
    rows = np.uint64(vectors.shape[1])
    top = 0.0
    for m in range(rows):
        top = max(top, abs(vectors[which, m]))
    scale = min(SCALE, LARGEST * length / top) / length
    square = 0.0
    for m in range(rows):
        value = vectors[which, m] * scale
        nearest = np.rint(value)
        square += (nearest - value) ** 2
        steps.drift[slot, m] += factor / scale * (nearest - value)
        steps.moves[slot, m] = np.int16(np.int32(nearest))
    return 1 / (scale * length), np.sqrt(square) / (scale * length)
