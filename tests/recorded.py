"""Recordings for the tests of footage: values, files, and the truth made of them."""

from pathlib import Path

import numpy as np
import pytest

from optsim.core.cache import Cache
from optsim.core.config import build
from optsim.core.quantities import Timing, View
from optsim.footage import FootageSource, FootageTruth, open_footage

ROWS, COLS, N = 6, 9, 8
VIEW = View(ROWS, COLS, 3, 0.3)
TIMING = Timing(1 / 180, 4, 2)
SCALE, WHITE = 3.0, 2.0


def signal(n: int = N, rows: int = ROWS, cols: int = COLS) -> np.ndarray:
    """Linear signal 0 .. 1, array (t, y, x): no two frames, rows or columns alike, ends reached."""
    values = np.random.default_rng(5).uniform(0.05, 0.95, (n, rows, cols))
    values[0, 0, 0], values[-1, -1, -1] = 0, 1
    return values


def truth(path: Path, view: View = VIEW, timing: Timing = TIMING, **keys: object) -> FootageTruth:
    stated = {
        "path": str(path),
        "frame_rate_hz": 180,
        "scale_w_m2_sr": SCALE,
        "white_w_m2_sr": WHITE,
        "linearisation": "linear",
        **keys,
    }
    return open_footage(build(FootageSource, stated, where="test"), view, timing)


def slots(found: FootageTruth, tmp_path: Path) -> np.ndarray:
    """Every slot of a truth through a fresh cache, array (slot, y, x)."""
    video = found.radiance(Cache(tmp_path / "cache"))
    return np.stack([video.load(k).instant(0) for k in range(video.n_slots)])


def codes16(values: np.ndarray) -> np.ndarray:
    return np.round(values * 65535).astype(np.uint16)


def colours(grey: np.ndarray) -> np.ndarray:
    """Colour frames (t, y, x, 3), whose channels differ."""
    return np.stack([grey, grey[:, ::-1], grey[:, :, ::-1]], axis=-1)


def write_video(path: Path, frames: np.ndarray, codec: str, pixels: str, given_as: str) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30, options={"qp": "0"} if codec == "libx264" else {})
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=given_as)))
        container.mux(stream.encode())
