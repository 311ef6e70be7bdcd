"""Blur of moving light: tile by tile, each with the few modes that its points' PSFs are made of.

Moving light is a difference and has many instants: positivity is nothing to keep there, and time is dear. So
a block is cut into tiles of about one cell of the nodes' grid, within which every PSF is a mean and at most
three modes, by a singular-value decomposition, each with a share that the nodes' hats mix: one transform of
the light around a tile and one back for the mean and each mode, in float32, in those instants in which there
is any. What comes out is what each point of the tile collects (optics/image_formation.py).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import pairwise

import numpy as np

from optsim.forward.bands import side_by_side
from optsim.forward.field_blur import FieldPsf, hats
from optsim.forward.psf import fft
from optsim.quantities import Block, Doubles, Floats, Ints

_Region = tuple[int, int, int, int]  # first node and the one after the last, rows and columns
# Sides of a tile in half widths of the PSF: shorter ones transform more around them, longer ones need modes.
_SIDE_HALVES = 5.0
_LEAST_SIDE = 32


@dataclass(frozen=True)
class ModesError:
    """What leaving modes out may misplace.

    Parameters
    ----------
    share : float
        Of a point's light.
    level : float
        Brightest light of which that holds; of brighter light it is as much as of this: a window a thousand
        times as bright as its surroundings would leave its share of error as their light.
    """

    share: float
    level: float

    def of(self, brightest: float) -> float:
        """Share that may be misplaced, in powers of two, so that tiles have modes in common."""
        return self.share * 2.0 ** -np.ceil(np.log2(max(1.0, brightest / self.level)))


def blur_moving(
    blocks: tuple[Block, ...], psf: FieldPsf, factor: Floats, error: ModesError
) -> tuple[Block, ...]:
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
    error : ModesError
        What leaving modes out may misplace.
    """
    blurred = [_blurred(block, psf, factor, error) for block in blocks]
    side_by_side(piece for _, pieces in blurred for piece in pieces)
    return tuple(block for block, _ in blurred)


def _blurred(
    block: Block, psf: FieldPsf, factor: Floats, error: ModesError
) -> tuple[Block, list[Callable[[], None]]]:
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
        brightest = np.maximum(around.max(axis=(1, 2)), -around.min(axis=(1, 2)))
        lit = np.flatnonzero(brightest)
        if not lit.size:
            return
        most = error.of(float(brightest.max()))
        kernels, shares = _kernels_and_shares(psf, shape, ends_y, ends_x, most)
        shares *= factor[ends_y[0] : ends_y[1], ends_x[0] : ends_x[1]]
        target = image[:, ends_y[0] - top : ends_y[1] - top, ends_x[0] - left : ends_x[1] - left]
        if lit.size == n:
            _collect(around, kernels, shares, target)
        else:
            part = np.empty((lit.size, *target.shape[1:]), np.float32)
            _collect(around[lit], kernels, shares, part)
            target[lit] = part

    return Block(top, left, image), [partial(tile, y, x) for y in tiles_y for x in tiles_x]


def _borders(size: int, cells: int, half: int) -> Ints:
    """Where tiles of a field begin and end: some cells of the nodes' grid together, or parts of one."""
    side = max(_LEAST_SIDE, _SIDE_HALVES * half) * cells / size
    if side > 1:
        at = np.append(np.arange(0, cells, round(side)), cells) / cells
    else:
        parts = cells * round(1 / side)
        at = np.arange(parts + 1) / parts
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


def _collect(light: Floats, kernels: Floats, shares: Floats, found: Floats) -> None:
    """Find what the middle of windows collects with kernels of which each point has its shares."""
    padded = [int(fft.next_fast_len(side, real=True)) for side in light.shape[1:]]
    spectrum = fft.rfft2(light, s=padded)
    rows, cols = shares.shape[1:]
    for k, (transfer, share) in enumerate(zip(fft.rfft2(kernels, s=padded).conj(), shares, strict=True)):
        # The first row of a window is where that of its tile begins to collect; the last ones aren't wanted.
        some = fft.ifft(spectrum * transfer, axis=1, overwrite_x=True)[:, :rows]
        part = fft.irfft(some, n=padded[1], axis=2)[:, :, :cols]
        if k == 0:
            np.multiply(part, share, out=found)
        else:
            part *= share
            found += part


def _kernels_and_shares(
    psf: FieldPsf, field: tuple[int, int], rows: tuple[int, int], cols: tuple[int, int], error: float
) -> tuple[Floats, Floats]:
    """Mean PSF and modes of a tile, (k, 2 h + 1, 2 h + 1), and how much of each a point has, (k, y, x)."""
    if not psf.cores.size:
        return psf.kernel.astype(np.float32)[None], np.ones(
            (1, rows[1] - rows[0], cols[1] - cols[0]), np.float32
        )
    hats_y, hats_x = (
        hats((np.arange(*ends) + 0.5) / size * 2 - 1, len(psf.cores))
        for ends, size in zip((rows, cols), field, strict=True)
    )
    on_y, on_x = (np.flatnonzero(each.any(axis=1)) for each in (hats_y, hats_x))
    region = (int(on_y[0]), int(on_y[-1]) + 1, int(on_x[0]), int(on_x[-1]) + 1)
    kernels, at_nodes = _modes(psf, region, error)
    # The mean has a share of one everywhere, since hats add up to one.
    shares = [hats_y[region[0] : region[1]].T @ each @ hats_x[region[2] : region[3]] for each in at_nodes]
    return kernels, np.array(shares, np.float32)


# Movers pass the same tiles again and again.
@lru_cache(maxsize=1024)
def _modes(psf: FieldPsf, region: _Region, error: float) -> tuple[Floats, Doubles]:
    """Mean and modes of a region's nodes, and the share (k, i, j) that each node has of them."""
    cores = psf.cores[region[0] : region[1], region[2] : region[3]]
    mean = cores.mean(axis=(0, 1))
    flat = (cores - mean).reshape(-1, mean.size)
    # Of the few nodes' products with each other, from the largest: small matrices, for which BLAS would start
    # threads that wait for each other, stay out of the loop.
    left = np.linalg.eigh(flat @ flat.T)[1][:, ::-1]
    modes, rest, count = left.T @ flat, flat.copy(), 0
    while count < len(flat) and np.abs(rest).sum(axis=1).max() / 2 > error:
        rest -= np.multiply.outer(left[:, count], modes[count])
        count += 1
    kernels = np.zeros((1 + count, *psf.kernel.shape), np.float32)
    kernels[0] = psf.common
    inner = slice(psf.half - psf.core_half, psf.half + psf.core_half + 1)
    kernels[0, inner, inner] += mean
    kernels[1:, inner, inner] = modes[:count].reshape(count, *mean.shape)
    shares = np.ones((1 + count, *cores.shape[:2]))
    shares[1:] = left[:, :count].T.reshape(count, *cores.shape[:2])
    return kernels, shares
