"""Compiled loop of :mod:`optsim.optics.fringe_correction`: quadrature while pixels of a band relax.

Light that stands still needs the cells' sums over time only. All is linear but for the floor below, so
integrals are added up first, and cells are made of the sums; where something moves, of each instant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Bytes, Doubles, Floats, Ints
from optsim.optics.relaxation import SETTLED_RAD

# The cosine from -pi to pi in powers of the square, to 5e-7 in float32: a loop over it is vectorised.
_COSINE = np.polynomial.Chebyshev.interpolate(lambda z: np.cos(np.sqrt(z)), 6, domain=[0, np.pi**2])
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = map(np.float32, _COSINE.convert(kind=np.polynomial.Polynomial).coef)
_PI = np.float32(np.pi)
_SETTLED_RAD = np.float32(SETTLED_RAD)


class Nodes(NamedTuple):
    """Quadrature nodes along a pixel: each neighbour's share there, means over cells, and borders."""

    shares: Floats
    means: Floats
    borders: Floats


class Times(NamedTuple):
    """Quadrature nodes in time: shares of an interval, and their weights, (time,), float64."""

    share: Doubles
    weight: Doubles


class Switching(NamedTuple):
    """Instant of a slot in which each row switches to the slot's level, and how long after its start."""

    instant: Ints
    early_s: Doubles
    instant_s: float


class Light(NamedTuple):
    """Least weight that a pixel of each column has, and what ``sin^2`` of 1 adds, (u,), float32."""

    least: Floats
    span: Floats


class Quadrature(NamedTuple):
    """Quadrature nodes in a pixel and in an instant, and what the panel makes of light."""

    borders: Floats
    nodes: Nodes
    times: Times
    light: Light


class Integrals(NamedTuple):
    """Integrals of a band of pixels over an instant, or over several, each with a weight."""

    opened: Floats
    alone: Floats
    blurred: Floats


@compiled(fastmath=True)
def fill_cells(
    levels: Bytes,
    gamma: Floats,
    displayed: Bytes,
    targets: Floats,
    taus: Doubles,
    switching: Switching,
    quadrature: Quadrature,
    weights: Floats,
    keys: Floats,
    moving: Ints,
    sums: Floats,
    cells: Floats,
) -> None:
    """Fill the cells of a band: their sums over time, and those of each instant where something moves."""
    n_slots, rows, cols = levels.shape
    nodes, times, n_instants = quadrature.nodes, quadrature.times, len(weights)
    n_nodes, n_sub, instant_s = len(nodes.shares), n_instants // n_slots, switching.instant_s
    # A pixel more at the left and at the right, like its neighbour.
    wide, of_row = (rows, cols + 2), n_nodes**2
    target, step = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    # States in an instant: before rows switch and after, with the weight that each has in a row.
    now = np.empty((2 * times.share.size, *wide), np.float32)
    weight = np.empty((2 * times.share.size, rows), np.float32)
    integrals = Integrals(
        np.empty(wide, np.float32), np.empty(wide, np.float32), np.empty((of_row, cols), np.float32)
    )
    opened, alone = np.zeros((len(keys), *wide), np.float32), np.zeros((len(keys), *wide), np.float32)
    blurred = np.zeros((len(keys), (rows - 2) * of_row, cols), np.float32)
    share, room = np.empty(rows), np.empty((3 + n_nodes, cols + 2), np.float32)
    for t in range(n_instants):
        slot, sub, n_states = t // n_sub, t % n_sub, 0
        integrals.alone[:] = 0
        for part in range(2):
            for r in range(rows):
                before_s = min(
                    max((switching.instant[r] - sub) * instant_s + switching.early_s[r], 0.0), instant_s
                )
                share[r] = (before_s if part == 0 else instant_s - before_s) / instant_s
            if share.max() <= 0:
                continue
            _begin(gamma, targets[slot + part], displayed if part == 0 else levels[slot], target, step)
            for j in range(times.share.size):
                for r in range(rows):
                    weight[n_states, r] = times.weight[j] * share[r]
                    _relax_row(target, step, taus, times.share[j] * share[r] * instant_s, now[n_states], r)
                    _add_own_cosines(integrals.alone, now[n_states], r, weight[n_states, r])
                n_states += 1
            gamma[:] = now[n_states - 1, :, 1:-1]
        integrals.opened[:, 1:-1] = weights[t]
        integrals.opened[:, 0], integrals.opened[:, -1] = weights[t, :, 0], weights[t, :, -1]
        for key in range(len(keys)):
            for r in range(rows):
                _add(opened[key], r, keys[key, t], integrals.opened, r)
                _add(alone[key], r, keys[key, t], integrals.alone, r)
        for p in range(rows - 2):
            integrals.blurred[:] = 0
            for state in range(n_states):
                for a in range(n_nodes):
                    _mix_rows(nodes.shares, a, now[state], p, 0, cols + 2, room, 0)
                    for b in range(n_nodes):
                        at = b * n_nodes + a
                        _add_cosines(integrals.blurred, at, room, nodes.shares, b, weight[state, p + 1])
            for key in range(len(keys)):
                for at in range(of_row):
                    _add(blurred[key], p * of_row + at, keys[key, t], integrals.blurred, at)
            for first, end in moving:
                _open_cells(integrals, p, 0, quadrature, np.float32(1), first, end, room, cells[t])
        if sub == n_sub - 1:
            displayed[:] = levels[slot]
    for key in range(len(keys)):
        of_key = Integrals(opened[key], alone[key], blurred[key])
        for p in range(rows - 2):
            _open_cells(of_key, p, p, quadrature, keys[key].sum(), 0, cols, room, sums[key])
    for first, end in moving:
        tie_sums(keys, sums, cells, quadrature.light.least, first, end)


