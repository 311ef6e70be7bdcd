# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
"""Guarded, atomic writers of EXR, 16-bit PNG, TIFF and JSON, and their readers. All files go through them.

The OpenEXR binding writes wrong pixels without an error for arrays that are not C-contiguous (openexr#1929).
It also returns short channel groups padded with foreign memory. So every image goes through
:func:`write_exr`, which controls order, dtype and channel count. All writers write to a temporary name in the
same folder and rename: an interrupted run never leaves half a file.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import tempfile
import zlib
from collections.abc import Collection, Generator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.foreign.exr import exr_header, only_part
from optsim.core.foreign.png import png_head, png_pixels
from optsim.core.foreign.tiff import SUFFIXES, grey_pixels

_HALF_MAX = 65504.0
_BLOCK = 1 << 20  # bytes read at a time for a checksum
CLAIM = ".claim"
"""Hidden file of a folder that a process writes into, or has been killed in."""


def writable_folder(place: Path, what: str, cure: str) -> Path:
    """Find the folder in which a path can be made: the path itself, or its nearest existing parent.

    Raises
    ------
    StorageError
        When it is a file or cannot be written to; raised before long work begins.
    """
    above = [place.absolute(), *place.absolute().parents]
    existing = next(each for each in above if each.exists() or each.is_symlink())
    if not existing.is_dir():
        kind = "a file" if existing.is_file() else "a broken link"
        raise StorageError(f"{existing} is {kind}, expected a folder ({what}); {cure}")
    try:
        # Permissions alone prove nothing: root has them even on a read-only disk.
        Path(tempfile.mkdtemp(prefix=".optsim-", dir=existing)).rmdir()
    except OSError as error:
        raise StorageError(
            f"{existing} cannot be written to ({what}): {error.strerror or error}; {cure}"
        ) from None
    return existing


def holds_nothing(folder: Path) -> bool:
    """Whether a folder is empty except for a claim."""
    return all(each.name == CLAIM for each in folder.iterdir())


def check_empty(folder: Path) -> None:
    """Refuse an output folder that is not empty or could not be made.

    Raises
    ------
    StorageError
        With the cure.
    """
    if folder.is_dir() and not holds_nothing(folder):
        raise StorageError(f"--out {folder} is not an empty folder; choose a new one")
    writable_folder(folder, "--out", "choose another one")


@contextlib.contextmanager
def atomic(path: Path) -> Generator[Path, None, None]:
    """Yield a temporary path beside ``path``; rename it into place if the block succeeds."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{path.name}.", suffix=".part" + path.suffix, dir=path.parent
        )
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write text atomically, UTF-8."""
    with atomic(path) as temporary:
        # File names in the text need not be UTF-8.
        temporary.write_bytes(text.encode("utf-8", errors="backslashreplace"))


def write_new_text(path: Path, text: str) -> None:
    """Write text into a file that does not exist yet; a StorageError if it does."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch(exist_ok=False)
    except FileExistsError:
        raise StorageError(
            f"{path} exists already; choose another name with --out, or move it away"
        ) from None
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror or error}") from None
    try:
        write_text(path, text)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def write_json(path: Path, record: object) -> None:
    """Write JSON atomically; NaN and infinity are errors, never output."""
    try:
        text = json.dumps(record, indent=1, allow_nan=False, sort_keys=False)
    except ValueError as error:
        raise ValueCheckError(f"{path.name}: {error}; encode a missing number as null") from None
    write_text(path, text + "\n")


def read_json(path: Path) -> Any:
    """Read JSON, with an error that names the file."""
    try:
        # Some editors put a byte order mark before it.
        return json.loads(path.read_text(encoding="utf-8-sig"))
    except (FileNotFoundError, NotADirectoryError):
        raise StorageError(f"no such file: {path}") from None
    except OSError as error:
        raise StorageError(f"{path} cannot be read: {error.strerror or error}") from None
    except (ValueError, RecursionError) as error:
        raise StorageError(f"{path} is not valid JSON: {error}") from None


def read_record(path: Path) -> dict[str, Any]:
    """Read a JSON object; errors as of :func:`read_json`, and one for any other JSON value."""
    record = read_json(path)
    if not isinstance(record, dict):
        raise StorageError(f"{path}: got {type(record).__name__}, expected a JSON object")
    return cast("dict[str, Any]", record)


def sum_of(path: Path) -> tuple[int, int]:
    """Size and CRC-32 of a file's content, computed once for each state of the file."""
    state = path.stat()
    return state.st_size, _crc_of(path, state.st_ino, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=100_000)
def _crc_of(path: Path, *state: int) -> int:
    found = 0
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            found = zlib.crc32(block, found)
    return found


def content_hash(path: Path) -> str:
    """SHA-256 of a file's content, worked out once for each of its states."""
    state = path.stat()
    return _sha256_of(path, state.st_ino, state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=100_000)
