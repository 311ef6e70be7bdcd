"""Training patches: drawn where clips change, of equal mean light and energy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bools, Floats, Ints

_BLOCK = 1024
# Patches darker than this, relative to the mean of their clip, contain only noise.
_LEAST_MEAN = 1e-3
# Change in time, relative to the mean light, of patches that change by rounding alone.
_STILL = 1e-5


def training_patches(
    clips: Sequence[Floats], rng: np.random.Generator, patch: int, slots: int, n_patches: int
) -> Floats:
    """Draw patches from each clip by its size; normalise, rotate, mirror and reverse them in time."""
    size = sum(clip.size for clip in clips)
    kept: list[Floats] = []
    most = 0.0
    for clip in clips:
        share = -(-n_patches * clip.size // size)
        n, rows, cols = clip.shape
        if n < slots or rows < patch or cols < patch:
            raise ValueCheckError(
                f"training clip: got shape {clip.shape}, expected at least ({slots}, {patch}, {patch})"
            )
        # Twice the number needed, to keep the half with the largest relative change.
        corners = rng.integers((n - slots + 1, rows - patch + 1, cols - patch + 1), size=(2 * share, 3))
        bright, motion = _bright_and_moving(clip, corners, patch, slots)
        most = max(most, float(motion.max(initial=0)))
        chance = rng.random(len(motion)) ** (1 / (motion + 0.02 * motion.mean() + 1e-9))
        best = corners[bright][np.argsort(chance)[::-1][:share]]
        for first in range(0, len(best), _BLOCK):
            found = _cut(clip, best[first : first + _BLOCK], patch, slots)
            kept += [_turned(block, rng) for block in found / _means(found)]
    if most < _STILL:
        raise ValueCheckError(
            "training clips: nothing in them changes from slot to slot, expected something that moves; cure: "
            "other footage (or is time not where it should be in this array?)"
        )
    stack = np.stack(kept)
    # Equal energy: a few patches across a bright edge would outweigh all others.
    energy = np.sqrt((stack.astype(np.float64) ** 2).mean(axis=(1, 2, 3), keepdims=True))
    stack = (stack / energy).astype(np.float32)
    return np.moveaxis(stack, 1, -1).reshape(len(stack), -1)


def _bright_and_moving(clip: Floats, corners: Ints, patch: int, slots: int) -> tuple[Bools, Floats]:
    """Mask of patches above noise, and the change of each of these; a block at a time in memory."""
    bright: list[Bools] = []
    motion: list[Floats] = []
    least = _LEAST_MEAN * clip.mean()
    for first in range(0, len(corners), _BLOCK):
        found = _cut(clip, corners[first : first + _BLOCK], patch, slots)
        bright.append((_means(found) > least).ravel())
        lit = found[bright[-1]]
        motion.append((lit / _means(lit)).std(axis=1).mean(axis=(1, 2)))
    return np.concatenate(bright), np.concatenate(motion)


def _cut(clip: Floats, corners: Ints, patch: int, slots: int) -> Floats:
    """Blocks of shape (n, slot, v, u) from their first corners, (n, 3)."""
    return np.stack([clip[t : t + slots, v : v + patch, u : u + patch] for t, v, u in corners])


def _means(blocks: Floats) -> Floats:
    return blocks.mean(axis=(1, 2, 3), keepdims=True)


def _turned(block: Floats, rng: np.random.Generator) -> Floats:
    """One of the 16 rotations, mirror images and time reversals of a block of shape (slot, v, u)."""
    block = np.rot90(block, int(rng.integers(4)), axes=(1, 2))
    if rng.integers(2):
        block = block[:, :, ::-1]
    return block[::-1] if rng.integers(2) else block