@compiled(fastmath=True)
def tie_sums(keys: Floats, sums: Floats, cells: Floats, least: Floats, first: int, end: int) -> None:
    """Make the sums of some columns of pixels those of their instants, which keep the total of all sums.

    Neither is less than a dark pixel's. Apart from each other they would let light that is hidden in some
    instants have less than nothing in the others.
    """
    shares, pitch = keys.sum(axis=0), sums.shape[2] // len(least)
    begin, n = np.uint64(first * pitch), np.uint64((end - first) * pitch)
    dark, kept, beyond = least[first:end].repeat(pitch), np.empty(n, np.float32), np.empty(n, np.float32)
    for y in range(sums.shape[1]):
        kept[:] = -shares.sum() * dark
        beyond[:] = kept
        for key in range(len(keys)):
            for x in range(n):
                kept[x] += sums[key, y, begin + x]
                sums[key, y, begin + x] = 0
        for t in range(len(cells)):
            for x in range(n):
                beyond[x] += shares[t] * cells[t, y, begin + x]
        for x in range(n):
            kept[x] = kept[x] / beyond[x] if beyond[x] > 0 else np.float32(1)
        for t in range(len(cells)):
            for x in range(n):
                cells[t, y, begin + x] = dark[x] + kept[x] * (cells[t, y, begin + x] - dark[x])
            for key in range(len(keys)):
                share = keys[key, t]
                for x in range(n):
                    sums[key, y, begin + x] += share * cells[t, y, begin + x]


# What is called most takes whole arrays and a row: each slice would cost two atomic counts.
@compiled(fastmath=True, makes_arrays=False)
def _open_cells(
    integrals: Integrals,
    p: int,
    kept: int,
    quadrature: Quadrature,
    instants: np.floating,
    first: int,
    end: int,
    room: Floats,
    cells: Floats,
) -> None:
    """Fill the cells of some columns of a row of pixels from integrals over so many instants."""
    # ``kept`` is that row's place in ``integrals.blurred``. ``room`` holds rows in work: mixed weights of
    # pixels, mixed cosines of their own, the cells, and the means down each column of nodes.
    nodes, (least, span) = quadrature.nodes, quadrature.light
    pitch, n_nodes = nodes.means.shape
    begin, n, half = np.uint64(first), np.uint64(end - first), np.float32(0.5)
    for i in range(pitch):
        _mix_rows(quadrature.borders, i, integrals.opened, p, first, end - first + 2, room, 0)
        _mix_rows(nodes.borders, i, integrals.alone, p, first, end - first + 2, room, 1)
        for b in range(n_nodes):
            from_row = (kept * n_nodes + b) * n_nodes
            _mean_rows(nodes.means, i, integrals.blurred, from_row, first, end - first, room, 3 + b)
        for k in range(pitch):
            _mean_rows(nodes.means, k, room, 3, 0, end - first, room, 2)
            before, own, after = quadrature.borders[k, 0], quadrature.borders[k, 1], quadrature.borders[k, 2]
            left, middle, right = nodes.borders[k, 0], nodes.borders[k, 1], nodes.borders[k, 2]
            for u in range(n):
                mixed = before * room[0, u] + own * room[0, u + 1] + after * room[0, u + 2]
                alone = left * room[1, u] + middle * room[1, u + 1] + right * room[1, u + 2]
                # No edge is darker than a dark pixel: the nodes are too few to show that.
                least_of, span_of = least[begin + u], half * span[begin + u]
                room[2, u] = max(mixed + span_of * (alone - room[2, u]), instants * least_of)
            # Apart from the sums: a loop whose places lie apart is not vectorised.
            for u in range(n):
                cells[p * pitch + i, (begin + u) * pitch + k] = room[2, u]