def _sha256_of(path: Path, *state: int) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def write_exr(
    path: Path,
    channels: Mapping[str, NDArray[np.generic]],
    *,
    attributes: Mapping[str, object],
    half: bool | Collection[str] = False,
) -> None:
    """Write single-channel images of one size as an OpenEXR file (ZIP).

    Parameters
    ----------
    path : Path
        File to write.
    channels : Mapping
        Name -> array of shape (y, x), float32 or uint32; any memory order.
    attributes : Mapping
        Meaning of the numbers (unit, axes, ...). Stored as one JSON text, since EXR header numbers lose
        precision.
    half : bool or collection of str
        Store floats as 16 bit, all or these channels only; refused where a value would overflow.

    Raises
    ------
    ValueCheckError
        For a wrong rank, size or dtype, a non-finite value, or a half overflow.
    """
    import OpenEXR

    if not channels:
        raise ValueCheckError(f"{path.name}: no channels to write")
    shape = next(iter(channels.values())).shape
    short = (channels if half else ()) if isinstance(half, bool) else half
    out: dict[str, NDArray[np.generic]] = {}
    for name, image in channels.items():
        if image.ndim != 2 or image.shape != shape or image.size == 0:
            raise ValueCheckError(f"{path.name}: channel {name} has shape {image.shape}, expected {shape}")
        if image.dtype.name not in ("float32", "uint32"):
            raise ValueCheckError(f"{path.name}: channel {name} is {image.dtype}, expected float32 or uint32")
        if image.dtype == np.float32:
            if not np.isfinite(image).all():
                raise ValueCheckError(f"{path.name}: channel {name} holds a value that is not finite")
            if name in short and float(np.abs(image).max()) > _HALF_MAX:
                raise ValueCheckError(f"{path.name}: channel {name} exceeds {_HALF_MAX}; write it as float32")
        out[name] = np.ascontiguousarray(
            image, dtype=np.float16 if name in short and image.dtype.kind == "f" else None
        )
    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "optsim": json.dumps(dict(attributes), allow_nan=False),
    }
    content = io.BytesIO()
    with atomic(path) as temporary, OpenEXR.File(header, cast("Any", out)) as stream:
        # Written to memory first: the binding takes UTF-8 paths only and hides a full disk's error.
        stream.write(cast("Any", content))
        temporary.write_bytes(content.getbuffer())


def read_exr(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """Read what :func:`write_exr` wrote, or any EXR of one part.

    Returns
    -------
    channels : dict
        Name -> array of shape (y, x): uint32 where it is stored so (ids), otherwise float32.
    attributes : dict
        The JSON attributes, empty if the file is not ours.

    Raises
    ------
    StorageError, ValueCheckError
        When the file is missing, unreadable or of several parts; for pixels as of :meth:`ExrPart.pixels`.
    """
    part = only_part(path, "write one part a file")
    return part.pixels(path), _attributes(part.header)


def read_exr_header(path: Path) -> tuple[list[str], dict[str, Any]]:
    """Read the names of the channels and the JSON attributes without any pixel, else as :func:`read_exr`."""
    header = exr_header(path)
    return [channel.name for channel in header["channels"]], _attributes(header)


def _attributes(header: Mapping[str, Any]) -> dict[str, Any]:
    """JSON attributes of a header, empty if the file is not ours."""
    try:
        attributes = json.loads(header.get("optsim", "{}"))
    except (ValueError, TypeError, RecursionError):
        # Another program's attribute of the same name.
        attributes = {}
    return cast("dict[str, Any]", attributes) if isinstance(attributes, dict) else {}


def write_png16(path: Path, image: NDArray[np.uint16]) -> None:
    """Write a (y, x) uint16 image losslessly as 16-bit greyscale PNG."""
    from PIL import Image

    if image.ndim != 2 or image.dtype != np.uint16:
        raise ValueCheckError(
            f"{path.name}: got {image.dtype} of shape {image.shape}, expected (y, x) uint16"
        )
    with atomic(path) as temporary:
        Image.fromarray(np.ascontiguousarray(image)).save(temporary, format="PNG", compress_level=1)


def write_png8(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an 8-bit picture for viewing: (y, x) grey or (y, x, 3) sRGB."""
    from PIL import Image

    with atomic(path) as temporary:
        Image.fromarray(np.ascontiguousarray(image)).save(temporary, format="PNG")


def read_png16(path: Path) -> NDArray[np.uint16]:
    """Read a 16-bit greyscale PNG as (y, x) uint16."""
    head = png_head(path)
    if (head.channels, head.bits) != (1, 16):
        colour = "grey" if head.channels == 1 else "RGB"
        raise ValueCheckError(f"{path}: got {colour} of {head.bits} bits, expected 16-bit greyscale")
    return png_pixels(path, head)


def write_tiff16(path: Path, image: NDArray[np.uint16]) -> None:
    """Write a (y, x) uint16 image losslessly as uncompressed 16-bit greyscale TIFF."""
    import tifffile

    if image.ndim != 2 or image.dtype != np.uint16:
        raise ValueCheckError(
            f"{path.name}: got {image.dtype} of shape {image.shape}, expected (y, x) uint16"
        )
    with atomic(path) as temporary:
        tifffile.imwrite(temporary, np.ascontiguousarray(image), photometric="minisblack", metadata=None)


def read_tiff16(path: Path) -> NDArray[np.uint16]:
    """Read a greyscale TIFF of one page, or a DNG, of 9 to 16 bits as (y, x) uint16."""
    pixels = grey_pixels(path)
    if pixels.dtype != np.uint16:
        raise ValueCheckError(f"{path}: got pixels of {pixels.dtype}, expected 16-bit greyscale (uint16)")
    return pixels.astype(np.uint16, copy=False)


def read_words(path: Path) -> NDArray[np.uint16]:
    """Read a 16-bit greyscale PNG, or TIFF or DNG by its suffix: errors of :func:`read_png16`."""
    return read_tiff16(path) if path.suffix.lower() in SUFFIXES else read_png16(path)
