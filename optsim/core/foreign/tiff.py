# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Pages of TIFF files (TIFF 6.0, DNG 1.7): a tag on the stored numbers is honoured or refused."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.foreign import DEFLATE_LIMIT, check_memory, reading

_WHAT = "TIFF"
_CURE = "copy it again, whole, or write it uncompressed, one page a frame"
_MIN_IS_WHITE, _MIN_IS_BLACK, _RGB = 0, 1, 2
_FORMATS = (1, 2, 3)  # SampleFormat: whole numbers without and with a sign, floats
_ALPHA = (1, 2)
# Tag Orientation: transformation of stored rows and columns to the upright image.
_TURNS: dict[int, Callable[[NDArray[Any]], NDArray[Any]]] = {
    1: lambda stored: stored,
    2: lambda stored: stored[:, ::-1],
    3: lambda stored: stored[::-1, ::-1],
    4: lambda stored: stored[::-1],
    5: lambda stored: stored.swapaxes(0, 1),
    6: lambda stored: np.rot90(stored, -1),
    7: lambda stored: stored[::-1, ::-1].swapaxes(0, 1),
    8: lambda stored: np.rot90(stored),
}
_NOT_A_FRAME = 0b101  # NewSubfileType: a smaller version of another page, or its mask
_LINEAR_RAW, _DNG_VERSION = 34892, 50706
# Tags of DNG that make its stored numbers others than the sensor's counts.
_NOT_COUNTS = {50712: "LinearizationTable", 50829: "ActiveArea", 51008: "OpcodeList1"}
SUFFIXES = (".tif", ".tiff", ".dng")


class _Refusal(logging.Handler):
    """Raise errors that the library only logs: pages that it leaves out, strips that it cuts."""

    def __init__(self) -> None:
        logging.Handler.__init__(self, logging.WARNING)
        self._thread = threading.get_ident()

    def emit(self, record: logging.LogRecord) -> None:
        """Raise an error of the reading thread; ignore other records."""
        if record.levelno >= logging.ERROR and record.thread == self._thread:
            raise ValueError(record.getMessage())


@contextmanager
def opened(path: Path) -> Generator[Any, None, None]:
    """Open a TIFF file; errors that the library only logs are raised."""
    import tifffile

    handler, logger = _Refusal(), logging.getLogger("tifffile")
    logger.addHandler(handler)
    try:
        with reading(path, _WHAT, _CURE), tifffile.TiffFile(path) as tiff:
            yield tiff
    finally:
        logger.removeHandler(handler)


def frame_pages(where: str, tiff: Any) -> list[Any]:
    """Return the pages that hold frames: all of a TIFF, the one of raw counts of a DNG."""
    first = tiff.pages[0].aspage() if len(tiff.pages) else None
    if first is None or _DNG_VERSION not in first.tags:
        return list(tiff.pages)
    if first.tags.valueof(274, 1) != 1:
        raise _unlike(where, "Orientation", first.tags.valueof(274), "1: the sensor's own rows and columns")
    raw = [page.aspage() for page in (first, *(first.pages or ()))]
    raw = [page for page in raw if not page.subfiletype & _NOT_A_FRAME]
    if len(raw) != 1:
        raise ValueCheckError(f"{where}: got {len(raw)} pictures of full size, expected one of raw counts")
    whole = [0, 0, *raw[0].shape[:2]]
    for code, name in _NOT_COUNTS.items():
        if code in raw[0].tags and (code != 50829 or [*raw[0].tags.valueof(code)] != whole):
            raise _unlike(where, name, "that stored numbers differ from counts", "counts of all pixels")
    return raw


