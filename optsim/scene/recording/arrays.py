# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false
"""A whole recording as one array: npz, npy and mat files."""

from __future__ import annotations

from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from optsim.errors import ConfigError, StorageError, ValueCheckError, unknown_name
from optsim.scene.recording.film import Pixels, Recording, as_recording, with_channels


def film(path: Path, key: str | None, axes: str | None) -> Recording:
    """Open an array file; npy stays on disk, npz and mat are loaded once."""
    stored = _load_mat(path, key) if path.suffix.lower() == ".mat" else _load_numpy(path, key)
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
    return as_recording(
        (path,), len(film), lambda first: (np.asarray(with_channels(frame)) for frame in film[first:])
    )


def _load_numpy(path: Path, key: str | None) -> Pixels:
    try:
        if path.suffix.lower() == ".npy":
            if key is not None:
                raise ConfigError(
                    f"source.footage.key: got {key!r}, but {path.name} is a single array; remove it"
                )
            return np.load(path, mmap_mode="r", allow_pickle=False)
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return archive[_one_of(path, key, archive.files)]
    except (ValueError, OSError, EOFError, BadZipFile) as error:
        raise StorageError(f"{path} cannot be read as a numpy array of numbers: {error}") from None


def _load_mat(path: Path, key: str | None) -> Pixels:
    from scipy.io import loadmat, whosmat
    from scipy.io.matlab import MatReadError

    try:
        name = _one_of(path, key, [str(entry[0]) for entry in whosmat(path)])
        return np.asarray(loadmat(path, variable_names=[name])[name])
    except NotImplementedError:
        raise StorageError(
            f"{path} is of MATLAB's version 7.3 (HDF5), which is not read here; cure: in MATLAB, "
            f"save('{path.name}', '-v7'), or for arrays above 2 GB write one TIFF a frame"
        ) from None
    except (MatReadError, ValueError, OSError, TypeError) as error:
        raise StorageError(f"{path} cannot be read as a MATLAB file: {error}") from None


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
