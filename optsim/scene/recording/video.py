# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false, reportMissingImports=false
"""What only the extra ``video`` (PyAV, with its own FFmpeg) can read: videos, and 16-bit colour PNG."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.errors import ConfigError, StorageError
from optsim.quantities import Doubles
from optsim.scene.recording.film import Recording, as_recording

# Luma weights of red and blue by FFmpeg's number of the matrix: BT.709-6, BT.601-7 (5, 6; 2: not stated, for
# which FFmpeg also takes it), BT.2020-2.
_LUMA = {1: (0.2126, 0.0722), 2: (0.299, 0.114), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
_FULL_RANGE = 2


def video(path: Path) -> Recording:
    """Open a video; its frames are decoded to 16 bits over the full range, grey or R'G'B'.

    The file's own colour matrix and range hold; BT.601 and the limited range where it states none.

    Raises
    ------
    ConfigError
        When PyAV is missing.
    StorageError
        When the file cannot be read, or holds fewer frames than it declares.
    """
    av = _av(path)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise StorageError(f"{path} holds no video")
            stream = container.streams.video[0]
            form = stream.codec_context.format
            if form is None:
                raise StorageError(f"{path} cannot be read as a video: its pixel format is unknown")
            bits = max(component.bits for component in form.components)
            declared = max(stream.frames, _length(container, stream))
            n_frames = sum(1 for packet in container.demux(stream) if packet.size)
    except av.FFmpegError as error:
        raise StorageError(f"{path} cannot be read as a video: {error}") from None
    # A length in time is exact to a frame at most.
    if n_frames < declared - 1:
        raise StorageError(f"{path} ends after {n_frames} of {declared} frames; copy it again, whole")

    def frames(first: int) -> Iterator[NDArray[Any]]:
        try:
            with av.open(str(path)) as container:
                container.streams.video[0].thread_type = "AUTO"
                for frame in islice(container.decode(video=0), first, None):
                    yield _pixels(frame, bits, path)
        except av.FFmpegError as error:
            raise StorageError(f"{path} cannot be decoded: {error}; copy it again, whole") from None

    return as_recording((path,), n_frames, frames, bits)


def _pixels(frame: Any, bits: int, path: Path) -> NDArray[np.uint16]:
    if len(frame.format.components) == 1:
        return frame.to_ndarray(format="gray16le")[..., None]
    if frame.format.is_rgb:
        return frame.to_ndarray(format="rgb48le")
    if int(frame.colorspace) not in _LUMA:
        raise StorageError(f"{path}: colour matrix {int(frame.colorspace)} is none of BT.601, 709 and 2020")
    # FFmpeg's own way to 16-bit R'G'B' ends at 65283 of 65535; its planes at full resolution are exact.
    codes = frame.to_ndarray(format="yuv444p16le") / 2.0 ** (16 - bits)
    return rgb_of(codes, bits, _LUMA[int(frame.colorspace)], full=int(frame.color_range) == _FULL_RANGE)


def rgb_of(codes: Doubles, bits: int, luma: tuple[float, float], *, full: bool) -> NDArray[np.uint16]:
    """Turn Y'CbCr codes into R'G'B' (ITU-R BT.709-6, items 3.2 to 3.5, with any luma weights).

    Parameters
    ----------
    codes : ndarray of shape (y, x, 3), float64
        Y', Cb and Cr.
    bits : int
        Of the codes.
    luma : tuple of float
        Weights of red and blue in Y'.
    full : bool
        Codes fill 0 .. 2**bits - 1, rather than 16 .. 235 and 240 of 255.

    Returns
    -------
    ndarray of shape (y, x, 3), uint16
        Of 65535; what lies outside the cube is clipped.
    """
    unit = 2.0 ** (bits - 8)
    black, white, chroma = (
        (0.0, 2.0**bits - 1, 2.0**bits - 1) if full else (16 * unit, 235 * unit, 224 * unit)
    )
    light = (codes[..., 0] - black) / (white - black)
    from_blue, from_red = ((codes[..., k] - 128 * unit) / chroma for k in (1, 2))
    red_weight, blue_weight = luma
    red = light + 2 * (1 - red_weight) * from_red
    blue = light + 2 * (1 - blue_weight) * from_blue
    green = (light - red_weight * red - blue_weight * blue) / (1 - red_weight - blue_weight)
    return np.round(65535 * np.clip(np.stack([red, green, blue], axis=-1), 0, 1)).astype(np.uint16)


def colour_picture(path: Path) -> NDArray[np.uint16]:
    """Read a 16-bit colour PNG, array (y, x, 3), which Pillow would cut to 8 bits."""
    av = _av(path)
    try:
        with av.open(str(path)) as container:
            return next(container.decode(video=0)).to_ndarray(format="rgb48le")
    except (av.FFmpegError, StopIteration) as error:
        raise StorageError(f"{path} cannot be read as 16-bit colour PNG: {error}") from None


def _length(container: Any, stream: Any) -> int:
    """Frames that the container's duration declares, 0 where it declares none."""
    if container.duration is None or not stream.average_rate:
        return 0
    return int(container.duration / 1e6 * float(stream.average_rate))


def _av(path: Path) -> Any:
    try:
        import av
    except ImportError:
        raise ConfigError(
            f"source.footage.path: {path.name} is read by PyAV, which is not installed; cure: "
            "pip install 'optsim[video]', or convert the recording to 16-bit TIFF or EXR images"
        ) from None
    return av
