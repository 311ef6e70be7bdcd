"""A laboratory's film on a small panel, as the unchanged experiment of studies, and tasks done at once."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_experiment import COLS, ROWS

from optsim.core.progress import Progress, silent
from optsim.experiment.experiment import Experiment, experiment_path, load_experiment
from optsim.tasks import Outcome, Task
from optsim.tasks.folder import make_folder

FRAMES = 6
SMALL = [
    f"n_frames={FRAMES}",
    f"camera.panel_rows={ROWS}",
    f"camera.panel_cols={COLS}",
    f"camera.sensor.rows={3 * ROWS + 8}",
    f"camera.sensor.cols={3 * COLS + 8}",
    "calibration=true",
    "camera.relay.field_error=0.2",  # the finest would take most of these tests' time
    "save_reconstructions=[]",
]
FOOTAGE = """
[source.footage]
path = "film.npy"
axes = "tyx"
frame_rate_hz = "180 fps"
scale_w_m2_sr = 0.5
white_w_m2_sr = 0.4
linearisation = "linear"
full_scale = 65535
"""


def write_experiment(folder: Path) -> Path:
    """The demo before a texture that a bright bar crosses."""
    texture = np.random.default_rng(4).uniform(0.04, 0.3, (ROWS // 2, COLS // 2))
    frames = np.repeat(np.kron(texture, np.ones((6, 6)))[None], FRAMES * 36, 0)
    for slot, frame in enumerate(frames):
        col = round(30 + 14 * np.sin(2 * np.pi * slot / 50))
        frame[20:44, col : col + 10] = 0.7
    np.save(folder / "film.npy", np.round(frames * 65535).astype(np.uint16))
    demo = experiment_path("demo").read_text()
    start, stop = demo.index("[scene]"), demo.index("[camera]")
    path = folder / "lab.toml"
    path.write_text(demo[:start] + FOOTAGE + demo[stop:])
    return path


def load(path: Path, *methods: str) -> Experiment:
    """The small experiment with some of its methods."""
    loaded = load_experiment(str(path), SMALL)
    return loaded.model_copy(update={"methods": tuple(m for m in loaded.methods if m.name in methods)})


def done_here(tasks: Sequence[Task], root: Path, *, progress: Progress = silent, **others: Any) -> Outcome:
    """Do tasks in this process instead of workers."""
    states = {task.name: make_folder(root, task) for task in tasks}
    made, found = ([n for n, state in states.items() if state == word] for word in ("made", "found"))
    return Outcome(tuple(made), tuple(found), {})


@pytest.fixture
def without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("optsim.study.folder.run_tasks", done_here)
