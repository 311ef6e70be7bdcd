# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""The compiled loop of :mod:`optsim.forward.rims`: pixels of a band relax, and their rims are looked at.

Light that stands still needs the cells' sums over time only. All is linear but for the floor below, so what
was seen is added up first, and cells are made of the sums; where something moves, of each instant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.forward.compiled import compiled
from optsim.quantities import Bytes, Doubles, Floats, Ints

# The cosine from -pi to pi in powers of the square, to 5e-7 in float32: a loop over it is vectorised.
_COSINE = np.polynomial.Chebyshev.interpolate(lambda z: np.cos(np.sqrt(z)), 6, domain=[0, np.pi**2])
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = map(np.float32, _COSINE.convert(kind=np.polynomial.Polynomial).coef)
_PI = np.float32(np.pi)


class Points(NamedTuple):
    """Where along a pixel its retardance is looked at.

    Parameters
    ----------
    shares : ndarray of shape (point, 3), float32
        Of the pixel before, the pixel itself and the one after in its retardance.
    means : ndarray of shape (pitch, point), float32
        Their weights in the mean over each fine cell.
    borders : ndarray of shape (pitch, 3), float32
        Whose reflectance the cells have beside a border that stands still, as these points see it.
    """

    shares: Floats
    means: Floats
    borders: Floats


class Times(NamedTuple):
    """When the panel is looked at: shares of an interval, and the weights of each, (time,), float64."""

    share: Doubles
    weight: Doubles


class Turns(NamedTuple):
    """Instant of a slot in which each row turns to the slot's level, and how long after its start.

    Parameters
    ----------
    instant, early_s : ndarray of shape (v,), int64 and float64
        The instant, and the time, s.
    instant_s : float
        Duration of an instant, s.
    """

    instant: Ints
    early_s: Doubles
    instant_s: float


class Light(NamedTuple):
    """Least weight that a pixel of each column has, and what ``sin^2`` of 1 adds, (u,), float32."""

    least: Floats
    span: Floats


class Looks(NamedTuple):
    """Where and when a panel is looked at, and what it makes of light.

    Parameters
    ----------
    borders : ndarray of shape (pitch, 3), float32
        From :func:`optsim.forward.fringing.border_shares`.
    points : Points
        Along a pixel.
    times : Times
        In an instant, or in the part of one before or after a row's turn; the last is its end.
    light : Light
        Of each column.
    """

    borders: Floats
    points: Points
    times: Times
    light: Light


class Seen(NamedTuple):
    """What was seen of a band in an instant, or in several, each with a weight.

    Parameters
    ----------
    opened : ndarray of shape (v + 2, u + 2), float32
        Weights of pixels, one more on every side.
    alone : ndarray of shape (v + 2, u + 2), float32
        Mean cosines of their own retardances.
    blurred : ndarray of shape (v, point, point, u), float32
        Mean cosines of the blurred retardance at the points of each pixel, across and down.
    """

    opened: Floats
    alone: Floats
    blurred: Floats


@compiled(fastmath=True)
def fill_cells(
    levels: Bytes,
    gamma: Floats,
    shown: Bytes,
    targets: Floats,
    taus: Doubles,
    turns: Turns,
    looks: Looks,
    weights: Floats,
    keys: Floats,
    moving: Ints,
    sums: Floats,
    cells: Floats,
) -> None:
    """Fill the cells of a band: their sums over time, and those of each instant where something moves.

    Parameters
    ----------
    levels, gamma, shown, targets, taus, turns
        As of :func:`optsim.forward.relaxation.walk`, with a row more at the top and at the bottom of the
        band; ``gamma`` and ``shown`` are changed in place. Retardances are at most a whole wave.
    looks : Looks
        How rims are found.
    weights : ndarray of shape (t, v, u), float32
        Of the pixels, these rows too.
    keys : ndarray of shape (key, t), float32
        Share of each instant in each sum.
    moving : ndarray of shape (run, 2), int64
        Columns, first and after the last, that are wanted in each instant.
    sums : ndarray of shape (key, y, x), float32
        Filled.
    cells : ndarray of shape (t, y, x), float32
        Filled in these columns.
    """
    n_slots, rows, cols = levels.shape
    points, times, n_instants = looks.points, looks.times, len(weights)
    n_points, n_sub, instant_s = len(points.shares), n_instants // n_slots, turns.instant_s
    wide, inner = (rows, cols + 2), (rows - 2, n_points, n_points, cols)
    # A pixel more at the left and at the right, like its neighbour.
    target, step = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    now, line = np.empty(wide, np.float32), np.empty(cols + 2, np.float32)
    seen = Seen(np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty(inner, np.float32))
    opened, alone = np.zeros((len(keys), *wide), np.float32), np.zeros((len(keys), *wide), np.float32)
    blurred = np.zeros((len(keys), *inner), np.float32)
    share = np.empty(rows)
    for t in range(n_instants):
        slot, sub = t // n_sub, t % n_sub
        seen.alone[:] = 0
        seen.blurred[:] = 0
        for part in range(2):
            for r in range(rows):
                before_s = min(max((turns.instant[r] - sub) * instant_s + turns.early_s[r], 0.0), instant_s)
                share[r] = (before_s if part == 0 else instant_s - before_s) / instant_s
            if share.max() <= 0:
                continue
            _begin(gamma, targets[slot + part], shown if part == 0 else levels[slot], target, step)
            for j in range(times.share.size):
                for r in range(rows):
                    _relax_row(target[r], step[r], taus, times.share[j] * share[r] * instant_s, now[r, 1:-1])
                    now[r, 0], now[r, cols + 1] = now[r, 1], now[r, cols]
                    _add_own_cosines(seen.alone[r], now[r], np.float32(times.weight[j] * share[r]))
                for p in range(rows - 2):
                    of_time = np.float32(times.weight[j] * share[p + 1])
                    for a in range(n_points):
                        _mix_rows(points.shares[a], *_three(now, p, 0, cols + 2), line)
                        for b in range(n_points):
                            _add_cosines(seen.blurred[p, b, a], line, points.shares[b], of_time)
            gamma[:] = now[:, 1:-1]
        seen.opened[:, 1:-1] = weights[t]
        seen.opened[:, 0], seen.opened[:, -1] = weights[t, :, 0], weights[t, :, -1]
        for key in range(len(keys)):
            _add(opened[key], keys[key, t], seen.opened)
            _add(alone[key], keys[key, t], seen.alone)
            _add(blurred[key], keys[key, t], seen.blurred)
        for first, end in moving:
            _open_cells(seen, looks, np.float32(1), first, end, cells[t])
        if sub == n_sub - 1:
            shown[:] = levels[slot]
    for key in range(len(keys)):
        of_key = Seen(opened[key], alone[key], blurred[key])
        _open_cells(of_key, looks, keys[key].sum(), 0, cols, sums[key])


