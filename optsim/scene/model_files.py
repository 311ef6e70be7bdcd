"""Files of a model: a glTF file names buffers and pictures, an OBJ file its materials."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from optsim.core.errors import ConfigError
from optsim.core.files import content_hash
from optsim.core.foreign import reading
from optsim.scene.gltf import gltf_parts


def files_of(path: Path) -> tuple[Path, ...]:
    """List a model's file and all that it names and that is there.

    Raises
    ------
    StorageError
        For a damaged file.
    """
    stat = path.stat()
    return (path, *(file for _, file in _named(path, stat.st_mtime_ns, stat.st_size) if file.is_file()))


def check_files(path: Path, folder: Path, where: str, *, shown: bool) -> None:
    """Check that all files that a model names are inside a folder, and there if its materials are shown.

    Raises
    ------
    ConfigError
        For the first that isn't.
    """
    stat = path.stat()
    for name, file in _named(path, stat.st_mtime_ns, stat.st_size):
        if not file.is_relative_to(folder.resolve()):
            raise ConfigError(
                f"{where}: {path.name} names {name!r}, expected a file inside {folder.resolve()}"
            )
        if shown and not file.is_file():
            raise ConfigError(
                f"{where}: {path.name} names {name!r}, but there is no such file; cure: copy it there too, "
                "or give the object a material of the scene"
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
    names: list[str] = []
    if path.suffix.lower() in (".glb", ".gltf"):
        with reading(path, "a glTF 2.0 file", "export it again, for example as GLB"):
            header, _ = gltf_parts(path)
            listed: list[dict[str, Any]] = [*header.get("buffers", []), *header.get("images", [])]
            names = [
                unquote(each["uri"]) for each in listed if not each.get("uri", "data:").startswith("data:")
            ]
    elif path.suffix.lower() == ".obj":
        names = _after(path, "mtllib")
        libraries = [path.parent / name for name in names if (path.parent / name).is_file()]
        names += [name for library in libraries for name in _after(library, "map_Kd")]
    return tuple((name, (path.parent / name).resolve()) for name in dict.fromkeys(names))


def _after(path: Path, key: str) -> list[str]:
    """Names after a key of an OBJ or MTL file; options stand before a name."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    found = [
        line.split(maxsplit=1)[1].strip() for line in lines if line.split()[:1] == [key] and line.split()[1:]
    ]
    return [name.split()[-1] if name.startswith("-") else name for name in found]
