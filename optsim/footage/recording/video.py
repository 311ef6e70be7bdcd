# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false, reportMissingImports=false
"""Readers that need the extra ``video`` (PyAV, with its own FFmpeg): videos."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ConfigError, StorageError, ValueCheckError
from optsim.core.foreign import check_memory, reading
from optsim.core.foreign.h273 import CURVES, PRIMARIES
from optsim.core.quantities import Doubles
from optsim.footage.recording.film import FileStatement, Recording, as_recording

# Luma weights of red and blue by FFmpeg's number of the matrix: BT.709-6, BT.601-7 (5, 6; 2: not stated, for
# which FFmpeg also takes it), BT.2020-2.
_LUMA = {1: (0.2126, 0.0722), 2: (0.299, 0.114), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
_LIMITED_RANGE, _FULL_RANGE = 1, 2
_WHAT = "a video"
_ATTACHED_PICTURE = 1 << 10
# Least frames to determine a rate, and the share of a period by which a step may differ.
_FEW, _UNEVEN = 3, 0.05
# Names of pixel formats whose codes are not integers of light.
_OTHER_FORMATS = re.compile("pal|bayer|xyz|mono|f16|f32")
_DAMAGE = re.compile(r"crc|checksum|mismatch|while decoding|conceal|corrupt|damage|overread", re.IGNORECASE)


def video(path: Path) -> Recording:
    """Open a video, decoded to 16 bits of full range, grey or R'G'B', by what it states, else BT.601."""
    av = _av(path)
    with reading(path, _WHAT), av.open(str(path)) as container:
        stream = _stream(path, container)
        coded = stream.codec_context
        if coded.format is None:
            raise ValueError("its pixel format is unknown")
        bits = max(component.bits for component in coded.format.components)
        check_memory(path, 8.0 * coded.width * coded.height * 3, _WHAT)
        # Frames cut off by an edit list are decoded, but don't count.
        stored = [packet for packet in container.demux(stream) if packet.size]
        packets = [packet for packet in stored if not packet.is_discard]
        period_s = _period_s(path, packets, stream)
        length = int(container.duration / 1e6 / period_s) if container.duration and period_s else 0
        frames_stated = max(stream.frames - len(stored) + len(packets), length)
        declared = FileStatement(
            CURVES.get(int(getattr(coded, "color_trc", 0))),
            PRIMARIES.get(int(getattr(coded, "color_primaries", 0))),
        )
    n_frames = len(packets)
    # A length in time is exact to a frame at most.
    if n_frames < frames_stated - 1:
        raise StorageError(f"{path} ends after {n_frames} of {frames_stated} frames; copy it again, whole")

    def frames(first: int) -> Iterator[NDArray[Any]]:
        with reading(path, _WHAT), av.open(str(path)) as container:
            stream = _stream(path, container)
            # The decoder's log records go to the decoding thread.
            stream.thread_type = "NONE"
            decoded = container.decode(stream)
            for index in count():
                frame = _next(av, decoded)
                if frame is None:
                    return
                if index >= first:
                    yield _turned(frame, _pixels(frame, bits, path), path)

    return as_recording((path,), n_frames, frames, bits, declared)


def _stream(path: Path, container: Any) -> Any:
    """Return the one video stream of a file, of square pixels; cover images don't count."""
    found = [stream for stream in container.streams.video if not stream.disposition.value & _ATTACHED_PICTURE]
    if len(found) != 1:
        raise StorageError(
            f"{path} holds {len(found)} videos, expected one; cure: write it alone into a file"
        )
    aspect = found[0].sample_aspect_ratio
    if aspect and aspect != 1:
        raise ValueCheckError(
            f"{path}: its sample aspect ratio is {aspect}, expected square pixels; cure: scale it to square "
            "pixels, or correct the ratio"
        )
    return found[0]


def _period_s(path: Path, packets: list[Any], stream: Any) -> float:
    """Time between frames, 0 where none is stated; refused if not steady within a tick of the clock."""
    stamps = [packet.pts for packet in packets]
    if None in stamps:
        stamps = [packet.dts for packet in packets]
    if None in stamps or len(stamps) < _FEW:
        return float(1 / stream.average_rate) if stream.average_rate else 0.0
    times = np.sort(np.array(stamps, np.float64))
    steps = np.diff(times)
    period = float(np.median(steps))
    uneven = np.flatnonzero(np.abs(steps - period) > max(1.0, _UNEVEN * period))
    if len(uneven):
        frame = int(uneven[0]) + 1
        raise ValueCheckError(
            f"{path}: frame {frame} comes {steps[frame - 1] / max(period, 1e-9):.2g} periods after frame "
            f"{frame - 1}, expected a steady rate; cure: record at a constant rate, or fill the gaps"
        )
    drift = times - np.linspace(times[0], times[-1], len(times))
    frame = int(np.abs(drift).argmax())
    if abs(drift[frame]) > max(1.0, period / 2):
        raise ValueCheckError(
            f"{path}: frame {frame} is {drift[frame] / max(period, 1e-9):.3g} periods from where a steady "
            "rate would have it; cure: record at a constant rate"
        )
    return float((times[-1] - times[0]) / (len(times) - 1) * stream.time_base)


