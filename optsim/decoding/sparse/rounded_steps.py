"""What a pursuit asks :func:`.correlate` to renew, and how far the outcome may be off.

Correlations start from a rounded residual and lose the share of one rounded direction after the other. All
use one rounded matrix. So the outcome equals that matrix times (residual + drift), where the drift is the
known sum of the vectors' rounding errors. The matrix's own rounding adds at most its largest error times the
norm of the residual, however many steps were taken (Cauchy and Schwarz). Its products with orthonormal
directions, of which distances are made, are together no longer than it is (Bessel).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Doubles, Floats
from optsim.priors.correlation_bounds import LARGEST, SCALE, Pairs

# Of float32 sums, relative to a signal.
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
    """Make steps of slots at rest."""
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
    """Have correlations, which are set to zero, computed from the residual of some length itself.

    Parameters
    ----------
    slot : int
        Which one.
    residual : ndarray of shape (slot, m), float64
        Of all slots.
    length : float
        Of the slot's residual.
    grid : tuple of float
        Step and error of the matrix, from :func:`.pack`.
    steps : Steps
        The slot's are renewed; ``doubt`` stays.
    """
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
    """Have correlations lose a share of a direction, and distances what lies along it.

    Parameters
    ----------
    slot : int
        Which one.
    directions : ndarray of shape (d, m), float64
        Orthonormal those of a slot.
    which : int
        The direction.
    share : float
        What the residual loses of it.
    left : float
        Length of the residual without it.
    count : int
        Directions of the slot, this one included.
    grid : tuple of float
        Step and error of the matrix, from :func:`.pack`.
    steps : Steps
        The slot's are renewed.
    """
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
    """Most that a correlation with a residual of some length is off, but for its float32 rounding."""
    square = 0.0
    for m in range(steps.drift.shape[1]):
        square += steps.drift[slot, m] ** 2
    return (1 + grid_error) * np.sqrt(square) + grid_error * left


@compiled(fastmath={"reassoc", "contract", "nnan", "nsz"}, makes_arrays=False)
def _round_unit(
    vectors: Doubles, which: int, length: float, factor: float, slot: int, steps: Steps
) -> tuple[float, float]:
    """Round one of several vectors, divided by its length, to 16 bits; a factor times its error drifts.

    Returns
    -------
    step, error : float
        The vector divided by its length is ``step`` times the slot's moves, but for a vector of at most the
        length ``error``.
    """
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
