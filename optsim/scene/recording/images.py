# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false
"""One image a frame, or a stack of them: EXR, PNG and TIFF, with their own libraries and no rescaling."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from optsim.errors import ConfigError, StorageError, ValueCheckError, unknown_name
from optsim.files import read_exr
from optsim.scene.recording.film import Pixels, Recording, as_recording, with_channels

_PNG_DTYPES = {"L": np.uint8, "RGB": np.uint8, "I;16": np.uint16}


def exr(path: Path, key: str | None) -> Pixels:
    """Read the channel ``key``, else R, G and B, else Y or the only one, array (y, x, channel)."""
    channels, _ = read_exr(path)
    if key is not None:
        if key not in channels:
            raise unknown_name(f"source.footage.key of {path.name}", key, channels)
        names = [key]
    elif {"R", "G", "B"} <= set(channels):
        names = ["R", "G", "B"]
    elif len(channels) == 1 or "Y" in channels:
        names = ["Y"] if "Y" in channels else list(channels)
    else:
        raise ConfigError(
            f"source.footage.key: missing; {path.name} holds the channels {', '.join(sorted(channels))}"
        )
    return np.stack([channels[name] for name in names], axis=-1)


def png(path: Path) -> Pixels:
    """Read grey or colour of 8 or 16 bits, array (y, x, channel)."""
    from PIL import Image

    try:
        with Image.open(path) as picture:
            raw = str(picture.tile[0].args)
            # Pillow reads 16-bit colour as 8-bit without a word; only the raw mode of the tile says so.
            deep_colour = raw == "RGB;16B"
            if picture.mode in _PNG_DTYPES and not deep_colour:
                return with_channels(np.asarray(picture).astype(_PNG_DTYPES[picture.mode]))
    except (OSError, SyntaxError, ValueError) as error:
        raise StorageError(f"{path} cannot be read as PNG: {error}") from None
    if deep_colour:
        from optsim.scene.recording.video import colour_picture

        return colour_picture(path)
    raise ValueCheckError(
        f"{path} is PNG of mode {raw}; expected grey or RGB of 8 or 16 bits, without palette and transparency"
    )


def tiff(path: Path) -> Pixels:
    """Read a TIFF file of one frame, array (y, x, channel)."""
    stack = tiff_stack(path)
    if stack.n_frames > 1:
        raise StorageError(f"{path} holds {stack.n_frames} frames; in a folder of images each file holds one")
    return next(stack.frames(0))


def tiff_stack(path: Path) -> Recording:
    """Open a TIFF file of one page a frame."""
    import tifffile

    def pages(first: int) -> Iterator[Pixels]:
        try:
            with tifffile.TiffFile(path) as tiff:
                for page in islice(tiff.pages, first, None):
                    if page.axes not in ("YX", "YXS"):
                        raise ValueCheckError(f"{path}: a page has axes {page.axes}, expected YX or YXS")
                    yield with_channels(page.asarray())
        except (tifffile.TiffFileError, OSError, ValueError, IndexError) as error:
            if isinstance(error, ValueCheckError):
                raise
            raise StorageError(
                f"{path} cannot be read as TIFF: {error}; cure: write it uncompressed, one page a frame"
            ) from None

    try:
        with tifffile.TiffFile(path) as tiff:
            n_frames = len(tiff.pages)
            n_planes = sum(
                int(np.prod([s.shape[i] for i, a in enumerate(s.axes) if a not in "YXS"]))
                for s in tiff.series
            )
    except (tifffile.TiffFileError, OSError, ValueError) as error:
        raise StorageError(f"{path} cannot be read as TIFF: {error}") from None
    if n_planes != n_frames:
        raise StorageError(f"{path}: {n_planes} frames in {n_frames} pages; cure: write one page a frame")
    return as_recording((path,), n_frames, pages)
