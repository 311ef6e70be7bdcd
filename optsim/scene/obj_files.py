"""Wavefront OBJ files and their libraries of materials (MTL), read line by line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from optsim.core.errors import OptsimError, StorageError
from optsim.core.quantities import Doubles, Ints
from optsim.scene import model_surface as shared
from optsim.scene.model_surface import Placement, Surface, SurfacePiece, listed
from optsim.scene.polygons import check_indices, triangles

_CURVES = ("curv", "curv2", "surf", "call")
_NAMES = ("o", "g", "lod", "vp", "")  # without effect on what is shown
# Pictures of a material that are read -> key of the surface.
_MAPS = {"map_kd": "picture", "map_d": "cutout", "norm": "normal_map", "map_kn": "normal_map"} | {
    "map_pr": "roughness_map",
    "map_pm": "metallic_map",
}
# Read, or without a meaning in light that is traced.
_READ = (*_MAPS, "kd", "d", "tr", "ns", "ks", "pr", "pm", "ka", "map_ka", "illum", "ni", "sharpness")
# Options of a map -> the most words that they take; the first are honoured, the next change no colour.
_HONOURED = {"-s": 3, "-o": 3, "-clamp": 1}
_HARMLESS = dict.fromkeys(("-blendu", "-blendv", "-boost", "-texres", "-bm", "-cc", "-colorspace"), 1)
_IDLE = {"-mm": ["0", "1"], "-t": ["0", "0", "0"], "-type": ["none"], "-imfchan": ["m"]}
_OPTIONS = _HONOURED | _HARMLESS | {"-t": 3, "-mm": 2, "-imfchan": 1, "-type": 1}
# Kept are 3ds Max's names, as in "usemtl Material #25", and ZBrush's colours, which are said.
_COMMENT = re.compile(r"^(\s*(?:use|new)mtl\s.*\s#\d+\s*)$|(?:^|[ \t])#(?!MRGB).*", re.IGNORECASE)
_WHOLE = re.compile(r"-?\d+").fullmatch
Library = dict[str, dict[str, str]]


@dataclass(frozen=True, eq=False)
class Corners:
    """Faces of one material: corners that differ, by text and smoothing group, and those of each face."""

    known: dict[str, int] = field(default_factory=dict[str, int])
    used: list[int] = field(default_factory=list[int])
    counts: list[int] = field(default_factory=list[int])

    def indices(self) -> tuple[Ints, Ints]:
        """Vertex and texture coordinate of each known corner, from 0; -1 for none."""
        rows = [(*word.partition(" ")[0].split("/"), "")[:2] for word in self.known]
        if wrong := [row for row in rows if not (_WHOLE(row[0]) and (not row[1] or _WHOLE(row[1])))]:
            raise ValueError(
                f"a face has the corner {'/'.join(wrong[0]).strip('/')!r}, expected whole numbers"
            )
        table = np.array([[int(vertex), int(other or 0)] for vertex, other in rows], np.int64).reshape(-1, 2)
        return table[:, 0] - 1, table[:, 1] - 1


@dataclass(frozen=True, eq=False)
class ObjText:
    """An OBJ file's vertices (all numbers, and how many each has), coordinates, faces and libraries."""

    numbers: list[float]
    widths: list[int]
    coordinates: list[float]
    faces: dict[str, Corners]
    libraries: list[str]
    lost: str

    def columns(self, first: int, default: float) -> Doubles:
        """Three numbers of each vertex, (n, 3)."""
        widths, flat = np.array(self.widths, np.int64), np.array(self.numbers, np.float64)
        found = np.full((len(widths), 3), default)
        there = widths >= first + 3
        starts = (np.cumsum(widths) - widths)[there] + first
        found[there] = flat[starts[:, None] + np.arange(3)]
        return found


