"""Polygon files (PLY): their header is the truth; vertices, faces, colours and texture coordinates."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ConfigError
from optsim.core.quantities import Doubles, Ints
from optsim.scene.model_surface import Surface, SurfacePiece, linear_colours, listed, tinted
from optsim.scene.polygons import check_indices, triangles

# Names of PLY's number types, old and new -> numpy's.
_TYPES = (
    {"char": "i1", "short": "i2", "int": "i4", "uchar": "u1", "ushort": "u2", "uint": "u4"}
    | {"int8": "i1", "int16": "i2", "int32": "i4", "uint8": "u1", "uint16": "u2", "uint32": "u4"}
    | {"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"}
)
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_Numbers = NDArray[np.generic]
_LENGTH = "length of "
_STEP = 64  # rows read at once, growing while all lists have the same length
_INDICES = ("vertex_index", "vertex_indices")
# Names that programs give to a red, green and blue, and to texture coordinates.
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))


@dataclass(frozen=True)
class _Element:
    """Rows of a PLY file: properties are (name, type of a list's length or "", type)."""

    name: str
    rows: int
    properties: list[tuple[str, str, str]]


@dataclass(frozen=True, eq=False)
class PlyContent:
    """Columns of a file's elements by their names, lengths of their lists, and comments on pictures."""

    columns: dict[str, dict[str, _Numbers]]
    lengths: dict[str, dict[str, _Numbers]]
    pictures: list[str]

    def points(self) -> Doubles:
        """Vertices, (n, 3)."""
        if "vertex" not in self.columns:
            return np.zeros((0, 3))
        return np.stack([self.columns["vertex"][axis].astype(np.float64) for axis in "xyz"], axis=-1)

    def corners(self) -> Ints:
        """Vertices of all faces in a row."""
        faces = self.columns.get("face", {})
        return next(
            (faces[name].astype(np.int64) for name in _INDICES if name in faces), np.zeros(0, np.int64)
        )


def read_ply(path: Path) -> tuple[list[SurfacePiece], str]:
    """Read the one piece of a file, and what is left out."""
    ply = parse_ply(path)
    if "tristrips" in ply.columns:
        raise ConfigError(f"{path}: got triangle strips, which are not read; cure: export it as faces")
    points, corners = ply.points(), ply.corners()
    vertex, face = ply.columns.get("vertex", {}), ply.columns.get("face", {})
    check_indices(path, corners, len(points))
    counts = next((ply.lengths["face"][name] for name in _INDICES if name in face), np.zeros(0))
    faces, crossed = triangles(points, corners, counts.astype(np.int64))
    lost = [f"the outline of {crossed} faces that cross themselves"] if crossed else []
    lost += [element for element in ply.columns if element not in ("vertex", "face")] + ply.pictures
    read = {*"xyz", *_INDICES}
    tints, by_face = (_chosen(each, _COLOURS, read) for each in (vertex, face))
    uv = _chosen(vertex, _COORDINATES, read)
    if "alpha" in vertex and (vertex["alpha"] == (255 if vertex["alpha"].dtype == np.uint8 else 1)).all():
        read.add("alpha")
    for kind in ("vertex", "face"):
        lost += [f"{kind} {name}" for name in ply.columns.get(kind, ()) if name not in read]
    used = corners[faces]
    lost += ["colours of faces"] if tints is not None and by_face is not None else []
    if tints is None and by_face is not None:
        # Vertices are split where faces of several colours share them.
        rows = np.concatenate([corners[:, None], np.repeat(by_face, counts.astype(np.int64), axis=0)], axis=1)
        rows, first, each = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        used, points, tints = each.ravel()[faces], points[corners[first]], np.asarray(rows[:, 1:], np.float64)
        uv = None if uv is None else uv[corners[first]]
    surface, shades = tinted(Surface(), tints, plain=True)
    return [SurfacePiece("face", surface, points, used, uv, shades)], listed(*lost[:8])


def _chosen(
    columns: dict[str, _Numbers], names: tuple[tuple[str, ...], ...], read: set[str]
) -> Doubles | None:
    """Columns by the first names that are there, side by side; colours linear."""
    for each in names:
        if {*each} <= {*columns}:
            read.update(each)
            rows = np.stack([columns[name] for name in each], axis=-1)
            return linear_colours(rows) if len(each) == 3 else rows.astype(np.float64)
    return None


def parse_ply(path: Path) -> PlyContent:
    """Read all elements of a file."""
    content = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    if (end := re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", content)) is None:
        raise ValueError("its header has no end")
    head = content[: end.start()]
    order, elements = _header(head.decode("ascii", errors="replace"))
    body, at = content[end.end() :], 0
    if not order:
        # Text becomes numbers of one type, and is then read like binary.
        body = np.array(body.split(), np.float64).tobytes()
    found = PlyContent({}, {}, ["a picture (TextureFile)"] if b"\ncomment TextureFile" in head else [])
    for element in elements:
        columns, at = _columns(element, body, at, order)
        for name, _, number in element.properties:
            if not _TYPES.get(number, "f").startswith("f") and not order:
                typed = columns[name].astype(_TYPES[number])
                if (typed != columns[name]).any():
                    raise ValueError(f"{element.name} {name} holds what is no {number}")
                columns[name] = typed
        found.lengths[element.name] = {
            name.removeprefix(_LENGTH): columns.pop(name) for name in [*columns] if name.startswith(_LENGTH)
        }
        found.columns[element.name] = columns
    if (vertex := found.columns.get("vertex")) is not None and not {*"xyz"} <= {*vertex}:
        raise ValueError("its vertices have no x, y and z")
    return found


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
    found: dict[str, list[_Numbers]] = {name: [] for name in _names(element)}
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


def _names(element: _Element) -> list[str]:
    """Columns of an element: before each list its length."""
    return [
        each
        for name, length, _ in element.properties
        for each in ([_LENGTH + name] if length else []) + [name]
    ]


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
            if stop > len(body):
                raise ValueError(f"it ends within the rows of {element.name!r}")
            count = (int(np.frombuffer(body, dtype(length), 1, stop - size)[0]),)
            if element.name == "face" and name.startswith("vertex_ind") and count[0] < 3:
                raise ValueError(f"a face has {count[0]} corners")
        fields.append((name, dtype(number), count))
    return np.dtype(fields)
