"""Checks of a scene's mesh files before the renderer reads them: it trusts the faces' indices."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError
from optsim.core.foreign import DEFLATE_LIMIT, check_memory, reading

_CURE = "cure: export the mesh again, whole, as triangles"
# Names of PLY's number types, old and new -> numpy's.
_TYPES = {
    name: number
    for number, names in {
        "i1": ("char", "int8"),
        "u1": ("uchar", "uint8"),
        "i2": ("short", "int16"),
        "u2": ("ushort", "uint16"),
        "i4": ("int", "int32"),
        "u4": ("uint", "uint32"),
        "f4": ("float", "float32"),
        "f8": ("double", "float64"),
    }.items()
    for name in names
}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_Numbers = NDArray[np.generic]
# Vertices (n, 3), and the indices of all faces in a row.
_Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
_LENGTH = "length of "
# Mitsuba's serialized format: magic number, versions with the width of an offset, flags with the numbers per
# vertex.
_MARK, _OFFSET_BYTES, _DOUBLE = 0x041C, {3: 4, 4: 8}, 0x2000
_FURTHER = {0x1: 3, 0x2: 2, 0x8: 3}
_NAME_BYTES = 4096  # most that the name of a serialized mesh may take
_STEP = 64  # rows read at once, growing while all lists have the same length


@dataclass(frozen=True)
class _Element:
    """Rows of a PLY file: properties are (name, type of a list's length or "", type)."""

    name: str
    rows: int
    properties: list[tuple[str, str, str]]


def check_mesh(path: Path, kind: str = "") -> None:
    """Refuse a PLY, OBJ or serialized file with invalid faces or vertices, and any STL file.

    Parameters
    ----------
    path : Path
        Mesh file; other kinds are not checked.
    kind : str
        Type of the shape that names the file; if it is no mesh type, content and name decide.

    Raises
    ------
    StorageError
        For a face with a missing vertex, a vertex that is not finite, a file without faces, or a damaged one.
        It names the file and the place.
    """
    readers = {"ply": _read_ply, "obj": _read_obj, "serialized": _read_serialized}
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
    vertices: list[list[float]] = []
    faces: list[int] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "f":
            named = [int(word.split("/")[0]) for word in words]
            if len(named) < 3:
                raise ValueError(f"a face has {len(named)} corners")
            # Negative indices count back from the last vertex; 0 is invalid.
            faces += [each - 1 if each > 0 else each + len(vertices) if each else -1 for each in named]
    return [(np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64))]


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


def _read_ply(path: Path) -> list[_Mesh]:
    """Read its one mesh."""
    content = path.read_bytes()
    head, mark, _ = content.partition(b"end_header")
    if not mark:
        raise ValueError("its header has no end")
    order, elements = _header(head.decode("ascii", errors="replace"))
    body, at = content[content.index(b"\n", len(head)) + 1 :], 0
    if not order:
        # Text becomes numbers of one type, and is then read like binary.
        body = np.array(body.split(), np.float64).tobytes()
    vertices, faces = np.zeros((0, 3)), np.zeros(0, np.int64)
    for element in elements:
        columns, at = _columns(element, body, at, order)
        if element.name == "vertex":
            vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1)
        elif element.name == "face":
            name = "vertex_index" if "vertex_index" in columns else "vertex_indices"
            faces = columns[name].astype(np.int64)
    return [(vertices, faces)]


def _header(text: str) -> tuple[str, list[_Element]]:
    """Read the byte order, empty for text, and the elements that follow the header."""
    lines = [line.split() for line in text.splitlines() if line.strip()]
    if not lines or lines[0] != ["ply"]:
        raise ValueError("it doesn't begin with 'ply'")
    orders: list[str] = []
    elements: list[_Element] = []
    for kind, *words in lines[1:]:
        if kind == "format":
            orders.append(_FORMATS[words[0]])
        elif kind == "element":
            elements.append(_Element(words[0], int(words[1]), []))
        elif kind == "property":
            length, number = (words[1], words[2]) if words[0] == "list" else ("", words[0])
            elements[-1].properties.append((words[-1], length, number))
    if len(orders) != 1:
        raise ValueError("its header names no format")
    return orders[0], elements


def _columns(element: _Element, body: bytes, at: int, order: str) -> tuple[dict[str, _Numbers], int]:
    """Values of each property, those of lists concatenated; and the offset of the next element."""
    found: dict[str, list[_Numbers]] = {name: [] for name, _, _ in element.properties}
    done, step = 0, _STEP
    while done < element.rows:
        row = _row(element, body, at, order)
        n_rows = min(step, element.rows - done)
        if at + n_rows * row.itemsize > len(body):
            n_rows = (len(body) - at) // max(row.itemsize, 1)
        rows = np.frombuffer(body, row, n_rows, at)
        # Read on while all lists are as long as those of the first row.
        same = np.ones(n_rows, np.bool_)
        for name in row.names or ():
            if name.startswith(_LENGTH):
                same &= rows[name] == rows[name][:1]
        n_same = n_rows if same.all() else int(np.argmin(same))
        if not n_same:
            raise ValueError(f"it ends after {done} of {element.rows} rows of {element.name!r}")
        for name, parts in found.items():
            parts.append(rows[name][:n_same].ravel())
        done, at = done + n_same, at + n_same * row.itemsize
        step = 2 * step if n_same == n_rows else _STEP
    return {name: np.concatenate(parts) if parts else np.zeros(0) for name, parts in found.items()}, at


def _row(element: _Element, body: bytes, at: int, order: str) -> np.dtype[np.void]:
    """Layout of the row at an offset, with the lengths of its lists."""

    def dtype(name: str) -> str:
        return order + _TYPES[name] if order else "f8"

    fields: list[tuple[str, str, tuple[int, ...]]] = []
    for name, length, number in element.properties:
        count: tuple[int, ...] = ()
        if length:
            fields.append((_LENGTH + name, dtype(length), ()))
            stop = at + np.dtype(fields).itemsize
            size = np.dtype(dtype(length)).itemsize
            count = (int(np.frombuffer(body, dtype(length), 1, stop - size)[0]),)
            if element.name == "face" and name.startswith("vertex_ind") and count[0] < 3:
                raise ValueError(f"a face has {count[0]} corners")
        fields.append((name, dtype(number), count))
    return np.dtype(fields)
