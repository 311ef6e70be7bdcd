"""The regression matrix: three scenes, four schemes, two cameras, several seeds; small enough for every day.

Each run is a task, so a stopped matrix goes on, and its folder holds a report to look at.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optsim.core.cache import hash_of
from optsim.core.files import read_record, write_json
from optsim.core.progress import Progress, silent
from optsim.experiment import job
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.resume import run_key
from optsim.experiment.run_folder import versions
from optsim.report.baseline import YARDSTICK
from optsim.report.schema import RESULTS
from optsim.tasks import Outcome, Task, run_tasks

BASELINE = "regress"
"""Name of the baseline of the matrix."""
SEEDS = (1, 2, 3, 4)
SCENES = ("window_room", "half_moving", "night_street")
CAMERAS: dict[str, tuple[str, ...]] = {
    "nominal": (),
    # A camera as assembled: turned, out of scale and focus, and noisier.
    "rough": (
        "camera.relay.rotation_rad=0.004",
        "camera.relay.magnification_error=0.004",
        "camera.relay.shift_x_px=0.4",
        "camera.relay.aberration_m=3e-6",
        "camera.sensor.read_noise_e=14",
        "reading_px=3",
    ),
}
ROWS, COLS, FRAMES = 60, 80, 8
# What a report or a comparison doesn't need.
_HEAVY = ("frames", "masks", "codes", "reconstructions", "calibration*.npz", "checksums.json")


def matrix(
    seeds: Sequence[int] = SEEDS,
    scenes: Sequence[str] = SCENES,
    cameras: Sequence[str] = tuple(CAMERAS),
) -> list[Experiment]:
    """Experiments of the matrix; those of a scene share their truth."""
    small = [
        f"n_frames={FRAMES}",
        f"camera.panel_rows={ROWS}",
        f"camera.panel_cols={COLS}",
        f"camera.sensor.rows={3 * ROWS + 16}",
        f"camera.sensor.cols={3 * COLS + 16}",
        # The same field as the demo's.
        f"camera.objective.focal_length_m='{12.5 * COLS / 600} mm'",
        "save_reconstructions=[]",
    ]
    return [
        load_experiment(
            "demo",
            [*small, f"scene.name={scene}", f"name={scene}-{camera}", *CAMERAS[camera]],
            seed=seed,
        )
        # In this order a worker finds the operators of its camera still in memory, and workers that begin
        # side by side render different scenes.
        for camera in cameras
        for seed in seeds
        for scene in scenes
    ]


def run_matrix(
    experiments: Sequence[Experiment], out: Path, *, workers: int | None = None, progress: Progress = silent
) -> tuple[Path, Outcome]:
    """Run a matrix below a folder.

    Parameters
    ----------
    experiments : sequence of Experiment
        From :func:`matrix`.
    out : Path
        Gets a folder of this code, in it one a run.
    workers : int, optional
        Processes side by side, by default as for all lists of tasks.
    progress : Progress
        Told of each finished run.

    Returns
    -------
    folder : Path
        Folder of the runs, for a comparison.
    outcome : Outcome
        What was made, found, and failed.
    """
    tasks = [
        Task(f"{each.name}/{each.seed}", run_key(each, versions()), measure_run, (each,))
        for each in experiments
    ]
    folder = out / hash_of([task.key for task in tasks])[:12]
    return folder, run_tasks(tasks, folder, workers=workers, progress=progress)


def measure_run(folder: Path, experiment: Experiment) -> None:
    """Run one experiment of the matrix into a folder, time a yardstick beside it, and drop what is heavy."""
    before = _yardstick_s()
    job.execute(experiment, folder, command="optsim regress")
    record = read_record(folder / RESULTS)
    stage = {"stage": YARDSTICK, "wall_s": 0.0, "peak_rss_mb": 0.0, "peak_is_of_this_stage": False}
    record["timings"].append({**stage, "cpu_s": (before + _yardstick_s()) / 2})
    write_json(folder / RESULTS, record)
    for path in (path for pattern in _HEAVY for path in folder.glob(pattern)):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def _yardstick_s() -> float:
    """Processor time of fixed work like a run's: transforms, powers and sums; the best of three."""
    picture = np.random.default_rng(0).random((512, 512))
    times: list[float] = []
    for _ in range(3):
        start = time.process_time()
        for _ in range(6):
            np.fft.irfft2(np.fft.rfft2(picture) * 0.5)
            np.power(picture, 0.9).sum()
        times.append(time.process_time() - start)
    return min(times)
