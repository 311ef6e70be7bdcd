"""Blur of moving light by a PSF that varies over the field: few modes for the nodes around a block.

Moving light is a difference and has many instants: positivity is nothing to keep there, and time is dear. So
the cores of the nodes around a window become their mean and few modes, by a singular-value decomposition,
each with a share that the nodes' hats mix: a transform of the light and one back for each, whatever the
number of nodes. What is done so is the adjoint of a blur, as images are formed (optics/image_formation.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from optsim.forward.bands import CORES
from optsim.forward.field_blur import FieldPsf, hats_of
from optsim.forward.psf import Blur, fft, make_blur
from optsim.quantities import Block, Doubles, Floats

_Region = tuple[int, int, int, int]  # first node and the one after the last, rows and columns


@dataclass(frozen=True, eq=False)
class ModeBlur:
    """Blur of stacks of images of one shape, in float32, dark outside.

    Parameters
    ----------
    shape, padded : tuple of int
        Rows and columns of the images and of the transforms.
    mean : ndarray of shape (...), complex64
        Transfer function of the window's mean PSF.
    shares : ndarray of shape (k, y, x), float32
        How much of each mode a point's PSF has.
    modes : ndarray of shape (k, ...), complex64
        Transfer functions of the modes.
    """

    shape: tuple[int, int]
    padded: tuple[int, int]
    mean: NDArray[np.complexfloating]
    shares: Floats
    modes: NDArray[np.complexfloating]

    def adjoint(self, image: NDArray[np.floating]) -> Doubles:
        """Collect the light of images (..., y, x) with the PSF of each point."""
        rows, cols = self.shape
        spectrum = fft.rfft2(image.astype(np.float32, copy=False), s=self.padded, workers=CORES)

        def seen(transfer: NDArray[np.complexfloating]) -> Doubles:
            whole = fft.irfft2(spectrum * transfer.conj(), s=self.padded, workers=CORES, overwrite_x=True)
            return np.asarray(whole[..., :rows, :cols])

        total = seen(self.mean)
        for share, mode in zip(self.shares, self.modes, strict=True):
            total += share * seen(mode)
        return total


def make_mode_blur(
    psf: FieldPsf, shape: tuple[int, int], field: tuple[int, int], first: tuple[int, int], error: float
) -> ModeBlur | Blur:
    """Prepare a PSF for moving light in a window.

    Parameters
    ----------
    psf : FieldPsf
        PSF over the field.
    shape, first : tuple of int
        Rows and columns of the window, and where on the field it begins.
    field : tuple of int
        Rows and columns of the whole field.
    error : float
        Share of a point's light that leaving modes out may misplace.
    """
    if not psf.cores.size:
        return _uniform(psf, shape)
    every_y, every_x = hats_of(psf, shape, field, first)
    rows, cols = np.flatnonzero(every_y.any(axis=1)), np.flatnonzero(every_x.any(axis=1))
    region = (int(rows[0]), int(rows[-1]) + 1, int(cols[0]), int(cols[-1]) + 1)
    padded = tuple(int(fft.next_fast_len(size + psf.half, real=True)) for size in shape)
    mean, modes, coefficients = _modes(psf, region, (padded[0], padded[1]), error)
    shares = [every_y[region[0] : region[1]].T @ c @ every_x[region[2] : region[3]] for c in coefficients]
    return ModeBlur(shape, (padded[0], padded[1]), mean, np.array(shares, np.float32), modes)


def split_bright(block: Block, level: float) -> tuple[Block, Block | None]:
    """Split a block into what stays below a level at all times, and the rest, in as small a box as holds it.

    What modes misplace of light a thousand times as bright as its surroundings would count beside these.
    """
    bright = np.abs(block.excess).max(axis=0) > level
    if not bright.any():
        return block, None
    rows, cols = np.flatnonzero(bright.any(axis=1)), np.flatnonzero(bright.any(axis=0))
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(cols[0]), int(cols[-1]) + 1)
    part = np.where(bright[box], block.excess[:, box[0], box[1]], np.float32(0))
    rest = np.where(bright, np.float32(0), block.excess)
    return (
        Block(block.row, block.col, rest),
        Block(block.row + box[0].start, block.col + box[1].start, part),
    )


# Movers pass the same windows again and again: their transforms are kept.
@lru_cache(maxsize=64)
def _uniform(psf: FieldPsf, shape: tuple[int, int]) -> Blur:
    return make_blur(psf.kernel, shape, np.float32)


@lru_cache(maxsize=64)
def _modes(
    psf: FieldPsf, region: _Region, padded: tuple[int, int], error: float
) -> tuple[NDArray[np.complexfloating], NDArray[np.complexfloating], Doubles]:
    """Transfer functions of mean and modes, and shares (k, i, j) of the latter at the region's nodes."""
    cores = psf.cores[region[0] : region[1], region[2] : region[3]]
    mean = cores.mean(axis=(0, 1))
    flat = (cores - mean).reshape(-1, mean.size)
    left, sizes, right = np.linalg.svd(flat, full_matrices=False)
    rest, count = flat, 0
    while np.abs(rest).sum(axis=1).max() / 2 > error:
        count += 1
        rest = flat - (left[:, :count] * sizes[:count]) @ right[:count]
    everywhere = psf.common.copy()
    inner = slice(psf.half - psf.core_half, psf.half + psf.core_half + 1)
    everywhere[inner, inner] = mean
    modes = right[:count].reshape(count, *mean.shape)
    shares = (left[:, :count] * sizes[:count]).T.reshape(count, *cores.shape[:2])
    return _transfer(everywhere[None], padded)[0], _transfer(modes, padded), shares


def _transfer(kernels: Doubles, padded: tuple[int, int]) -> NDArray[np.complexfloating]:
    """Transfer functions of kernels (k, 2 h + 1, 2 h + 1) about their centres."""
    size = kernels.shape[1]
    whole = np.zeros((len(kernels), max(padded[0], size), max(padded[1], size)), np.float32)
    whole[:, :size, :size] = kernels
    return np.asarray(fft.rfft2(np.roll(whole, (-(size // 2), -(size // 2)), axis=(1, 2))))
