"""Footage as truth: every format means the same radiance, averages are exact, and what is wrong is said."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from recorded import (
    COLS,
    ROWS,
    SCALE,
    WHITE,
    N,
    codes16,
    colours,
    signal,
    slots,
    truth,
    write_video,
)
from scipy.io import savemat

from optsim.core.cache import Cache
from optsim.core.errors import ConfigError
from optsim.core.files import write_exr, write_png16
from optsim.footage.recording import open_recording
from optsim.footage.truth import CODE, cell_shares, overlap

REC709 = np.array([0.2126, 0.7152, 0.0722])


def write_colour_png(path: Path, frame: np.ndarray) -> None:
    av = pytest.importorskip("av")
    coder = av.CodecContext.create("png", "w")
    coder.height, coder.width, coder.pix_fmt = *frame.shape[:2], "rgb48be"
    coder.time_base = Fraction(1, 25)
    picture = av.VideoFrame.from_ndarray(frame, format="rgb48le").reformat(format="rgb48be")
    path.write_bytes(b"".join(bytes(p) for p in [*coder.encode(picture), *coder.encode(None)]))


def test_code_that_reads_footage_decides_where_it_is_cached() -> None:
    root = Path(__file__).parents[1]
    found = {path.relative_to(root).as_posix() for glob in CODE for path in root.glob(glob)}
    assert {"optsim/footage/source.py", "optsim/footage/recording/tiff.py"} <= found
    assert "optsim/core/foreign/png.py" in found


# --- every format ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["png", "exr", "tiff", "tiff stack", "npz", "npy", "mat", "npz yxt", "ffv1"])
def test_every_format_means_the_same_radiance(kind: str, tmp_path: Path) -> None:
    """Within half a step of 16 bits, or to float32, whatever the container."""
    values, codes, folder = signal(), codes16(signal()), tmp_path / "shots"
    folder.mkdir()
    keys: dict[str, object] = {"full_scale": 65535}
    path, error = folder, 0.5 / 65535
    if kind == "png":
        for k, frame in enumerate(codes):
            write_png16(folder / f"shot{k}.png", frame)
    elif kind == "exr":
        for k, frame in enumerate(values):
            write_exr(folder / f"shot{k}.exr", {"Y": frame.astype(np.float32)}, attributes={})
        keys, error = {}, 1e-7
    elif kind == "tiff":
        for k, frame in enumerate(codes):
            tifffile.imwrite(folder / f"shot{k}.tif", frame)
    elif kind == "tiff stack":
        path = folder / "stack.tif"
        tifffile.imwrite(path, codes)
    elif kind == "npz":
        path = folder / "film.npz"
        np.savez(path, film=codes, other=np.zeros(3))
        keys |= {"key": "film", "axes": "tyx"}
    elif kind == "npz yxt":
        path = folder / "film.npz"
        np.savez_compressed(path, only=codes.transpose(1, 2, 0))
        keys |= {"axes": "yxt"}
    elif kind == "npy":
        path = folder / "film.npy"
        np.save(path, values)
        keys, error = {"axes": "tyx"}, 1e-7
    elif kind == "mat":
        path = folder / "film.mat"
        savemat(path, {"film": codes.transpose(1, 2, 0), "other": 1.0})
        keys |= {"key": "film", "axes": "yxt"}
    else:
        path = folder / "film.mkv"
        write_video(path, codes, "ffv1", "gray16le", "gray16le")
    seen = slots(truth(path, **keys), tmp_path)
    assert np.abs(seen - SCALE * values).max() <= SCALE * (error + 2e-7)
    assert seen.max() == pytest.approx(SCALE)
    assert seen.min() == 0


@pytest.mark.parametrize("kind", ["png", "exr", "tiff", "npz", "8-bit png"])
def test_colour_becomes_luminance(kind: str, tmp_path: Path) -> None:
    grey, folder = signal(), tmp_path / "shots"
    folder.mkdir()
    values, path, error = colours(grey), folder, 0.5 / 65535
    keys: dict[str, object] = {"full_scale": 65535, "channel_weights": "rec709"}
    if kind == "png":
        for k, frame in enumerate(codes16(values)):
            write_colour_png(folder / f"{k}.png", frame)
    elif kind == "8-bit png":
        for k, frame in enumerate(values):
            Image.fromarray(np.round(frame * 255).astype(np.uint8)).save(folder / f"{k}.png")
        keys |= {"full_scale": 255, "accept_8bit": True}
        error = 0.5 / 255
    elif kind == "exr":
        for k, frame in enumerate(values.astype(np.float32)):
            layers = {name: frame[..., c] for c, name in enumerate("RGB")}
            write_exr(folder / f"{k}.exr", {**layers, "A": np.ones_like(layers["R"])}, attributes={})
        keys, error = {"channel_weights": "rec709"}, 1e-7
    elif kind == "tiff":
        for k, frame in enumerate(codes16(values)):
            tifffile.imwrite(folder / f"{k}.tif", frame, photometric="rgb")
    else:
        path = folder / "film.npz"
        np.savez(path, film=codes16(values))
        keys |= {"axes": "tyxc"}
    seen = slots(truth(path, **keys), tmp_path)
    assert np.abs(seen - SCALE * values @ REC709).max() <= SCALE * (error + 2e-7)


@pytest.mark.parametrize("full", [True, False])
@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize(("matrix", "luma"), [(1, (0.2126, 0.7152, 0.0722)), (5, (0.299, 0.587, 0.114))])
def test_video_colour_follows_its_file(
    matrix: int, luma: tuple[float, ...], bits: int, full: bool, tmp_path: Path
) -> None:
    """Flat colours coded here by the standard's forward formulas: back within half a code of each plane."""
    av = pytest.importorskip("av")
    path, unit = tmp_path / "film.mp4", 2 ** (bits - 8)
    colour = np.random.default_rng(1).uniform(0.1, 0.9, (N, 3))
    pixels, dtype = ("yuv420p", np.uint8) if bits == 8 else ("yuv420p10le", np.uint16)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"qp": "0"})
        stream.height, stream.width, stream.pix_fmt = 48, 66, pixels
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, 2 if full else 1
        for red, green, blue in colour:
            y = float(np.dot(luma, (red, green, blue)))
            chroma = 128 * unit + np.array([(blue - y) / (1 - luma[2]), (red - y) / (1 - luma[0])]) / 2 * (
                2**bits - 1 if full else 224 * unit
            )
            codes = [(2**bits - 1) * y if full else (16 + 219 * y) * unit, *chroma]
            frame = av.VideoFrame(66, 48, pixels)
            for plane, code in zip(frame.planes, codes, strict=True):
                plane.update(np.full(plane.buffer_size // dtype().itemsize, round(code), dtype))
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    seen = np.stack([f[20, 30] for f in open_recording(path).read(0)]) / 65535
    # half a code of Y' and of one chroma, times its factor of at most 2 (1 - 0.0722)
    assert np.abs(seen - colour).max() < (0.5 + 0.5 * 1.86) / ((219 if not full else 255) * unit)
    assert open_recording(path).bits == bits
    if bits == 8:
        with pytest.raises(ConfigError, match="accept_8bit = true"):
            truth(path, full_scale=65535).check()


def test_curves_are_undone(tmp_path: Path) -> None:
    linear = signal()
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    for name, stored, keys in (
        ("srgb", srgb, {"linearisation": "srgb"}),
        ("gamma", linear ** (1 / 2.2), {"linearisation": "gamma", "gamma": 2.2}),
    ):
        np.save(tmp_path / f"{name}.npy", codes16(stored))
        seen = slots(truth(tmp_path / f"{name}.npy", axes="tyx", full_scale=65535, **keys), tmp_path / name)
        # slope of both curves is at most 2.4 from code to light
        assert np.abs(seen - SCALE * linear).max() < SCALE * 2.4 / 65535


def test_black_level_goes_and_its_noise_stays(tmp_path: Path) -> None:
    """Dark frames average to no light, not to clipped noise; the shares say what was below and clipped."""
    rng = np.random.default_rng(3)
    codes = np.round(rng.normal(64, 5, (N, ROWS, COLS))).astype(np.uint16)
    codes[:, 0] = 1023
    np.save(tmp_path / "dark.npy", codes)
    found = truth(tmp_path / "dark.npy", axes="tyx", full_scale=1023, black_level=64)
    seen = slots(found, tmp_path)
    assert np.allclose(seen[:, 0], SCALE)
    assert np.allclose(seen[:, 1:], SCALE * (codes[:, 1:] - 64.0) / (1023 - 64), atol=1e-6)
    assert (seen < 0).any()
    text = found.description(Cache(tmp_path / "cache"))
    assert f"{1 / ROWS:.3%} of pixels at full scale" in text
    assert f"{(codes < 64).mean():.3%} of values below black" in text


# --- averages ---------------------------------------------------------------------------------------------


@given(start=st.floats(0, 50), step=st.floats(0.05, 20), n=st.integers(1, 12), slope=st.floats(-3, 3))
def test_cell_means_of_a_staircase_are_its_integrals(start: float, step: float, n: int, slope: float) -> None:
    """Against the antiderivative of the staircase: energy is conserved, cell by cell."""
    n_samples = int(np.ceil(start + step * n)) + 1
    stairs = slope * np.arange(n_samples) + 2.0
    seen = cell_shares(start, step, n, n_samples) @ stairs
    edges = start + step * np.arange(n + 1)
    integral = np.interp(edges, np.arange(n_samples + 1), np.concatenate([[0], np.cumsum(stairs)]))
    assert seen == pytest.approx(
        np.diff(integral) / step, abs=2e-6 * (1 + abs(slope) * n_samples) / min(step, 1)
    )


def test_overlaps_of_whole_frames_are_whole() -> None:
    first, weights = overlap(7 * (1 / 180) * 180, 8 * (1 / 180) * 180)
    assert (first, weights.tolist()) == (7, [1.0])


@pytest.mark.parametrize("rate", [180, 360, 450, 1000, 120])
def test_slots_are_means_over_time(rate: float, tmp_path: Path) -> None:
    """Frames that count up: the mean over a slot is the staircase's integral over it."""
    n = int(np.ceil(8 * rate / 180)) + 3
    stairs = np.arange(n, dtype=np.float64) + 1
    np.save(tmp_path / "film.npy", np.broadcast_to(stairs[:, None, None], (n, ROWS, COLS)))
    found = truth(tmp_path / "film.npy", axes="tyx", frame_rate_hz=rate, first_frame=3, repeat=rate < 180)
    edges = 3 + np.arange(9) * rate / 180
    total = np.interp(edges, np.arange(n + 1), np.concatenate([[0], np.cumsum(stairs)]))
    expected = SCALE * np.diff(total) / (rate / 180)
    assert slots(found, tmp_path)[:, 2, 3] == pytest.approx(expected, rel=1e-6)


def test_area_fit_conserves_light_and_keeps_its_place(tmp_path: Path) -> None:
    """17 x 21 pixels on 6 x 9: the middle 14 x 21 are kept; a lit pixel's light is there, where it was."""
    frames = np.zeros((N, 17, 21))
    frames[:, 3, 4] = 1.0
    np.save(tmp_path / "film.npy", frames)
    found = truth(tmp_path / "film.npy", axes="tyx", fit="area")
    seen = slots(found, tmp_path)[0] / SCALE
    step = 21 / 9
    assert found.pixels_per_sample == pytest.approx(step)
    assert seen.sum() * step**2 == pytest.approx(1, rel=1e-6)
    # pixel rows 3 .. 4 lie at (3 - 1.5) / step = 0.64 .. 1.07 cells, columns 4 .. 5 at 1.71 .. 2.14
    assert seen[0, 1] / seen.sum() == pytest.approx((1 - 1.5 / step) * step * (2 - 4 / step) * step, rel=1e-5)
    assert seen[:2, 1:3].sum() == pytest.approx(seen.sum())


def test_area_fit_may_be_coarser_and_says_so(tmp_path: Path) -> None:
    coarse = signal(N, 2, 3)
    np.save(tmp_path / "film.npy", coarse)
    found = truth(tmp_path / "film.npy", axes="tyx", fit="area")
    assert np.allclose(slots(found, tmp_path), SCALE * np.kron(coarse, np.ones((3, 3))), atol=1e-6)
    assert "coarser than the fine grid" in found.description()


def test_crop_keeps_the_middle_pixels(tmp_path: Path) -> None:
    large = signal(N, ROWS + 5, COLS + 2)
    np.save(tmp_path / "film.npy", large)
    seen = slots(truth(tmp_path / "film.npy", axes="tyx", fit="crop"), tmp_path)
    assert np.allclose(seen, SCALE * large[:, 2:-3, 1:-1], atol=1e-6)


def test_file_names_count_as_people_do(tmp_path: Path) -> None:
    values = codes16(signal(12))
    for k, frame in enumerate(values):
        write_png16(tmp_path / f"cam2_{k}.png", frame)
    found = open_recording(tmp_path)
    assert all(np.array_equal(a[..., 0], b) for a, b in zip(found.read(0), values, strict=True))


# --- laziness and cache -----------------------------------------------------------------------------------


def test_images_are_read_once_and_a_changed_one_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from optsim.footage.recording import images

    folder, cache = tmp_path / "shots", Cache(tmp_path / "cache")
    for k, frame in enumerate(codes16(signal())):
        write_png16(folder / f"{k}.png", frame)
    read: list[str] = []
    real = images.png
    monkeypatch.setattr(images, "png", lambda path: read.append(path.name) or real(path))
    truth(folder, full_scale=65535).radiance(cache)
    assert sorted(set(read)) == [f"{k}.png" for k in range(N)]
    read.clear()
    truth(folder, full_scale=65535).radiance(cache)
    assert set(read) == {"0.png"}, "only the first frame, to look at"
    write_png16(folder / "5.png", codes16(np.full((ROWS, COLS), 0.25)))
    read.clear()
    video = truth(folder, full_scale=65535).radiance(cache)
    assert set(read) == {"0.png", "5.png", "6.png", "7.png"} - {"6.png", "7.png"}
    assert video.load(5).instant(0) == pytest.approx(SCALE * 0.25, rel=1e-4)


@pytest.mark.parametrize(
    "other",
    [
        {"scale_w_m2_sr": 2 * SCALE},
        {"first_frame": 1},
        {"frame_rate_hz": 200},
        {"full_scale": 60000.0},
        {"black_level": 100.0},
        {"linearisation": "srgb"},
    ],
    ids=lambda each: next(iter(each)),
)
def test_what_is_stated_otherwise_never_comes_from_an_earlier_import(
    tmp_path: Path, other: dict[str, object]
) -> None:
    np.save(tmp_path / "film.npy", np.round(signal(2 * N) * 50000 + 200).astype(np.uint16))
    stated = {"axes": "tyx", "full_scale": 65535.0}
    first = slots(truth(tmp_path / "film.npy", **stated), tmp_path)
    again = slots(truth(tmp_path / "film.npy", **stated | other), tmp_path)
    fresh = slots(truth(tmp_path / "film.npy", **stated | other), tmp_path / "fresh")
    np.testing.assert_array_equal(again, fresh)
    assert np.abs(again - first).mean() > 1e-3


def test_footage_has_no_ceiling(tmp_path: Path) -> None:
    np.save(tmp_path / "film.npy", signal())
    video = truth(tmp_path / "film.npy", axes="tyx").radiance(Cache(tmp_path / "cache"))
    assert video.half_difference is None
    assert video.outside is None
    assert video.white_w_m2_sr == WHITE
