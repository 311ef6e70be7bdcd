"""PNG files chunk by chunk (ISO/IEC 15948): only plain grey or colour of 8 or 16 bits is read."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.foreign import DEFLATE_LIMIT, check_memory, reading
from optsim.core.foreign.h273 import CURVES, PRIMARIES, primaries_at

_WHAT = "PNG"
_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_COLOUR_TYPES = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}
_CHANNELS = {0: 1, 2: 3}


class PngHead(NamedTuple):
    """Properties declared in a file's header."""

    rows: int
    cols: int
    channels: int
    bits: int
    curve: str | None
    primaries: str | None


def png_head(path: Path) -> PngHead:
    """Read the chunks of a file and verify every checksum.

    Raises
    ------
    StorageError
        When the file is missing, damaged, incomplete, or declares more than it can hold.
    ValueCheckError
        For a palette, transparency, an animation, other bits than 8 and 16, a rotation, or oblong pixels.
    """
    with reading(path, _WHAT):
        chunks, n_packed = _chunks(path.read_bytes())
        cols, rows, bits, colour, *_ = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    channels = _CHANNELS.get(colour, 0)
    if not channels or bits not in (8, 16) or b"tRNS" in chunks:
        kind = _COLOUR_TYPES.get(colour, f"colour type {colour}") + ", transparency" * (b"tRNS" in chunks)
        raise ValueCheckError(
            f"{path} is PNG of {bits} bits, {kind}; expected grey or RGB of 8 or 16 bits, without palette "
            "and transparency; cure: write it so, unscaled"
        )
    if b"acTL" in chunks:
        raise ValueCheckError(
            f"{path} is an animated PNG, expected one picture a file; cure: write its frames"
        )
    n_bytes = rows * (1 + cols * channels * bits // 8)
    if n_bytes > DEFLATE_LIMIT * n_packed:
        raise StorageError(
            f"{path} cannot be read as PNG: it declares {rows} x {cols} pixels, but holds {n_packed} bytes "
            "of them; cure: copy it again, whole"
        )
    check_memory(path, n_bytes, _WHAT)
    _check_shape(path, chunks)
    return PngHead(rows, cols, channels, bits, _curve(chunks), _primaries(chunks) if channels > 1 else None)


def png_meaning(path: Path) -> tuple[str | None, str | None]:
    """Curve and primaries as in :class:`PngHead` of a PNG of any kind; errors as of :func:`png_head`."""
    with reading(path, _WHAT):
        chunks, _ = _chunks(path.read_bytes())
        return _curve(chunks), _primaries(chunks)


def png_pixels(path: Path, head: PngHead) -> NDArray[Any]:
    """Read grey or RGB of 8 or 16 bits, array (y, x) or (y, x, 3).

    Raises
    ------
    StorageError
        When the pixels are damaged.
    """
    from PIL.PngImagePlugin import PngImageFile

    # Image.open would refuse a large picture whatever the memory; the size is already checked here.
    with reading(path, _WHAT), path.open("rb") as stream, PngImageFile(stream) as picture:
        if (head.channels, head.bits) == (3, 16):
            return deep_pixels(path, picture)
        return np.asarray(picture).astype(np.uint8 if head.bits == 8 else np.uint16)


def deep_pixels(path: Path, picture: Any) -> NDArray[np.uint16]:
    """Read RGB or RGBA of 16 bits, (y, x, channel), of which Pillow takes the high bytes."""
    from PIL.PngImagePlugin import PngImageFile

    with path.open("rb") as stream, PngImageFile(stream) as low:
        # Called little-endian, big-endian values show their low bytes.
        low.tile = [part._replace(args=str(part.args).replace("16B", "16L")) for part in low.tile]
        return (256 * np.asarray(picture, np.uint16) + np.asarray(low)).astype(np.uint16)


def _chunks(content: bytes) -> tuple[dict[bytes, bytes], int]:
    """Return chunks by name without the pixels, and the bytes of those; every checksum is verified."""
    if content[:8] != _SIGNATURE:
        raise ValueError("it doesn't begin as one")
    found: dict[bytes, bytes] = {}
    view, at, n_packed, name = memoryview(content), 8, 0, b""
    while name != b"IEND":
        if at + 12 > len(content):
            raise ValueError(f"it ends after {len(content)} bytes, before its last chunk")
        length, name = int.from_bytes(view[at : at + 4], "big"), bytes(view[at + 4 : at + 8])
        end = at + 8 + length
        if end + 4 > len(content):
            raise ValueError(f"it ends in the middle of chunk {name.decode('latin-1')}")
        if zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise ValueError(f"chunk {name.decode('latin-1')} has a wrong checksum")
        if name == b"IDAT":
            n_packed += length
        else:
            found.setdefault(name, bytes(view[at + 8 : end]))
        at = end + 4
    if b"IHDR" not in found or not n_packed:
        raise ValueError(f"it holds no {'image data' if b'IHDR' in found else 'header'}")
    return found, n_packed


def _check_shape(path: Path, chunks: Mapping[bytes, bytes]) -> None:
    """Refuse a rotation and pixels that aren't square."""
    if b"pHYs" in chunks:
        with reading(path, _WHAT):
            across, down, _ = struct.unpack(">IIB", chunks[b"pHYs"])
        # 0 means unknown.
        if across and down and across != down:
            raise ValueCheckError(
                f"{path}: chunk pHYs says {across} x {down} pixels a unit, expected square pixels; cure: "
                "scale it to square pixels, or remove the chunk"
            )
    if b"eXIf" in chunks:
        from PIL.Image import Exif

        with reading(path, _WHAT):
            exif = Exif()
            exif.load(chunks[b"eXIf"])
            orientation = exif.get(274, 1)
        if orientation != 1:
            raise ValueCheckError(
                f"{path}: chunk eXIf says orientation {orientation}, expected 1; cure: turn the pixels, or "
                "remove the chunk"
            )


def _curve(chunks: Mapping[bytes, bytes]) -> str | None:
    if b"cICP" in chunks:
        return CURVES.get(chunks[b"cICP"][1])
    if b"sRGB" in chunks or b"srgb" in chunks.get(b"iCCP", b"").partition(b"\0")[0].lower():
        return "srgb"
    if b"gAMA" in chunks and b"iCCP" not in chunks:
        exponent = int.from_bytes(chunks[b"gAMA"], "big") / 1e5
        return "linear" if abs(exponent - 1) < 0.01 else f"gamma {1 / max(exponent, 1e-5):.3g}"
    return None


def _primaries(chunks: Mapping[bytes, bytes]) -> str | None:
    if b"cICP" in chunks:
        return PRIMARIES.get(chunks[b"cICP"][0])
    if b"sRGB" in chunks:
        return "BT.709"
    if len(chunks.get(b"cHRM", b"")) == 32 and b"iCCP" not in chunks:
        # White comes first, all in 1/100000.
        return primaries_at([value / 1e5 for value in struct.unpack(">8I", chunks[b"cHRM"])[2:]])
    return None
