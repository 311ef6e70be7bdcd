"""The files of a recording, their order, and their readers."""

from __future__ import annotations

import re
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path

from optsim.core.errors import ConfigError, OptsimError, StorageError
from optsim.core.foreign.tiff import SUFFIXES as TIFF
from optsim.footage.recording import arrays, images, tiff
from optsim.footage.recording.arrays import ARRAYS
from optsim.footage.recording.film import Recording, as_recording

IMAGES = (".exr", ".png", *TIFF)
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm")


def open_recording(path: Path, *, key: str | None = None, axes: str | None = None) -> Recording:
    """Find a recording's files and read its first frame.

    Parameters
    ----------
    path : Path
        A folder of images, a pattern, or one file.
    key : str, optional
        Array of an npz or mat file, or channel or part of EXR files.
    axes : str, optional
        Order of an array's axes, of ``t y x c``.

    Raises
    ------
    StorageError
        When a file is missing, unreadable, or the numbering has a hole.
    ConfigError
        When ``key`` or ``axes`` is missing, or doesn't occur in the file.
    ValueCheckError
        For a dtype that no measured light has.
    """
    files = _files_of(path)
    suffix = files[0].suffix.lower()
    if suffix in ARRAYS:
        return arrays.film(files[0], key, axes)
    if axes is not None:
        raise ConfigError(f"source.footage.axes: got '{axes}', but {path} is no array file; remove the key")
    if key is not None and suffix != ".exr":
        raise ConfigError(f"source.footage.key: got {key!r}, but {path} has no names inside; remove the key")
    if suffix in VIDEOS:
        from optsim.footage.recording.video import video

        return video(files[0])
    if len(files) == 1 and suffix in TIFF:
        return tiff.tiff_stack(files[0])
    if suffix == ".exr":
        read, declared = partial(images.exr, key=key), images.exr_statement(files[0], key)
    elif suffix == ".png":
        read, declared = images.png, images.png_statement(files[0])
    else:
        read, declared = tiff.tiff, tiff.tiff_stack(files[0]).declared
    return as_recording(files, len(files), lambda first: map(read, files[first:]), declared=declared)


@contextmanager
def naming(keys: Mapping[str, str]) -> Generator[None, None, None]:
    """Let this room's errors name options, or keys of other files, instead of its own keys."""
    try:
        yield
    except OptsimError as error:
        text = str(error)
        for key, other in keys.items():
            text = text.replace(key, other)
        raise type(error)(text) from None


def by_number(name: str) -> list[tuple[int, str]]:
    """Sort key of a name by its numbers: slot2 before slot10."""
    return [(int(digits or -1), word) for digits, word in re.findall(r"(\d+)|(\D+)", name)]


def _files_of(path: Path) -> tuple[Path, ...]:
    """List the files of a recording in order of time: by the numbers in their names, not letter by letter."""
    if path.is_dir():
        found = [p for p in path.iterdir() if p.suffix.lower() in IMAGES and not p.name.startswith(".")]
    elif path.is_file():
        found = [path]
    elif set(path.name) & set("*?["):
        found = [p for p in path.parent.glob(path.name) if p.is_file()]
    else:
        raise StorageError(f"source.footage.path: no such file or folder: {path}")
    if not found:
        raise StorageError(
            f"source.footage.path: no frames in {path}; expected images ({' '.join(IMAGES)}), arrays "
            f"({' '.join(ARRAYS)}) or a video ({' '.join(VIDEOS)})"
        )
    kinds = sorted({p.suffix.lower() for p in found})
    if len(kinds) > 1 or kinds[0] not in IMAGES + ARRAYS + VIDEOS:
        raise StorageError(
            f"source.footage.path: {path} holds {', '.join(kinds)}; expected one kind of "
            f"{' '.join(IMAGES + ARRAYS + VIDEOS)}; a pattern such as '*.png' chooses one"
        )
    if len(found) > 1 and kinds[0] not in IMAGES:
        raise StorageError(
            f"source.footage.path: {path} matches {len(found)} files; name one {kinds[0]} file"
        )
    files = tuple(sorted(found, key=lambda file: by_number(file.name)))
    _check_numbering(files)
    return files


def _check_numbering(files: tuple[Path, ...]) -> None:
    """Refuse a hole in the numbers of names: a lost file would shift all later time."""
    numbers = [re.findall(r"\d+", p.stem) for p in files]
    if len(files) < 3 or not all(numbers):
        return
    steps = [int(b[-1]) - int(a[-1]) for a, b in pairwise(numbers)]
    usual = max(set(steps), key=steps.count)
    for (before, after), step in zip(pairwise(files), steps, strict=True):
        if step != usual:
            raise StorageError(
                f"source.footage.path: after {before.name} comes {after.name}, while numbers go in steps of "
                f"{usual}; frames are missing, or files of two recordings are mixed"
            )
