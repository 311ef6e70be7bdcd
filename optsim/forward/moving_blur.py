"""Blur of moving light: tile by tile, each between the nodes whose PSFs its points have shares of.

Moving light is a difference and has many instants: positivity is nothing to keep there, and time is dear. So
a block is cut into tiles of about one cell of the nodes' grid, with one transform of the light around a tile
for all of its nodes, in float32, in those instants in which there is any. What comes out is what each point
of the tile collects (optics/image_formation.py).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise

import numpy as np

from optsim.forward.bands import side_by_side
from optsim.forward.field_blur import FieldPsf, collect_windows, hats
from optsim.forward.psf import fft
from optsim.quantities import Block, Floats, Ints

# Sides of a tile in half widths of the PSF: shorter ones transform more around them, longer ones gain little.
_SIDE_HALVES = 5.0
_LEAST_SIDE = 32


def blur_moving(blocks: tuple[Block, ...], psf: FieldPsf, factor: Floats) -> tuple[Block, ...]:
    """Let each point collect moving blocks' light; blocks grow by the PSF's half width, within the field.

    Parameters
    ----------
    blocks : tuple of Block
        Excess in rectangles; where one touches the border of the field it continues beyond, as
        :func:`optsim.forward.psf.extend` continues the base.
    psf : FieldPsf
        PSF over the field, the light that each point collects lying turned by half a turn.
    factor : ndarray of shape (y, x), float32
        What each point of the field makes of its light.
    """
    blurred = [_blurred(block, psf, factor) for block in blocks]
    side_by_side(piece for _, pieces in blurred for piece in pieces)
    return tuple(block for block, _ in blurred)


def _blurred(block: Block, psf: FieldPsf, factor: Floats) -> tuple[Block, list[Callable[[], None]]]:
    """Block still dark, and the pieces of work, one a tile, that bring its light."""
    shape, half = (factor.shape[0], factor.shape[1]), psf.half
    n, height, width = block.excess.shape
    top, bottom = max(block.row - half, 0), min(block.row + height + half, shape[0])
    left, right = max(block.col - half, 0), min(block.col + width + half, shape[1])
    image = np.zeros((n, bottom - top, right - left), np.float32)
    borders = [_borders(size, max(len(psf.cores) - 1, 1), half) for size in shape]
    tiles_y, tiles_x = _within(borders[0], top, bottom), _within(borders[1], left, right)

    def tile(ends_y: tuple[int, int], ends_x: tuple[int, int]) -> None:
        around = _around(
            block, shape, (ends_y[0] - half, ends_y[1] + half), (ends_x[0] - half, ends_x[1] + half)
        )
        lit = np.flatnonzero(around.any(axis=(1, 2)))
        if not lit.size:
            return
        # What light reaches: it is often a part of a tile only.
        rows = _reached(np.flatnonzero(around.any(axis=(0, 2))), ends_y[1] - ends_y[0], half)
        cols = _reached(np.flatnonzero(around.any(axis=(0, 1))), ends_x[1] - ends_x[0], half)
        kernels, hats_y, hats_x = _nodes(psf, shape, ends_y, ends_x)
        part = np.empty((lit.size, rows.stop - rows.start, cols.stop - cols.start), np.float32)
        window = around[:, rows.start : rows.stop + 2 * half, cols.start : cols.stop + 2 * half]
        _collect(window if lit.size == n else window[lit], kernels, hats_y[:, rows], hats_x[:, cols], part)
        part *= factor[ends_y[0] : ends_y[1], ends_x[0] : ends_x[1]][rows, cols]
        target = image[:, ends_y[0] - top : ends_y[1] - top, ends_x[0] - left : ends_x[1] - left]
        target[lit, rows, cols] = part

    return Block(top, left, image), [partial(tile, y, x) for y in tiles_y for x in tiles_x]


def _reached(lit: Ints, size: int, half: int) -> slice:
    """Part of a tile of a size that collects from lit places, counted from ``half`` before it."""
    return slice(max(int(lit[0]) - 2 * half, 0), min(int(lit[-1]) + 1, size))


def _borders(size: int, cells: int, half: int) -> Ints:
    """Where tiles of a field begin and end: at cells of the nodes' grid, some together or parts of one."""
    parts = cells * max(1, round(size / cells / max(_LEAST_SIDE, _SIDE_HALVES * half)))
    # Far more than a tile of less than half a PSF's width would lie around it.
    together = max(1, int(np.ceil(half * cells / size)))
    at = np.append(np.arange(0, parts, together), parts) / parts
    return np.unique(np.rint(at * size).astype(np.int64))


