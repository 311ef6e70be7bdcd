"""What can be wrong with footage, and that it is said: before a run, with the key and the cure."""

import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image
from recorded import (
    COLS,
    ROWS,
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
from optsim.core.errors import ConfigError, GeometryError, StorageError, ValueCheckError
from optsim.core.files import write_exr, write_png16
from optsim.core.quantities import View
from optsim.footage.recording import open_recording
from optsim.footage.recording.film import as_recording


def fill(folder: Path, frames: np.ndarray) -> Path:
    for k, frame in enumerate(frames):
        write_png16(folder / f"{k}.png", codes16(frame))
    return folder


def wrong(tmp_path: Path, name: str) -> tuple[Path, dict[str, object]]:
    """A recording or a statement with one thing wrong."""
    keys: dict[str, object] = {"axes": "tyx"}
    path = tmp_path / "film.npy"
    values = signal()
    if name == "missing file":
        return tmp_path / "nothing.npy", keys
    if name == "empty folder":
        (tmp_path / "empty").mkdir()
        return tmp_path / "empty", {}
    if name == "empty pattern":
        return tmp_path / "*.png", {}
    if name == "mixed kinds":
        write_exr(fill(tmp_path, values) / "9.exr", {"Y": np.zeros((ROWS, COLS), np.float32)}, attributes={})
        return tmp_path, {"full_scale": 65535}
    if name == "mixed sizes":
        write_png16(fill(tmp_path, values) / "4.png", codes16(values[0, :-1]))
        return tmp_path, {"full_scale": 65535}
    if name == "lost frame":
        (fill(tmp_path, values) / "4.png").unlink()
        return tmp_path, {"full_scale": 65535}
    if name == "cut png":
        cut = fill(tmp_path, values) / "3.png"
        cut.write_bytes(cut.read_bytes()[:60])
        return tmp_path, {"full_scale": 65535}
    if name == "palette":
        Image.new("P", (COLS, ROWS)).save(tmp_path / "0.png")
        return tmp_path, {}
    if name == "8 bit":
        np.save(path, np.zeros((N, ROWS, COLS), np.uint8))
        return path, {**keys, "full_scale": 255}
    if name == "no full scale":
        values = codes16(values)
    if name == "full scale of another dtype":
        values, keys = codes16(values), {**keys, "full_scale": 2**20}
    if name == "above full scale":
        values, keys = codes16(values), {**keys, "full_scale": 16383}
    if name == "nan":
        values[6, 2, 3] = np.nan
    if name == "negative":
        values[6, 2, 3] = -0.1
    if name == "black level too high":
        keys["black_level"] = 0.9
    if name == "complex":
        values = values.astype(np.complex128)
    if name == "pickled":
        values = values.astype(object)
    if name == "rank":
        values = values[0]
    if name == "no axes":
        keys = {}
    if name == "axes of images":
        return fill(tmp_path, values), keys
    if name == "too short":
        values = values[:7]
    if name == "too slow":
        keys["frame_rate_hz"] = 100
    if name == "size":
        values = values[:, :, :-1]
    if name == "crop of less":
        values, keys = values[:, :, :-1], {**keys, "fit": "crop"}
    if name == "colour":
        values, keys = colours(values), {"axes": "tyxc"}
    if name == "weights of grey":
        keys["channel_weights"] = "rec709"
    if name in ("no key", "wrong key"):
        np.savez(tmp_path / "film.npz", film=values, shutter=np.zeros(2))
        return tmp_path / "film.npz", keys | ({"key": "flim"} if name == "wrong key" else {})
    if name == "key of a wrong mat":
        savemat(tmp_path / "film.mat", {"film": values})
        return tmp_path / "film.mat", {**keys, "key": "flim"}
    if name == "mat 7.3":
        # The first bytes of every such file: 116 of text, offset, version 0x0200, endian mark.
        text = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
        (tmp_path / "film.mat").write_bytes(text + b"\x00" * 512)
        return tmp_path / "film.mat", keys
    if name == "no mat":
        (tmp_path / "film.mat").write_bytes(b"nothing of the kind" * 20)
        return tmp_path / "film.mat", keys
    if name == "cut npz":
        np.savez(tmp_path / "film.npz", film=values)
        whole = (tmp_path / "film.npz").read_bytes()
        (tmp_path / "film.npz").write_bytes(whole[: len(whole) // 2])
        return tmp_path / "film.npz", keys
    if name == "cut tiff":
        tifffile.imwrite(tmp_path / "film.tif", codes16(values))
        whole = (tmp_path / "film.tif").read_bytes()
        (tmp_path / "film.tif").write_bytes(whole[: len(whole) - ROWS * COLS * 3])
        return tmp_path / "film.tif", {"full_scale": 65535}
    if name == "no exr channel":
        layers = {"left": np.zeros((ROWS, COLS), np.float32), "right": np.zeros((ROWS, COLS), np.float32)}
        write_exr(tmp_path / "0.exr", layers, attributes={})
        return tmp_path / "0.exr", {}
    np.save(path, values)
    return path, keys


WRONG = {
    "missing file": (StorageError, "no such file or folder"),
    "empty folder": (StorageError, "no frames in"),
    "empty pattern": (StorageError, "no frames in"),
    "mixed kinds": (StorageError, r"\.exr, \.png"),
    "mixed sizes": (ValueCheckError, r"4\.png: 5 x 9 of uint16, but the recording starts with 6 x 9"),
    "lost frame": (StorageError, r"after 3\.png comes 5\.png"),
    "cut png": (StorageError, r"3\.png cannot be read"),
    "palette": (ValueCheckError, "PNG of 1 bits, palette; expected grey or RGB"),
    "8 bit": (ConfigError, "accept_8bit = true"),
    "no full scale": (ConfigError, "full_scale: missing; the footage holds uint16"),
    "full scale of another dtype": (ConfigError, "at most 65535"),
    "above full scale": (ValueCheckError, "is above source.footage.full_scale = 16383"),
    "nan": (ValueCheckError, "frame 6: not a finite number at row 2, column 3"),
    "negative": (ValueCheckError, "frame 6: negative light -0.1 at row 2, column 3"),
    "black level too high": (ValueCheckError, "below source.footage.black_level = 0.9"),
    "complex": (ValueCheckError, "holds complex128; expected one of"),
    "pickled": (StorageError, "array of numbers"),
    "rank": (ValueCheckError, r"shape \(6, 9\), 2 axes; source.footage.axes = 'tyx' says 3"),
    "no axes": (ConfigError, r"axes: missing; the array in film.npy has shape \(8, 6, 9\)"),
    "axes of images": (ConfigError, "axes: got 'tyx'"),
    "too short": (ConfigError, "7 frames at 180 Hz from first_frame = 0 cover 1 coded frames"),
    "too slow": (ConfigError, "slower than the slots' 180 Hz.*repeat = true"),
    "size": (GeometryError, "footage has 6 x 8 pixels, the fine grid.*6 x 9"),
    "crop of less": (GeometryError, "which is larger; state 'area'"),
    "colour": (ConfigError, "channel_weights: missing; the footage has 3 channels"),
    "weights of grey": (ConfigError, "3 weights; the footage has 1 channel$"),
    "no key": (ConfigError, "key: missing; film.npz holds film, shutter"),
    "wrong key": (ConfigError, "expected one of: film, shutter; did you mean 'film'"),
    "key of a wrong mat": (ConfigError, "expected one of: film"),
    "mat 7.3": (StorageError, "7.3.*'-v7'"),
    "no mat": (StorageError, "cannot be read as a MATLAB file"),
    "cut npz": (StorageError, "cannot be read as a numpy array"),
    "cut tiff": (StorageError, "TIFF"),
    "no exr channel": (ConfigError, "key: missing; 0.exr holds the channels left, right"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_wrong_is_said(name: str, tmp_path: Path) -> None:
    error, text = WRONG[name]
    path, keys = wrong(tmp_path, name)
    with pytest.raises(error, match=text):
        slots(truth(path, **keys), tmp_path / "c")


@pytest.mark.parametrize("name", ["missing file", "8 bit", "too short", "too slow", "size", "colour"])
def test_the_check_alone_finds_it(name: str, tmp_path: Path) -> None:
    error, text = WRONG[name]
    path, keys = wrong(tmp_path, name)
    with pytest.raises(error, match=text):
        truth(path, **keys).check()


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
def test_a_half_copied_video_is_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"film{suffix}"
    noise = np.random.default_rng(0).integers(0, 65535, (60, 48, 66)).astype(np.uint16)
    write_video(path, noise, "libx264" if suffix == ".mp4" else "ffv1", "gray10le", "gray16le")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StorageError, match=r"cannot be read as a video|ends after \d+ of"):
        truth(path, View(48, 66, 3, 0.3), full_scale=65535).radiance(Cache(tmp_path / "cache"))


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "film.mp4").write_bytes(b"anything")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(ConfigError, match=r"optsim\[video\]"):
        open_recording(tmp_path / "film.mp4")


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"frame_rate_hz": None}, "frame_rate_hz"),
        ({"linearisation": "log"}, "linearisation"),
        ({"linearisation": "gamma", "full_scale": 1}, "gamma: got None"),
        ({"gamma": 2.2}, "gamma: got 2.2"),
        ({"linearisation": "srgb"}, "full_scale: missing"),
        ({"linearisation": "srgb", "full_scale": 255, "black_level": 3}, "black_level"),
        ({"full_scale": 64, "black_level": 64}, "more than black_level"),
        ({"channel_weights": (1, -1, 0)}, "weights >= 0"),
        ({"frame_rate": 180}, "did you mean 'frame_rate_hz'"),
    ],
)
def test_statements_that_disagree_are_refused(keys: dict[str, object], text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=text):
        truth(tmp_path, **keys)


def test_frames_that_stop_coming_are_missed(tmp_path: Path) -> None:
    frames = np.zeros((3, ROWS, COLS, 1))
    found = as_recording((tmp_path / "film",), 5, lambda first: iter(frames[first:]))
    with pytest.raises(StorageError, match="ends after 3 of 5 frames"):
        list(found.read(1))
