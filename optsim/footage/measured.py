"""Images of other cameras from disk, as stored: arrays, images, and EXR files whose channels are slots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ConfigError, ValueCheckError
from optsim.core.files import read_exr
from optsim.footage.recording import array_names, by_number, load_array, naming, open_recording

_ARRAYS = (".npz", ".mat")


def read_pictures(
    path: Path,
    said: str,
    *,
    names: Sequence[str] = (),
    slots: bool = False,
    curves: Sequence[str] | None = None,
) -> NDArray[Any]:
    """Read images in order of time.

    Parameters
    ----------
    path : Path
        An npz or mat file, or a folder, pattern or file of EXR, PNG or TIFF images.
    said : str
        Their name in messages: the key that gives the path.
    names : sequence of str
        Names of the array in an npz or mat file; the first that exists is read.
    slots : bool
        The channels of an EXR are slots, in the order of the numbers in their names.
    curves : sequence of str or None
        Curves that a file may state of its values, any by default.

    Returns
    -------
    ndarray of shape (y, x), (t, y, x) or (frame, slot, y, x)
        As stored.

    Raises
    ------
    ConfigError, StorageError, ValueCheckError
        When a file is missing, cannot be read, differs from the others, or has colours.
    """
    if path.suffix.lower() in _ARRAYS:
        return _array(path, said, names)
    if slots and (path.suffix.lower() == ".exr" or (path.is_dir() and [*path.glob("*.exr")])):
        return _slot_stacks(path, said)
    with naming({"source.footage.path": said, "source.footage.key": said, "source.footage.axes": said}):
        recording = open_recording(path)
        pictures = np.stack(list(recording.read(0)))
    if curves is not None and recording.declared.curve not in (None, *curves):
        raise ValueCheckError(
            f"{said}: {path} says that its values follow the curve {recording.declared.curve}, expected "
            "linear ones; cure: convert it, or remove what it says"
        )
    if pictures.shape[3] != 1:
        raise ValueCheckError(f"{said}: {path} has {pictures.shape[3]} channels, expected grey pictures")
    return pictures[..., 0]


def _array(path: Path, said: str, names: Sequence[str]) -> NDArray[Any]:
    there = array_names(path)
    name = next((name for name in names if name in there), None)
    if name is None:
        raise ConfigError(
            f"{said}: {path} holds {', '.join(sorted(there)) or 'no arrays'}, expected "
            f"{' or '.join(names)}; rename the array"
        )
    # MATLAB's last axes are time; of a code (y, x, slot, frame), the frames are the last one.
    stored = load_array(path, name)
    return stored.T.swapaxes(-1, -2) if path.suffix.lower() == ".mat" else stored


def _slot_stacks(path: Path, said: str) -> NDArray[Any]:
    """Slots of each EXR file, (frame, slot, y, x); for files of one channel each, (t, y, x)."""
    files = sorted(path.glob("*.exr"), key=lambda file: by_number(file.name)) if path.is_dir() else [path]
    stacks = [_slots(read_exr(each)[0], f"{said}: {each}") for each in files]
    for each, stack in zip(files, stacks, strict=True):
        if stack.shape != stacks[0].shape:
            raise ValueCheckError(
                f"{said}: {each} holds {stack.shape[0]} channels of {stack.shape[1:]} pixels, expected "
                f"{stacks[0].shape[0]} of {stacks[0].shape[1:]} as {files[0].name} does"
            )
    return np.concatenate(stacks) if len(stacks[0]) == 1 else np.stack(stacks)


def _slots(channels: Mapping[str, NDArray[Any]], what: str) -> NDArray[Any]:
    """Channels of an EXR in the order of the numbers in their names, (slot, v, u); none may be missing."""
    names = sorted(channels, key=by_number)
    numbers_in_names = [[number for number, word in by_number(name) if not word] for name in names]
    numbers = [each[-1] for each in numbers_in_names if each]
    if 0 < len(numbers) < len(names):
        raise ValueCheckError(
            f"{what}: got channels {', '.join(names)}, expected slots alone, all with numbers in their names "
            "or none; cure: leave the others out"
        )
    if numbers and numbers != list(range(numbers[0], numbers[0] + len(names))):
        missing = sorted(set(range(numbers[0], numbers[-1] + 1)) - set(numbers))
        raise ValueCheckError(
            f"{what}: got channels {', '.join(names)}, expected slots one after the other; "
            f"missing: {', '.join(map(str, missing)) or 'none, but some are there twice'}"
        )
    return np.stack([channels[name] for name in names])