def _within(borders: Ints, first: int, end: int) -> list[tuple[int, int]]:
    """Parts of tiles from first to end."""
    cut = np.unique(borders.clip(first, end))
    return [(int(a), int(b)) for a, b in pairwise(cut)]


def _around(block: Block, shape: tuple[int, int], rows: tuple[int, int], cols: tuple[int, int]) -> Floats:
    """Light of a block in a window of the field, (t, y, x); beyond the field that of its border."""
    n, height, width = block.excess.shape
    window = np.zeros((n, rows[1] - rows[0], cols[1] - cols[0]), np.float32)
    y = np.arange(*rows).clip(0, shape[0] - 1) - block.row
    x = np.arange(*cols).clip(0, shape[1] - 1) - block.col
    on_y, on_x = np.flatnonzero((y >= 0) & (y < height)), np.flatnonzero((x >= 0) & (x < width))
    if on_y.size and on_x.size:
        part = block.excess[:, y[on_y[0]] : y[on_y[-1]] + 1, x[on_x[0]] : x[on_x[-1]] + 1]
        # Only beyond the field's border does a row or column come more than once.
        for axis, places in ((1, y[on_y]), (2, x[on_x])):
            if len(places) > part.shape[axis]:
                part = np.take(part, places - places[0], axis=axis)
        window[:, on_y[0] : on_y[-1] + 1, on_x[0] : on_x[-1] + 1] = part
    return window


def _collect(light: Floats, kernels: Floats, hats_y: Floats, hats_x: Floats, found: Floats) -> None:
    """Find what the middle of windows collects with the kernels of nodes, (i, j, ...), each by its hats."""
    height, width = (int(fft.next_fast_len(side, real=True)) for side in light.shape[1:])
    # By columns of nodes, and the same for all instants.
    transfers = fft.rfft2(kernels, s=(height, width)).conj().swapaxes(0, 1)[:, :, None]
    collect_windows(light, (height, width), transfers, hats_y[:, None], hats_x[:, None], found)


def _nodes(
    psf: FieldPsf, field: tuple[int, int], rows: tuple[int, int], cols: tuple[int, int]
) -> tuple[Floats, Floats, Floats]:
    """PSFs of the nodes around a tile, (i, j, 2 h + 1, 2 h + 1), and their hats on it, (i, y) and (j, x)."""
    if not psf.cores.size:
        one_y, one_x = (np.ones((1, ends[1] - ends[0]), np.float32) for ends in (rows, cols))
        return psf.kernel.astype(np.float32)[None, None], one_y, one_x
    hats_y, hats_x = (
        hats((np.arange(*ends) + 0.5) / size * 2 - 1, len(psf.cores)).astype(np.float32)
        for ends, size in zip((rows, cols), field, strict=True)
    )
    on_y, on_x = (np.flatnonzero(each.any(axis=1)) for each in (hats_y, hats_x))
    kernels = np.empty((len(on_y), len(on_x), *psf.kernel.shape), np.float32)
    kernels[:] = psf.common
    inner = slice(psf.half - psf.core_half, psf.half + psf.core_half + 1)
    kernels[:, :, inner, inner] = psf.cores[np.ix_(on_y, on_x)]
    return kernels, hats_y[on_y], hats_x[on_x]