def _next(av: Any, decoded: Iterator[Any]) -> Any:
    """Return the next frame, None at the end; a decoder that hides damage only logs it."""
    level = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture() as logged:
            frame = next(decoded, None)
    finally:
        av.logging.set_level(level)
    complaint = next((text for _, _, text in logged if _DAMAGE.search(text)), None)
    if complaint is not None or (frame is not None and frame.is_corrupt):
        raise ValueError(f"a frame is damaged: {complaint or 'its decoder says so'}")
    return frame


def _turned(frame: Any, pixels: NDArray[Any], path: Path) -> NDArray[Any]:
    """Rotate a frame by its display matrix (ISO/IEC 14496-12, 8.3.2)."""
    for said in frame.side_data:
        if said.type.name == "DISPLAYMATRIX":
            right, down = np.frombuffer(bytes(said), np.int32).reshape(3, 3)[:2, :2] / 65536
            if not np.array_equal(np.abs([right, down]), np.eye(2)):
                # Stored columns go down, so axes change places.
                if not np.array_equal(np.abs([right, down]), np.eye(2)[::-1]):
                    raise ValueCheckError(
                        f"{path}: its display matrix turns by {-frame.rotation} degrees, expected quarter "
                        "turns; cure: turn it, or remove the matrix"
                    )
                pixels = pixels.swapaxes(0, 1)
            flip_x, flip_y = (right + down) < 0
            pixels = pixels[:: -1 if flip_y else 1, :: -1 if flip_x else 1]
    return np.ascontiguousarray(pixels)


def _pixels(frame: Any, bits: int, path: Path) -> NDArray[np.uint16]:
    if frame.interlaced_frame:
        raise ValueCheckError(
            f"{path}: its frames are interlaced, two instants in one; cure: split it into fields, or "
            "deinterlace it"
        )
    form, parts = frame.format, frame.format.components
    limited = int(frame.color_range) == _LIMITED_RANGE
    if _OTHER_FORMATS.search(form.name) or any(part.bits not in range(8, 17) for part in parts):
        raise ValueCheckError(
            f"{path}: its pixel format is {form.name}, expected grey, R'G'B' or Y'CbCr of 8 to 16 bits; "
            "cure: convert it, to FFV1 of gray16le or gbrp16le for instance"
        )
    if any(part.is_alpha for part in parts):
        if bits > 8 or not form.is_rgb or frame.to_ndarray(format="rgba")[..., 3].min() < 255:
            raise ValueCheckError(
                f"{path}: its pixels are transparent ({form.name}); cure: write it without alpha"
            )
        parts = parts[:3]
    if len(parts) == 1 or (form.is_rgb and form.is_planar):
        codes = np.stack([_plane(frame, part.plane, bits) for part in parts], axis=-1)
        return _full_scale(codes, bits, limited=limited)
    if form.is_rgb:
        # FFmpeg's own conversion from 8 to 16 bits ends at 65283 of 65535.
        codes = frame.to_ndarray(format="rgb24" if bits == 8 else "rgb48le")
        return _full_scale(codes, bits, limited=limited)
    if int(frame.colorspace) not in _LUMA:
        raise StorageError(f"{path}: colour matrix {int(frame.colorspace)} is none of BT.601, 709 and 2020")
    # As with 8 bits; its planes at full resolution are exact.
    codes = frame.to_ndarray(format="yuv444p16le") / 2.0 ** (16 - bits)
    return rgb_of(codes, bits, _LUMA[int(frame.colorspace)], full=int(frame.color_range) == _FULL_RANGE)


def _plane(frame: Any, index: int, bits: int) -> NDArray[Any]:
    """Codes of a plane as stored, array (y, x)."""
    plane = frame.planes[index]
    dtype = np.dtype(np.uint8 if bits == 8 else ">u2" if frame.format.is_big_endian else "<u2")
    rows = np.frombuffer(plane, dtype).reshape(-1, plane.line_size // dtype.itemsize)
    return rows[: plane.height, : plane.width]


def _full_scale(codes: NDArray[Any], bits: int, *, limited: bool) -> NDArray[np.uint16]:
    """Codes of grey or R'G'B' as parts of 65535; the limited range only where the file states it."""
    unit = 2.0 ** (bits - 8)
    black, white = (16 * unit, 235 * unit) if limited else (0.0, 2.0**bits - 1)
    return np.round(65535 * np.clip((codes - black) / (white - black), 0, 1)).astype(np.uint16)


def rgb_of(codes: Doubles, bits: int, luma: tuple[float, float], *, full: bool) -> NDArray[np.uint16]:
    """Turn Y'CbCr codes (y, x, 3) into R'G'B' of 16 bits; ``luma`` weighs red and blue."""
    # ITU-R BT.709-6, items 3.2 to 3.5, with any luma weights.
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


def _av(path: Path) -> Any:
    try:
        import av
    except ImportError:
        raise ConfigError(
            f"source.footage.path: {path.name} is read by PyAV, which is not installed; cure: "
            "pip install 'optsim[video]', or convert the recording to 16-bit TIFF or EXR images"
        ) from None
    return av
