"""The learned dictionary of space-time patches, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Floats, checked
from optsim.priors.prior_file import eight_bits, read_prior, write_prior

# Least length left of an atom of unit length; files hold 8 bits a number.
_LEFT = 0.1


@dataclass(frozen=True, eq=False)
class Dictionary:
    """Atoms of space-time patches.

    Parameters
    ----------
    atoms : ndarray of shape (atom, v, u, slot), float32
        Atoms of unit length.
    provenance : Mapping
        Settings, seed and training set.
    """

    atoms: Floats
    provenance: Mapping[str, object] = field(default_factory=dict[str, object])

    def __post_init__(self) -> None:
        axes = ("atom", "v", "u", "slot")
        checked("dictionary", self.atoms, axes=axes, dtype=np.float32, unit="1", nonnegative=False)
        lengths = np.sqrt((self.atoms.astype(np.float64) ** 2).sum(axis=(1, 2, 3)))
        if np.abs(lengths - 1).max() > 1e-3:
            raise ValueCheckError(
                f"dictionary: atom {int(np.abs(lengths - 1).argmax())} is not of unit length; cure: unit()"
            )

    @property
    def patch(self) -> int:
        """Side of a patch, panel pixels."""
        return self.atoms.shape[1]

    @property
    def slots(self) -> int:
        """Slots of a patch."""
        return self.atoms.shape[3]

    def shortened(self, slots: int) -> Dictionary:
        """Return the dictionary of the first slots, without atoms that are nearly zero there."""
        first = self.atoms[..., :slots]
        left = np.sqrt((first.astype(np.float64) ** 2).sum(axis=(1, 2, 3)))
        return Dictionary(unit(first[left > _LEFT]), self.provenance)


def unit(atoms: Floats) -> Floats:
    """Scale each atom, shape (atom, ...), to unit length."""
    lengths = np.sqrt(np.sum(atoms.astype(np.float64) ** 2, axis=tuple(range(1, atoms.ndim)), keepdims=True))
    return (atoms / np.maximum(lengths, 1e-30)).astype(np.float32)


def save_dictionary(path: Path, dictionary: Dictionary) -> None:
    """Write a dictionary as a compressed .npz: 8 bits a number, one scale an atom."""
    codes, _ = eight_bits(dictionary.atoms)
    write_prior(path, {"atoms": codes}, dictionary.provenance)


def load_dictionary(path: Path) -> Dictionary:
    """Read a file of :func:`save_dictionary`.

    Raises
    ------
    StorageError
        When the file is missing or is no dictionary.
    """
    stored, provenance = read_prior(path, "dictionary", ("atoms",))
    return Dictionary(unit(stored["atoms"].astype(np.float32)), provenance)


@lru_cache(maxsize=2)
def shipped_dictionary() -> Dictionary:
    """Load the dictionary shipped with the package."""
    with resources.as_file(resources.files("optsim.priors") / "dictionary.npz") as path:
        return load_dictionary(path)
