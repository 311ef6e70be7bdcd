"""Blur by PSFs that vary over the field, with a transform a tile: for large kernels, and for little light.

A tile is about one cell of the nodes' grid. Its surrounding light is transformed once for all of its nodes.
"""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Floats, Ints
from optsim.optics.field_blur import FieldPsf, collect_windows, hats
from optsim.optics.psf import fft
from optsim.optics.tap_blur import Grid, Patch


def collect_tile(
    light: Patch,
    psf: FieldPsf,
    grid: Grid,
    rows: tuple[int, int],
    cols: tuple[int, int],
    target: Floats,
) -> None:
    """Add the light of a patch, blurred, to a tile, by transforms."""
    half = psf.half
    window = _around(light, grid, (rows[0] - half, rows[1] + half), (cols[0] - half, cols[1] + half))
    lit = np.flatnonzero(window.any(axis=(1, 2)))
    if not lit.size:
        return
    # The light often reaches only part of a tile.
    down = _reached(np.flatnonzero(window.any(axis=(0, 2))), rows[1] - rows[0], half)
    across = _reached(np.flatnonzero(window.any(axis=(0, 1))), cols[1] - cols[0], half)
    window = window[:, down.start : down.stop + 2 * half, across.start : across.stop + 2 * half]
    kernels, hats_y, hats_x = _nodes(psf, grid, rows, cols)
    height, width = (int(fft.next_fast_len(side, real=True)) for side in window.shape[1:])
    # By columns of nodes, and the same for all instants.
    transfers = fft.rfft2(kernels, s=(height, width)).conj().swapaxes(0, 1)[:, :, None]
    part = np.empty((lit.size, down.stop - down.start, across.stop - across.start), np.float32)
    hats_y, hats_x = hats_y[:, None, down], hats_x[:, None, across]
    collect_windows(
        window if lit.size == len(window) else window[lit], (height, width), transfers, hats_y, hats_x, part
    )
    target[lit, down, across] += part


def _reached(lit: Ints, size: int, half: int) -> slice:
    """Part of a tile that collects from lit samples; these are counted from ``half`` before the tile."""
    return slice(max(int(lit[0]) - 2 * half, 0), min(int(lit[-1]) + 1, size))


def _around(light: Patch, grid: Grid, rows: tuple[int, int], cols: tuple[int, int]) -> Floats:
    """Light of a patch in a window of the field, (t, y, x); beyond the field that of its border."""
    n, height, width = light.excess.shape
    window = np.zeros((n, rows[1] - rows[0], cols[1] - cols[0]), np.float32)
    y = np.arange(*rows).clip(0, grid.rows - 1) - light.row
    x = np.arange(*cols).clip(0, grid.cols - 1) - light.col
    on_y, on_x = np.flatnonzero((y >= 0) & (y < height)), np.flatnonzero((x >= 0) & (x < width))
    if on_y.size and on_x.size:
        part = light.excess[:, y[on_y[0]] : y[on_y[-1]] + 1, x[on_x[0]] : x[on_x[-1]] + 1]
        # Rows and columns repeat only beyond the field's border.
        for axis, places in ((1, y[on_y]), (2, x[on_x])):
            if len(places) > part.shape[axis]:
                part = np.take(part, places - places[0], axis=axis)
        window[:, on_y[0] : on_y[-1] + 1, on_x[0] : on_x[-1] + 1] = part
    return window


def _nodes(
    psf: FieldPsf, grid: Grid, rows: tuple[int, int], cols: tuple[int, int]
) -> tuple[Floats, Floats, Floats]:
    """PSFs of the nodes around a tile, (i, j, 2 h + 1, 2 h + 1), and hat functions, (i, y) and (j, x)."""
    if not psf.cores.size:
        one_y, one_x = (np.ones((1, ends[1] - ends[0]), np.float32) for ends in (rows, cols))
        return psf.kernel.astype(np.float32)[None, None], one_y, one_x
    hats_y, hats_x = (
        hats((np.arange(*ends) + 0.5) / size * 2 - 1, len(psf.cores))
        for ends, size in ((rows, grid.rows), (cols, grid.cols))
    )
    on_y, on_x = (np.flatnonzero(each.any(axis=1)) for each in (hats_y, hats_x))
    kernels = np.empty((len(on_y), len(on_x), *psf.kernel.shape), np.float32)
    kernels[:] = psf.common
    inner = slice(psf.half - psf.core_half, psf.half + psf.core_half + 1)
    kernels[:, :, inner, inner] = psf.cores[np.ix_(on_y, on_x)]
    return kernels, hats_y[on_y].astype(np.float32), hats_x[on_x].astype(np.float32)
