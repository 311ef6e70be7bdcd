"""Checks of a scene's mesh files before the renderer reads them: it trusts the faces' indices."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError
from optsim.core.foreign import DEFLATE_LIMIT, check_memory, reading
from optsim.scene.obj_files import parse_obj
from optsim.scene.ply_files import parse_ply

_CURE = "cure: export the mesh again, whole, as triangles"
# Vertices (n, 3), and the indices of all faces in a row.
_Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
# Mitsuba's serialized format: magic number, versions with the width of an offset, flags with the numbers per
# vertex.
_MARK, _OFFSET_BYTES, _DOUBLE = 0x041C, {3: 4, 4: 8}, 0x2000
_FURTHER = {0x1: 3, 0x2: 2, 0x8: 3}
_NAME_BYTES = 4096  # most that the name of a serialized mesh may take


def check_mesh(path: Path, kind: str = "") -> None:
    """Refuse STL and invalid meshes; where the shape states no kind, content and name decide."""
    readers: dict[str, Callable[[Path], list[_Mesh]]] = {
        "ply": _read_ply,
        "obj": _read_obj,
        "serialized": _read_serialized,
    }
    if kind not in (*readers, "stl"):
        with path.open("rb") as stream:
            kind = "ply" if stream.read(4).strip() == b"ply" else path.suffix.lower().removeprefix(".")
    if kind == "stl":
        raise StorageError(f"{path}: got an STL mesh, expected PLY or OBJ; cure: convert it")
    if kind not in readers:
        return
    with reading(path, f"a mesh ({kind.upper()})", _CURE.removeprefix("cure: ")):
        meshes = readers[kind](path)
    for vertices, faces in meshes:
        _check(path, vertices, faces)


def _check(path: Path, vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
    bad = np.argwhere(~np.isfinite(vertices).all(axis=1)).ravel()
    if len(bad):
        raise StorageError(f"{path}: vertex {bad[0]} of {len(vertices)} is not finite; {_CURE}")
    if not len(faces):
        raise StorageError(f"{path}: got no faces, expected some; {_CURE}")
    wrong = faces[(faces < 0) | (faces >= len(vertices))]
    if len(wrong):
        raise StorageError(
            f"{path} names vertex {wrong[0]} of {len(vertices)}, expected 0 to {len(vertices) - 1}; {_CURE}"
        )


def _read_obj(path: Path) -> list[_Mesh]:
    """Read its one mesh; indices count from 0."""
    text = parse_obj(path)
    for fewest in [min(group.counts) for group in text.faces.values()]:
        if fewest < 3:
            raise ValueError(f"a face has {fewest} corners")
    indices = [group.indices()[0][group.used] for group in text.faces.values()]
    return [(text.columns(0, 0.0), np.concatenate([np.zeros(0, np.int64), *indices]))]


def _read_ply(path: Path) -> list[_Mesh]:
    """Read its one mesh."""
    ply = parse_ply(path)
    return [(ply.points(), ply.corners())]


def _read_serialized(path: Path) -> list[_Mesh]:
    """Read all meshes of a file; a table at its end lists their offsets."""
    content = path.read_bytes()
    width = _OFFSET_BYTES[_version(content, 0)]
    (count,) = struct.unpack_from("<I", content, len(content) - 4)
    listed = len(content) - 4 - count * width
    if not 0 < listed < len(content) - 4:
        raise ValueError(f"it says that it holds {count} meshes")
    starts = np.frombuffer(content, f"<u{width}", count, listed)
    return [_serialized_mesh(path, content[:listed], int(start)) for start in starts]


def _version(content: bytes, at: int) -> int:
    mark, version = struct.unpack_from("<HH", content, at) if at + 4 <= len(content) else (0, 0)
    if mark != _MARK or version not in _OFFSET_BYTES:
        raise ValueError(f"at byte {at} no serialized mesh of version 3 or 4 begins")
    return version


def _serialized_mesh(path: Path, content: bytes, at: int) -> _Mesh:
    stream, version = zlib.decompressobj(), _version(content, at)
    body = stream.decompress(content[at + 4 :], 4 + _NAME_BYTES + 16)
    (flags,) = struct.unpack_from("<I", body)
    first = body.index(b"\0", 4) + 1 if version == 4 else 4
    n_vertices, n_faces = struct.unpack_from("<QQ", body, first)
    number = 8 if flags & _DOUBLE else 4
    each = number * (3 + sum(more for flag, more in _FURTHER.items() if flags & flag))
    n_bytes = first + 16 + n_vertices * each + 12 * n_faces
    if n_bytes > DEFLATE_LIMIT * len(content):
        raise ValueError(f"it declares {n_vertices} vertices and {n_faces} faces, more than its bytes can be")
    check_memory(path, n_bytes, "a mesh (SERIALIZED)")
    if n_bytes > len(body):
        body += stream.decompress(stream.unconsumed_tail, n_bytes - len(body))
    vertices = np.frombuffer(body, f"<f{number}", 3 * n_vertices, first + 16).reshape(-1, 3)
    faces = np.frombuffer(body, "<u4", 3 * n_faces, n_bytes - 12 * n_faces)
    return vertices.astype(np.float64), faces.astype(np.int64)
