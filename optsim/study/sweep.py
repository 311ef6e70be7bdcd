"""A parameter, or a pair, over a range: what it costs when the calibration knows it, and when it doesn't."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.errors import ConfigError, GeometryError
from optsim.core.progress import Progress, silent
from optsim.experiment.experiment import Experiment
from optsim.metrics.records import REGIONS
from optsim.study.comparison import PAIR, Estimate, Seeds, add_work, compare, pool_scatter, rows_of
from optsim.study.crops import PICTURES
from optsim.study.folder import StudyTask, Workplace, compute, write_result, write_table
from optsim.study.measurement import Key
from optsim.study.point import Axis, Mode, Point, changed_only, experiment_at
from optsim.study.stage import stage_of

REGISTRATION = ("registration",)
_MOST_POINTS = 2000


@dataclass(frozen=True)
class SweepPlan:
    """A sweep.

    Parameters
    ----------
    axes : tuple of Axis
        One parameter, or two.
    modes : tuple of Mode
        Curves.
    frames : int
        Coded frames to score.
    seeds : Seeds
        How many, and until when. Two are enough: intervals take the scatter of all points of a curve.
    marks : tuple of float
        Values of the first axis whose pictures are kept.
    """

    axes: tuple[Axis, ...]
    modes: tuple[Mode, ...] = ("known", "unknown", "compensated")
    frames: int = 1
    seeds: Seeds = PAIR
    marks: tuple[float, ...] = ()

    def points(self) -> list[tuple[Any, ...]]:
        """Values of all points, in the order of the axes."""
        return list(itertools.product(*(axis.values for axis in self.axes)))


def sweep(base: Experiment, plan: SweepPlan, place: Workplace, progress: Progress = silent) -> dict[str, Any]:
    """Measure a sweep into a folder.

    Parameters
    ----------
    base : Experiment
        The unchanged experiment.
    plan : SweepPlan
        What is varied.
    place : Workplace
        Folder and workers; the same folder goes on.
    progress : Progress
        Told of each task.

    Returns
    -------
    dict
        The content of study.json.

    Raises
    ------
    ConfigError
        When no value can be built, or there is nothing to vary.
    """
    _check(base, plan)
    modes = modes_of(plan)
    seeds = asdict(plan.seeds)
    tasks = [
        StudyTask(
            f"points/{at:04d}",
            _measure_value,
            (
                plan.frames,
                [axis.key for axis in plan.axes],
                list(values),
                modes,
                seeds,
                values[0] in plan.marks,
            ),
        )
        for at, values in enumerate(plan.points())
    ]
    said = {
        "axes": [{"key": axis.key, "values": list(axis.values)} for axis in plan.axes],
        "modes": modes,
        "frames": plan.frames,
        "seeds": seeds,
        "marks": list(plan.marks),
    }
    record = compute("sweep", base, said, tasks, place, progress)
    rows = [row for result in record["results"].values() for row in result["rows"]]
    pool_scatter(rows)
    write_table(place.folder, record, rows)
    return {**record, "rows": rows}


def modes_of(plan: SweepPlan) -> list[str]:
    """Curves that a sweep has: only the camera can drift."""
    drifts = all(axis.key.startswith("camera.") for axis in plan.axes)
    return [mode for mode in plan.modes if drifts or mode == "known"]


def _check(base: Experiment, plan: SweepPlan) -> None:
    """Refuse a sweep none of whose points can be, before there is any work."""
    if not 1 <= len(plan.axes) <= 2:
        raise ConfigError(f"--vary: got {len(plan.axes)}, expected one parameter or a pair")
    if len({axis.key for axis in plan.axes}) < len(plan.axes):
        raise ConfigError(f"--vary: got {plan.axes[0].label} twice, expected two parameters")
    if len(plan.points()) > _MOST_POINTS:
        raise ConfigError(f"--vary: got {len(plan.points())} points, expected at most {_MOST_POINTS}")
    if not modes_of(plan):
        raise ConfigError(f"--curves: {plan.axes[0].label} is no part of the camera; cure: --curves known")
    for mark in plan.marks:
        if mark not in plan.axes[0].values:
            raise ConfigError(f"--mark: got {mark:g}, expected one of the values of {plan.axes[0].label}")
    refused = ""
    for values in plan.points():
        changes = changed_only(base, {a.key: v for a, v in zip(plan.axes, values, strict=True)})
        for mode in modes_of(plan):
            try:
                experiment_at(base, Point(changes, mode))  # type: ignore[arg-type]
            except (ConfigError, GeometryError) as error:
                refused = str(error)
            else:
                return
    raise ConfigError(f"--vary: every value is refused: {' '.join(refused.split())}")


def _measure_value(
    folder: Path,
    text: str,
    frames: int,
    keys: Sequence[str],
    values: Sequence[Any],
    modes: Sequence[Mode],
    seeds: dict[str, Any],
    marked: bool,
) -> None:
    """Measure all curves at one place, in a worker."""
    stage = stage_of(text, frames)
    changes = changed_only(stage.base, dict(zip(keys, values, strict=True)))
    rows: list[dict[str, Any]] = []
    work: dict[str, int] = {}
    pictures: dict[str, Any] = {}
    for mode in modes:
        compensators = REGISTRATION if mode == "compensated" and changes else ()
        point = Point(changes, mode if changes else "known", compensators, stage.base.seed)
        found = compare(stage, point, Seeds(**seeds), of_everything)
        add_work(work, found.work)
        about = {key.removeprefix("camera."): value for key, value in zip(keys, values, strict=True)}
        rows += [{**row, "mode": mode} for row in rows_of(found, **about)]
        for name, image in found.first.pictures.items() if marked else ():
            pictures[name if name == "truth" else f"{mode} {name}"] = image
    if pictures:
        with (folder / PICTURES).open("wb") as stream:
            np.savez(stream, **pictures)
    write_result(folder, work, values=list(values), rows=rows)


def of_everything(changes: dict[Key, Estimate]) -> list[Key]:
    """Scores of all pixels: their intervals decide on more seeds."""
    return [key for key in changes if key[1] == REGIONS[0]]


def labels(plan: dict[str, Any]) -> list[str]:
    """Names of the axes of a plan, as a user writes them."""
    return [axis["key"].removeprefix("camera.") for axis in plan["axes"]]
