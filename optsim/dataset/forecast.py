"""Time, disk and memory that a build will take, by the records of the sequences already made."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.progress import Progress, silent
from optsim.core.threads import CORES
from optsim.dataset.building import Layout, own, tasks_of
from optsim.dataset.spec import DatasetSpec
from optsim.tasks import run_tasks, task_record

# Sequences of a scene that are measured: the second finds everything compiled, loaded and calibrated.
_PILOTS = 2


@dataclass(frozen=True)
class Forecast:
    """Core-seconds left, and those of them that can't use a second core; disk of all, memory of a worker.

    They follow from ``measured`` of all ``sequences``. ``failed`` maps pilots to what went wrong.
    """

    sequences: int
    to_do: int
    core_s: float
    serial_s: float
    disk_mb: float
    peak_mb: float
    measured: int
    failed: dict[str, str] = field(default_factory=dict[str, str])

    def wall_s(self, workers: int, cores: int = CORES) -> float:
        """Time left with this many workers on this many cores, which they share evenly."""
        busy = max(1, min(workers, self.to_do, max(cores, 1)))
        return (self.serial_s + (self.core_s - self.serial_s) / max(1, cores // busy)) / busy


def forecast(
    spec: DatasetSpec,
    folder: Path,
    *,
    workers: int | None = None,
    layout: Layout = "exr",
    progress: Progress = silent,
) -> Forecast:
    """Estimate what the rest of a build takes, from at least two sequences of each scene.

    Where fewer are made yet, they are made now, as part of the build: nothing is made twice.
    """
    spec, sources = own(folder, spec)
    tasks = tasks_of(spec, folder, layout, sources)
    by_scene: dict[str, list[Any]] = defaultdict(list)
    for task, sequence in zip(tasks, spec.sequences(), strict=True):
        by_scene[sequence.scene].append(task)
    pilots: list[Any] = []
    for listed in by_scene.values():
        missing = [task for task in listed if task_record(folder, task) is None]
        pilots += missing[: max(0, _PILOTS - (len(listed) - len(missing)))]
    failed = run_tasks(pilots, folder, workers=workers, progress=progress).failed if pilots else {}
    to_do = measured = 0
    core_s = serial_s = disk_mb = peak_mb = 0.0
    for listed in by_scene.values():
        records = [record for task in listed if (record := task_record(folder, task)) is not None]
        measured, to_do = measured + len(records), to_do + len(listed) - len(records)
        if records:
            # The slowest one waited for compiling and calibration.
            warm = sorted(records, key=lambda record: record["core_s"])[: max(1, len(records) - 1)]
            left = len(listed) - len(records)
            core_s += left * float(np.mean([record["core_s"] for record in warm]))
            serial_s += left * float(np.mean([_serial_s(record) for record in warm]))
            disk_mb += len(listed) * float(np.mean([record["disk_mb"] for record in records]))
            peak_mb = max(peak_mb, *(record["peak_mb"] for record in records))
    return Forecast(len(tasks), to_do, core_s, serial_s, disk_mb, peak_mb, measured, failed)


def _serial_s(record: dict[str, Any]) -> float:
    """Time that a sequence spends on one core, whatever its threads; all of it where it had one thread."""
    core_s, threads = record["core_s"], record["threads"]
    if threads == 1:
        return core_s
    return float(np.clip((threads * record["seconds"] - core_s) / (threads - 1), 0, core_s))
