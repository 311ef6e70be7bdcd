"""One task makes one folder: whole and under its name, or not there."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optsim.core.errors import StorageError
from optsim.core.files import read_record, write_json
from optsim.core.folder_claims import claimed_file
from optsim.core.threads import CORES

RECORDS = ".tasks"
"""Folder below the root with a record of each finished task."""


@dataclass(frozen=True)
class Task:
    """A piece of work that makes one folder.

    Parameters
    ----------
    name : str
        Place of the folder below the root, with ``/`` between parts.
    key : str
        Hash of everything that decides what is in it: a folder of another key is refused.
    make : callable
        Called with the folder to fill and the arguments; a function of a module, so that workers find it.
        It may find the files of an attempt that was stopped, and go on with them.
    arguments : tuple
        Further arguments; they travel to the worker by pickle.
    """

    name: str
    key: str
    make: Callable[..., None]
    arguments: tuple[Any, ...] = ()


def task_record(root: Path, task: Task) -> dict[str, Any] | None:
    """Return the record of a finished task, None while it isn't done.

    Returns
    -------
    dict or None
        ``key``; ``seconds`` of wall time by ``threads``, ``core_s`` of all of them; ``disk_mb``, and
        ``peak_mb`` of memory.

    Raises
    ------
    StorageError
        When the folder was made by a task of another key.
    """
    place = root / task.name
    if not place.exists():
        return None
    record: dict[str, Any] = {}
    with suppress(StorageError):
        record = read_record(_record_path(root, task))
    if record.get("key") != task.key:
        raise StorageError(
            f"{place}: got a folder made from something else (settings, files or versions differ), expected "
            "one of this list; cure: choose another --out, or remove the folder"
        )
    return record


def make_folder(root: Path, task: Task) -> str:
    """Do a task unless it is done, ``made`` or ``found``; refuse a folder of another key, or at work."""
    place = root / task.name
    part = place.with_name(f".{place.name}.part")
    with claimed_file(place):
        if task_record(root, task) is not None:
            return "found"
        part.mkdir(exist_ok=True)
        start, core_start = time.perf_counter(), time.process_time()
        task.make(part, *task.arguments)
        record = {
            "key": task.key,
            "seconds": time.perf_counter() - start,
            "core_s": time.process_time() - core_start,
            "threads": CORES,
            "disk_mb": sum(path.stat().st_size for path in part.rglob("*") if path.is_file()) / 1e6,
            "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        }
        # The record first: without its folder it says nothing.
        write_json(_record_path(root, task), record)
        part.rename(place)
    return "made"


def _record_path(root: Path, task: Task) -> Path:
    return root / RECORDS / f"{task.name.replace('/', '__')}.json"
