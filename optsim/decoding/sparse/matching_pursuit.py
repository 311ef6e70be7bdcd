"""Orthogonal matching pursuit for many short signals that share one matrix, in single-thread kernels.

Each step selects the atom that leaves the least residual after a fit of all selected ones: the greatest
``c**2 / n`` with c the atom's correlation with the residual and n its squared distance from the span of
the selected atoms. That is the order-recursive form (Gharavi-Alkhansari and Huang, ICASSP 1998,
doi:10.1109/ICASSP.1998.681678; Rebollo-Neira and Lowe, 2002, doi:10.1109/LSP.2002.1001652), which SPAMS
computes too; Pati, Rezaiifar and Krishnaprasad (1993) select the greatest ``|c|``.

The direction q that an atom adds changes all c and n by ``A'q``: one product of q with the matrix a step. It
runs in 16-bit integers for a few signals at a time (:mod:`.correlation_bounds`), which gives bounds. Atoms
whose bound could win are compared exactly, in float64. So the choice doesn't depend on the blocks of signals.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.decoding.sparse.rounded_steps import Steps, follow, look, make_steps
from optsim.priors.correlation_bounds import (
    COPY,
    PANEL,
    SHARING,
    atom_of,
    correlate,
    pack,
    packed_shape,
    peaks_of,
)

# Signals in work together share each reading of the matrix; with more, their own states would be read too
# often.
_SLOTS = 16
# Shares of a signal's energy below this are rounding of its float32 numbers.
_NOTHING = 1e-12
# Correlations are recomputed where their bound exceeds this share of the residual.
_STALE = 0.0012
# Peaks compared together.
_CHUNK = 16


class _Atoms(NamedTuple):
    """Columns of a matrix as contiguous vectors: all copied for many signals, else at their first use."""

    matrix: Floats  # (m, k)
    columns: Floats  # (k, m)
    known: Bools  # (k,)


@compiled()
def pursue(matrix: Floats, signals: Floats, stop_energy: Floats, support: Ints, amounts: Floats) -> None:
    """Sparse codes of signals over the columns of a matrix.

    Atoms nearer than ``sqrt(1e-5)`` to the span of the selected ones count as copies and are never selected,
    nor are those with less than 1e-12 of a signal's energy: rounding of its float32 numbers.
    """
    rows, width = matrix.shape
    n, cap = support.shape
    packed = np.empty(packed_shape(rows, width), np.int16)
    grid = pack(matrix, packed)
    atoms = _Atoms(matrix, np.empty((width, rows), np.float32), np.zeros(width, np.bool_))
    support[:] = -1
    amounts[:] = 0
    slots = min(_SLOTS, n)
    if n > _SLOTS:
        _turn(matrix, atoms.columns)
        atoms.known[:] = True
    # Arrays that correlate() reads and renews.
    steps = make_steps(slots, rows, packed.shape[1])
    state = np.zeros((packed.shape[0], slots, 2, PANEL), np.float32)
    peaks = np.zeros((slots, peaks_of(packed.shape[0])), np.float32)
    # Largest peak of each chunk, of one slot at a time.
    heights = np.zeros(-(-peaks.shape[1] // _CHUNK), np.float32)
    # For each slot: its signal and that signal's length, the unit of all lengths below; its number of atoms.
    owner, length, picked = np.full(slots, -1, np.int64), np.zeros(slots), np.zeros(slots, np.int64)
    # The residual, its energy, and the energy at which pursuit stops.
    residual, energy, enough = np.zeros((slots, rows)), np.zeros(slots), np.zeros(slots)
    # Selected atoms, one a row, in an orthonormal basis; the signal in that basis.
    basis, triangle = np.zeros((slots, cap, rows)), np.zeros((slots, cap, cap))
    directions = basis.reshape(slots * cap, rows)
    shares, parts = np.zeros((slots, cap)), np.zeros(cap)
    # Whether correlations must be recomputed before the next selection.
    stale = np.zeros(slots, np.bool_)
    following = 0
    while True:
        busy = 0
        for slot in range(slots):
            while owner[slot] < 0 and following < n:
                residual[slot] = signals[following]
                square = _dot(residual[slot], residual[slot])
                if square > stop_energy[following]:
                    owner[slot], length[slot], picked[slot] = following, np.sqrt(square), 0
                    energy[slot], enough[slot] = 1, max(stop_energy[following] / square, _NOTHING)
                    residual[slot] /= length[slot]
                    steps.doubt[slot] = 0
                    _restart(slot, state, width)
                    _look(slot, residual, energy, grid, state, steps)
                following += 1
            if owner[slot] >= 0:
                busy = slot + 1
        if busy == 0:
            break
        correlate(packed, steps.moves, state, steps.terms, peaks, busy)
        for slot in range(busy):
            p, count = owner[slot], picked[slot]
            if p < 0:
                continue
            if stale[slot]:
                _look(slot, residual, energy, grid, state, steps)
                stale[slot] = False
                continue
            best = _best(
                slot, state, peaks, heights, steps.terms, atoms, residual, basis, triangle, parts, count
            )
            if best >= 0:
                shares[slot, count], energy[slot] = _extend(
                    slot, best, atoms.columns, basis, triangle, residual, count
                )
                support[p, count] = best
                count += 1
                picked[slot] = count
            if best < 0 or count == cap or energy[slot] <= enough[slot]:
                _solve(triangle[slot], shares[slot], length[slot], amounts[p, :count])
                owner[slot] = -1
                steps.terms[slot] = 0
                continue
            share, left = shares[slot, count - 1], np.sqrt(energy[slot])
            follow(slot, directions, slot * cap + count - 1, share, left, count, grid, steps)
            stale[slot] = steps.terms[slot, 2] > _STALE * left


# The hottest functions take whole arrays and a slot: each slice would cost two atomic counts.
@compiled(makes_arrays=False)
def _look(
    slot: int, residual: Doubles, energy: Doubles, grid: tuple[float, float], state: Floats, steps: Steps
) -> None:
    """Set a step that computes the correlations from the residual itself."""
    for panel in range(len(state)):
        for k in range(PANEL):
            state[panel, slot, 0, k] = 0
    look(slot, residual, np.sqrt(energy[slot]), grid, steps)


@compiled()
def _turn(matrix: Floats, columns: Floats) -> None:
    """Transpose, some columns at a time, since single ones would miss the cache at each number."""
    rows, width = matrix.shape
    for first in range(0, width, PANEL):
        for m in range(rows):
            for k in range(first, min(first + PANEL, width)):
                columns[k, m] = matrix[m, k]


@compiled(makes_arrays=False)
def _restart(slot: int, state: Floats, width: int) -> None:
    """Set initial distances of unit atoms; columns beyond the last atom are never selected."""
    for panel in range(len(state)):
        for k in range(PANEL):
            state[panel, slot, 1, k] = 1
    for atom in range(width, len(state) * PANEL):
        state[atom // PANEL, slot, 1, atom % PANEL] = np.inf


@compiled(makes_arrays=False)
def _best(
    slot: int,
    state: Floats,
    peaks: Floats,
    heights: Floats,
    terms: Floats,
    atoms: _Atoms,
    residual: Doubles,
    basis: Doubles,
    triangle: Doubles,
    parts: Doubles,
    count: int,
) -> int:
    """Atom with the most residual energy, the first of equal ones or -1; the triangle gets its parts."""
    c_error, n_error = terms[slot, 2], terms[slot, 3]
    n_peaks = peaks.shape[1]
    highest, top = np.float32(-1), 0
    for chunk in range(0, n_peaks, _CHUNK):
        largest = _largest(peaks, slot, chunk)
        heights[chunk // _CHUNK] = largest
        if largest > highest:
            highest, top = largest, chunk
    while peaks[slot, top] != highest:
        top += 1
    # The likeliest first: its exact value rules out nearly all others.
    first, bound = 0, 0.0
    for i in range(SHARING):
        product, distance = _bounds(state, slot, atom_of(top, i), c_error, n_error)
        if product > bound * distance:
            first, bound = atom_of(top, i), product / distance
    best, score = -1, _NOTHING
    taken = _energy_taken(slot, first, atoms, residual, basis, parts, count, 0.0)
    if taken > score:
        best, score = first, taken
        for k in range(count):
            triangle[slot, count, k] = parts[k]
    for chunk in range(0, n_peaks, _CHUNK):
        if heights[chunk // _CHUNK] <= score:
            continue
        for peak in range(chunk, min(chunk + _CHUNK, n_peaks)):
            if peaks[slot, peak] <= score:
                continue
            for i in range(SHARING):
                atom = atom_of(peak, i)
                if atom == best:
                    continue
                product, distance = _bounds(state, slot, atom, c_error, n_error)
                if product <= score * distance:
                    continue
                taken = _energy_taken(slot, atom, atoms, residual, basis, parts, count, score * distance)
                if taken > score or (taken == score and atom < best):
                    best, score = atom, taken
                    for k in range(count):
                        triangle[slot, count, k] = parts[k]
                elif taken < 0:
                    state[atom // PANEL, slot, 1, atom % PANEL] = np.inf
    return best


@compiled(fastmath={"nnan", "nsz"}, makes_arrays=False)
def _largest(peaks: Floats, slot: int, first: int) -> np.float32:
    """Largest of a chunk of peaks."""
    largest = np.float32(-1)
    # Unsigned: a loop whose index might be negative would not become vector code.
    for k in range(np.uint64(first), np.uint64(min(first + _CHUNK, peaks.shape[1]))):
        largest = max(largest, peaks[slot, k])
    return largest


@compiled(makes_arrays=False)
def _bounds(
    state: Floats, slot: int, atom: int, c_error: np.float32, n_error: np.float32
) -> tuple[float, float]:
    """Greatest c**2 and least n of an atom, as :func:`correlate` computes them; nothing beyond the last."""
    panel, place = atom // PANEL, atom % PANEL
    if panel >= len(state):
        return 0.0, 1.0
    most = abs(state[panel, slot, 0, place]) + c_error
    return float(most * most), float(max(state[panel, slot, 1, place] - n_error, np.float32(COPY)))


@compiled(fastmath={"reassoc", "contract"}, makes_arrays=False)
def _energy_taken(
    slot: int,
    atom: int,
    atoms: _Atoms,
    residual: Doubles,
    basis: Doubles,
    parts: Doubles,
    count: int,
    least: float,
) -> float:
    """Exact energy that an atom takes; 0 if c**2 is below the least, -1 for a copy. Finds its parts."""
    columns, rows = atoms.columns, atoms.columns.shape[1]
    if not atoms.known[atom]:
        for m in range(rows):
            columns[atom, m] = atoms.matrix[m, atom]
        atoms.known[atom] = True
    # Rounded to float32 an atom's length is not quite 1, and ties are finer than that.
    product, distance = 0.0, 0.0
    for m in range(rows):
        number = np.float64(columns[atom, m])
        product += residual[slot, m] * number
        distance += number * number
    if product * product < least:
        return 0.0
    for k in range(count):
        part = 0.0
        for m in range(rows):
            part += basis[slot, k, m] * columns[atom, m]
        parts[k] = part
        distance -= part * part
    return product * product / distance if distance >= COPY else -1.0


@compiled(fastmath={"reassoc", "contract"}, makes_arrays=False)
def _extend(
    slot: int,
    atom: int,
    columns: Floats,
    basis: Doubles,
    triangle: Doubles,
    residual: Doubles,
    count: int,
) -> tuple[float, float]:
    """Add an atom with its parts in the triangle to the basis; return its share and the energy left."""
    rows = columns.shape[1]
    for m in range(rows):
        basis[slot, count, m] = columns[atom, m]
    for k in range(count):
        part = triangle[slot, count, k]
        for m in range(rows):
            basis[slot, count, m] -= part * basis[slot, k, m]
    square = 0.0
    for m in range(rows):
        square += basis[slot, count, m] ** 2
    length = np.sqrt(square)
    share = 0.0
    for m in range(rows):
        basis[slot, count, m] /= length
        share += basis[slot, count, m] * residual[slot, m]
    energy = 0.0
    for m in range(rows):
        residual[slot, m] -= share * basis[slot, count, m]
        energy += residual[slot, m] ** 2
    triangle[slot, count, count] = length
    return share, energy


@compiled(makes_arrays=False)
def _solve(triangle: Doubles, shares: Doubles, length: float, amounts: Floats) -> None:
    """Coefficients of the atoms from those of the basis."""
    for i in range(len(amounts) - 1, -1, -1):
        total = length * shares[i]
        for j in range(i + 1, len(amounts)):
            total -= triangle[j, i] * amounts[j]
        amounts[i] = total / triangle[i, i]


@compiled(fastmath={"reassoc", "contract"})
def _dot(a: Doubles, b: Doubles | Floats) -> float:
    total = 0.0
    for m in range(len(a)):
        total += a[m] * b[m]
    return total
