"""Weights that patches share under a periodic code; the period is found from the weights.

Preparing a prior for a matrix of weights costs more than decoding a patch with it. So patches that start at
the same place of a periodic tile share one. Calibrated weights have noise and holes, some pixels are just
leaving another code, and rows written one after the other drift apart. The period is therefore that of most
pixels, and pixels that deviate from the tile keep their own weights. A wrong period costs time, never
accuracy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, Floats, Ints

# Longest period that is tried, panel pixels: the longest tile of a scheme.
_LONGEST = 64
# Pixels that are compared with their partners; least pairs to judge a lag.
_COMPARED, _LEAST_PAIRS = 1024, 16
# Two pixels differ when their distance, relative to the rms over pixels, exceeds this many tolerances:
# three standard deviations of the most noise that a patch may have. Codes differ by far more.
_APART = 4
# A lag at which more pairs than this differ is no period.
_MOST_DIFFERING = 0.5
# A tile that this share of the pixels follows is taken before one of more places.
_MOST_FOLLOW = 0.8
# Pixels from which the weights of a place in the tile are taken.
_AVERAGED = 101
_GOLDEN = (np.sqrt(5) - 1) / 2


@dataclass(frozen=True, eq=False)
class SharedWeights:
    """Assignment of patches to shared weights, and these weights."""

    # (v, u, slot), the periodic tile; as many rows or columns as the image where there is no period.
    tile: Floats
    # (p,), place in the tile at which each patch starts, row by row; -1 for those with their own weights.
    phase: Ints
    patch: int  # Side of a patch, panel pixels.

    def weights(self, phase: int) -> Floats:
        """Weights (pixel, slot) of the patches that start at a place of the tile."""
        return weights_at(self.tile, phase, self.patch)

    @property
    def matrices(self) -> int:
        """Number of different weight matrices over all patches."""
        return len(np.unique(self.phase[self.phase >= 0])) + int((self.phase < 0).sum())


def shared_weights(
    weights: Floats, mask: Bools, corners: Ints, patch: int, tolerance: float
) -> SharedWeights:
    """Find the patches that share weights."""
    rows, cols = mask.shape
    v, u = code_period(weights, mask, tolerance)
    if (v, u) == (rows, cols):
        return SharedWeights(weights, np.full(len(corners), -1, np.int64), patch)
    best = _shared(weights, mask, corners, patch, tolerance, (v, u))
    left_out = best.phase < 0
    if left_out.any():
        # No tile includes patches with a hole.
        left_out &= _gathered(mask, corners, patch) == patch**2
    # Weights drift over the rows or columns: only patches of the same rows, or columns, share.
    for tile in ((rows, u), (v, cols)):
        if 2 * len(np.unique(places(corners[left_out], tile))) < left_out.sum():
            other = _shared(weights, mask, corners, patch, tolerance, tile)
            best = min(best, other, key=lambda each: each.matrices)
    return best


def weights_at(tile: Floats, place: int, patch: int) -> Floats:
    """Weights (pixel, slot) of a patch that starts at a place of a tile, which repeats."""
    rows, cols, slots = tile.shape
    first_v, first_u = divmod(place, cols)
    v = np.mod(first_v + np.arange(patch), rows)
    u = np.mod(first_u + np.arange(patch), cols)
    return tile[v[:, None], u].reshape(patch**2, slots)


def followed_tile(weights: Floats, mask: Bools, tolerance: float) -> tuple[Floats, Bools]:
    """Find the tile (v, u, slot) that most pixels follow to the tolerance, relative rms, and these pixels.

    They may lie beyond the mask.
    """
    # As many rows or columns as the image where there is no period or weights drift along it.
    rows, cols = mask.shape
    v, u = code_period(weights, mask, tolerance / _APART)
    best = np.zeros((v, u, weights.shape[2]), np.float32), np.zeros_like(mask)
    most = 0
    for shape in ((v, u), (rows, u), (v, cols), (rows, cols)):
        tile = np.zeros((*shape, weights.shape[2]), np.float32)
        _fill_medians(weights, mask, tile)
        error, energy = _deviation(weights, tile)
        follows = error <= tolerance**2 * energy
        if (inside := (follows & mask).sum()) > most:
            best, most = (tile, follows), inside
        if most >= _MOST_FOLLOW * mask.sum():
            break
    return best


def code_period(weights: Floats, mask: Bools, tolerance: float) -> tuple[int, int]:
    """Rows and columns after which a code repeats; all of them where it doesn't.

    At each lag a thousand pixels are compared with those at that distance along the axis. Some pairs differ
    at any lag, because some pixels are just leaving another code. The period is the shortest lag at which no
    more pairs differ than at the best one, within three standard errors.
    """
    rows, cols = mask.shape
    there = np.flatnonzero(mask)
    # Multiples of the golden ratio spread evenly and share no period with any code.
    chosen = there[(np.arange(min(_COMPARED, len(there))) * _GOLDEN % 1 * len(there)).astype(np.int64)]
    v, u = np.divmod(chosen, cols)
    energy = np.square(weights[v, u], dtype=np.float64).sum(axis=1).mean() if len(chosen) else 0.0
    bound = float(energy) * (_APART * tolerance) ** 2
    return (
        _period(weights, mask, v, u, 0, bound) or rows,
        _period(weights, mask, v, u, 1, bound) or cols,
    )


def _shared(
    weights: Floats, mask: Bools, corners: Ints, patch: int, tolerance: float, tile: tuple[int, int]
) -> SharedWeights:
    nominal = np.zeros((*tile, weights.shape[2]), np.float32)
    _fill_medians(weights, mask, nominal)
    error, energy = (_gathered(image, corners, patch) for image in _deviation(weights, nominal))
    return SharedWeights(nominal, np.where(error > tolerance**2 * energy, -1, places(corners, tile)), patch)


def _gathered(image: Doubles | Bools, corners: Ints, patch: int) -> Doubles:
    """Sum of an image (v, u) over each patch."""
    sums = np.pad(image.astype(np.float64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    top, left = corners[:, 0], corners[:, 1]
    bottom, right = top + patch, left + patch
    return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]


def places(corners: Ints, tile: tuple[int, int]) -> Ints:
    """Place in the tile at which each patch starts, row by row."""
    return corners[:, 0] % tile[0] * tile[1] + corners[:, 1] % tile[1]


@compiled()
def _period(weights: Floats, mask: Bools, rows: Ints, cols: Ints, axis: int, bound: float) -> int:
    """Shortest lag at which the weights repeat along an axis; 0 if there is none."""
    longest = min(_LONGEST, mask.shape[axis] - 1)
    pairs, differ = np.zeros(longest + 1, np.int64), np.zeros(longest + 1, np.int64)
    least = 2.0
    for lag in range(1, longest + 1):
        pairs[lag], differ[lag] = _pairs(weights, mask, rows, cols, axis, lag, bound)
        if pairs[lag] >= _LEAST_PAIRS:
            least = min(least, differ[lag] / pairs[lag])
            if differ[lag] == 0:
                break
    if least <= _MOST_DIFFERING:
        for lag in range(1, longest + 1):
            if pairs[lag] >= _LEAST_PAIRS and differ[lag] - 3 * np.sqrt(differ[lag]) <= least * pairs[lag]:
                return lag
    return 0


@compiled(fastmath={"reassoc", "contract"})
def _pairs(
    weights: Floats, mask: Bools, rows: Ints, cols: Ints, axis: int, lag: int, bound: float
) -> tuple[int, int]:
    """Pixels that have a partner at a lag, before or behind, and how many of them differ from it."""
    pairs, differ = 0, 0
    down, right = (lag, 0) if axis == 0 else (0, lag)
    for v, u in zip(rows, cols):  # noqa: B905 (numba)
        y, x = v + down, u + right
        if y >= mask.shape[0] or x >= mask.shape[1] or not mask[y, x]:
            y, x = v - down, u - right
            if y < 0 or x < 0 or not mask[y, x]:
                continue
        pairs += 1
        square = np.float32(0)
        for t in range(weights.shape[2]):
            square += (weights[v, u, t] - weights[y, x, t]) ** 2
        differ += int(square > bound)
    return pairs, differ


@compiled()
def _fill_medians(weights: Floats, mask: Bools, tile: Floats) -> None:
    """Fill in the median weights of each place in the tile: the steady state; 0 without pixels."""
    rows, cols, slots = weights.shape
    high, wide = tile.shape[:2]
    numbers = np.empty((slots, _AVERAGED), np.float32)
    for v0 in range(high):
        for u0 in range(wide):
            there = 0
            for v in range(v0, rows, high):
                for u in range(u0, cols, wide):
                    there += mask[v, u]
            if there == 0:
                continue
            step, seen, taken = -(-there // _AVERAGED), 0, 0
            for v in range(v0, rows, high):
                for u in range(u0, cols, wide):
                    if mask[v, u]:
                        if seen % step == 0:
                            for t in range(slots):
                                numbers[t, taken] = weights[v, u, t]
                            taken += 1
                        seen += 1
            for t in range(slots):
                tile[v0, u0, t] = np.median(numbers[t, :taken])


@compiled(fastmath={"reassoc", "contract"})
def _deviation(weights: Floats, tile: Floats) -> tuple[Doubles, Doubles]:
    """Squared difference of each pixel's weights from the tile's, and the square of these: (v, u) each."""
    rows, cols, slots = weights.shape
    error, energy = np.empty((rows, cols)), np.empty((rows, cols))
    for v in range(rows):
        y = v % tile.shape[0]
        for u in range(cols):
            x = u % tile.shape[1]
            off, all_ = np.float32(0), np.float32(0)
            for t in range(slots):
                off += (weights[v, u, t] - tile[y, x, t]) ** 2
                all_ += tile[y, x, t] ** 2
            error[v, u], energy[v, u] = off, all_
    return error, energy
