"""Files of a model: a glTF file names buffers and pictures, an OBJ file its materials."""

from __future__ import annotations

import functools
import hashlib
import io
import re
from contextlib import suppress
from pathlib import Path
from typing import Any

from optsim.core.errors import ConfigError, OptsimError
from optsim.core.files import content_hash
from optsim.core.foreign import any_size, check_memory, reading
from optsim.scene.gltf import Gltf, Header, open_gltf, source
from optsim.scene.gltf_model import textures_of
from optsim.scene.model_surface import beside
from optsim.scene.obj_files import libraries_of, named_pictures

# Bytes of a triangle, a texel and one of normals, from reading to rendering: measured 410 to 680, 57 and 128.
_TRIANGLE_BYTES, _TEXEL_BYTES, _NORMAL_BYTES = 800.0, 64.0, 144.0
# Least bytes of a triangle in an OBJ file and in an STL file of text; of binary STL all of them.
_OBJ_BYTES, _TEXT_BYTES, _STL_BYTES = 40, 200, 50


def files_of(path: Path) -> tuple[Path, ...]:
    """List a model's file and all that it names and that is there."""
    stat = path.stat()
    return (path, *(file for _, file in _named(path, stat.st_mtime_ns, stat.st_size) if file.is_file()))


def check_files(path: Path, folder: Path, where: str, *, shown: bool) -> None:
    """Refuse a model that names a file outside of a folder or, if its materials are shown, a missing one."""
    stat = path.stat()
    for name, file in _named(path, stat.st_mtime_ns, stat.st_size):
        if not file.is_relative_to(folder.resolve()):
            raise ConfigError(
                f"{where}: {path.name} names {name!r}, expected a file inside {folder.resolve()}"
            )
        if shown and not file.is_file():
            raise ConfigError(
                f"{where}: {path.name} names {name!r}, but there is no such file; cure: copy it there too, "
                "or, unless it is a buffer, give the object a material of the scene"
            )


def check_size(path: Path) -> None:
    """Refuse a model that memory can't hold with its pictures, before it is read."""
    with reading(path, "a model", "export it again, for example as GLB"):
        triangles, texels, normals = _counts(path)
    check_memory(
        path,
        _TRIANGLE_BYTES * triangles + _TEXEL_BYTES * texels + _NORMAL_BYTES * normals,
        "a model",
        said=f"about {triangles:.2g} triangles and {texels + normals:.2g} texels take",
        cure="a model with fewer triangles or smaller pictures, or more memory",
    )


def _counts(path: Path) -> tuple[float, float, float]:
    """Count a model's triangles, by its header or its size, its texels, and those of normals."""
    suffix, size = path.suffix.lower(), path.stat().st_size
    if suffix in (".glb", ".gltf"):
        gltf = open_gltf(path)
        others, normals = (sum(map(_texels, _contents(gltf, normals=n))) for n in (False, True))
        return _triangles(gltf), others, normals
    with path.open("rb") as stream:
        head = stream.read(1 << 16)
    if suffix == ".ply":
        stated = re.search(rb"element\s+face\s+(\d+)", head)
        # A face has a byte or more: a header alone demands nothing.
        return min(float(stated[1]), size) if stated else 0.0, 0.0, 0.0
    if suffix == ".stl":
        binary = len(head) >= 84 and size == 84 + 50 * int.from_bytes(head[80:84], "little")
        return size / (_STL_BYTES if binary else _TEXT_BYTES), 0.0, 0.0
    pictures = {file for _, file in _named(path, path.stat().st_mtime_ns, size) if file.is_file()}
    return size / _OBJ_BYTES, sum(_texels(file.read_bytes()) for file in pictures), 0.0


def _triangles(gltf: Gltf) -> float:
    """Triangles of all nodes of a glTF file; a mesh counts for each node that shows it."""
    total = 0.0
    for node in gltf.header.get("nodes", []):
        primitives: list[Header] = gltf.entry("meshes", node["mesh"])["primitives"] if "mesh" in node else []
        for each in primitives:
            at = each.get("indices", each["attributes"].get("POSITION"))
            corners = 0 if at is None else gltf.entry("accessors", at)["count"]
            total += corners / 3 if each.get("mode", 4) == 4 else corners
    return total


def _contents(gltf: Gltf, *, normals: bool) -> list[bytes]:
    """Contents of the pictures of normals that a glTF file shows, or of the others, each once."""
    used = {
        source(gltf.entry("textures", each["index"])): each["index"]
        for material in gltf.header.get("materials", [])
        for key, each in textures_of(material).items()
        if (key == "normalTexture") == normals
    }
    found: list[bytes] = []
    for index in used.values():
        # What is wrong with it, and whether it is missing, is said where it is read.
        with suppress(ValueError, LookupError, OptsimError):
            found.append(gltf.picture(index))
    return found


def _texels(content: bytes) -> float:
    """Count a picture's texels by its header; 0 of what is no picture."""
    from PIL import Image

    try:
        with any_size(), Image.open(io.BytesIO(content)) as picture:
            return float(picture.width * picture.height)
    except (OSError, SyntaxError, ValueError):
        return 0.0


def model_hash(path: Path) -> str:
    """Hash of a model with all its files."""
    files = files_of(path)
    if len(files) == 1:
        return content_hash(path)
    return hashlib.sha256("".join(map(content_hash, files)).encode()).hexdigest()


@functools.lru_cache(maxsize=64)
def _named(path: Path, _mtime_ns: int, _size: int) -> tuple[tuple[str, Path], ...]:
    """Names in a model's file, and where they lead."""
    names, pictures = list[str](), list[tuple[str, Path]]()
    with reading(path, "a model", "export it again, for example as GLB"):
        if path.suffix.lower() in (".glb", ".gltf"):
            header = open_gltf(path).header
            used = {
                source(header["textures"][each["index"]])
                for material in header.get("materials", [])
                for each in textures_of(material).values()
            }
            listed: list[dict[str, Any]] = header.get("buffers", []) + [
                image for number, image in enumerate(header.get("images", [])) if number in used
            ]
            names = [each["uri"] for each in listed if not each.get("uri", "data:").startswith("data:")]
        elif path.suffix.lower() == ".obj":
            names = libraries_of(path)
            libraries = [file for name in names if (file := beside(path, name)).is_file()]
            pictures = [each for library in libraries for each in named_pictures(path, library)]
        return (*((name, beside(path, name)) for name in dict.fromkeys(names)), *dict.fromkeys(pictures))
