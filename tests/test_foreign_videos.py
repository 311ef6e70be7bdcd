"""Videos that others wrote: time stamps, turns, pixel shapes, ranges and damage are honoured or refused."""

import struct
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from recorded import truth

from optsim.core.errors import ConfigError, OptsimError, StorageError, ValueCheckError
from optsim.footage.clips import open_clips
from optsim.footage.recording import open_recording

av = pytest.importorskip("av")

ROWS, COLS, N = 32, 48, 12
# Blocks of 8 of 10 bits: no frame is like another, or like itself turned.
BLOCKS = np.kron(
    np.random.default_rng(4).integers(64, 941, (N, ROWS // 8, COLS // 8)), np.ones((8, 8), np.int64)
).astype(np.uint16)


def film(
    path: Path,
    frames: np.ndarray = BLOCKS,
    *,
    codec: str = "libx264",
    pixels: str = "gray10le",
    given_as: str = "gray10le",
    stamps: Sequence[int] | None = None,
    tick: Fraction = Fraction(1, 30),
    rate: int = 30,
    options: dict[str, str] | None = None,
    **context: object,
) -> Path:
    if codec == "libx264":
        options = {"qp": "0", "x264-params": "log-level=none", **(options or {})}
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options or {})
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
        if stamps is not None:
            stream.codec_context.time_base = tick
        for key, value in context.items():
            setattr(stream.codec_context, key, value)
        for k, values in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(values, format=given_as)
            if stamps is not None:
                frame.pts, frame.time_base = stamps[k], tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def seen(path: Path) -> np.ndarray:
    """All frames, (t, y, x), or (t, y, x, 3) of colours."""
    frames = np.stack(list(open_recording(path).read(0)))
    return frames[..., 0] if (frames == frames[..., :1]).all() else frames


def light(codes: np.ndarray) -> np.ndarray:
    """Y' of 10 bits in the limited range, which H.264 takes grey for, as parts of 65535 (BT.709-6, 3.5)."""
    return np.round((codes.astype(float) - 64) * (65535 / 876)).astype(np.uint16)


# --- time ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize(
    ("stamps", "text"),
    [
        ([0, 1, 2, 3, 4, 5, 26, 27, 28, 29, 30, 31], "frame 6 comes 21 periods after frame 5"),
        ([0, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12], "frame 1 comes 2 periods after frame 0"),
        ([0, 10, 20, 30, 40, 50, 62, 74, 86, 98, 110, 122], r"frame \d+ comes (1.2|0.8.) periods"),
    ],
)
def test_frames_that_come_unevenly_are_refused(
    suffix: str, stamps: list[int], text: str, tmp_path: Path
) -> None:
    tick = Fraction(1, 300 if stamps[-1] > 100 else 30)
    path = film(tmp_path / f"a{suffix}", stamps=stamps, tick=tick)
    with pytest.raises(ValueCheckError, match=text):
        open_recording(path)


@pytest.mark.parametrize("rate", [24, 30, 60, 240, 700])
def test_a_clock_of_milliseconds_is_no_uneven_rate(rate: int, tmp_path: Path) -> None:
    """Matroska rounds time stamps to 1 ms."""
    path = film(tmp_path / "a.mkv", stamps=range(N), tick=Fraction(1, rate), rate=rate)
    assert open_recording(path).n_frames == N


def test_a_rate_that_drifts_is_refused(tmp_path: Path) -> None:
    """Each step is within 5 % of the usual one, but half-way time is off by more than half a period."""
    steps = np.repeat([1000, 960], 40)
    frames = np.repeat(BLOCKS[:1], 81, axis=0)
    path = film(tmp_path / "a.mp4", frames, stamps=[0, *np.cumsum(steps).tolist()], tick=Fraction(1, 30000))
    with pytest.raises(ValueCheckError, match="periods from where a steady rate"):
        open_recording(path)


