"""Building a data set: a task a sequence, then manifest, card, contact sheet and README."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np

from optsim.core.cache import hash_of
from optsim.core.code_hash import hash_files
from optsim.core.config import Table
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import CLAIM, atomic, content_hash, read_record, write_json, write_text
from optsim.core.folder_claims import claimed_file
from optsim.core.progress import Progress, silent
from optsim.dataset.card import card, croissant, manifest_lines, readme
from optsim.dataset.consistency import consistency
from optsim.dataset.contact_sheet import write_contact_sheet, write_histograms
from optsim.dataset.filters import DROPPED, content, drop, lines, take_back
from optsim.dataset.reading import ARRAYS, CARD, MANIFEST, Dataset, Sample
from optsim.dataset.sequence import make_sequence
from optsim.dataset.sources import bundled, carry, check_sources, hashes, inside
from optsim.dataset.spec import DatasetSpec, check_spec
from optsim.dataset.verify import statistics
from optsim.experiment.run_folder import libraries
from optsim.experiment.truth import renderer
from optsim.tasks import Outcome, Task, run_tasks, task_record

Layout = Literal["exr", "npy"]
CHECKS = "checks.json"
_SPEC = "spec.json"
SHEET, HISTOGRAMS = "contact_sheet.png", "histograms.png"


def tasks_of(spec: DatasetSpec, folder: Path, layout: Layout, sources: Mapping[str, str]) -> list[Task]:
    """List the tasks of a set, one a sequence, each with a key of all that determines its files."""
    check_sources(folder, sources)
    table: Table = spec.model_dump(mode="json") | {"split": {}, "filter": {}}
    tasks, root = list[Task](), str(folder.absolute())
    whole = hash_of(hash_files(["optsim/**/*.py", "optsim/**/*.npz"]), libraries(), dict(sources), layout)
    backends: dict[str, str] = {}
    with inside(folder):
        for sequence in spec.sequences():
            if sequence.scene not in backends:
                experiment = spec.experiment_of(sequence, spec.seeds[0])
                backends[sequence.scene] = renderer(experiment)[0]
            # Of a long list each worker gets its own part.
            own = table | {"scenes": {sequence.scene: [sequence.variation]}}
            key = hash_of(whole, backends[sequence.scene], own, asdict(sequence))
            tasks.append(Task(sequence.name, key, _make, (root, own, asdict(sequence), layout)))
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
        Keep sources, card and the hash of each file, but not the files: :func:`regenerate` makes them again.
    workers, scheduler, shard
        As in :func:`optsim.tasks.run_tasks`. A build of several shards ends without a card; a build without
        shards then writes it.
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
    spec, sources = own(folder, spec)
    _take_back(folder, spec)
    if recipe and (folder / CARD).is_file() and read_record(folder / CARD)["recipe"]:
        # Its sequences are gone on purpose.
        return Outcome((), tuple(each.name for each in spec.sequences()), {})
    tasks = tasks_of(spec, folder, layout, sources)
    outcome = run_tasks(tasks, folder, workers=workers, scheduler=scheduler, shard=shard, progress=progress)
    if all(task_record(folder, task) is not None for task in tasks):
        finish(spec, folder, layout, recipe=recipe, sources=sources)
    return outcome


def finish(
    spec: DatasetSpec, folder: Path, layout: Layout, *, recipe: bool, sources: Mapping[str, str] | None = None
) -> None:
    """Drop what filters drop, and write all documents of a set whose sequences are all there."""
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
    seed = spec.seeds[0] if spec.schemes else None
    shown = [Sample(folder / each.name, seed, {"name": each.name}) for each in sequences[:24]]
    write_contact_sheet(folder / SHEET, shown)
    listed = "".join(manifest_lines(folder, sequences))
    write_text(folder / MANIFEST, listed)
    digest = hashlib.sha256(listed.encode()).hexdigest()
    with inside(folder):
        about = card(spec, sequences, checks, layout, digest, recipe=recipe, filters=filters)
    about["statistics"] = statistics(Dataset(folder, about))
    write_histograms(folder / HISTOGRAMS, about["statistics"])
    write_json(folder / "croissant.json", croissant(about))
    write_text(folder / "README.md", readme(about))
    about["sources"] = dict(sources or {})
    documents = [folder / each for each in (_SPEC, SHEET, HISTOGRAMS, "croissant.json", "README.md")]
    if not recipe:
        documents += [folder / name / each for name in failed if failed[name] for each in (CHECKS, DROPPED)]
    there = [path for path in documents if path.is_file()]
    about["documents"] = {path.relative_to(folder).as_posix(): content_hash(path) for path in there}
    if recipe:
        for name in found:
            shutil.rmtree(folder / name)
    # Last: its presence marks a complete data set.
    write_json(folder / CARD, about)


def _make(
    folder: Path, root: str, spec: Mapping[str, Any], sequence: Mapping[str, Any], layout: Layout
) -> None:
    """Fill the folder of a sequence, in a worker; the spec's paths start at ``root``."""
    with inside(Path(root)):
        make_sequence(folder, dict(spec), dict(sequence))
    if not (folder / CHECKS).is_file():
        write_json(folder / CHECKS, consistency(folder / "truth") | content(folder / "truth"))
    for hidden in folder.rglob(f"{CLAIM}*"):
        hidden.unlink(missing_ok=True)
    # Of an attempt that was stopped: an array must not be read from the file it is written to.
    shutil.rmtree(folder / ARRAYS, ignore_errors=True)
    if layout == "npy":
        seeds = spec["seeds"] if spec["schemes"] else [None]
        for seed in seeds:
            sample = Sample(folder, seed, {"name": sequence["scene"]})
            for name in sample:
                # Seeds share their truth.
                if not (path := sample.mapped(name)).is_file():
                    with atomic(path) as part:
                        np.save(part, sample[name])


def own(folder: Path, spec: DatasetSpec) -> tuple[DatasetSpec, dict[str, str]]:
    """Write a spec into its folder with its sources, whose hashes follow; refuse another's folder."""
    check_spec(spec)
    spec, files = bundled(spec, folder)
    sources, path = hashes(files), folder / _SPEC
    table = spec.model_dump(mode="json") | {"sources": sources}
    with claimed_file(path):
        if not path.is_file():
            if any(not each.name.startswith(CLAIM) for each in folder.iterdir()):
                raise StorageError(
                    f"--out {folder}: got a folder that isn't empty and holds no build; cure: choose another"
                )
            write_json(path, table)
        elif (known := read_record(path)) != table:
            was: dict[str, str] = known.get("sources", {})
            # Filters may change: they decide about what is made, not how.
            free = {"filter": None, "sources": None}
            if {**known, **free} != {**table, **free}:
                raise StorageError(
                    f"--out {folder}: got a build of another spec ({path}), expected this one; "
                    "cure: choose another folder"
                )
            if changed := sorted(place for place in {*was, *sources} if was.get(place) != sources.get(place)):
                raise StorageError(
                    f"--out {folder}: got a build in which {changed[0]} was another file, expected the same; "
                    "cure: put it back, or choose another folder"
                )
            (folder / CARD).unlink(missing_ok=True)
            write_json(path, table)
        carry(files, folder)
    return spec, sources


def _take_back(folder: Path, spec: DatasetSpec) -> None:
    """Remove what is left of sequences that filters dropped and no longer do: they are made again."""
    for each in spec.sequences():
        place = folder / each.name
        if (place / DROPPED).is_file() and not spec.filter.failed(read_record(place / CHECKS)):
            take_back(place)
