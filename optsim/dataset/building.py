"""Building a data set: a task a sequence, then manifest, card, contact sheet and README."""

from __future__ import annotations

import hashlib
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from optsim.core.cache import hash_of
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import CLAIM, read_record, write_json, write_text
from optsim.core.folder_claims import claimed_file
from optsim.core.progress import Progress, silent
from optsim.dataset.card import card, croissant, manifest_lines, readme
from optsim.dataset.consistency import consistency
from optsim.dataset.contact_sheet import write_contact_sheet
from optsim.dataset.filters import DROPPED, content, drop, lines, take_back
from optsim.dataset.reading import CARD, MANIFEST, Sample
from optsim.dataset.sequence import make_sequence
from optsim.dataset.spec import DatasetSpec, SequencePlan, check_spec
from optsim.experiment.resume import run_key
from optsim.experiment.run_folder import versions
from optsim.experiment.truth import renderer
from optsim.tasks import Outcome, Task, default_workers, run_tasks, task_record

Layout = Literal["exr", "npy"]
CHECKS = "checks.json"
_SPEC = "spec.json"
SHEET = "contact_sheet.png"


@dataclass(frozen=True)
class Forecast:
    """Time, disk and memory that a build will take, extrapolated from sequences already built.

    Parameters
    ----------
    sequences, to_do : int
        All sequences, and those still missing.
    workers : int
        Processes that do them.
    wall_s, disk_mb, peak_mb : float
        Time left, disk of the whole data set, memory of a worker.
    measured : int
        Sequences behind the forecast.
    """

    sequences: int
    to_do: int
    workers: int
    wall_s: float
    disk_mb: float
    peak_mb: float
    measured: int


def tasks_of(spec: DatasetSpec, layout: Layout = "exr") -> list[Task]:
    """List the tasks of a data set, one a sequence, each with a key of all that determines its files."""
    table, made_by = spec.model_dump(mode="json"), versions()
    wanted = list(spec.schemes), list(spec.seeds), spec.reconstruct, spec.half, layout
    tasks: list[Task] = []
    for sequence in spec.sequences():
        experiment = spec.experiment_of(sequence, spec.seeds[0])
        backend, _ = renderer(experiment, None)
        key = hash_of(run_key(experiment, backend, made_by), *wanted)
        tasks.append(Task(sequence.name, key, _make, (table, asdict(sequence), layout)))
    return tasks


def build_dataset(
    spec: DatasetSpec,
    folder: Path,
    *,
    layout: Layout = "exr",
    recipe: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    shard: tuple[int, int] = (1, 1),
    only: Sequence[str] = (),
    progress: Progress = silent,
) -> Outcome:
    """Build a data set, or continue a build.

    Parameters
    ----------
    spec : DatasetSpec
        The spec of the data set.
    folder : Path
        New, empty, or with a build of the same spec.
    layout : {"exr", "npy"}
        ``npy`` writes a memory-mapped array a pass beside the EXR files.
    recipe : bool
        Keep spec, card and the hash of each file, but not the files. With ``only`` any sequence can be made
        again, bit for bit on the same backend.
    workers, scheduler, shard
        As in :func:`optsim.tasks.run_tasks`. A build of several shards ends without a card; a build without
        shards then writes it.
    only : sequence of str
        Names of the sequences to make; all by default.
    progress : Progress
        Called after each sequence, as "tasks".

    Returns
    -------
    Outcome
        Sequences made, found and set aside. The card is written when none is missing.

    Raises
    ------
    ConfigError
        For an invalid spec.
    StorageError
        When the folder holds other files.
    """
    _own(folder, spec)
    _take_back(folder, spec)
    if recipe and not only and (folder / CARD).is_file() and read_record(folder / CARD)["recipe"]:
        # Its sequences are gone on purpose.
        return Outcome((), tuple(each.name for each in spec.sequences()), {})
    tasks = tasks_of(spec, layout)
    wanted = [task for task in tasks if not only or task.name in only]
    outcome = run_tasks(wanted, folder, workers=workers, scheduler=scheduler, shard=shard, progress=progress)
    if not only and all(task_record(folder, task) is not None for task in tasks):
        finish(spec, folder, layout, recipe=recipe)
    return outcome


