"""Positions of the overlapping patches of an image."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Floats, Ints

_Kind = TypeVar("_Kind", bound=np.generic)


def patch_corners(mask: Bools, patch: int, stride: int) -> Ints:
    """First rows and columns of the patches that touch a mask: array of shape (n, 2), raster order."""
    v, u = _starts(mask.shape[0], patch, stride), _starts(mask.shape[1], patch, stride)
    sums = np.pad(mask.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    top, left = v[:, None], u
    touched = sums[top + patch, left + patch] - sums[top, left + patch]
    touched += sums[top, left] - sums[top + patch, left]
    rows, cols = np.nonzero(touched)
    return np.stack([v[rows], u[cols]], axis=1)


def cut_patches(image: NDArray[_Kind], corners: Ints, patch: int) -> NDArray[_Kind]:
    """Cut patches of an image, (v, u), to rows of an array (n, pixel)."""
    windows = np.lib.stride_tricks.sliding_window_view(image, (patch, patch))
    return windows[corners[:, 0], corners[:, 1]].reshape(len(corners), patch**2)


def overlap(shape: tuple[int, ...], patch: int, stride: int, along: Floats | None = None) -> Floats:
    """Count the grid's patches over each pixel, (v, u), or sum their weights ``along`` either side."""
    counts: list[Floats] = []
    for length in shape:
        count = np.zeros(length, np.float32)
        for start in _starts(length, patch, stride):
            count[start : start + patch] += 1 if along is None else along
        counts.append(count)
    return counts[0][:, None] * counts[1]


def _starts(length: int, patch: int, stride: int) -> Ints:
    """First indices of patches along an axis; the last patch ends at the edge, so every pixel is covered."""
    starts = np.arange(0, length - patch + 1, stride)
    return starts if starts[-1] == length - patch else np.append(starts, length - patch)


@compiled()
def add_patches(patches: Floats, corners: Ints, taper: Floats, total: Floats) -> None:
    """Add patches (n, pixel * slot), times a weight of each pixel (v, u), to an image (v, u, slot)."""
    size, slots = len(taper), total.shape[2]
    weights = np.empty((size, size * slots), np.float32)
    for u in range(size):
        for k in range(slots):
            weights[:, u * slots + k] = taper[:, u]
    lines = total.reshape(total.shape[0], -1)
    for p in range(len(corners)):
        v0, u0 = corners[p]
        for v in range(size):
            target = lines[v0 + v, u0 * slots : (u0 + size) * slots]
            row = patches[p, v * size * slots : (v + 1) * size * slots]
            for k in range(len(target)):
                target[k] += weights[v, k] * row[k]
