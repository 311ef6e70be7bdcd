# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Updates of atoms from sparse codes: all at once by least squares, or one after the other by K-SVD."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from optsim.core.compiled import compiled
from optsim.core.quantities import Doubles, Floats, Ints

_BLOCK = 2048
# With fewer uses an atom would fit one patch instead of learning from many.
_FEWEST_USES = 5
# Sums may be reordered for vector units; NaN keeps its meaning.
_FAST = {"reassoc", "contract", "arcp", "nsz"}


def least_squares_atoms(signals: Floats, atoms: Floats, support: Ints, amounts: Floats) -> Floats:
    """Update all atoms at once by the method of optimal directions: ``X' C (C' C)^-1``."""
    # Engan, Aase and Husoy, ICASSP 1999, doi:10.1109/ICASSP.1999.760624.
    n_atoms = len(atoms)
    square = np.zeros((n_atoms, n_atoms))
    cross = np.zeros(atoms.shape)
    for first in range(0, len(signals), _BLOCK):
        part = slice(first, first + _BLOCK)
        codes = dense(support[part], amounts[part], n_atoms)
        square += codes.T @ codes
        cross += codes.T @ signals[part]
    # Keeps rarely used atoms.
    ridge = 1e-6 * np.trace(square) / n_atoms
    system: Doubles = square + ridge * np.eye(n_atoms)
    return np.asarray(np.linalg.solve(system, cross + ridge * atoms), np.float32)


def k_svd_atoms(signals: Floats, atoms: Floats, support: Ints, amounts: Floats) -> tuple[Floats, Floats]:
    """Update the atoms but the constant one after the other, with their coefficients, by approximate K-SVD.

    R. Rubinstein, M. Zibulevsky and M. Elad, Technion CS-2008-08: one step of the power method towards the
    best rank-one fit of the other atoms' residual, so the error never grows. The residuals are stored and
    updated, which takes four passes over the signals of an atom and no product with all atoms.
    """
    rows, places = np.nonzero(support >= 0)
    used = support[rows, places]
    shape = len(signals), len(atoms)
    residuals = csr_array((amounts[rows, places], (rows, used)), shape=shape) @ atoms
    np.subtract(signals, residuals, out=residuals)
    order = np.argsort(used, kind="stable")
    starts = np.searchsorted(used[order], np.arange(len(atoms) + 1))
    new, coefficients = atoms.copy(), amounts[rows, places][order]
    _one_by_one(residuals, new, rows[order], coefficients, starts)
    changed = amounts.copy()
    changed[rows[order], places[order]] = coefficients
    return new, changed


@compiled(fastmath=_FAST)
def _one_by_one(residuals: Floats, atoms: Floats, users: Ints, amounts: Floats, starts: Ints) -> None:
    """Update atoms and amounts in place; those of atom k are from ``starts[k]`` to ``starts[k + 1]``."""
    new = np.empty(atoms.shape[1], np.float32)
    for k in range(1, len(atoms)):
        atom, first, last = atoms[k], starts[k], starts[k + 1]
        # The direction E'g of E = residuals + g atom', without E.
        energy = np.float32(0)
        for i in range(first, last):
            energy += amounts[i] * amounts[i]
        for j in range(len(new)):
            new[j] = energy * atom[j]
        for i in range(first, last):
            row, amount = residuals[users[i]], amounts[i]
            for j in range(len(new)):
                new[j] += amount * row[j]
        square, same = np.float32(0), np.float32(0)
        for j in range(len(new)):
            square += new[j] * new[j]
        if square == 0:
            continue
        length = np.float32(1) / np.sqrt(square)
        for j in range(len(new)):
            new[j] *= length
            same += new[j] * atom[j]
        # The coefficients Ed, and the residuals after them.
        for i in range(first, last):
            row, before = residuals[users[i]], amounts[i]
            amount = before * same
            for j in range(len(new)):
                amount += row[j] * new[j]
            for j in range(len(new)):
                row[j] += before * atom[j] - amount * new[j]
            amounts[i] = amount
        atom[:] = new


def renewed(atoms: Floats, uses: Ints, signals: Floats, left: Floats) -> Floats:
    """Restart rarely used atoms from the patches with the largest residuals."""
    idle = uses < _FEWEST_USES
    idle[0] = False
    worst = signals[np.argsort(left)[::-1][: int(idle.sum())]]
    fresh = atoms.copy()
    fresh[idle] = worst - worst.mean(axis=1, keepdims=True)
    fresh[0] = 1
    return fresh


def dense(support: Ints, amounts: Floats, n_atoms: int) -> Floats:
    """Sparse codes as an array of shape (n, k)."""
    codes = np.zeros((len(support), n_atoms), np.float32)
    rows, places = np.nonzero(support >= 0)
    codes[rows, support[rows, places]] = amounts[rows, places]
    return codes
