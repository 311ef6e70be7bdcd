# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportMissingTypeStubs=false
"""MATLAB files up to version 7: full arrays of real numbers."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.foreign import DEFLATE_LIMIT, check_memory, reading
from optsim.footage.recording.film import Pixels

_WHAT = "a MATLAB file"
_HDF5 = b"\x89HDF\r\n\x1a\n"
# Classes of full numeric arrays, and the bytes of a number in memory.
_BYTES = {
    "double": 8,
    "single": 4,
    "logical": 1,
    **{f"{sign}int{bits}": bits // 8 for sign in ("", "u") for bits in (8, 16, 32, 64)},
}


def names(path: Path) -> list[str]:
    """Names of the variables in a file."""
    return [name for name, _, _ in _listed(path)]


def load(path: Path, name: str) -> Pixels:
    """Load one variable."""
    from scipy.io import loadmat

    for each, shape, kind in _listed(path):
        if each != name:
            continue
        if kind not in _BYTES:
            cure = f"full({name})" if kind == "sparse" else "convert it"
            raise ValueCheckError(
                f"{path}: {name} is {kind}, expected a full array of real numbers; cure: {cure}"
            )
        # A stored number takes a byte at least.
        if math.prod(shape) > DEFLATE_LIMIT * path.stat().st_size:
            raise StorageError(
                f"{path} cannot be read as {_WHAT}: {name} declares {' x '.join(map(str, shape))} numbers, "
                "more than the file can hold; cure: copy it again, whole"
            )
        check_memory(path, math.prod(shape) * _BYTES[kind], _WHAT)
    with reading(path, _WHAT):
        return np.asarray(loadmat(path, variable_names=[name])[name])


def _listed(path: Path) -> list[tuple[str, tuple[int, ...], str]]:
    """Name, shape and class of each variable, from the headers alone."""
    from scipy.io import whosmat

    with reading(path, _WHAT):
        with path.open("rb") as stream:
            start = stream.read(128)
        # Version 0x0200 stands behind 124 bytes of text; other programs write bare HDF5.
        is_hdf5 = start[124:126] in (b"\x00\x02", b"\x02\x00") and start[:6] == b"MATLAB"
        if is_hdf5 or start[:8] == _HDF5:
            raise StorageError(
                f"{path} is of MATLAB's version 7.3 (HDF5), which is not read here; cure: in MATLAB, "
                f"save('{path.name}', '-v7'), or for arrays above 2 GB write one TIFF a frame"
            )
        found = [(str(name), tuple(int(n) for n in shape), str(kind)) for name, shape, kind in whosmat(path)]
        twice = {name for name, _, _ in found if sum(other == name for other, _, _ in found) > 1}
        if twice:
            raise ValueError(f"it holds {', '.join(sorted(twice))} more than once")
        return found
