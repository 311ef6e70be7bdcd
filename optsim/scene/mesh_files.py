"""Mesh files that a scene names, checked before the renderer reads them: it trusts what faces say."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError
from optsim.core.foreign import reading

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
_LENGTH = "length of "
_STEP = 64  # rows looked at at once, more and more while all lists are as long


@dataclass(frozen=True)
class _Element:
    """Rows of a PLY file: properties are (name, type of a list's length or "", type)."""

    name: str
    rows: int
    properties: list[tuple[str, str, str]]


def check_mesh(path: Path) -> None:
    """Refuse a PLY or OBJ file whose faces or vertices can't be; other files are not looked at.

    Raises
    ------
    StorageError
        For a face that names a vertex that isn't there, a vertex that is not finite, a PLY file without
        faces, and one that is damaged; it names the file and the place.
    """
    kind = path.suffix.lower()
    with path.open("rb") as stream:
        kind = ".ply" if stream.read(4).strip() == b"ply" else kind
    reader = {".ply": _read_ply, ".obj": _read_obj}.get(kind)
    if reader is None:
        return
    with reading(path, f"a mesh ({kind[1:].upper()})", _CURE.removeprefix("cure: ")):
        vertices, faces = reader(path)
    bad = np.argwhere(~np.isfinite(vertices).all(axis=1)).ravel()
    if len(bad):
        raise StorageError(f"{path}: vertex {bad[0]} of {len(vertices)} is not finite; {_CURE}")
    if kind == ".ply" and not len(faces):
        raise StorageError(f"{path}: got no faces, expected some; {_CURE}")
    wrong = faces[(faces < 0) | (faces >= len(vertices))]
    if len(wrong):
        raise StorageError(
            f"{path} names vertex {wrong[0]} of {len(vertices)}, expected 0 to {len(vertices) - 1}; {_CURE}"
        )


def _read_obj(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices, and the indices of all faces, from 0."""
    vertices: list[list[float]] = []
    faces: list[int] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *words = line.split() or [""]
        if kind == "v":
            vertices.append([float(word) for word in words[:3]])
        elif kind == "f":
            named = [int(word.split("/")[0]) for word in words]
            # Negative ones count back from the vertex before; 0 is none.
            faces += [each - 1 if each > 0 else each + len(vertices) if each else -1 for each in named]
    return np.array(vertices, np.float64).reshape(-1, 3), np.array(faces, np.int64)


def _read_ply(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices, and the indices of all faces."""
    content = path.read_bytes()
    head, mark, _ = content.partition(b"end_header")
    if not mark:
        raise ValueError("its header has no end")
    order, elements = _header(head.decode("ascii", errors="replace"))
    body, at = content[content.index(b"\n", len(head)) + 1 :], 0
    if not order:
        # Words become numbers of one type; from then on both are alike.
        body = np.array(body.split(), np.float64).tobytes()
    vertices, faces = np.zeros((0, 3)), np.zeros(0, np.int64)
    for element in elements:
        columns, at = _columns(element, body, at, order)
        if element.name == "vertex":
            vertices = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=-1)
        elif element.name == "face":
            name = "vertex_index" if "vertex_index" in columns else "vertex_indices"
            faces = columns[name].astype(np.int64)
    return vertices, faces


def _header(text: str) -> tuple[str, list[_Element]]:
    """Byte order, empty for text, and what follows the header."""
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
    """Values of each property, those of lists one after the other; and where the next element begins."""
    found: dict[str, list[_Numbers]] = {name: [] for name, _, _ in element.properties}
    done, step = 0, _STEP
    while done < element.rows:
        row = _row(element, body, at, order)
        n_rows = min(step, element.rows - done)
        if at + n_rows * row.itemsize > len(body):
            n_rows = (len(body) - at) // max(row.itemsize, 1)
        rows = np.frombuffer(body, row, n_rows, at)
        # As far as all lists are as long as those of the first row.
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
    """Layout of the row at a place: with as many numbers as its lists say they have."""

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
