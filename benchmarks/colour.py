"""Time of passes in colour against the same passes in one band, and the noise that colour adds.

Each is the command ``optsim render --passes`` with a cache of its own, start and first use of random paths
included. Both are run twice in turn, and the shorter time counts; seconds of CPU stand beside it. The scene
of one band is the same file with G as its only band, so its Y is that of the colour scene.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.files import read_exr
from optsim.core.progress import Progress, silent
from optsim.scene.scene import scenes_folder

_SCENE, _SLOTS, _ROUNDS = "flying_solids", 36, 2
_COLOUR, _MONO = 'bands = "srgb"', 'bands = [{ name = "G", wavelength_nm = 549, channel = "G" }]'


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Measure both.

    Parameters
    ----------
    name : str
        ``render.colour``.
    progress : Progress
        Told of each export.
    """
    text = (scenes_folder() / _SCENE / "scene.toml").read_text(encoding="utf-8")
    if _COLOUR not in text:
        raise ValueError(f"{_SCENE}: got no line {_COLOUR!r}: it is not in colour")
    found: dict[str, list[tuple[float, float]]] = {_COLOUR: [], _MONO: []}
    with tempfile.TemporaryDirectory() as folder:
        for number, line in enumerate([_COLOUR, _MONO] * _ROUNDS):
            place = Path(folder) / str(number)
            (place / "scene").mkdir(parents=True)
            (place / "scene" / "scene.toml").write_text(text.replace(_COLOUR, line), encoding="utf-8")
            found[line].append(_export(place))
            progress("exports", number + 1, 2 * _ROUNDS)
        channels, said = read_exr(Path(folder) / "0" / "out" / f"slot{_SLOTS // 2:06d}.exr")
    (colour, colour_cpu), (mono, mono_cpu) = (map(min, zip(*each, strict=True)) for each in found.values())
    about = said["further"]["colour"]
    return {
        "name": name,
        "value": _SLOTS / colour,
        "unit": "slots/s",
        "peer": "the same passes in one band",
        "peer_value": _SLOTS / mono,
        "ratio": mono / colour,
        "conditions": {
            "grid": " x ".join(map(str, channels["Y"].shape[::-1])),
            "slots": _SLOTS,
            "time_over_mono": colour / mono,
            "cpu_over_mono": colour_cpu / mono_cpu,
            "seconds_and_cpu": {"colour": found[_COLOUR], "mono": found[_MONO]},
            "noise": about["noise"],
            "noise_besides_Y": about["noise_besides_Y"],
            "median_of_sigma_over_Y": float(np.median(channels["Y.sigma"] / np.maximum(channels["Y"], 1e-9))),
            "noise_is": about["noise_is"],
        },
    }


def _export(place: Path) -> tuple[float, float]:
    """Seconds of an export into a new folder, and seconds of CPU."""
    command = [sys.executable, "-m", "optsim", "render", "demo", "--passes", "--out", str(place / "out")]
    chosen = [f"scene.name={place / 'scene'}", "n_frames=1"]
    start, before = time.perf_counter(), os.times()
    subprocess.run(
        [*command, *(word for each in chosen for word in ("--set", each))],
        env={**os.environ, "OPTSIM_CACHE": str(place / "cache")},
        check=True,
        capture_output=True,
    )
    after = os.times()
    used = after.children_user - before.children_user + after.children_system - before.children_system
    return time.perf_counter() - start, used