def test_an_edit_list_is_honoured(tmp_path: Path) -> None:
    """What it cuts off at the beginning is no frame."""
    path = film(tmp_path / "a.mp4", options={"bf": "0", "x264-params": "bframes=0:log-level=none"})
    content = bytearray(path.read_bytes())
    period = 512  # of the track's clock, as FFmpeg chooses it for 30 frames a second
    at = content.index(b"elst") + 12
    assert struct.unpack(">ii", content[at : at + 8]) == (400, 0)
    content[at : at + 8] = struct.pack(">ii", 300, 3 * period)
    path.write_bytes(content)
    assert np.array_equal(seen(path), light(BLOCKS[3:]))


# --- geometry -----------------------------------------------------------------------------------------------

# The matrix (a, b, c, d) moves what is stored at (x, y) to (a x + c y, b x + d y), y down.
MATRICES = {
    (1, 0, 0, 1): BLOCKS,
    (0, 1, -1, 0): np.rot90(BLOCKS, -1, (1, 2)),
    (-1, 0, 0, -1): np.rot90(BLOCKS, 2, (1, 2)),
    (0, -1, 1, 0): np.rot90(BLOCKS, 1, (1, 2)),
    (-1, 0, 0, 1): BLOCKS[:, :, ::-1],
    (1, 0, 0, -1): BLOCKS[:, ::-1],
    (0, 1, 1, 0): BLOCKS.swapaxes(1, 2),
}


def turned(path: Path, matrix: Sequence[float]) -> Path:
    """Write another matrix into the track's header."""
    content = bytearray(path.read_bytes())
    at = content.index(b"tkhd") + 4
    at += (24 if content[at] == 0 else 36) + 16
    a, b, c, d = (round(65536 * value) for value in matrix)
    content[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("matrix", MATRICES)
def test_a_turned_film_stands_upright(matrix: tuple[int, ...], tmp_path: Path) -> None:
    path = turned(film(tmp_path / "a.mp4"), matrix)
    assert np.array_equal(seen(path), light(MATRICES[matrix]))


@pytest.mark.parametrize("how", ["slanted", "oblong", "interlaced", "two films", "transparent"])
def test_other_geometry_is_refused(how: str, tmp_path: Path) -> None:
    if how == "slanted":
        path = turned(film(tmp_path / "a.mp4"), (0.8, 0.6, -0.6, 0.8))
    elif how == "oblong":
        path = film(tmp_path / "a.mp4", sample_aspect_ratio=Fraction(4, 3))
    elif how == "interlaced":
        interlaced = {"x264-params": "interlaced=1:log-level=none"}
        path = film(tmp_path / "a.mp4", pixels="yuv420p10le", options=interlaced)
    elif how == "transparent":
        values = (np.dstack([BLOCKS[0]] * 3 + [BLOCKS[1]])[None] // 4).astype(np.uint8)
        path = film(tmp_path / "a.mkv", values, codec="ffv1", pixels="bgra", given_as="rgba")
    else:
        path = tmp_path / "a.mkv"
        with av.open(str(path), "w") as container:
            streams = [container.add_stream("ffv1", rate=30) for _ in range(2)]
            for stream in streams:
                stream.height, stream.width, stream.pix_fmt = ROWS, COLS, "gray10le"
            for stream in streams:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(BLOCKS[0], format="gray10le")))
                container.mux(stream.encode())
    with pytest.raises(
        OptsimError, match=r"matrix turns|aspect ratio is 4/3|interlaced|2 videos|transparent"
    ):
        open_recording(path)


# --- values -------------------------------------------------------------------------------------------------

CODES = [
    ("bgr0", "rgb24", 8),
    ("bgra", "rgba", 8),
    ("gray", "gray", 8),
    ("gray10le", "gray10le", 10),
    ("gray12le", "gray12le", 12),
    ("gray16le", "gray16le", 16),
    ("gbrp10le", "gbrp10le", 10),
    ("gbrp12le", "gbrp12le", 12),
    ("gbrp16le", "gbrp16le", 16),
]