def lines_of(path: Path) -> list[str]:
    """Lines of a text of any common encoding, without comments, those that go on joined."""
    content = path.read_bytes()
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        text = content.decode("utf-16", "replace")
    elif b"\0" in content[:2]:
        text = content.decode("utf-16-be" if content[:1] == b"\0" else "utf-16-le", "replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            text = content.decode("latin-1")
    text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines = [_COMMENT.sub(r"\1", line) if "#" in line else line for line in text.split("\n")]
    # A backslash after a letter beyond ASCII may be the second half of a Japanese one.
    return re.sub(r"(?<![^\0-\x7f])\\[ \t]*\n", " ", "\n".join(lines)).split("\n") if "\\" in text else lines


def parse_obj(path: Path) -> ObjText:
    """Read the lines of a file."""
    found = ObjText([], [], [], {}, [], "")
    lost: dict[str, None] = {}
    material, smooth, faces, normals = "", "", 0, 0
    for number, line in enumerate(lines_of(path), 1):
        key, *words = line.split() or [""]
        why = "expected numbers"
        try:
            if key == "v":
                found.numbers.extend(map(float, words))
                found.widths.append(len(words))
                if len(words) < 3:
                    raise ValueError
            elif key == "vt":
                found.coordinates.extend(map(float, (*words, "0")[:2]))
            elif key == "f":
                faces += 1
                group = found.faces.setdefault(material, Corners())
                # Faces of group "off" share no corner; normals decide where there are any.
                own = -faces if smooth in ("off", "0") else int(smooth or 0)
                if "-" in line:
                    counts = len(found.widths), len(found.coordinates) // 2, normals
                    words = [_counted(word, counts) for word in words]
                if own and words and words[0].count("/") < 2:
                    words = [f"{word} {own}" for word in words]
                known = group.known
                group.used.extend([known.setdefault(word, len(known)) for word in words])
                group.counts.append(len(words))
            elif key == "vn":
                normals += 1
            elif key == "usemtl":
                material = line.strip()[6:].strip()
            elif key == "mtllib":
                found.libraries.extend(_libraries(path, line.strip()[6:].strip()))
            elif key == "s":
                smooth = words[0] if words and (words[0].isdigit() or words[0] == "off") else ""
            elif key in _CURVES:
                why = "which is not read; export polygons"
                raise ValueError
            elif key not in _NAMES:
                lost[key if key.isprintable() else "what is no text"] = None
        except ValueError:
            raise StorageError(
                f"{path}: line {number}: got {line.strip()[:60]!r}, {why}; cure: export it again"
            ) from None
    return replace(found, lost=listed(*list(lost)[:8]))


def _counted(word: str, counts: tuple[int, int, int]) -> str:
    """Corner whose indices count back from the last, as one that counts from 1; -1 becomes n."""
    parts = word.split("/")
    for place, count in zip(range(len(parts)), counts, strict=False):
        if parts[place].startswith("-"):
            index = count + 1 + int(parts[place])
            # One too far back stays wrong; without a sign 0 would be none.
            parts[place] = str(index if index or not place else -1)
    return "/".join(parts)


def _libraries(path: Path, text: str) -> list[str]:
    """Names after ``mtllib``: one with spaces, or several."""
    names, text = text.split(), text.strip("\"'")
    several = all(name.lower().endswith(".mtl") for name in names)
    return names if several and not shared.beside(path, text).is_file() else [text]


def libraries_of(path: Path) -> list[str]:
    """Names of the libraries of a file."""
    lines = [line.strip()[6:].strip() for line in lines_of(path) if line.split()[:1] == ["mtllib"]]
    return [name for text in lines for name in _libraries(path, text)]


def read_obj(path: Path) -> tuple[list[SurfacePiece], str]:
    """Read the pieces of a file, one a material, and what is left out."""
    text = parse_obj(path)
    materials: dict[str, tuple[Path, dict[str, str]]] = {}
    for library in [shared.beside(path, name) for name in text.libraries]:
        stated = parse_mtl(library) if library.is_file() else {}
        materials = {name: (library, each) for name, each in stated.items()} | materials
    points, lost, pieces = text.columns(0, 0.0), [text.lost], list[SurfacePiece]()
    coded = None
    lost += ["numbers of a vertex beyond place and colour"] if {*text.widths} - {3, 4, 6} else []
    if max(text.widths, default=0) >= 6:
        # White for a vertex without.
        coded = shared.linear_colours(text.columns(3, 1.0))
    flat = np.array([*text.coordinates, 0.0, 0.0]).reshape(-1, 2)
    for name, group in text.faces.items():
        vertices, coordinates = group.indices()
        check_indices(path, vertices, len(points))
        check_indices(path, coordinates[coordinates != -1], len(flat) - 1, "texture coordinate")
        used = np.array(group.used)
        counts = np.array(group.counts)
        faces, crossed = triangles(points[vertices], used, counts)
        lost.append(f"the outline of {crossed} faces that cross themselves" if crossed else "")
        lost.append(f"{(counts < 3).sum()} faces of less than 3 corners" if (counts < 3).any() else "")
        surface, places = Surface(name), list[Placement]()
        if name in materials:
            surface, places = _material(path, name, *materials[name])
        elif name:
            surface = replace(surface, lost=f"material {name!r}, which no library has")
        uv = None
        if (coordinates >= 0).any():
            uv = flat[coordinates]
            if places and (coordinates < 0).any():
                surface = replace(surface, lost=listed(surface.lost, "a picture where coordinates lack"))
        surface, uv = shared.laid(surface, uv, places)
        tints = None if coded is None else coded[vertices]
        surface, tints = shared.tinted(surface, tints, plain=name not in materials)
        pieces.append(SurfacePiece(f"material {name!r}", surface, points[vertices], used[faces], uv, tints))
    return pieces, listed(*lost)


def parse_mtl(path: Path) -> Library:
    """Read the materials of a library: text by key in lower case; the first of a name counts."""
    found: Library = {}
    current: dict[str, str] = {}
    for line in lines_of(path):
        key, _, text = line.strip().replace("\t", " ").partition(" ")
        if key.lower() == "newmtl":
            current = {}
            found.setdefault(text.strip(), current)
        elif key:
            current[key.lower()] = text.strip()
    return found


def named_pictures(path: Path, library: Path) -> list[tuple[str, Path]]:
    """Pictures of a library that are read: their names and places."""
    stated = parse_mtl(library).values()
    names = [_map(each[key])[0] for each in stated for key in _MAPS if key in each]
    return [(name, shared.beside(_base(path, library, name), name)) for name in names]


def _base(path: Path, library: Path, name: str) -> Path:
    """File beside which a picture lies: its library, else the model."""
    return library if shared.beside(library, name).is_file() else path


def _map(text: str) -> tuple[str, dict[str, list[str]]]:
    """Name and options of a map."""
    options: dict[str, list[str]] = {}
    words = text.split()
    while words and (option := words[0].lower()) in _OPTIONS:
        count = 1
        while count <= _OPTIONS[option] and count < len(words) - 1:
            if count > 1 and not re.fullmatch(r"[-+.\deE]+", words[count]):
                break
            count += 1
        options[option] = words[1:count]
        # The rest as it stands: a name may hold several spaces.
        text = text.split(maxsplit=count)[-1] if len(words) > count else ""
        words = text.split()
    return text.strip("\"' "), options


def _material(
    path: Path, name: str, library: Path, stated: Mapping[str, str]
) -> tuple[Surface, list[Placement]]:
    """Surface of a material, and how its pictures lie."""
    lost = [key for key, text in stated.items() if key not in _READ and not _nothing(key, text)]
    surface, places = Surface(name, np.full(3, 1.0 if "map_kd" in stated else 0.5)), list[Placement]()
    refused = ""
    try:
        surface = _by_numbers(surface, stated)
    except ValueError as error:
        refused = f"material {name!r}: {error}"
    lost += ["d -halo"] if "-halo" in stated.get("d", "") else []
    lost += ["map_kd, which Kd 0 makes black"] if "map_kd" in stated and not surface.colour.any() else []
    for key in [each for each in _MAPS if each in stated]:
        file, options = _map(stated[key])
        lost += [f"{key} {option}" for option in options if option in _HARMLESS]
        try:
            idle = [each for each in options if options[each] == _IDLE.get(each)]
            if bad := [each for each in options if each not in (*_HONOURED, *_HARMLESS, *idle)]:
                raise ValueError(f"got {bad[0]} {' '.join(options[bad[0]])}, which is not read")
            numbers = [[float(word) for word in options.get(each, [])] for each in ("-s", "-o")]
            (wide, high), (right, up) = (
                [*each, k, k][:2] for each, k in zip(numbers, (1.0, 0.0), strict=True)
            )
            surface = shared.with_picture(
                surface, _MAPS[key], shared.content_beside(_base(path, library, file), file)
            )
        except (ValueError, OptsimError) as error:
            refused = listed(refused, f"material {name!r}: {key}: {shared.fault(error)}")
        else:
            wrap = "clamp" if options.get("-clamp", [""])[0].lower() == "on" else "repeat"
            places.append(Placement(0, (wide, 0.0, right, 0.0, high, up), (wrap, wrap)))
    return replace(surface, lost=listed(*lost, surface.lost), refused=refused), places


def _by_numbers(surface: Surface, stated: Mapping[str, str]) -> Surface:
    """Surface with the numbers of a material."""

    def number(key: str, default: float) -> float:
        try:
            return float(stated[key].split()[-1]) if key in stated else default
        except (ValueError, IndexError):
            raise ValueError(f"got {key} {stated[key]!r}, expected a number") from None

    if "kd" in stated:
        words = stated["kd"].split()
        if not all(re.fullmatch(r"[-+.\deE]+", word) for word in words) or len(words) not in (1, 3):
            raise ValueError(f"got Kd {stated['kd']!r}, expected one or three numbers")
        # One number is grey.
        surface = replace(surface, colour=np.array([float(word) for word in words]) * np.ones(3))
    glossy = "ns" in stated and stated.get("illum") not in ("0", "1")
    # A Blinn-Phong exponent as the slope of facets, whose root is the roughness of the renderer.
    shiny = 0.0 if not glossy or _nothing("ks", stated.get("ks", "1")) else max(number("ns", 0.0), 0.0)
    return replace(
        surface,
        opacity=number("d", 1.0) if "d" in stated else 1 - number("tr", 0.0),
        roughness=number("pr", 1.0 if "map_pr" in stated else (2 / (2 + shiny)) ** 0.25),
        metallic=number("pm", 1.0 if "map_pm" in stated else 0.0),
    )


def _nothing(key: str, text: str) -> bool:
    """Whether a key states nothing: zeros, or a filter of ones."""
    try:
        return {float(word) for word in text.split()} <= {1.0 if key == "tf" else 0.0}
    except ValueError:
        return False
