# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""Blur by small kernels that vary over the field, tap by tap: a compiled loop.

To multiply and add is cheaper than to transform where kernels are small, and needs no more than is lit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from optsim.forward.compiled import compiled
from optsim.quantities import Floats, Ints

# Half width of kernels beyond which transforms are cheaper.
LARGEST_TAPS = 12
# Taps of a row that are worked through together.
_TAPS = 5
# Loops over whole vectors, several at a time, have no rest to do one by one.
_WHOLE = 64


class Grid(NamedTuple):
    """Samples that light moves on.

    Parameters
    ----------
    rows, cols : int
        How many; beyond them the light of the border goes on.
    margin : int
        Of these on every side, around the field over which the PSF varies: there it is as at its edge.
    """

    rows: int
    cols: int
    margin: int = 0


class Patch(NamedTuple):
    """Light in a rectangle of a grid.

    Parameters
    ----------
    excess : ndarray of shape (t, y, x), float32
        The light.
    row, col : int
        Its first row and column.
    """

    excess: Floats
    row: int
    col: int


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
    """Add what some rows of a field collect with the kernels of nodes, each by its hats.

    Parameters
    ----------
    light : Patch
        What is collected.
    grid : Grid
        Where it lies.
    nodes : ndarray of shape (i, i, 2 h + 1, 2 h + 1), float32
        Kernels at the nodes of an even grid from edge to edge of the field, two or more to a side.
    borders : ndarray of shape (tile + 1,), int64
        Columns of the field at which tiles begin and end, no node's column within any.
    target : Patch
        Added to.
    first, end : int
        The grid's rows that collect.
    """
    n, n_nodes, side = len(light.excess), len(nodes), nodes.shape[2]
    half, taps = side // 2, -(-side // _TAPS) * _TAPS
    widest = np.diff(borders).max()
    lines = np.empty((end - first + 2 * half, n * (widest + 2 * half) + _WHOLE + taps), np.float32)
    # Of a row, with the kernels of both nodes beside a tile; and these kernels.
    totals, own = np.empty((2, lines.shape[1]), np.float32), np.zeros((2, side, taps), np.float32)
    hats = np.empty((2, widest), np.float32)
    # Of each instant: the columns that collect anything, and where they begin in the lines.
    reached, begin = np.empty((n, 2), np.int64), np.zeros(n + 1, np.int64)
    light_of = _light_of_columns(light, first - half, end + half)
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
            _kernels_between(nodes, _place(y, grid.rows, grid.margin, n_nodes), node, own)
            totals[:, :length] = 0
            for a in range(side):
                _add_taps(totals[0, :length], totals[1, :length], lines[y - first + a], own[:, a])
            _weigh(totals, begin, hats, start, reached, target, y)


@compiled(fastmath=True)
def _light_of_columns(light: Patch, top: int, bottom: int) -> Floats:
    """Sum of the magnitudes in each column of some rows of the field, (t, x): nothing where it is dark.

    Beyond the field's border its own light goes on, which reaches no place that the border's does not.
    """
    n, tall, wide = light.excess.shape
    found = np.zeros((n, wide), np.float32)
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


@compiled(fastmath=True)
def _kernels_between(nodes: Floats, place: float, node: int, own: Floats) -> None:
    """Kernels at a place between the nodes' rows, in a node's column and in the next one."""
    i = int(place)
    after = np.float32(place - i)
    for j in range(2):
        for a in range(nodes.shape[2]):
            for b in range(nodes.shape[3]):
                own[j, a, b] = (1 - after) * nodes[i, node + j, a, b] + after * nodes[i + 1, node + j, a, b]


@compiled(fastmath=True)
def _add_taps(first: Floats, second: Floats, line: Floats, taps: Floats) -> None:
    """Add what a row of places collects from a longer row of light with two kernels.

    Several taps of both kernels at a time: light is read, and sums are written, that much more seldom.
    """
    n = first.size
    for b in range(0, taps.shape[1], _TAPS):
        k0, k1, k2, k3, k4 = taps[0, b : b + _TAPS]
        q0, q1, q2, q3, q4 = taps[1, b : b + _TAPS]
        l0, l1, l2 = line[b : b + n], line[b + 1 : b + 1 + n], line[b + 2 : b + 2 + n]
        l3, l4 = line[b + 3 : b + 3 + n], line[b + 4 : b + 4 + n]
        for x in range(n):
            v0, v1, v2, v3, v4 = l0[x], l1[x], l2[x], l3[x], l4[x]
            first[x] += k0 * v0 + k1 * v1 + k2 * v2 + k3 * v3 + k4 * v4
            second[x] += q0 * v0 + q1 * v1 + q2 * v2 + q3 * v3 + q4 * v4


@compiled(fastmath=True)
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
