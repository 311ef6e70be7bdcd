"""Time and memory of a calibration at the full CCD, from the images that an operator has time for.

The bench is the virtual laboratory's of the paper's camera at its full size, sixty images on disk. Timed is
what ``optsim calibrate`` does, in a process of its own: read, check, estimate, write the calibration and its
page. The peer is the goal.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from optsim.camera.bench_folder import take_bench
from optsim.camera.laboratory import FEW_FRAMES
from optsim.core.progress import Progress, silent
from optsim.experiment.calibration_record import bench_camera
from optsim.experiment.calibrations import bench_noise
from optsim.experiment.experiment import load_experiment

_GOAL_S, _GOAL_GB = 30.0, 2.0
_PRESET = "paper_prototype"


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Measure the record.

    Parameters
    ----------
    name : str
        ``calibrate.full_frame``.
    progress : Progress
        Told of each setting of the bench.
    """
    experiment = load_experiment(_PRESET)
    camera = bench_camera(experiment)
    with tempfile.TemporaryDirectory() as folder:
        bench, out = Path(folder) / "bench", Path(folder) / "found.npz"
        start = time.perf_counter()
        take_bench(camera, bench_noise(experiment), bench, about={}, frames=FEW_FRAMES, progress=progress)
        laboratory_s = time.perf_counter() - start
        n_images = len(list(bench.glob("*.png")))
        seconds, cpu_s, told = list[float](), list[float](), ""
        # The first run may compile.
        for _ in range(2):
            start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
            command = [sys.executable, "-m", "optsim", "calibrate", str(bench), "--out", str(out), "--json"]
            told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
            seconds.append(time.perf_counter() - start)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            cpu_s.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
        record = json.loads(told)
    peak_gb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024 / 1e9
    values = {each["key"]: each["value"] for each in record["quantities"]}
    return {
        "name": name,
        "value": min(seconds),
        "unit": "s",
        "peer": "goal",
        "peer_value": _GOAL_S,
        "ratio": _GOAL_S / min(seconds),
        "conditions": {
            "panel": f"{camera.panel_cols} x {camera.panel_rows}",
            "ccd": f"{camera.sensor.cols} x {camera.sensor.rows}",
            "images": n_images,
            "first_run_s": seconds[0],
            "cpu_s": min(cpu_s),
            "peak_gb": peak_gb,
            "goal_gb": _GOAL_GB,
            "laboratory_s": laboratory_s,
            "map_residual_px": values["map_residual_px"],
            "note": "a process of its own: reading, checks, estimate, calibration and page; better of two",
        },
    }
