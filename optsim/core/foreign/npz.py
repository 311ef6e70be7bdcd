"""Arrays that numpy wrote, one (npy) or several (npz). A file must hold the size that its header declares."""

from __future__ import annotations

import math
from pathlib import Path
from typing import IO, Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile, ZipInfo

import numpy as np
from numpy.typing import NDArray

from optsim.core.foreign import DEFLATE_LIMIT, check_memory, reading

_WHAT = "a numpy array of numbers"
_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
# Most bytes that a compressed byte can expand to, by the compression.
_MOST = {ZIP_STORED: 1, ZIP_DEFLATED: DEFLATE_LIMIT}


def npz_names(path: Path) -> list[str]:
    """Names of the arrays in an npz file.

    Raises
    ------
    StorageError
        When it is missing or cannot be read.
    """
    with reading(path, _WHAT), ZipFile(path) as archive:
        return list(_members(archive))


def npz_array(path: Path, name: str) -> NDArray[Any]:
    """Load one array of an npz file; never a Python object.

    Raises
    ------
    StorageError
        When the file is missing, damaged, encrypted, or declares more than it or memory can hold.
    """
    with reading(path, _WHAT), ZipFile(path) as archive:
        members = _members(archive)
        if name not in members:
            raise ValueError(f"it holds no {name}")
        member = members[name]
        if member.file_size > _MOST.get(member.compress_type, math.inf) * member.compress_size:
            raise ValueError(
                f"{name} declares {member.file_size} bytes in {member.compress_size} compressed ones"
            )
        with archive.open(member) as stream:
            check_memory(path, _declared(stream, member.file_size), _WHAT)
        with archive.open(member) as stream:
            return np.lib.format.read_array(stream, allow_pickle=False)


def npy_on_disk(path: Path) -> NDArray[Any]:
    """Open the array of an npy file, which stays on disk; errors as of :func:`npz_array`."""
    with reading(path, _WHAT):
        with path.open("rb") as stream:
            _declared(stream, path.stat().st_size)
        return np.load(path, mmap_mode="r", allow_pickle=False)


def _members(archive: ZipFile) -> dict[str, ZipInfo]:
    """List the arrays of an archive by name; of two with the same name one would hide the other."""
    found: dict[str, ZipInfo] = {}
    for member in archive.infolist():
        name = member.filename.removesuffix(".npy")
        if name in found:
            raise ValueError(f"it holds {name} more than once")
        if name != member.filename:
            found[name] = member
    return found


def _declared(stream: IO[bytes], n_bytes: int) -> int:
    """Bytes of an array by its header; the file must hold as many."""
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ValueError(f"its format {version[0]}.{version[1]} is not read here")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, expected numbers")
    declared, there = math.prod(shape) * dtype.itemsize, n_bytes - stream.tell()
    if declared != there:
        size = " x ".join(map(str, shape))
        raise ValueError(f"its header declares {size} of {dtype}, {declared} bytes, but {there} are there")
    return declared