def forecast(
    spec: DatasetSpec,
    folder: Path,
    *,
    workers: int | None = None,
    layout: Layout = "exr",
    progress: Progress = silent,
) -> Forecast:
    """Build two sequences of each scene, as a pilot, and estimate the time of the rest.

    The second measures a warm worker. The pilot is part of the build: nothing is made twice.
    """
    _own(folder, spec)
    workers = workers or default_workers()
    sequences, tasks = spec.sequences(), tasks_of(spec, layout)
    scene_of = {sequence.name: sequence.scene for sequence in sequences}
    pilots: list[Task] = []
    for scene in spec.scenes:
        pilots += [task for task in tasks if scene_of[task.name] == scene][:2]
    run_tasks(pilots, folder, workers=workers, progress=progress)
    seconds: dict[str, float] = {}
    sizes: dict[str, float] = {}
    peak_mb, to_do = 0.0, Counter(scene_of[task.name] for task in tasks if task_record(folder, task) is None)
    for task in pilots:
        record = task_record(folder, task)
        if record is not None:
            # The last one of a scene ran with everything compiled, loaded and calibrated.
            seconds[scene_of[task.name]] = record["seconds"]
            sizes[scene_of[task.name]] = sum(p.stat().st_size for p in (folder / task.name).rglob("*")) / 1e6
            peak_mb = max(peak_mb, record["peak_mb"])
    counts = Counter(scene_of.values())
    wall_s = sum(seconds[scene] * n for scene, n in to_do.items()) / max(1, min(workers, sum(to_do.values())))
    disk_mb = sum(sizes[scene] * n for scene, n in counts.items())
    return Forecast(len(tasks), sum(to_do.values()), workers, wall_s, disk_mb, peak_mb, len(pilots))


def finish(spec: DatasetSpec, folder: Path, layout: Layout, *, recipe: bool) -> None:
    """Drop what filters drop, and write manifest, contact sheet, card, Croissant metadata and README.

    All sequences must be there.

    Raises
    ------
    ConfigError
        When filters drop all of them.
    """
    found = {each.name: read_record(folder / each.name / CHECKS) for each in spec.sequences()}
    failed = {name: spec.filter.failed(numbers) for name, numbers in found.items()}
    filters = spec.filter.counts(found)
    sequences = [each for each in spec.sequences() if not failed[each.name]]
    if not sequences:
        raise ConfigError(
            f"filter: got no sequence inside ({'; '.join(lines(filters, len(found)))}), expected some; "
            f"cure: wider ranges (measured numbers: SEQUENCE/{CHECKS})"
        )
    for name, keys in failed.items():
        if keys:
            drop(folder / name, {key: found[name].get(key) for key in keys}, keep=CHECKS)
    checks = {each.name: found[each.name] for each in sequences}
    write_contact_sheet(folder / SHEET, [_sample(folder, spec, each) for each in sequences[:24]])
    listed = "".join(manifest_lines(folder, sequences))
    write_text(folder / MANIFEST, listed)
    digest = hashlib.sha256(listed.encode()).hexdigest()
    about = card(spec, sequences, checks, layout, digest, recipe=recipe, filters=filters)
    write_json(folder / "croissant.json", croissant(about))
    write_text(folder / "README.md", readme(about))
    if recipe:
        for name in found:
            shutil.rmtree(folder / name)
    # Last: its presence marks a complete data set.
    write_json(folder / CARD, about)


def _sample(folder: Path, spec: DatasetSpec, sequence: SequencePlan) -> Sample:
    seed = spec.seeds[0] if spec.schemes else None
    return Sample(folder / sequence.name, seed, {"name": sequence.name})


def _make(folder: Path, spec: Mapping[str, Any], sequence: Mapping[str, Any], layout: Layout) -> None:
    """Fill the folder of a sequence, in a worker."""
    make_sequence(folder, dict(spec), dict(sequence))
    if not (folder / CHECKS).is_file():
        write_json(folder / CHECKS, consistency(folder / "truth") | content(folder / "truth"))
    for hidden in folder.rglob(f"{CLAIM}*"):
        hidden.unlink(missing_ok=True)
    if layout == "npy":
        seeds = spec["seeds"] if spec["schemes"] else [None]
        for seed in seeds:
            sample = Sample(folder, seed, {"name": sequence["scene"]})
            for name in sample:
                path = sample.mapped(name)
                path.parent.mkdir(parents=True, exist_ok=True)
                np.save(path, sample[name])


def _own(folder: Path, spec: DatasetSpec) -> None:
    """Check a spec and write it into its folder, or refuse a folder of another one.

    Filters may change: they decide about what is made, not how. The card is then written anew.
    """
    check_spec(spec)
    table, path = spec.model_dump(mode="json"), folder / _SPEC
    with claimed_file(path):
        if not path.is_file():
            if any(not each.name.startswith(CLAIM) for each in folder.iterdir()):
                raise StorageError(
                    f"--out {folder}: got a folder that isn't empty and holds no build; cure: choose another"
                )
            write_json(path, table)
        elif (known := read_record(path)) != table:
            if {**known, "filter": None} != {**table, "filter": None}:
                raise StorageError(
                    f"--out {folder}: got a build of another spec ({path}), expected this one; "
                    "cure: choose another folder"
                )
            (folder / CARD).unlink(missing_ok=True)
            write_json(path, table)


def _take_back(folder: Path, spec: DatasetSpec) -> None:
    """Remove what is left of sequences that filters dropped and no longer do: they are made again."""
    for each in spec.sequences():
        place = folder / each.name
        if (place / DROPPED).is_file() and not spec.filter.failed(read_record(place / CHECKS)):
            take_back(place)
