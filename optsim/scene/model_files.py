"""Files of a model: a glTF file names buffers and pictures, an OBJ file its materials."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any

from optsim.core.errors import ConfigError
from optsim.core.files import content_hash
from optsim.core.foreign import reading
from optsim.scene.gltf import open_gltf, source
from optsim.scene.gltf_model import textures_of
from optsim.scene.model_surface import beside
from optsim.scene.obj_files import libraries_of, named_pictures


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
