"""Blur of moving light: the near part on fine samples, the far part on panel pixels, in every instant.

Moving light is a difference, so it need not stay positive, and it has many instants, so speed matters. The
PSF is cut in two (:mod:`optsim.optics.moving_psf`). Its centre, with nearly all of its light, is small enough
for a loop over taps. The rest works on panel pixels. All is in float32, and only in instants with light.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from optsim.core.compiled import FEW
from optsim.core.quantities import Block, Floats, Ints
from optsim.core.threads import side_by_side
from optsim.optics.field_blur import FieldPsf, uniform
from optsim.optics.moving_psf import MovingPsf, divided
from optsim.optics.pixel_splines import draw, spread
from optsim.optics.tap_blur import LARGEST_TAPS, Grid, Patch, collect_strip, kernels_in_sixes
from optsim.optics.tile_blur import collect_tile

# Side of transformed tiles in half widths of the PSF, and its minimum: shorter tiles transform more margin,
# longer ones gain little.
_SIDE_HALVES, _LEAST_SIDE = 5.0, 32
# Rows and columns of a block in the loop over taps: their surroundings fit into the cache.
_ROWS, _COLS = 64, 128


def blur_moving(blocks: tuple[Block, ...], psf: FieldPsf, pitch: int, factor: Floats) -> tuple[Block, ...]:
    """Blur moving blocks; they grow by the PSF's half width, within the field.

    Parameters
    ----------
    blocks : tuple of Block
        Excess in rectangles; where one touches the border of the field it continues beyond, as
        :func:`optsim.optics.psf.extend` continues the base.
    psf : FieldPsf
        Weights with which each point collects. For much light it is cut in two
        (:func:`optsim.optics.moving_psf.divided`).
    pitch : int
        Fine samples to a panel pixel; divides the sides of the field.
    factor : ndarray of shape (y, x), float32
        Factor of the light at each point of the field.
    """
    grid = Grid(factor.shape[0], factor.shape[1])
    few = sum(block.excess.size for block in blocks) < FEW
    cut = MovingPsf(psf) if few else divided(psf, pitch)
    by_taps = not few and cut.near.half <= LARGEST_TAPS
    near = _by_taps(cut.near, grid) if by_taps else _by_transforms(cut.near, grid)
    lights = [Patch(block.excess, block.row, block.col) for block in blocks]
    further = [None] * len(lights) if cut.rest is None else _further_off(lights, cut.rest, pitch, grid)
    targets = [
        _empty(light, cut.near.half, 1, grid) if pixels is None else _empty(pixels, 0, pitch, grid)
        for light, pixels in zip(lights, further, strict=True)
    ]

    def strip(light: Patch, pixels: Patch | None, target: Patch, first: int, end: int) -> None:
        rows = target.excess[:, first - target.row : end - target.row]
        if pixels is None:
            rows[:] = 0
        else:
            draw(pixels, pitch, first, target.col, rows)
        near.add(light, target, first, end)
        rows *= factor[first:end, target.col : target.col + rows.shape[2]]

    side_by_side(
        partial(strip, light, pixels, target, first, end)
        for light, pixels, target in zip(lights, further, targets, strict=True)
        for first, end in near.strips(target)
    )
    return tuple(Block(target.row, target.col, target.excess) for target in targets)


def _further_off(lights: list[Patch], psf: FieldPsf, pitch: int, grid: Grid) -> list[Patch]:
    """Collect the far part, on panel pixels."""
    # Includes a margin of pixels around the field: light arrives from there, and the outermost splines start
    # there.
    margin, reach = psf.half + 3, psf.half + 1
    pixels = Grid(grid.rows // pitch + 2 * margin, grid.cols // pitch + 2 * margin, margin)
    rest = _by_taps(psf, pixels)
    spreads = side_by_side(partial(spread, light, pitch, pixels) for light in lights)
    # One dark pixel more: the splines of the last lit ones reach into it.
    targets = [_empty(light, reach, 1, pixels) for light in spreads]

    def strip(light: Patch, target: Patch, first: int, end: int) -> None:
        target.excess[:, first - target.row : end - target.row] = 0
        rest.add(light, target, first, end)

    side_by_side(
        partial(strip, light, target, first, end)
        for light, target in zip(spreads, targets, strict=True)
        for first, end in rest.strips(target)
    )
    return [Patch(target.excess, target.row - margin, target.col - margin) for target in targets]


def _empty(light: Patch, reach: int, pitch: int, grid: Grid) -> Patch:
    """Empty patch for light ``pitch`` times as fine, larger by ``reach`` samples, within a grid."""
    n, height, width = light.excess.shape
    top, left = max(light.row * pitch - reach, 0), max(light.col * pitch - reach, 0)
    bottom = min((light.row + height) * pitch + reach, grid.rows)
    right = min((light.col + width) * pitch + reach, grid.cols)
    return Patch(np.empty((n, bottom - top, right - left), np.float32), top, left)


class _Collector(NamedTuple):
    """A way to collect: the strips of rows to work on together, and the work itself."""

    strips: Callable[[Patch], list[tuple[int, int]]]
    add: Callable[[Patch, Patch, int, int], None]


def _by_taps(psf: FieldPsf, grid: Grid) -> _Collector:
    nodes = kernels_in_sixes(psf.whole)
    cells = max(len(nodes) - 1, 1)
    borders = _borders(grid.cols, grid.margin, cells * max(1, -(-grid.cols // (cells * _COLS))))

    def strips(target: Patch) -> list[tuple[int, int]]:
        end = target.row + target.excess.shape[1]
        return [(row, min(row + _ROWS, end)) for row in range(target.row, end, _ROWS)]

    def add(light: Patch, target: Patch, first: int, end: int) -> None:
        columns = _cut(borders, target.col, target.col + target.excess.shape[2])
        collect_strip(light, grid, nodes, columns, target, first, end)

    return _Collector(strips, add)


def _by_transforms(psf: FieldPsf, grid: Grid) -> _Collector:
    if 0 <= psf.core_half < psf.half:
        return _one_after_the_other(uniform(psf.common), psf.middle(0), grid)
    cells = max(len(psf.cores) - 1, 1)

    def tiles(size: int, first: int, end: int) -> list[tuple[int, int]]:
        """Find tiles: several cells of the nodes' grid together, or parts of one."""
        parts = cells * max(1, round(size / cells / max(_LEAST_SIDE, _SIDE_HALVES * psf.half)))
        # A tile narrower than half a PSF would have far more margin than content.
        together = max(1, int(np.ceil(psf.half * cells / size)))
        return list(pairwise(_cut(_borders(size, 0, parts, together), first, end).tolist()))

    def strips(target: Patch) -> list[tuple[int, int]]:
        return tiles(grid.rows, target.row, target.row + target.excess.shape[1])

    def add(light: Patch, target: Patch, first: int, end: int) -> None:
        top, left = target.row, target.col
        for a, b in tiles(grid.rows, first, end):
            for c, d in tiles(grid.cols, left, left + target.excess.shape[2]):
                part = target.excess[:, a - top : b - top, c - left : d - left]
                collect_tile(light, psf, grid, (a, b), (c, d), part)

    return _Collector(strips, add)


def _one_after_the_other(even: FieldPsf, varying: FieldPsf, grid: Grid) -> _Collector:
    """Collect with the uniform part of the PSF, and with the smaller core that varies."""
    # Transforming every node's whole PSF would multiply the time by the number of nodes.
    whole, middle = _by_transforms(even, grid), _by_transforms(varying, grid)

    def add(light: Patch, target: Patch, first: int, end: int) -> None:
        whole.add(light, target, first, end)
        middle.add(light, target, first, end)

    return _Collector(whole.strips, add)


def _borders(size: int, margin: int, parts: int, together: int = 1) -> Ints:
    """Cut a grid within its margin into equal parts, group them, and return where each group begins."""
    at = np.append(np.arange(0, parts, together), parts) / parts
    borders = margin + np.rint(at * (size - 2 * margin)).astype(np.int64)
    borders[0], borders[-1] = 0, size
    return borders


def _cut(borders: Ints, first: int, end: int) -> Ints:
    """Borders of what lies between first and end."""
    return np.unique(borders.clip(first, end))
