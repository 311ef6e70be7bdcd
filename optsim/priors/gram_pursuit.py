"""Orthogonal matching pursuit for long signals, from BLAS products and the whole Gram matrix.

For training, where a signal has 2304 numbers. Products of each new direction with the matrix, as in
:mod:`.matching_pursuit`, would cost far more than a row of the Gram matrix.

Pati, Rezaiifar and Krishnaprasad, "Orthogonal matching pursuit", Asilomar 1993
(doi:10.1109/ACSSC.1993.342465), in the QR form. Let q be the part of the selected atom that is orthogonal
to those before. Its correlations with all atoms are ``A'q = (G_k - sum r_i A'q_i) / |.|``, and ``A'residual``
loses a multiple of that (compare Rubinstein, Zibulevsky and Elad, Technion CS-2008-08, which keeps G
but not ``A'q``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from optsim.core.compiled import compiled
from optsim.core.quantities import Floats, Ints
from optsim.priors.correlation_bounds import COPY

# Sums may be reordered for vector units; NaN keeps its meaning.
_FAST = {"reassoc", "contract", "arcp", "nsz"}
_LANE = 128


@compiled(fastmath=_FAST)
def _add(target: Floats, factor: float, source: Floats) -> None:
    for k in range(len(target)):
        target[k] += factor * source[k]


@compiled()
def pursue_products(products: Floats, gram: Floats, support: Ints, amounts: Floats) -> None:
    """Sparse codes of signals from their products with all atoms."""
    n, cap = support.shape
    spans = np.empty((cap, products.shape[1]), np.float32)
    for p in range(n):
        _one(products[p], gram, spans, support[p], amounts[p])


@compiled()
def _one(products: Floats, gram: Floats, spans: Floats, support: Ints, amounts: Floats) -> None:
    cap = len(support)
    triangle = np.zeros((cap, cap), np.float64)
    shares = np.zeros(cap, np.float64)
    picked = 0
    support[:] = -1
    amounts[:] = 0
    best = _largest(products)
    while picked < cap and products[best] != 0:
        rest = 1.0
        for i in range(picked):
            triangle[i, picked] = spans[i, best]
            rest -= triangle[i, picked] ** 2
        if rest < COPY:
            break
        length = np.sqrt(rest)
        triangle[picked, picked] = length
        support[picked] = best
        shares[picked] = products[best] / length
        factors = triangle[:, picked].astype(np.float32)
        _project(gram[best], spans, factors, picked, 1 / length, shares[picked], products)
        picked += 1
        best = _largest(products)
    for i in range(picked - 1, -1, -1):
        total = shares[i]
        for j in range(i + 1, picked):
            total -= triangle[i, j] * amounts[j]
        amounts[i] = total / triangle[i, i]


@compiled(fastmath=_FAST)
def _project(
    row: Floats, spans: Floats, factors: Floats, picked: int, scale: float, share: float, products: Floats
) -> None:
    """Fill ``spans[picked]`` with the new direction's correlations; subtract its share from the products."""
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


@compiled()
def _largest(values: Floats) -> int:
    """Index of the largest magnitude."""
    # Floats without their sign bit are in the order of their bit patterns. Compilers turn an integer maximum
    # into vector code, unlike a float one: ten times faster here.
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


@compiled()
def _peak(bits: NDArray[np.int32]) -> np.int32:
    peak = np.int32(-1)
    for k in range(len(bits)):
        peak = max(peak, bits[k] & np.int32(0x7FFFFFFF))
    return peak
