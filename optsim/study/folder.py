"""The folder of a study: its tasks, its table as JSON and CSV, and whose it is."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from optsim.core.cache import hash_of
from optsim.core.errors import StorageError
from optsim.core.files import CLAIM, read_json, read_record, write_json, write_text
from optsim.core.folder_claims import claimed
from optsim.core.progress import Progress, silent
from optsim.experiment import job
from optsim.experiment.calibrations import calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import planned
from optsim.experiment.resume import run_key
from optsim.experiment.run_folder import versions
from optsim.experiment.truth import render_truth
from optsim.study.comparison import add_work
from optsim.study.stage import scored_part
from optsim.tasks import Task, run_tasks

STUDY = "study.json"
"""The table of a finished study."""
POINTS = "points.csv"
PAGE = "study.html"
RESULT = "result.json"
"""In the folder of each task: rows, and counts of what was computed."""
_PLAN = "plan.json"
_FORMAT = "optsim study 1"


@dataclass(frozen=True)
class Workplace:
    """Where a study is computed.

    Parameters
    ----------
    folder : Path
        New, empty, or with the same study, which goes on.
    workers, scheduler
        As of :func:`optsim.tasks.run_tasks`.
    command : str
        The command line, for the record.
    """

    folder: Path
    workers: int | None = None
    scheduler: str | None = None
    command: str = ""


@dataclass(frozen=True)
class StudyTask:
    """A task of a study: its name, what it does, and the arguments after folder and experiment."""

    name: str
    make: Callable[..., None]
    arguments: tuple[Any, ...]


def chosen_methods(experiment: Experiment, names: Sequence[str]) -> Experiment:
    """Keep some methods of an experiment; all without names.

    Raises
    ------
    ConfigError
        For a name that is none of them.
    """
    chosen = experiment.only(names) if names else experiment
    return chosen.model_copy(update={"save_reconstructions": ()})


def compute(
    kind: str,
    base: Experiment,
    plan: dict[str, Any],
    wanted: Sequence[StudyTask],
    place: Workplace,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Do all tasks of a study that aren't done yet, and return its record without what is read from it."""
    start = time.perf_counter()
    # What is scored needs no later frames.
    part = scored_part(base, plan["frames"])
    job.check(part, place.folder, None)
    with claimed(place.folder):
        _own(place.folder, {"format": _FORMAT, "kind": kind, "plan": plan, "experiment": _table(base)})
        # Once, here: the workers find it.
        render_truth(part, progress=progress)
        progress("laboratory", 0, 1)
        calibrate_all(planned(part)[0])
        progress("laboratory", 1, 1)
        text, key = part.model_dump_json(), run_key(part, versions())
        tasks = [
            Task(each.name, hash_of(key, kind, each.arguments), each.make, (text, *each.arguments))
            for each in wanted
        ]
        outcome = run_tasks(
            tasks, place.folder, workers=place.workers, scheduler=place.scheduler, progress=progress
        )
    work: dict[str, int] = {}
    results: dict[str, Any] = {}
    for task in tasks:
        if task.name not in outcome.failed:
            results[task.name] = read_json(place.folder / task.name / RESULT)
            if task.name in outcome.made:
                add_work(work, results[task.name]["work"])
    return {
        "format": _FORMAT,
        "kind": kind,
        "experiment": _table(base),
        "plan": plan,
        "command": place.command,
        "finished_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "seconds": time.perf_counter() - start,
        "work": {**work, "tasks_done_before": len(outcome.found)},
        "put_aside": outcome.failed,
        "results": results,
    }


def write_result(folder: Path, work: dict[str, int], **found: Any) -> None:
    """Write what a task found, in a worker."""
    write_json(folder / RESULT, {**found, "work": work})


def write_table(folder: Path, record: dict[str, Any], rows: Sequence[dict[str, Any]]) -> None:
    """Write study.json, and its rows as CSV."""
    heads = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, heads, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(folder / POINTS, text.getvalue())
    # Last: its presence marks a finished study.
    write_json(folder / STUDY, {**record, "rows": list(rows)})


def read_study(path: Path, kind: str) -> dict[str, Any]:
    """Read the record of a finished study of a kind, from its file or its folder."""
    file = path / STUDY if path.is_dir() else path
    record = read_record(file)
    if record.get("format") != _FORMAT or record.get("kind") != kind:
        raise StorageError(
            f"{file}: got no finished {kind} study, expected the study.json that 'optsim {kind}' writes"
        )
    return record


def _table(base: Experiment) -> dict[str, Any]:
    return base.model_dump(mode="json")


def _own(folder: Path, plan: dict[str, Any]) -> None:
    """Write whose folder it is, or refuse a folder of another study."""
    path = folder / _PLAN
    if path.is_file():
        # As JSON has it: tuples are lists.
        if read_record(path) != json.loads(json.dumps(plan)):
            raise StorageError(
                f"--out {folder}: got another study ({path}), expected this one; cure: choose another folder"
            )
    elif any(not each.name.startswith(CLAIM) for each in folder.iterdir()):
        raise StorageError(
            f"--out {folder}: got a folder that isn't empty and holds no study; cure: choose another"
        )
    else:
        write_json(path, plan)
