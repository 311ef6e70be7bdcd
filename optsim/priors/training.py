"""Training of the dictionary from high-frame-rate clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from optsim.core.cache import Arrays
from optsim.core.errors import ValueCheckError
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats, Ints
from optsim.priors.atom_updates import dense, k_svd_atoms, least_squares_atoms, renewed
from optsim.priors.dictionary import Dictionary, unit
from optsim.priors.gram_pursuit import pursue_products
from optsim.priors.iterations import iterate, learning_key
from optsim.priors.training_patches import training_patches

Method = Literal["mod", "ksvd"]
_NAMES: dict[Method, str] = {"mod": "MOD with OMP", "ksvd": "approximate K-SVD with OMP"}
_BLOCK = 2048
_PATCHES_AN_ATOM = 30


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
    method: Method = "mod",
    provenance: Mapping[str, object] | None = None,
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Dictionary:
    """Train a dictionary by the method of optimal directions or by approximate K-SVD.

    Sparse coding by OMP alternates with an update of the atoms (:mod:`.atom_updates`). Unused atoms are
    replaced by the patches with the largest residuals. Patches are drawn where clips change, scaled to the
    same mean light, rotated, mirrored and reversed in time. Atom 0 is the constant patch, and stays.

    Both methods train equally well. On patches of unseen clips of dead leaves, 512 atoms leave 0.1781 of the
    rms by MOD and 0.1783 by K-SVD after 12 alternations on 15,000 patches. With 1024 atoms they leave 0.1687
    and 0.1685 after 10 on 30,000. These decode moving photographs equally well, to 0.01 dB. On a core, the
    codes took 0.8 and 3.1 s an alternation, MOD's update 0.5 and 2.1 s, K-SVD's 0.3 and 0.7 s.

    Parameters
    ----------
    clips : sequence of ndarray of shape (slot, v, u), float32
        Mean light in each slot, any scale; at least ``slots`` slots and ``patch`` pixels each.
    rng : numpy.random.Generator
        Generator of patches, rotations and first atoms.
    n_atoms, patch, slots : int
        Size of the dictionary.
    n_patches, atoms_per_patch, iterations : int
        Training patches (30 an atom by default), cap of the sparse codes, alternations.
    method : {"mod", "ksvd"}
        Update of the atoms: all at once by least squares, or one after the other with their coefficients.
    provenance : Mapping, optional
        Record of the clips for the file.
    checkpoint : Path, optional
        Folder of a cache that keeps the state after each alternation, from which the same training continues.
        The result is that of an uninterrupted training, bit for bit on the same machine with the same number
        of threads.
    progress : Progress
        Called after each alternation.

    Raises
    ------
    ValueCheckError
        When a clip is too small, or the training set is.
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
    key = learning_key(signals, method, n_atoms, patch, slots, atoms_per_patch, iterations)
    atoms, error = learn_atoms(
        signals, atoms, atoms_per_patch, iterations, method, key=key, checkpoint=checkpoint, progress=progress
    )
    record = {
        "method": _NAMES[method],
        "atoms_per_patch": atoms_per_patch,
        "iterations": iterations,
        "patches": len(signals),
        "relative_rms_error": error,
        **(provenance or {}),
    }
    return Dictionary(atoms.reshape(n_atoms, patch, patch, slots), record)


def learn_atoms(
    signals: Floats,
    atoms: Floats,
    cap: int,
    iterations: int,
    method: Method,
    *,
    key: str = "",
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> tuple[Floats, float]:
    """Alternate sparse codes and updates of the atoms."""
    energy = (signals.astype(np.float64) ** 2).sum()

    def alternate(state: Arrays) -> Arrays:
        atoms = state["atoms"]
        support, amounts, left = _code(signals, atoms, cap)
        if method == "ksvd":
            learned, _ = k_svd_atoms(signals, atoms, support, amounts)
        else:
            learned = least_squares_atoms(signals, atoms, support, amounts)
        uses = np.bincount(support[support >= 0], minlength=len(atoms))
        error = np.asarray(np.sqrt(left.sum() / energy))
        return {"atoms": unit(renewed(learned, uses, signals, left)), "error": error}

    first: Arrays = {"atoms": atoms, "error": np.zeros(())}
    last = iterate(alternate, first, iterations, key=key, checkpoint=checkpoint, progress=progress)
    return last["atoms"], float(last["error"])


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
        codes = dense(support[part], amounts[part], len(atoms))
        left[part] = ((block - codes @ atoms) ** 2).sum(axis=1)
    return support, amounts, left
