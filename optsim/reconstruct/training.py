"""Learning the dictionary from high-frame-rate clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from optsim.errors import ValueCheckError
from optsim.progress import Progress, silent
from optsim.quantities import Doubles, Floats, Ints
from optsim.reconstruct.dictionary import Dictionary, unit
from optsim.reconstruct.gram_pursuit import pursue_products

_BLOCK = 2048
_PATCHES_AN_ATOM = 30
# Patches darker than this, relative to the mean of their clip, hold only noise.
_LEAST_MEAN = 1e-3


def train_dictionary(
    clips: Sequence[Floats],
    *,
    rng: np.random.Generator,
    n_atoms: int = 2000,
    patch: int = 8,
    slots: int = 36,
    n_patches: int | None = None,
    atoms_per_patch: int = 10,
    iterations: int = 12,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> Dictionary:
    """Learn a dictionary by the method of optimal directions.

    Alternates sparse coding by OMP with the least-squares update ``D = X C' (C C')^-1`` (Engan, Aase and
    Husoy, ICASSP 1999, doi:10.1109/ICASSP.1999.760624); atoms that nobody uses are replaced by the patches
    that are coded worst. Patches are drawn where clips change, scaled to the same brightness, turned,
    mirrored and reversed in time. Atom 0 is the constant patch, and stays.

    Parameters
    ----------
    clips : sequence of ndarray of shape (slot, v, u), float32
        Mean light in each slot, any scale; at least ``slots`` slots and ``patch`` pixels each.
    rng : numpy.random.Generator
        Draws patches, turns and first atoms.
    n_atoms, patch, slots : int
        Size of the dictionary.
    n_patches, atoms_per_patch, iterations : int
        Effort: training patches (30 an atom unless told), cap of the sparse codes, alternations.
    provenance : Mapping, optional
        What to remember about the clips.
    progress : Progress
        Told after each alternation.

    Raises
    ------
    ValueCheckError
        When a clip is too small, or there is too little to learn from.
    """
    wanted = _PATCHES_AN_ATOM * n_atoms if n_patches is None else n_patches
    signals = training_patches(clips, rng, patch, slots, wanted)
    if len(signals) < 2 * n_atoms:
        raise ValueCheckError(
            f"training: got {len(signals)} usable patches, expected at least {2 * n_atoms} "
            f"for {n_atoms} atoms"
        )
    constant = np.ones((1, signals.shape[1]), np.float32)
    first = rng.choice(len(signals), n_atoms - 1, replace=False)
    detail = signals[first] - signals[first].mean(axis=1, keepdims=True)
    atoms = unit(np.concatenate([constant, detail]))
    left = np.zeros(0, np.float32)
    for step in range(iterations):
        support, amounts, left = _code(signals, atoms, atoms_per_patch)
        atoms = _update(signals, atoms, support, amounts, left)
        progress("train", step + 1, iterations)
    record = {
        "method": "MOD with OMP",
        "atoms_per_patch": atoms_per_patch,
        "iterations": iterations,
        "patches": len(signals),
        "relative_rms_error": float(np.sqrt(left.sum() / (signals.astype(np.float64) ** 2).sum())),
        **(provenance or {}),
    }
    return Dictionary(atoms.reshape(n_atoms, patch, patch, slots), record)


def training_patches(
    clips: Sequence[Floats], rng: np.random.Generator, patch: int, slots: int, n_patches: int
) -> Floats:
    """Brightness-normalised patches of shape (patch, v * u * slot), from each clip by its size."""
    size = sum(clip.size for clip in clips)
    kept: list[Floats] = []
    for clip in clips:
        share = -(-n_patches * clip.size // size)
        n, rows, cols = clip.shape
        if n < slots or rows < patch or cols < patch:
            raise ValueCheckError(
                f"training clip: got shape {clip.shape}, expected at least ({slots}, {patch}, {patch})"
            )
        # Twice what is needed, to keep the half that changes most in relation to its brightness.
        corners = rng.integers((n - slots + 1, rows - patch + 1, cols - patch + 1), size=(2 * share, 3))
        found = np.stack([clip[t : t + slots, v : v + patch, u : u + patch] for t, v, u in corners])
        means = found.mean(axis=(1, 2, 3), keepdims=True)
        found = found[(means > _LEAST_MEAN * clip.mean()).ravel()]
        found = found / found.mean(axis=(1, 2, 3), keepdims=True)
        motion = found.std(axis=1).mean(axis=(1, 2))
        chance = rng.random(len(found)) ** (1 / (motion + 0.02 * motion.mean() + 1e-9))
        best = np.argsort(chance)[::-1][:share]
        kept += [_turned(found[i], rng) for i in best]
    stack = np.stack(kept)
    # Equal energy: a few patches across a bright edge would outweigh all others.
    energy = np.sqrt((stack.astype(np.float64) ** 2).mean(axis=(1, 2, 3), keepdims=True))
    stack = (stack / energy).astype(np.float32)
    return np.moveaxis(stack, 1, -1).reshape(len(stack), -1)


def _turned(block: Floats, rng: np.random.Generator) -> Floats:
    """One of the 16 turns, mirrors and time reversals of a block of shape (slot, v, u)."""
    block = np.rot90(block, int(rng.integers(4)), axes=(1, 2))
    if rng.integers(2):
        block = block[:, :, ::-1]
    return block[::-1] if rng.integers(2) else block


def _code(signals: Floats, atoms: Floats, cap: int) -> tuple[Ints, Floats, Floats]:
    """Sparse codes and squared residuals of all signals."""
    gram = np.ascontiguousarray(atoms @ atoms.T)
    support = np.empty((len(signals), cap), np.int64)
    amounts = np.empty((len(signals), cap), np.float32)
    left = np.empty(len(signals), np.float32)
    for first in range(0, len(signals), _BLOCK):
        part = slice(first, first + _BLOCK)
        block = signals[part]
        products = np.ascontiguousarray(block @ atoms.T)
        pursue_products(products, gram, support[part], amounts[part])
        codes = _dense(support[part], amounts[part], len(atoms))
        left[part] = ((block - codes @ atoms) ** 2).sum(axis=1)
    return support, amounts, left


def _dense(support: Ints, amounts: Floats, n_atoms: int) -> Floats:
    codes = np.zeros((len(support), n_atoms), np.float32)
    rows, places = np.nonzero(support >= 0)
    codes[rows, support[rows, places]] = amounts[rows, places]
    return codes


def _update(signals: Floats, atoms: Floats, support: Ints, amounts: Floats, left: Floats) -> Floats:
    """Least-squares atoms for given codes; unused ones start again from the worst patches."""
    n_atoms = len(atoms)
    square = np.zeros((n_atoms, n_atoms))
    cross = np.zeros(atoms.shape)
    for first in range(0, len(signals), _BLOCK):
        part = slice(first, first + _BLOCK)
        codes = _dense(support[part], amounts[part], n_atoms)
        square += codes.T @ codes
        cross += codes.T @ signals[part]
    uses = np.bincount(support[support >= 0], minlength=n_atoms)
    ridge = 1e-6 * np.trace(square) / n_atoms
    system: Doubles = square + ridge * np.eye(n_atoms)
    solved: Doubles = np.asarray(np.linalg.solve(system, cross + ridge * atoms), np.float64)
    # Fewer uses than this is fitting one patch, not learning from many.
    idle = uses < 5
    idle[0] = False
    worst = signals[np.argsort(left)[::-1][: int(idle.sum())]]
    solved[idle] = worst - worst.mean(axis=1, keepdims=True)
    solved[0] = 1
    return unit(solved.astype(np.float32))