@compiled(fastmath=True)
def _add(total: Floats, share: np.floating, part: Floats) -> None:
    to, what = total.ravel(), part.ravel()
    for i in range(to.size):
        to[i] += share * what[i]


@compiled(fastmath=True)
def _open_cells(seen: Seen, looks: Looks, instants: np.floating, first: int, end: int, cells: Floats) -> None:
    """Fill the cells of some columns from what was seen in so many instants."""
    points, (least, span) = looks.points, looks.light
    pitch, n_points = points.means.shape
    n = end - first
    opened, alone, blurred = np.empty(n + 2, np.float32), np.empty(n + 2, np.float32), np.empty(n, np.float32)
    along = np.empty((n_points, n), np.float32)
    half, least, span = np.float32(0.5), least[first:end], span[first:end]
    for y in range(cells.shape[0]):
        p, i = y // pitch, y % pitch
        _mix_rows(looks.borders[i], *_three(seen.opened, p, first, end + 2), opened)
        _mix_rows(points.borders[i], *_three(seen.alone, p, first, end + 2), alone)
        for b in range(n_points):
            _mean_rows(points.means[i], seen.blurred[p, b], first, end, along[b])
        for k in range(pitch):
            _mean_rows(points.means[k], along, 0, n, blurred)
            before, own, after = looks.borders[k]
            left, middle, right = points.borders[k]
            for u in range(n):
                mixed = before * opened[u] + own * opened[u + 1] + after * opened[u + 2]
                beyond = left * alone[u] + middle * alone[u + 1] + right * alone[u + 2] - blurred[u]
                # No rim is darker than any pixel could be: there are not points enough to see that.
                blurred[u] = max(mixed + half * span[u] * beyond, instants * least[u])
            # Apart from the sums: a loop whose places lie apart is not vectorised.
            for u in range(n):
                cells[y, (first + u) * pitch + k] = blurred[u]


@compiled(fastmath=True)
def _begin(gamma: Floats, drive: Floats, levels: Bytes, target: Floats, step: Floats) -> None:
    """Find where pixels are going to, and how far they are from there."""
    for r in range(gamma.shape[0]):
        for u in range(gamma.shape[1]):
            target[r, u] = drive[levels[r, u]]
            step[r, u] = gamma[r, u] - target[r, u]


@compiled(fastmath=True)
def _relax_row(target: Floats, step: Floats, taus: Doubles, time_s: float, after: Floats) -> None:
    """Retardance of a row of pixels after a time; at once where a constant is nothing, but not in no time."""
    still = 0.0 if time_s > 0 else 1.0
    on = np.float32(np.exp(-time_s / taus[0]) if taus[0] > 0 else still)
    off = np.float32(np.exp(-time_s / taus[1]) if taus[1] > 0 else still)
    for u in range(target.size):
        after[u] = target[u] + step[u] * (on if step[u] < 0 else off)


@compiled(fastmath=True)
def _three(rows: Floats, first: int, start: int, end: int) -> tuple[Floats, Floats, Floats]:
    """Parts of three rows, each known to be dense: over an array of them short loops take twice as long."""
    return rows[first, start:end], rows[first + 1, start:end], rows[first + 2, start:end]


@compiled(fastmath=True)
def _mix_rows(shares: Floats, above: Floats, row: Floats, below: Floats, line: Floats) -> None:
    before, own, after = shares[0], shares[1], shares[2]
    for u in range(line.size):
        line[u] = before * above[u] + own * row[u] + after * below[u]


@compiled(fastmath=True)
def _mean_rows(means: Floats, rows: Floats, start: int, end: int, mean: Floats) -> None:
    """Weighted sum of parts of rows, of which there are three or more."""
    _mix_rows(means, *_three(rows, 0, start, end), mean)
    for a in range(3, means.size):
        _add(mean, means[a], rows[a, start:end])


@compiled(fastmath=True)
def _add_cosines(total: Floats, line: Floats, shares: Floats, weight: np.floating) -> None:
    before, own, after = shares
    for u in range(total.size):
        total[u] += weight * _cosine(before * line[u] + own * line[u + 1] + after * line[u + 2])


@compiled(fastmath=True)
def _add_own_cosines(total: Floats, line: Floats, weight: np.floating) -> None:
    for u in range(total.size):
        total[u] += weight * _cosine(line[u])


@compiled(fastmath=True)
def _cosine(angle: np.float32) -> np.float32:
    """Cosine of 0 to 2 pi, to 5e-7."""
    z = (angle - _PI) * (angle - _PI)
    return -(_C0 + z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * _C6))))))