def page_pixels(where: str, page: Any, file_bytes: int) -> NDArray[Any]:
    """NDArray[Any] of a page in upright orientation, array (y, x, channel)."""
    tags, shape = page.tags, page.shape
    if page.subfiletype & _NOT_A_FRAME:
        raise _unlike(where, "NewSubfileType", page.subfiletype, "a frame, no smaller version or mask")
    photometric = int(tags.valueof(262, _MIN_IS_BLACK))
    if photometric not in (_MIN_IS_WHITE, _MIN_IS_BLACK, _RGB, _LINEAR_RAW):
        raise _unlike(where, "PhotometricInterpretation", page.photometric, "grey or RGB")
    formats = set(np.atleast_1d(tags.valueof(339, 1)).tolist())
    if len(formats) != 1 or not formats <= set(_FORMATS):
        raise _unlike(where, "SampleFormat", sorted(formats), "whole numbers or floats, all of one kind")
    bits = page.bitspersample
    if not isinstance(bits, int):
        raise _unlike(where, "BitsPerSample", bits, "as many for each sample")
    if set(page.extrasamples) & set(_ALPHA):
        raise _unlike(where, "ExtraSamples", "alpha", "none; transparency is no light")
    across, down = (_ratio(tags.valueof(code)) for code in (282, 283))
    if across and down and abs(across / down - 1) > 1e-3:
        raise _unlike(where, "XResolution and YResolution", f"{across:g} and {down:g}", "square pixels")
    orientation = tags.valueof(274, 1)
    if orientation not in _TURNS:
        raise _unlike(where, "Orientation", orientation, "1 to 8")
    if page.axes not in ("YX", "YXS", "SYX"):
        raise ValueCheckError(f"{where}: a page has axes {page.axes}, expected YX, YXS or SYX")
    _check_segments(where, page, bits, file_bytes)
    # In one thread: log records of other threads could not be told apart.
    try:
        pixels = page.asarray(maxworkers=1)
    except (NotImplementedError, ValueError) as error:
        if "imagecodecs" not in str(error):
            raise
        raise StorageError(
            f"{where}: {bits} bits a sample, compression {page.compression.name}, need a package that is not "
            "installed; fix: pip install 'optsim[raw]', or write it uncompressed in 16 bits"
        ) from None
    pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if page.axes == "SYX":
        pixels = np.moveaxis(pixels.reshape(shape), 0, -1)
    if photometric == _MIN_IS_WHITE:
        if pixels.dtype.kind != "u":
            raise _unlike(
                where, "PhotometricInterpretation", f"min-is-white of {pixels.dtype}", "min-is-black"
            )
        pixels = pixels.dtype.type(2**bits - 1) - pixels
    return np.ascontiguousarray(_TURNS[orientation](pixels))


def _check_segments(where: str, page: Any, bits: int, file_bytes: int) -> None:
    """Refuse strips or tiles that were never written, and sizes that the file can't hold."""
    sizes, offsets = page.databytecounts, page.dataoffsets
    expected = int(np.prod(page.chunked))
    held = [at > 0 and size > 0 and at + size <= file_bytes for at, size in zip(offsets, sizes, strict=False)]
    if len(offsets) != len(sizes) or sum(held) < expected:
        raise StorageError(
            f"{where}: {sum(held)} of {expected} strips or tiles are in the file, expected all; cure: copy "
            "it again, whole"
        )
    declared, packed = page.size * bits / 8, sum(sizes)
    most = {1: 1, 8: DEFLATE_LIMIT, 32946: DEFLATE_LIMIT}.get(int(page.compression), np.inf)
    if declared > most * packed:
        said = " x ".join(map(str, page.shape))
        raise StorageError(
            f"{where}: declares {said} samples of {bits} bits, but holds {packed} bytes of them; cure: "
            "copy it again, whole"
        )
    check_memory(Path(where), page.nbytes, _WHAT)


def _ratio(value: tuple[int, int] | None) -> float:
    """Rational number of a tag; 0 where there is none."""
    return value[0] / value[1] if value and value[1] else 0.0


def _unlike(where: str, tag: str, got: object, expected: str) -> ValueCheckError:
    said = getattr(got, "name", got)
    return ValueCheckError(f"{where}: tag {tag} says {said}, expected {expected}; cure: convert the file")


def grey_pixels(path: Path) -> NDArray[Any]:
    """Read a file of one grey page: array (y, x) of the numbers as they are stored."""
    with opened(path) as tiff:
        pages = frame_pages(str(path), tiff)
        if len(pages) != 1:
            raise ValueCheckError(f"{path}: got {len(pages)} pages, expected one")
        pixels = page_pixels(str(path), pages[0].aspage(), path.stat().st_size)
    if pixels.shape[2] != 1:
        raise ValueCheckError(f"{path}: got {pixels.shape[2]} channels, expected one: greyscale")
    return pixels[..., 0]
