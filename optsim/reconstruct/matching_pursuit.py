# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""Orthogonal matching pursuit for many signals that share one matrix, in compiled single-thread kernels.

Pati, Rezaiifar and Krishnaprasad, "Orthogonal matching pursuit", Asilomar 1993
(doi:10.1109/ACSSC.1993.342465), in the QR form: with q the part of the atom just picked that is orthogonal
to those before, its correlations with all atoms are ``A'q = (G_k - sum r_i A'q_i) / |.|``; ``A'residual``
then loses a multiple of that. So an atom costs one row of the Gram matrix G and a few vectors of K
numbers that stay in cache. Rows of G are computed when first asked for and kept: a matrix used once costs
what it must, a matrix shared by thousands of patches costs its Gram matrix once (compare Rubinstein,
Zibulevsky and Elad, Technion CS-2008-08, which keeps G but not ``A'q``).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from optsim.quantities import Bools, Doubles, Floats, Ints

# Sums may be reordered for vector units; NaN keeps its meaning.
_FAST = {"reassoc", "contract", "arcp", "nsz"}
_BLOCK = 32
_CHUNK = 256
_LANE = 128
# Squared distance of an atom from the span of those picked below which it is a copy, in float32.
_COPY = 1e-5


@njit(nogil=True, cache=True, fastmath=_FAST)
def correlations(signals: Floats, matrix: Floats, out: Floats) -> None:
    """Products ``signals @ matrix`` into ``out``, four signals and four rows at a time.

    Parameters
    ----------
    signals : ndarray of shape (p, m), float32
    matrix : ndarray of shape (m, k), float32
    out : ndarray of shape (p, k), float32
    """
    n, rows = signals.shape
    width = matrix.shape[1]
    for first in range(0, width, _CHUNK):
        last = min(width, first + _CHUNK)
        for p in range(0, n - 3, 4):
            o0 = out[p, first:last]
            o1 = out[p + 1, first:last]
            o2 = out[p + 2, first:last]
            o3 = out[p + 3, first:last]
            o0[:] = 0
            o1[:] = 0
            o2[:] = 0
            o3[:] = 0
            for m in range(0, rows - 3, 4):
                a = matrix[m, first:last]
                b = matrix[m + 1, first:last]
                c = matrix[m + 2, first:last]
                d = matrix[m + 3, first:last]
                s0 = signals[p, m : m + 4]
                s1 = signals[p + 1, m : m + 4]
                s2 = signals[p + 2, m : m + 4]
                s3 = signals[p + 3, m : m + 4]
                a0, b0, c0, d0 = s0[0], s0[1], s0[2], s0[3]
                a1, b1, c1, d1 = s1[0], s1[1], s1[2], s1[3]
                a2, b2, c2, d2 = s2[0], s2[1], s2[2], s2[3]
                a3, b3, c3, d3 = s3[0], s3[1], s3[2], s3[3]
                for k in range(last - first):
                    o0[k] += a0 * a[k] + b0 * b[k] + c0 * c[k] + d0 * d[k]
                    o1[k] += a1 * a[k] + b1 * b[k] + c1 * c[k] + d1 * d[k]
                    o2[k] += a2 * a[k] + b2 * b[k] + c2 * c[k] + d2 * d[k]
                    o3[k] += a3 * a[k] + b3 * b[k] + c3 * c[k] + d3 * d[k]
            for m in range(rows - rows % 4, rows):
                for q in range(p, p + 4):
                    _add(out[q, first:last], signals[q, m], matrix[m, first:last])
        for p in range(n - n % 4, n):
            out[p, first:last] = 0
            for m in range(rows):
                _add(out[p, first:last], signals[p, m], matrix[m, first:last])


@njit(nogil=True, cache=True, fastmath=_FAST)
def _add(target: Floats, factor: float, source: Floats) -> None:
    for k in range(len(target)):
        target[k] += factor * source[k]


@njit(nogil=True, cache=True)
def pursue(
    matrix: Floats,
    signals: Floats,
    stop_energy: Floats,
    gram: Floats,
    known: Bools,
    support: Ints,
    amounts: Floats,
) -> None:
    """Sparse codes of signals over the columns of a matrix.

    Parameters
    ----------
    matrix : ndarray of shape (m, k), float32
        Columns of unit length (or all zero).
    signals : ndarray of shape (p, m), float32
        One signal a row.
    stop_energy : ndarray of shape (p,), float32
        Squared residual at which a signal is done.
    gram : ndarray of shape (k, k), float32
        Rows of ``matrix.T @ matrix``, valid where ``known``; others are filled in on the way.
    known : ndarray of shape (k,), bool
        Which rows of ``gram`` are valid.
    support : ndarray of shape (p, s), int64
        Filled with the atoms in the order picked, -1 after the last.
    amounts : ndarray of shape (p, s), float32
        Filled with their coefficients.
    """
    width = matrix.shape[1]
    products = np.empty((_BLOCK, width), np.float32)
    for first in range(0, len(signals), _BLOCK):
        block = signals[first : first + _BLOCK]
        correlations(block, matrix, products)
        pursue_products(
            products[: len(block)],
            (block.astype(np.float64) ** 2).sum(axis=1),
            stop_energy[first : first + _BLOCK],
            matrix,
            gram,
            known,
            support[first : first + _BLOCK],
            amounts[first : first + _BLOCK],
        )


@njit(nogil=True, cache=True)
def pursue_products(
    products: Floats,
    energy: Doubles,
    stop_energy: Floats,
    matrix: Floats,
    gram: Floats,
    known: Bools,
    support: Ints,
    amounts: Floats,
) -> None:
    """As :func:`pursue`, from the products ``signals @ matrix`` (overwritten) and the signals' energies."""
    n, cap = support.shape
    width = products.shape[1]
    spans = np.empty((cap, width), np.float32)
    for p in range(n):
        _one(products[p], energy[p], stop_energy[p], matrix, gram, known, spans, support[p], amounts[p])


@njit(nogil=True, cache=True)
def _one(
    products: Floats,
    energy: float,
    stop_energy: float,
    matrix: Floats,
    gram: Floats,
    known: Bools,
    spans: Floats,
    support: Ints,
    amounts: Floats,
) -> None:
    cap = len(support)
    triangle = np.zeros((cap, cap), np.float64)
    shares = np.zeros(cap, np.float64)
    picked = 0
    support[:] = -1
    amounts[:] = 0
    best = _largest(products)
    while picked < cap and energy > stop_energy and products[best] != 0:
        rest = 1.0
        for i in range(picked):
            triangle[i, picked] = spans[i, best]
            rest -= triangle[i, picked] ** 2
        if rest < _COPY:
            break
        if not known[best]:
            _gram_row(matrix, best, gram[best])
            known[best] = True
        length = np.sqrt(rest)
        triangle[picked, picked] = length
        support[picked] = best
        shares[picked] = products[best] / length
        energy -= shares[picked] ** 2
        factors = triangle[:, picked].astype(np.float32)
        _project(gram[best], spans, factors, picked, 1 / length, shares[picked], products)
        picked += 1
        best = _largest(products)
    for i in range(picked - 1, -1, -1):
        total = shares[i]
        for j in range(i + 1, picked):
            total -= triangle[i, j] * amounts[j]
        amounts[i] = total / triangle[i, i]


@njit(nogil=True, cache=True, fastmath=_FAST)
def _gram_row(matrix: Floats, column: int, row: Floats) -> None:
    row[:] = 0
    for m in range(matrix.shape[0]):
        _add(row, matrix[m, column], matrix[m])


@njit(nogil=True, cache=True, fastmath=_FAST)
def _project(
    row: Floats, spans: Floats, factors: Floats, picked: int, scale: float, share: float, products: Floats
) -> None:
    """Fill ``spans[picked]`` with the new direction's correlations; take its share out of the products."""
    # Only in-place updates: where a loop's source may be its own target, compilers fall back to scalar code.
    scale32, share32 = np.float32(scale), np.float32(share)
    new = spans[picked]
    for k in range(len(new)):
        new[k] = row[k]
    whole = picked - picked % 4
    for i in range(0, whole, 4):
        a, b, c, d = spans[i], spans[i + 1], spans[i + 2], spans[i + 3]
        fa, fb, fc, fd = factors[i], factors[i + 1], factors[i + 2], factors[i + 3]
        for k in range(len(new)):
            new[k] -= fa * a[k] + fb * b[k] + fc * c[k] + fd * d[k]
    for i in range(whole, picked):
        _add(new, -factors[i], spans[i])
    for k in range(len(new)):
        value = new[k] * scale32
        new[k] = value
        products[k] -= share32 * value


@njit(nogil=True, cache=True)
def _largest(values: Floats) -> int:
    """Index of the largest magnitude.

    Floats without their sign bit are in the order of their bit patterns, and compilers turn an integer
    maximum into vector code, unlike a float one: ten times faster here.
    """
    bits = values.view(np.int32)
    peak = np.int32(-1)
    start = 0
    for first in range(0, len(bits), _LANE):
        local = _peak(bits[first : first + _LANE])
        if local > peak:
            peak = local
            start = first
    for k in range(start, len(bits)):
        if bits[k] & np.int32(0x7FFFFFFF) == peak:
            return k
    return 0


@njit(nogil=True, cache=True)
def _peak(bits: NDArray[np.int32]) -> np.int32:
    peak = np.int32(-1)
    for k in range(len(bits)):
        peak = max(peak, bits[k] & np.int32(0x7FFFFFFF))
    return peak
