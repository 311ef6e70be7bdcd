"""Blur by small kernels that vary over the field, tap by tap: a compiled loop.

To multiply and add is cheaper than to transform where kernels are small, and needs no more than is lit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Doubles, Floats, Ints

# Half width of kernels beyond which transforms are cheaper.
LARGEST_TAPS = 12
# Taps that are worked through together.
_TAPS = 6
# Loops over whole vectors, several at a time, have no rest to do one by one.
_WHOLE = 32


class Grid(NamedTuple):
    """Samples that light moves on."""

    rows: int
    cols: int
    margin: int = 0


class Patch(NamedTuple):
    """Light in a rectangle of a grid."""

    excess: Floats
    row: int
    col: int


def kernels_in_sixes(kernels: Doubles) -> Floats:
    """Make kernels ready to collect with: (i, i, 2 h + 1, 2 h + 1), taps filled up to whole sixes by none."""
    return np.pad(kernels, [(0, 0)] * 3 + [(0, -kernels.shape[3] % _TAPS)]).astype(np.float32)


@compiled(fastmath=True)
def collect_strip(
    light: Patch,
    grid: Grid,
    nodes: Floats,
    borders: Ints,
    target: Patch,
    first: int,
    end: int,
) -> None:
    """Add what some rows of a field collect with the kernels of nodes, each by its hats."""
    n, n_nodes, side = len(light.excess), len(nodes), nodes.shape[2]
    half, tall, taps = side // 2, end - first + side - 1, nodes.shape[3]
    widest = np.diff(borders).max()
    room = -(-n * (widest + 2 * half) // _WHOLE) * _WHOLE
    # A tile's light, all instants side by side.
    lines = np.empty((tall, room + taps), np.float32)
    # Of a row, with the kernels of both nodes beside a tile, or with the only one; and these kernels.
    totals = np.zeros((2, room), np.float32)
    own = np.empty((min(n_nodes, 2), side, taps), np.float32)
    all_nodes, all_own = nodes.reshape((n_nodes, n_nodes, -1)), own.reshape((len(own), -1))
    hats = np.empty((2, widest), np.float32)
    # Of each instant: the columns that collect anything, and where they begin in the lines.
    reached, begin = np.empty((n, 2), np.int64), np.zeros(n + 1, np.int64)
    light_of = _light_of_columns(light, first - half, end + half)
    # Rows of the lines that may be lit; beyond the field the light of its border goes on.
    begins, ends = light.row == 0, light.row + light.excess.shape[1] == grid.rows
    top = 0 if begins else max(light.row - first + half, 0)
    bottom = tall if ends else min(light.row + light.excess.shape[1] - first + half, tall)
    for tile in range(borders.size - 1):
        start, stop = borders[tile], borders[tile + 1]
        for t in range(n):
            lit, dark = _lit_columns(light_of, t, start - half - light.col, stop + half - light.col)
            lit, dark = lit + light.col, dark + light.col
            reached[t, 0], reached[t, 1] = max(lit - half, start), min(dark + half, stop)
            begin[t + 1] = begin[t] + (reached[t, 1] - reached[t, 0] + 2 * half if lit < dark else 0)
            _copy_lines(light, grid, t, first - half, reached[t, 0] - half, lines[:, begin[t] : begin[t + 1]])
        if begin[n] == 0:
            continue
        length = -(-begin[n] // _WHOLE) * _WHOLE
        lines[:, begin[n] : length + taps] = 0
        node = int(_place((start + stop - 1) / 2, grid.cols, grid.margin, n_nodes))
        for x in range(start, stop):
            hats[1, x - start] = min(max(_place(x, grid.cols, grid.margin, n_nodes) - node, 0.0), 1.0)
        hats[0] = 1 - hats[1]
        for y in range(first, end):
            _kernels_between(all_nodes, _place(y, grid.rows, grid.margin, n_nodes), node, all_own)
            taps_down = max(top - (y - first), 0), min(bottom - (y - first), side)
            _add_products(lines, y - first, taps_down, own, totals, length)
            _weigh(totals, begin, hats, start, reached, target, y)


@compiled(fastmath=True)
def _light_of_columns(light: Patch, top: int, bottom: int) -> Floats:
    """Sum of the magnitudes in each column of some rows of the field, (t, x): nothing where it is dark."""
    n, tall, wide = light.excess.shape
    found = np.zeros((n, wide), np.float32)
    # Beyond the border its own light goes on, and reaches no other place than the border's.
    first, end = max(top - light.row, 0), min(bottom - light.row, tall)
    for t in range(n):
        # Unsigned: a loop whose places might be negative would not become vector code.
        for row in range(np.uint64(first), np.uint64(max(first, end))):
            for x in range(np.uint64(wide)):
                found[t, x] += abs(light.excess[t, row, x])
    return found


@compiled()
def _lit_columns(light_of: Floats, t: int, left: int, right: int) -> tuple[int, int]:
    """First lit column of some, which need not all be there, and that after the last."""
    lit, dark = max(left, 0), min(right, light_of.shape[1])
    while lit < dark and light_of[t, lit] == 0:
        lit += 1
    while lit < dark and light_of[t, dark - 1] == 0:
        dark -= 1
    return lit, dark


@compiled()
def _copy_lines(light: Patch, grid: Grid, t: int, top: int, left: int, lines: Floats) -> None:
    """Copy a part of the field."""
    _, tall, wide = light.excess.shape
    size, end = lines.shape[1], light.col + wide
    first, last = min(max(light.col - left, 0), size), min(max(end - left, 0), size)
    for y in range(lines.shape[0]):
        row = min(max(top + y, 0), grid.rows - 1) - light.row
        if not 0 <= row < tall:
            lines[y] = 0
            continue
        # Beyond the field the light of its border goes on.
        lines[y, :first] = light.excess[t, row, 0] if light.col == 0 else np.float32(0)
        lines[y, last:] = light.excess[t, row, -1] if end == grid.cols else np.float32(0)
        for x in range(np.uint64(first), np.uint64(last)):
            lines[y, x] = light.excess[t, row, np.uint64(left - light.col) + x]


@compiled()
def _place(sample: float, samples: int, margin: int, n_nodes: int) -> float:
    """Where a sample lies between the nodes; the last one counts as just before it."""
    place = (sample - margin + 0.5) / (samples - 2 * margin) * (n_nodes - 1)
    return min(max(place, 0.0), n_nodes - 1 - 1e-9)


# From here on places are unsigned and no part of an array is an array of its own: for such short loops numba
# would count references to it as long as it multiplies.
@compiled(fastmath=True, makes_arrays=False)
def _kernels_between(nodes: Floats, place: float, node: int, own: Floats) -> None:
    """Kernels at a place between the nodes' rows, in a node's column and in the next one: (2, all of one)."""
    i, first = int(place), np.uint64(node)
    after, above, below = np.float32(place - i), np.uint64(i), np.uint64(min(i + 1, len(nodes) - 1))
    for j in range(np.uint64(own.shape[0])):
        for k in range(np.uint64(own.shape[1])):
            own[j, k] = (1 - after) * nodes[above, first + j, k] + after * nodes[below, first + j, k]


@compiled(fastmath=True, makes_arrays=False)
def _add_products(
    lines: Floats, first: int, taps_down: tuple[int, int], kernels: Floats, totals: Floats, length: int
) -> None:
    """Sum the products of a row, with one kernel or two; of taps from the first to before the last of two."""
    n, last = np.uint64(length), np.uint64(kernels.shape[0] - 1)
    for x in range(n):
        totals[0, x] = totals[1, x] = 0
    for a in range(np.uint64(taps_down[0]), np.uint64(max(taps_down))):
        y = np.uint64(first) + a
        # Several taps of both kernels at a time: sums are read and written that much more seldom.
        for b in range(np.uint64(0), np.uint64(kernels.shape[2]), np.uint64(_TAPS)):
            b1, b2, b3 = b + np.uint64(1), b + np.uint64(2), b + np.uint64(3)
            b4, b5 = b + np.uint64(4), b + np.uint64(5)
            k0, k1, k2 = kernels[0, a, b], kernels[0, a, b1], kernels[0, a, b2]
            k3, k4, k5 = kernels[0, a, b3], kernels[0, a, b4], kernels[0, a, b5]
            q0, q1, q2 = kernels[last, a, b], kernels[last, a, b1], kernels[last, a, b2]
            q3, q4, q5 = kernels[last, a, b3], kernels[last, a, b4], kernels[last, a, b5]
            for x in range(n):
                v0, v1, v2 = lines[y, x + b], lines[y, x + b1], lines[y, x + b2]
                v3, v4, v5 = lines[y, x + b3], lines[y, x + b4], lines[y, x + b5]
                totals[0, x] += k0 * v0 + k1 * v1 + k2 * v2 + k3 * v3 + k4 * v4 + k5 * v5
                if last:
                    totals[1, x] += q0 * v0 + q1 * v1 + q2 * v2 + q3 * v3 + q4 * v4 + q5 * v5


@compiled(fastmath=True, makes_arrays=False)
def _weigh(
    totals: Floats, begin: Ints, hats: Floats, start: int, reached: Ints, target: Patch, y: int
) -> None:
    """Add to a row of a tile, which begins at ``start``, what instants collected, by its nodes' hats."""
    row = np.uint64(y - target.row)
    for t in range(len(reached)):
        a, there, of = np.uint64(begin[t]), np.uint64(reached[t, 0] - target.col), reached[t, 0] - start
        if begin[t + 1] > begin[t]:
            for x in range(np.uint64(reached[t, 1] - reached[t, 0])):
                hat = np.uint64(of) + x
                target.excess[t, row, there + x] += (
                    hats[0, hat] * totals[0, a + x] + hats[1, hat] * totals[1, a + x]
                )
