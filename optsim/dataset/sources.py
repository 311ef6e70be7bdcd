"""Sources of a data set: experiment and scenes, carried in its folder, so that any machine makes it again.

::

    experiment.toml  files/0-dictionary.npz  scenes/house/scene.toml scenes/house/house.glb

Paths of the carried spec start at the set's folder, so no file of a sequence tells where the set was built.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Generator, Iterator, Mapping
from contextlib import chdir, contextmanager, suppress
from pathlib import Path
from typing import cast

from optsim.calibration.choice import BENCH_FILE, in_folder, resolve_stored
from optsim.core.config import read_toml
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import atomic, content_hash
from optsim.dataset.spec import DatasetSpec, plain
from optsim.experiment.experiment import experiment_path
from optsim.scene.scene import scenes_folder

SHIPPED = "shipped:"
"""Before the place of a file of a shipped scene, of which a set keeps the hash alone."""
_EXPERIMENT = "experiment.toml"
# Larger folders are rarely meant; sensible default.
_MOST_BYTES = 2_000_000_000

Content = Path | bytes


@contextmanager
def inside(folder: Path) -> Generator[None]:
    """Work in the folder of a set, where the paths of its spec start."""
    if chosen := os.environ.get("OPTSIM_CACHE"):
        os.environ["OPTSIM_CACHE"] = os.path.abspath(os.path.expanduser(chosen))
    with chdir(folder):
        yield


def bundled(spec: DatasetSpec, folder: Path) -> tuple[DatasetSpec, dict[str, Content]]:
    """Return a spec whose paths start at its set's folder, and the content of the files that they name."""
    found: dict[str, Content] = {}
    found[_EXPERIMENT] = _experiment(spec.experiment, folder, found)
    scenes: dict[str, tuple[str, ...]] = {}
    for name, variations in spec.scenes.items():
        root, own, place = Path(name), "", f"scenes/{plain(name)}"
        if is_shipped := "/" not in name and not name.endswith(".toml"):
            root, place = scenes_folder() / name, f"{SHIPPED}{name}"
        elif root.is_file():
            root, own = root.parent, f"/{root.name}"
        new = name if is_shipped else f"./{place}{own}"
        if new in scenes:
            raise ConfigError(
                f"scenes: got two folders named {plain(name)!r}, expected one; cure: rename one"
            )
        scenes[new] = variations
        files = {f"{place}/{at}": path for at, path in _below(root, folder)}
        if (size := sum(path.stat().st_size for path in files.values())) > _MOST_BYTES:
            raise ConfigError(
                f"scenes: {name} has {size / 1e9:.1f} GB, expected at most {_MOST_BYTES / 1e9:g} GB: the set "
                "carries it; cure: a folder with scene.toml and the files that it names"
            )
        found |= files
    return spec.model_copy(update={"experiment": f"./{_EXPERIMENT}", "scenes": scenes}), found


def hashes(files: Mapping[str, Content]) -> dict[str, str]:
    """SHA-256 of each content, by its place."""
    return {
        place: content_hash(held) if isinstance(held, Path) else hashlib.sha256(held).hexdigest()
        for place, held in files.items()
    }


def carry(files: Mapping[str, Content], folder: Path) -> None:
    """Write what is missing of the carried files into the folder of a set."""
    for place, held in files.items():
        if not place.startswith(SHIPPED) and not (folder / place).is_file():
            with atomic(folder / place) as part:
                part.write_bytes(held.read_bytes() if isinstance(held, Path) else held)


def check_sources(folder: Path, known: Mapping[str, str]) -> None:
    """Refuse a set of which the experiment or a scene is not as it was when it was built."""
    for place, sha256 in known.items():
        is_shipped, path = place.startswith(SHIPPED), folder / place
        if is_shipped:
            path = scenes_folder() / place.removeprefix(SHIPPED)
        if not path.is_file() or content_hash(path) != sha256:
            cure = "the version of optsim that built the set" if is_shipped else "copy it there again"
            raise StorageError(f"{path}: got it lost or changed since the set was built; cure: {cure}")


def _below(root: Path, besides: Path) -> Iterator[tuple[str, Path]]:
    """Files of a folder by their place in it, without hidden ones, texts about it, and the set itself."""
    for path in sorted(root.rglob("*")):
        place = path.relative_to(root)
        is_hidden = any(part.startswith(".") for part in place.parts) or place.suffix == ".md"
        if not is_hidden and path.is_file() and not path.resolve().is_relative_to(besides.resolve()):
            yield place.as_posix(), path


def _experiment(name: str, folder: Path, found: dict[str, Content]) -> bytes:
    """Text of an experiment in which carried files, which are added, stand for those that it names."""
    path = experiment_path(name)
    text, table, meant = path.read_text(encoding="utf-8-sig"), read_toml(path), read_toml(path)
    resolve_stored(meant, path.parent)
    for said, there in dict(zip(_texts(table), _texts(meant), strict=True)).items():
        file = Path()
        # Most texts are no file names, and some cannot be.
        with suppress(OSError, RuntimeError, ValueError):
            file = in_folder(Path(there).expanduser()) if "/" in there or Path(there).suffix else file
            file = file if file.is_file() else Path()
        if not file.name:
            continue
        place = f"files/{len(found)}/{file.name}"
        found |= (
            {f"{Path(place).parent}/{at}": each for at, each in _below(file.parent, folder)}
            if file.name == BENCH_FILE
            else {place: file}
        )
        if not any(quoted in text for quoted in (f'"{said}"', f"'{said}'")):
            raise ConfigError(f"{name}: got {said!r} in a form that can't be carried; cure: plain quotes")
        text = text.replace(f'"{said}"', json.dumps(place)).replace(f"'{said}'", json.dumps(place))
    return text.encode()


def _texts(value: object) -> Iterator[str]:
    """All texts in a table, in its order."""
    if isinstance(value, dict):
        for each in cast("dict[str, object]", value).values():
            yield from _texts(each)
    elif isinstance(value, list):
        for each in cast("list[object]", value):
            yield from _texts(each)
    elif isinstance(value, str):
        yield value