@compiled(fastmath=True, makes_arrays=False)
def _begin(gamma: Floats, drive: Floats, levels: Bytes, target: Floats, step: Floats) -> None:
    """Find where pixels are going to, and how far they are from there."""
    for r in range(gamma.shape[0]):
        for u in range(gamma.shape[1]):
            target[r, u] = drive[levels[r, u]]
            step_rad = gamma[r, u] - target[r, u]
            # Below 1e-38, nearer and nearer to 0, numbers take processors ten times as long.
            step[r, u] = step_rad if abs(step_rad) > _SETTLED_RAD else np.float32(0)


@compiled(fastmath=True, makes_arrays=False)
def _relax_row(target: Floats, step: Floats, taus: Doubles, time_s: float, after: Floats, r: int) -> None:
    """Retardance of a row of pixels after a time; at once where a constant is nothing, but not in no time."""
    still, cols = 0.0 if time_s > 0 else 1.0, step.shape[1]
    on = np.float32(np.exp(-time_s / taus[0]) if taus[0] > 0 else still)
    off = np.float32(np.exp(-time_s / taus[1]) if taus[1] > 0 else still)
    for u in range(cols):
        after[r, u + 1] = target[r, u] + step[r, u] * (on if step[r, u] < 0 else off)
    after[r, 0], after[r, cols + 1] = after[r, 1], after[r, cols]


@compiled(fastmath=True, makes_arrays=False)
def _mix_rows(shares: Floats, i: int, rows: Floats, p: int, first: int, n: int, to: Floats, at: int) -> None:
    """Mix parts of three rows."""
    begin, before, own, after = np.uint64(first), shares[i, 0], shares[i, 1], shares[i, 2]
    for u in range(np.uint64(n)):
        to[at, u] = (
            before * rows[p, begin + u] + own * rows[p + 1, begin + u] + after * rows[p + 2, begin + u]
        )


@compiled(fastmath=True, makes_arrays=False)
def _mean_rows(means: Floats, i: int, rows: Floats, p: int, first: int, n: int, to: Floats, at: int) -> None:
    """Weighted sum of parts of rows, of which there are three or more."""
    _mix_rows(means, i, rows, p, first, n, to, at)
    begin = np.uint64(first)
    for a in range(3, means.shape[1]):
        share = means[i, a]
        for u in range(np.uint64(n)):
            to[at, u] += share * rows[p + a, begin + u]


@compiled(fastmath=True, makes_arrays=False)
def _add(total: Floats, r: int, share: np.floating, part: Floats, at: int) -> None:
    for u in range(total.shape[1]):
        total[r, u] += share * part[at, u]


@compiled(fastmath=True, makes_arrays=False)
def _add_cosines(total: Floats, at: int, line: Floats, shares: Floats, b: int, weight: np.floating) -> None:
    before, own, after = shares[b, 0], shares[b, 1], shares[b, 2]
    for u in range(total.shape[1]):
        total[at, u] += weight * _cosine(before * line[0, u] + own * line[0, u + 1] + after * line[0, u + 2])


@compiled(fastmath=True, makes_arrays=False)
def _add_own_cosines(total: Floats, now: Floats, r: int, weight: np.floating) -> None:
    for u in range(total.shape[1]):
        total[r, u] += weight * _cosine(now[r, u])


@compiled(fastmath=True)
def _cosine(angle: np.float32) -> np.float32:
    """Cosine of 0 to 2 pi, to 5e-7."""
    z = (angle - _PI) * (angle - _PI)
    return -(_C0 + z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + z * (_C5 + z * _C6))))))
