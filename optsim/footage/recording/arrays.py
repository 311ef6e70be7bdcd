"""A whole recording as one array: npz, npy and mat files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optsim.core.errors import ConfigError, ValueCheckError, unknown_name
from optsim.core.foreign.npz import npy_on_disk, npz_array, npz_names
from optsim.footage.recording import mat
from optsim.footage.recording.film import Pixels, Recording, as_recording, with_channels

ARRAYS = (".npz", ".npy", ".mat")


def film(path: Path, key: str | None, axes: str | None) -> Recording:
    """Open an array file; npy stays on disk, npz and mat are loaded once."""
    stored = _load(path, key)
    if axes is None:
        raise ConfigError(
            f"source.footage.axes: missing; the array in {path.name} has shape {stored.shape}. State the "
            "order of its axes: 'tyx' or 'tyxc' (time first), 'yxt' or 'yxct' (time last, as in MATLAB)"
        )
    if stored.ndim != len(axes):
        raise ValueCheckError(
            f"{path}: the array has shape {stored.shape}, {stored.ndim} axes; source.footage.axes = "
            f"'{axes}' says {len(axes)}"
        )
    film = stored.transpose([axes.index(name) for name in ("tyxc" if "c" in axes else "tyx")])
    return as_recording((path,), len(film), lambda first: (_native(frame) for frame in film[first:]))


def _native(frame: Pixels) -> Pixels:
    return np.asarray(with_channels(frame), frame.dtype.newbyteorder("="))


def array_axes(path: Path) -> str | None:
    """Axes of a file's only array: time first in files of numpy, last in those of MATLAB; else None.

    Raises
    ------
    StorageError, ConfigError
        When it cannot be read or holds several arrays.
    ValueCheckError
        When an array has other than three or four axes.
    """
    suffix = path.suffix.lower()
    if suffix not in ARRAYS:
        return None
    found = {3: "yxt", 4: "yxct"} if suffix == ".mat" else {3: "tyx", 4: "tyxc"}
    stored = _load(path, None)
    if stored.ndim not in found:
        raise ValueCheckError(
            f"{path}: the array has shape {stored.shape}, expected the axes {' or '.join(found.values())}: "
            "t(ime), y, x and c(hannel)"
        )
    return found[stored.ndim]


def array_names(path: Path) -> list[str]:
    """Names of the arrays in an npz or mat file.

    Raises
    ------
    StorageError
        When it is missing or cannot be read.
    """
    return mat.names(path) if path.suffix.lower() == ".mat" else npz_names(path)


def load_array(path: Path, name: str) -> Pixels:
    """Load one array of an npz or mat file; errors as in :func:`array_names`.

    Raises
    ------
    ValueCheckError
        For an array of anything but plain real numbers.
    """
    stored = mat.load(path, name) if path.suffix.lower() == ".mat" else npz_array(path, name)
    if stored.dtype.kind not in "buif":
        raise ValueCheckError(
            f"{path}: {name} holds {stored.dtype}, expected plain real numbers; cure: convert it"
        )
    return stored.astype(stored.dtype.newbyteorder("="), copy=False)


def _load(path: Path, key: str | None) -> Pixels:
    if path.suffix.lower() != ".npy":
        return load_array(path, _one_of(path, key, array_names(path)))
    if key is not None:
        raise ConfigError(f"source.footage.key: got {key!r}, but {path.name} is a single array; remove it")
    return npy_on_disk(path)


def _one_of(path: Path, key: str | None, names: list[str]) -> str:
    if key is None and len(names) == 1:
        return names[0]
    if key is None:
        raise ConfigError(
            f"source.footage.key: missing; {path.name} holds {', '.join(sorted(names)) or 'no arrays'}"
        )
    if key not in names:
        raise unknown_name(f"source.footage.key of {path.name}", key, names)
    return key
