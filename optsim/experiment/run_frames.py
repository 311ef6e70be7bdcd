# pyright: reportUnknownMemberType=false
"""Coded frames in the folder of a run: digital numbers, codes and masks, written and read again."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError
from optsim.core.files import read_exr, read_record, sum_of, write_exr, write_json, write_png8, write_png16
from optsim.core.foreign import reading
from optsim.core.quantities import CodedFrame, ExposureCode, Floats

CHECKSUMS = "checksums.json"
"""Size and CRC-32 of each frame, code and mask, by its place in the folder."""
_CURE = "cure: copy the run's folder again, or run the experiment again"


def write_frames(folder: Path, frames: Mapping[str, Sequence[CodedFrame]]) -> None:
    """Write the frames of each method, and :data:`CHECKSUMS` of their files.

    Parameters
    ----------
    folder : Path
        Of the run.
    frames : mapping
        Method -> its frames.
    """
    written: list[Path] = []
    for name, taken in frames.items():
        for frame in taken:
            dn, mask, code = _places(folder, name, frame.index)
            write_png16(dn, frame.dn)
            write_png8(mask, frame.code.moving.astype(np.uint8) * 255)
            levels: Floats = frame.code.levels.astype(np.float32)
            write_exr(
                code,
                {f"slot{slot:02d}": levels[slot] for slot in range(len(levels))},
                attributes={"unit": "drive level 0..255", "axes": "slot, v, u", "frame": frame.index},
                half=True,
            )
            written += [dn, mask, code]
    write_json(folder / CHECKSUMS, {path.relative_to(folder).as_posix(): sum_of(path) for path in written})


def read_frames(
    folder: Path, method: str, n_frames: int, ccd: tuple[int, int], code: tuple[int, int, int]
) -> list[CodedFrame]:
    """Read the frames of a method, as the run wrote them.

    Parameters
    ----------
    folder : Path
        Of the run.
    method : str
        Its name.
    n_frames : int
        Frames that there must be, no fewer and no more.
    ccd : tuple of int
        CCD pixels (y, x) of a frame.
    code : tuple of int
        Slots and panel pixels (slot, v, u) of a code.

    Raises
    ------
    StorageError
        For a file that is missing, damaged, of another size or kind, or not what the run wrote.
    """
    paths = sorted((folder / "frames" / method).glob("*.png"))
    if paths != [_places(folder, method, index)[0] for index in range(n_frames)]:
        raise StorageError(
            f"{folder}: got {len(paths)} frames of {method!r}, expected {n_frames}, numbered from 0; "
            "cure: optsim run with --out, which goes on where it stopped"
        )
    sums = read_record(folder / CHECKSUMS) if (folder / CHECKSUMS).is_file() else None
    return [_read(folder, method, index, ccd, code, sums) for index in range(n_frames)]


def _read(
    folder: Path,
    method: str,
    index: int,
    ccd: tuple[int, int],
    code: tuple[int, int, int],
    sums: Mapping[str, object] | None,
) -> CodedFrame:
    places = _places(folder, method, index)
    dn = _picture(places[0], "a 16-bit greyscale", "I;16", ccd)
    mask = _picture(places[1], "an 8-bit greyscale", "L", code[1:])
    levels = _levels(places[2], code)
    # Runs of older versions have none.
    if sums is not None:
        for path in places:
            if sums.get(path.relative_to(folder).as_posix()) != list(sum_of(path)):
                raise StorageError(
                    f"{path}: got other content than the run wrote, by {folder / CHECKSUMS}; {_CURE}; to "
                    "decode images of your own, name them in a TOML file"
                )
    return CodedFrame(index, dn, ExposureCode(levels, mask > 0))


def _picture(path: Path, kind: str, mode: str, shape: tuple[int, ...]) -> NDArray[np.uint16]:
    from PIL import Image

    expected = f"{kind} PNG of {shape[0]} x {shape[1]} pixels"
    with reading(path, expected, _CURE.removeprefix("cure: ")), Image.open(path) as picture:
        # Before any pixel is read: a header may declare more than memory holds.
        if picture.format != "PNG" or picture.mode != mode or picture.size != shape[::-1]:
            got = f"a {picture.format} of mode {picture.mode} and {picture.height} x {picture.width} pixels"
            raise StorageError(f"{path}: got {got}, expected {expected}; {_CURE}")
        return np.asarray(picture).astype(np.uint16)


def _levels(path: Path, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
    channels, _ = read_exr(path)
    names = [f"slot{slot:02d}" for slot in range(shape[0])]
    got = {image.shape for image in channels.values()}
    if set(channels) != set(names) or got != {shape[1:]}:
        sizes = " and ".join(f"{rows} x {cols}" for rows, cols in sorted(got))
        raise StorageError(
            f"{path}: got {len(channels)} channels of {sizes} pixels, expected slot00 to {names[-1]} of "
            f"{shape[1]} x {shape[2]}; {_CURE}"
        )
    levels = np.stack([channels[name] for name in names])
    if not np.isin(levels, np.arange(256)).all():
        raise StorageError(f"{path}: got drive levels that are no whole numbers 0 to 255; {_CURE}")
    return levels.astype(np.uint8)


def _places(folder: Path, method: str, index: int) -> tuple[Path, Path, Path]:
    """Files of a frame: digital numbers, mask, code."""
    stem = f"{index:06d}"
    return (
        folder / "frames" / method / f"{stem}.png",
        folder / "masks" / method / f"{stem}.png",
        folder / "codes" / method / f"{stem}.exr",
    )
