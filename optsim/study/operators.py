"""The same frames decoded with four operators: ideal, calibrated, calibrated and moved blind, and true.

Decoding with the operator that made the images flatters every method. Here the frames are taken once, with
the codes that the calibration chose. Only what the decoder knows differs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from optsim.calibration.blind import Blind, moved_back, registered_blind
from optsim.camera.true_calibration import ideal_calibration, true_calibration
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Reconstruction
from optsim.experiment.calibrations import Calibrations
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import Frames, capture, decode, planned
from optsim.metrics.scoring import FrameTally
from optsim.study.comparison import LIMITS, Seeds, student
from optsim.study.crops import PICTURES
from optsim.study.folder import StudyTask, Workplace, compute, write_result, write_table
from optsim.study.measurement import DB, pooled
from optsim.study.stage import stage_of

OPERATORS = {
    "ideal": "the paper's equations",
    "calibrated": "what the experiment's calibration knows; after a drift, of the camera before it",
    "blind": "the same, and the frames moved back by what they tell themselves",
    "true": "the parameters of the camera that took the frames",
}
"""What the decoder knows, by name."""
DIFFERENCES = {
    "calibration loss": ("true", "calibrated"),
    "blind recovery": ("blind", "calibrated"),
    "knowledge limit": ("true", "ideal"),
}
"""Differences of scores: the first operator less the second."""


@dataclass(frozen=True)
class OperatorsPlan:
    """A comparison of operators.

    Parameters
    ----------
    frames : int
        Coded frames to score.
    seeds : Seeds
        ``least`` seeds of codes and photons are measured; no more are added.
    """

    frames: int = 3
    seeds: Seeds = LIMITS


def operators(
    base: Experiment, plan: OperatorsPlan, place: Workplace, progress: Progress = silent
) -> dict[str, Any]:
    """Decode the frames of an experiment with every operator, into a folder.

    Parameters
    ----------
    base : Experiment
        The experiment, with its drift if it has one.
    plan : OperatorsPlan
        Frames and seeds.
    place : Workplace
        Folder and workers; the same folder goes on.
    progress : Progress
        Told of each task.

    Returns
    -------
    dict
        The content of study.json. ``rows`` has a row a method, region and operator or difference;
        ``registrations`` has one a method and seed.
    """
    tasks = [
        StudyTask(f"seeds/{number:02d}", _measure_seed, (plan.frames, base.seed + number, number == 0))
        for number in range(plan.seeds.least)
    ]
    record = compute("operators", base, asdict(plan), tasks, place, progress)
    results = [record["results"][name] for name in sorted(record["results"])]
    found = {**record, "registrations": [row for result in results for row in result["registrations"]]}
    rows = rows_of([result["db"] for result in results])
    write_table(place.folder, found, rows)
    return {**found, "rows": rows}


def rows_of(seeds: Sequence[Sequence[Sequence[Any]]]) -> list[dict[str, Any]]:
    """Return scores and their differences over the seeds: a row a method, region and name."""
    tables = [{(o, m, r): db for o, m, r, db in each if db is not None} for each in seeds]
    if not tables:
        return []
    rows: list[dict[str, Any]] = []
    for method, region in dict.fromkeys((m, r) for _, m, r in tables[0]):

        def values(operator: str, here: tuple[str, str] = (method, region)) -> list[float] | None:
            found = [table.get((operator, *here)) for table in tables]
            return [each for each in found if each is not None] if None not in found else None

        levels = {name: values(name) for name in OPERATORS}
        for name in (*OPERATORS, *DIFFERENCES):
            first, second = (levels[each] for each in DIFFERENCES.get(name, (name, name)))
            if first is None or second is None:
                continue
            apart = [a - b for a, b in zip(first, second, strict=True)] if name in DIFFERENCES else first
            mean = student(apart)
            rows.append(
                {
                    "method": method,
                    "region": region,
                    "what": name,
                    "db": mean.mean,
                    "db_half": mean.stated_half,
                    "seeds": mean.n,
                    "below_noise": mean.below_noise if name in DIFFERENCES else "",
                }
            )
    return rows


def _measure_seed(folder: Path, text: str, frames: int, seed: int, keep_pictures: bool) -> None:
    """Take the frames of a seed, and decode them with every operator, in a worker."""
    stage = stage_of(text, frames)
    modelled, _ = planned(stage.base)
    camera = modelled.at_work().with_nd(stage.light.nd_transmission)
    seeded = modelled.model_copy(update={"seed": seed, "n_frames": stage.scored[-1] + 1})
    taken = capture(seeded, camera, stage.truth, stage.calibrations, expose=partial(stage.expose, camera))
    on_bench, working = modelled.camera.with_nd(1.0), camera.with_nd(1.0)
    choices = tuple(stage.calibrations)
    knows = {m.name: stage.calibrations[seeded.choice_of(m)] for m in seeded.methods}
    blind = {name: registered_blind(taken[name], calibration) for name, calibration in knows.items()}
    back: Frames = {
        name: moved_back(taken[name], calibration, blind[name].registration)
        for name, calibration in knows.items()
    }
    known: dict[str, tuple[Frames, Calibrations]] = {
        "ideal": (taken, {each: ideal_calibration(on_bench, each.reading_px) for each in choices}),
        "calibrated": (taken, stage.calibrations),
        "blind": (back, stage.calibrations),
        "true": (taken, {each: true_calibration(working, each.reading_px) for each in choices}),
    }
    videos: dict[int, dict[tuple[str, str], Reconstruction]] = {index: {} for index in stage.scored}
    for operator, (shown, calibrations) in known.items():
        for decoded in decode(seeded, shown, calibrations, first=stage.scored[0]):
            for name, video in decoded.videos.items() if decoded.index in videos else ():
                videos[decoded.index][operator, name] = video
    tallies: dict[str, list[FrameTally]] = {operator: [] for operator in known}
    pictures: dict[str, Any] = {}
    for index, target in stage.targets.items():
        # The same pixels for all operators: else the one that knows least would choose its own.
        scored = np.logical_and.reduce([video.valid for video in videos[index].values()])
        slot = len(target.reference_w_m2) // 2
        pictures = {"truth": target.reference_w_m2[slot]}
        for (operator, name), video in videos[index].items():
            tally = stage.board.tally(name, video, target.reference_w_m2, target.moving, scored)
            tallies[operator].append(tally)
            pictures[f"{name} {operator}"] = video.irradiance_w_m2[slot]
    if keep_pictures:
        with (folder / PICTURES).open("wb") as stream:
            np.savez(stream, **pictures)
    write_result(
        folder,
        {"points_measured": 1},
        db=[
            [operator, *key, db]
            for operator, found in tallies.items()
            for key, db in pooled(stage.board, found, DB).items()
        ],
        registrations=[
            {"method": name, "seed": seed, **registration_row(found), **_planted(seeded)}
            for name, found in blind.items()
        ],
    )


def registration_row(found: Blind) -> dict[str, Any]:
    """Return a blind registration as a row of JSON."""
    row = asdict(found)
    return {**row.pop("registration"), **row}


def _planted(experiment: Experiment) -> dict[str, float]:
    """Return what moved the panel's image since the calibration, by the keys of a registration."""
    before, after = experiment.camera.relay, experiment.at_work().relay
    return {
        "true_shift_y_px": after.shift_y_px - before.shift_y_px,
        "true_shift_x_px": after.shift_x_px - before.shift_x_px,
        "true_rotation_rad": after.rotation_rad - before.rotation_rad,
    }
