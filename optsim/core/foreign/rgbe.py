"""Radiance's pictures, ``.hdr``: linear light, three mantissas and one exponent a pixel.

No package of ours reads them outside of the renderer. The format is that of G. Ward, "Real Pixels", Graphics
Gems II (1991), and of Radiance's ``color.h``, whose decoding takes the middle of each step:
(mantissa + 1/2) 2^(exponent - 136).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from optsim.core.foreign import check_memory, reading

_WHAT = "a Radiance picture (.hdr)"
# Red, green and blue of sRGB; some writers state rounded or Radiance's own.
_PRIMARIES = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)
_NEAR = 0.02


def rgbe_pixels(path: Path) -> NDArray[np.float32]:
    """Read a picture: linear RGB (y, x, 3), row 0 on top, over the exposure and COLORCORR that it states.

    Raises
    ------
    StorageError
        For a missing, damaged or incomplete file, XYZ, other primaries, a gamma, oblong pixels, another
        orientation, or the run-length encoding of before 1991.
    """
    with reading(path, _WHAT, "write it again, as 32-bit_rle_rgbe with -Y and +X"):
        content = path.read_bytes()
        rows, cols, exposure, at = _head(content)
        # A row needs 4 bytes, and 2 for each 127 equal ones of 4 channels.
        least = rows * min(4 * cols, 4 + 8 * -(-cols // 127))
        if len(content) - at < least:
            raise ValueError(
                f"it declares {rows} x {cols} pixels, but holds {len(content) - at} bytes of them"
            )
        check_memory(path, 20.0 * rows * cols, _WHAT)
        packed = _pixels(content, at, rows, cols)
    mantissas, exponents = packed[..., :3].astype(np.float32), packed[..., 3].astype(np.int32)
    light = np.ldexp(mantissas + np.float32(0.5), (exponents - 136)[..., None])
    light[exponents == 0] = 0.0
    return (light / exposure).astype(np.float32)


def _head(content: bytes) -> tuple[int, int, NDArray[np.float64], int]:
    """Rows, columns, exposure of R, G and B, and where the pixels begin."""
    if not content.startswith((b"#?RADIANCE", b"#?RGBE")):
        raise ValueError("it doesn't begin as one")
    head, found, _ = content.partition(b"\n\n")
    size, ended, _ = content[len(head) + 2 :].partition(b"\n")
    if not (found and ended):
        raise ValueError("its header is incomplete")
    exposure = np.ones(3)
    for line in head.decode("latin-1").splitlines()[1:]:
        key, _, value = line.partition("=")
        # What is indented is of the pictures that this one was made from.
        match key.rstrip():
            case "FORMAT" if value.strip() != "32-bit_rle_rgbe":
                raise ValueError(f"its format is {value.strip()}")
            case "EXPOSURE":
                # Of several the product counts.
                exposure = exposure * float(value)
            case "COLORCORR":
                exposure = exposure * np.array(value.split(), float)
            case "GAMMA" if abs(float(value) - 1) > 1e-3:
                raise ValueError(f"its values have a gamma of {value.strip()}")
            case "PIXASPECT" if abs(float(value) - 1) > 1e-3:
                raise ValueError(f"its pixels are oblong, {value.strip()}")
            case "PRIMARIES" if np.abs(np.array(value.split()[:6], float) - _PRIMARIES).max() > _NEAR:
                raise ValueError(f"its primaries are {value.strip()}")
            case _:
                pass
    up, height, right, width = size.split()
    if (up, right) != (b"-Y", b"+X"):
        raise ValueError(f"its orientation is {size.decode('latin-1')}")
    if not (exposure.min() > 0 and np.isfinite(exposure).all() and min(int(height), int(width)) > 0):
        raise ValueError(f"it declares exposure {exposure.min():g}, size {int(height)} x {int(width)}")
    return int(height), int(width), exposure, len(head) + len(size) + 3


def _pixels(content: bytes, at: int, rows: int, cols: int) -> NDArray[np.uint8]:
    """Mantissas and exponents (y, x, 4)."""
    if len(content) - at == 4 * rows * cols:
        return np.frombuffer(content, np.uint8, 4 * rows * cols, at).reshape(rows, cols, 4)
    packed = np.empty((rows, cols, 4), np.uint8)
    start = bytes([2, 2, cols >> 8, cols & 255]) if 8 <= cols < 1 << 15 else None
    for row in range(rows):
        if content[at : at + 4] != start:
            raise ValueError(f"row {row} is not run-length encoded by channels, or the file is cut")
        at += 4
        for channel in range(4):
            line, at = _run_lengths(content, at, cols)
            packed[row, :, channel] = np.frombuffer(line, np.uint8)
    return packed


def _run_lengths(content: bytes, at: int, count: int) -> tuple[bytearray, int]:
    """One channel of a row, and where the next one begins."""
    line = bytearray()
    while len(line) < count:
        if at >= len(content):
            raise ValueError("the file is cut")
        length = content[at]
        if length > 128:
            line += content[at + 1 : at + 2] * (length - 128)
            at += 2
        else:
            line += content[at + 1 : at + 1 + length]
            at += 1 + length
        if length == 0:
            raise ValueError("a run of no pixels")
    if len(line) != count:
        raise ValueError("a row is longer than the picture, or the file is cut")
    return line, at