@pytest.mark.parametrize(("pixels", "given_as", "bits"), CODES)
def test_codes_become_parts_of_full_scale(pixels: str, given_as: str, bits: int, tmp_path: Path) -> None:
    """From 0, to 65535 exactly, and each code in between to the nearest number; the planes in their order."""
    most = 2**bits - 1
    codes = np.random.default_rng(1).integers(0, most + 1, (2, ROWS, COLS, 4))
    codes[:, :8], codes[:, 8:16], codes[..., 3] = 0, most, most
    codes = codes.astype(np.uint8 if bits == 8 else np.uint16)
    codes = codes[..., 0] if "gray" in given_as else codes if given_as == "rgba" else codes[..., :3]
    path = film(tmp_path / "a.mkv", codes, codec="ffv1", pixels=pixels, given_as=given_as)
    light = codes[..., :3] if codes.ndim == 4 else codes
    assert np.array_equal(seen(path), np.round(light * (65535 / most)).astype(np.uint16))
    assert open_recording(path).bits == bits


@pytest.mark.parametrize("stated", [0, 1, 2])
def test_grey_is_limited_only_where_its_file_says_so(stated: int, tmp_path: Path) -> None:
    codes = np.full((2, ROWS, COLS), 16, np.uint8)
    codes[:, 8:16], codes[:, 16:] = 235, 126
    path = film(tmp_path / "a.mkv", codes, codec="ffv1", pixels="gray", given_as="gray", color_range=stated)
    expected = [0, 65535, 32917] if stated == 1 else [16 * 257, 235 * 257, 126 * 257]
    assert seen(path)[0, [0, 8, 16], 0].tolist() == pytest.approx(expected, abs=1)


def test_a_film_says_its_curve_and_primaries(tmp_path: Path) -> None:
    """The curve decides how clips are read, and contradicts another statement; primaries their luminance."""
    colours = np.stack([BLOCKS // 4] * 3, axis=-1).astype(np.uint8)
    wide = {"color_trc": 16, "color_primaries": 9, "colorspace": 9}
    path = film(tmp_path / "pq.mkv", colours, codec="ffv1", pixels="yuv444p10le", given_as="rgb24", **wide)
    assert open_recording(path).declared == ("PQ", "BT.2020")
    with pytest.raises(ConfigError, match=r"--linearisation: got 'srgb', but pq.mkv .* curve PQ"):
        open_clips([path], slots=8)
    wide["color_trc"] = 8
    path = film(tmp_path / "a.mkv", colours, codec="ffv1", pixels="yuv444p10le", given_as="rgb24", **wide)
    assert open_clips([path], slots=8)[0].source.linearisation == "linear"
    with pytest.raises(ConfigError, match=r"colours are BT\.2020"):
        truth(path, full_scale=65535, channel_weights="rec709").check()
    with pytest.raises(ConfigError, match=r"linearisation: got 'srgb', but a.mkv .* curve linear"):
        truth(path, full_scale=65535, linearisation="srgb").check()


# --- damage -------------------------------------------------------------------------------------------------


def test_a_damaged_frame_that_its_decoder_would_hide_is_an_error(tmp_path: Path) -> None:
    noise = np.random.default_rng(2).integers(0, 65535, (N, ROWS, COLS)).astype(np.uint16)
    path = film(tmp_path / "a.mkv", noise, codec="ffv1", pixels="gray16le", given_as="gray16le")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 255
    path.write_bytes(content)
    with pytest.raises(StorageError, match="a frame is damaged: slice CRC mismatch"):
        seen(path)


def test_what_is_no_video_is_an_error(tmp_path: Path) -> None:
    for suffix in (".mp4", ".mkv", ".avi", ".mov", ".webm"):
        for content in (b"", b"nothing of the kind" * 50):
            path = tmp_path / f"a{suffix}"
            path.write_bytes(content)
            with pytest.raises(StorageError, match="cannot be read as a video"):
                open_recording(path)
