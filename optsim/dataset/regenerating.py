"""Making sequences of a data set again, from the set alone, and comparing them with its manifest."""

from __future__ import annotations

import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from optsim.core.config import build
from optsim.core.errors import unknown_name
from optsim.core.files import atomic, content_hash, writable_folder
from optsim.core.progress import Progress, silent
from optsim.dataset.building import tasks_of
from optsim.dataset.reading import CARD, Dataset, manifest
from optsim.dataset.spec import DatasetSpec
from optsim.experiment.run_folder import versions
from optsim.tasks import run_tasks


def regenerate(
    dataset: Dataset, names: Sequence[str], progress: Progress = silent
) -> tuple[dict[str, str], int]:
    """Make sequences again beside the set; return what differs, and files put back into whole ones."""
    known = [sequence["name"] for sequence in dataset.card["sequences"]]
    for name in names:
        if name not in known:
            raise unknown_name("sequence", name, known)
    folder, card = dataset.folder.absolute(), dataset.card
    spec = build(DatasetSpec, card["spec"], where=CARD)
    tasks = tasks_of(spec, folder, card["layout"], card.get("sources", {}))
    listed = {record["path"]: record["sha256"] for record in manifest(folder)}
    writable_folder(folder.parent, "sequences made again", "make it writable")
    restored, problems = 0, dict[str, str]()
    with TemporaryDirectory(prefix=f".{folder.name}-again-", dir=folder.parent) as scratch:
        root = Path(scratch) / "set"
        with _cache(Path(scratch) / "cache"):
            outcome = run_tasks([task for task in tasks if task.name in names], root, progress=progress)
        for name in (*outcome.made, *outcome.failed):
            wanted = {place: sha256 for place, sha256 in listed.items() if place.startswith(f"{name}/")}
            files = [path for path in (root / name).rglob("*") if path.is_file()]
            made = {path.relative_to(root).as_posix(): content_hash(path) for path in files}
            differ = sorted(place for place in wanted | made if wanted.get(place) != made.get(place))
            if name in outcome.failed or differ:
                problems[name] = outcome.failed.get(name) or _said(differ, len(wanted), card["versions"])
                continue
            for place in wanted:
                own = folder / place
                if not own.is_file() or content_hash(own) != made[place]:
                    with atomic(own) as part:
                        part.write_bytes((root / place).read_bytes())
                    restored += 1
    return problems, restored


def _said(differ: Sequence[str], n: int, was: dict[str, str]) -> str:
    """Say which files differ, and which versions do."""
    now = versions()
    others = [f"{each} was {was.get(each)} and is {now[each]}" for each in now if was.get(each) != now[each]]
    why = f"; {', '.join(others)}" if others else "; versions are the same: another backend, or other code"
    files = ", ".join(differ[:3]) + (", ..." if len(differ) > 3 else "")
    return f"{len(differ)} files are not as in the manifest, which has {n}: {files}{why}"


@contextmanager
def _cache(folder: Path) -> Generator[None]:
    """Let workers keep renders in another folder: a render found again proves nothing."""
    before = os.environ.get("OPTSIM_CACHE")
    os.environ["OPTSIM_CACHE"] = str(folder)
    try:
        yield
    finally:
        del os.environ["OPTSIM_CACHE"]
        if before is not None:
            os.environ["OPTSIM_CACHE"] = before
