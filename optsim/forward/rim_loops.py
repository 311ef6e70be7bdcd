# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""The compiled loop of :mod:`optsim.forward.rims`: pixels of a band relax, and their rims are looked at."""

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


@compiled(fastmath=True)
def fill_cells(
    levels: Bytes,
    gamma: Floats,
    shown: Bytes,
    targets: Floats,
    taus: Doubles,
    turns: Turns,
    borders: Floats,
    points: Points,
    times: Times,
    light: Light,
    weights: Floats,
    cells: Floats,
) -> None:
    """Fill the cells of a band.

    Parameters
    ----------
    levels, gamma, shown, targets, taus, turns
        As of :func:`optsim.forward.relaxation.walk`, with a row more at the top and at the bottom of the
        band; ``gamma`` and ``shown`` are changed in place. Retardances are at most a whole wave.
    borders : ndarray of shape (pitch, 3), float32
        From :func:`optsim.forward.fringing.border_shares`.
    points, times, light
        Where and when the panel is looked at, and what it makes of light.
    weights : ndarray of shape (t, v, u), float32
        Of the pixels, these rows too.
    cells : ndarray of shape (t, y, x), float32
        Filled.
    """
    n_slots, rows, cols = levels.shape
    n_instants, (pitch, n_points) = cells.shape[0], points.means.shape
    n_sub, instant_s = n_instants // n_slots, turns.instant_s
    # A pixel more at the left and at the right, like its neighbour.
    now = np.empty((rows, cols + 2), np.float32)
    alone = np.empty((rows, cols + 2), np.float32)
    line = np.empty(cols + 2, np.float32)
    open_line = np.empty(cols + 2, np.float32)
    opened = np.empty((rows, cols + 2), np.float32)
    seen = np.empty((rows - 2, n_points, n_points, cols), np.float32)
    along = np.empty((n_points, cols), np.float32)
    blurred = np.empty(cols, np.float32)
    share = np.empty(rows)
    for t in range(n_instants):
        slot, sub = t // n_sub, t % n_sub
        alone[:] = 0
        seen[:] = 0
        for part in range(2):
            for r in range(rows):
                before_s = min(max((turns.instant[r] - sub) * instant_s + turns.early_s[r], 0.0), instant_s)
                share[r] = (before_s if part == 0 else instant_s - before_s) / instant_s
            if share.max() <= 0:
                continue
            drive, wanted = targets[slot + part], shown if part == 0 else levels[slot]
            for j in range(times.share.size):
                for r in range(rows):
                    _relax_row(
                        gamma[r], drive, wanted[r], taus, times.share[j] * share[r] * instant_s, now[r, 1:-1]
                    )
                    now[r, 0], now[r, cols + 1] = now[r, 1], now[r, cols]
                    of_time = np.float32(times.weight[j] * share[r])
                    for u in range(cols + 2):
                        alone[r, u] += of_time * _cosine(now[r, u])
                for p in range(rows - 2):
                    of_time = np.float32(times.weight[j] * share[p + 1])
                    for a in range(n_points):
                        _mix_rows(points.shares[a], now[p : p + 3], line)
                        for b in range(n_points):
                            _add_cosines(seen[p, a, b], line, points.shares[b], of_time)
            for r in range(rows):
                _relax_row(gamma[r], drive, wanted[r], taus, share[r] * instant_s, gamma[r])
        for r in range(rows):
            for u in range(cols):
                opened[r, u + 1] = weights[t, r, u]
            opened[r, 0], opened[r, cols + 1] = opened[r, 1], opened[r, cols]
        for p in range(rows - 2):
            for i in range(pitch):
                _mix_rows(borders[i], opened[p : p + 3], open_line)
                _mix_rows(points.borders[i], alone[p : p + 3], line)
                for b in range(n_points):
                    _mean_rows(points.means[i], seen[p, :, b], along[b])
                for k in range(pitch):
                    _mean_rows(points.means[k], along, blurred)
                    _open_cells(
                        borders[k], open_line, points.borders[k], line, blurred, light,
                        cells[t, p * pitch + i, k::pitch],
                    )  # fmt: skip
        if sub == n_sub - 1:
            shown[:] = levels[slot]


@compiled(fastmath=True)
def _open_cells(
    borders: Floats,
    opened: Floats,
    still: Floats,
    alone: Floats,
    blurred: Floats,
    light: Light,
    cells: Floats,
) -> None:
    least, span = light.least, light.span
    before, own, after = borders
    first, middle, last = still
    half = np.float32(0.5)
    for u in range(cells.size):
        mixed = before * opened[u] + own * opened[u + 1] + after * opened[u + 2]
        beyond = first * alone[u] + middle * alone[u + 1] + last * alone[u + 2] - blurred[u]
        # No rim is darker than any pixel could be: there are not points enough to see that.
        cells[u] = max(mixed + half * span[u] * beyond, least[u])


@compiled(fastmath=True)
def _relax_row(
    gamma: Floats, drive: Floats, levels: Bytes, taus: Doubles, time_s: float, after: Floats
) -> None:
    """Retardance of a row of pixels after a time; at once where a constant is nothing, but not in no time."""
    still = 0.0 if time_s > 0 else 1.0
    on = np.float32(np.exp(-time_s / taus[0]) if taus[0] > 0 else still)
    off = np.float32(np.exp(-time_s / taus[1]) if taus[1] > 0 else still)
    for u in range(gamma.size):
        target = drive[levels[u]]
        step = gamma[u] - target
        after[u] = target + step * (on if step < 0 else off)


@compiled(fastmath=True)
def _mix_rows(shares: Floats, rows: Floats, line: Floats) -> None:
    before, own, after = shares
    for u in range(line.size):
        line[u] = before * rows[0, u] + own * rows[1, u] + after * rows[2, u]


@compiled(fastmath=True)
def _mean_rows(means: Floats, rows: Floats, mean: Floats) -> None:
    mean[:] = 0
    for a in range(means.size):
        if means[a] != 0:
            for u in range(mean.size):
                mean[u] += means[a] * rows[a, u]


@compiled(fastmath=True)
def _add_cosines(total: Floats, line: Floats, shares: Floats, weight: np.floating) -> None:
    before, own, after = shares
    for u in range(total.size):
        total[u] += weight * _cosine(before * line[u] + own * line[u + 1] + after * line[u + 2])


@compiled(fastmath=True)
def _cosine(angle: np.float32) -> np.float32:
    """Cosine of 0 to 2 pi, to 5e-7."""
    z = (angle - _PI) * (angle - _PI)
    return -(_C0 + z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * _C6))))))
