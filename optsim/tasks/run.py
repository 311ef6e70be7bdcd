# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Many tasks, side by side: workers of this machine, or of a scheduler that is already there.

A task whose folder is there is done, so the same call goes on after a stop. A worker that dies is replaced.
A task that failed three times is put aside, and the rest goes on.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from uuid import uuid4

from optsim.core.errors import ConfigError, OptsimError
from optsim.core.memory import keep_freed_memory
from optsim.core.progress import Progress, silent
from optsim.core.threads import CORES
from optsim.tasks.cluster import read_cluster, running
from optsim.tasks.folder import Task, make_folder, task_record

ATTEMPTS = 3
# Memory that a worker may need: a sequence of the demo's camera peaks at 1.2 GB.
_WORKER_BYTES = 2_000_000_000
# Waiting for a scheduler that may not be there, s.
_PATIENCE_S = 10
_TELL_EVERY_S = 2.0
_listener: ContextVar[Progress] = ContextVar("_listener", default=silent)


@dataclass(frozen=True)
class Outcome:
    """How a list of tasks ended.

    Parameters
    ----------
    made, found : tuple of str
        Names of the tasks done now, and of those that were done before.
    failed : dict
        Name -> what went wrong, of the tasks put aside.
    """

    made: tuple[str, ...]
    found: tuple[str, ...]
    failed: dict[str, str]


def default_workers() -> int:
    """Return one process a core, as far as memory allows: much of a task runs on one core."""
    from distributed.system import MEMORY_LIMIT

    return max(1, min(CORES, MEMORY_LIMIT // _WORKER_BYTES))


def run_tasks(
    tasks: Sequence[Task],
    root: Path,
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    shard: tuple[int, int] = (1, 1),
    progress: Progress = silent,
) -> Outcome:
    """Do all tasks of a list that aren't done yet.

    Parameters
    ----------
    tasks : sequence of Task
        Names must differ.
    root : Path
        Folder below which they make theirs; workers of a cluster must see it under the same name.
    workers : int, optional
        Processes on this machine, by default :func:`default_workers`.
    scheduler : str, optional
        Address of a dask scheduler, ``tcp://host:port``, whose workers are used instead; or a TOML file with
        a ``[cluster]`` table (:class:`optsim.tasks.cluster.Cluster`), whose jobs are the workers.
    shard : tuple of int
        (i, n): the i-th of n parts of the list, counted from 1: for job arrays without a scheduler.
    progress : Progress
        Told of each finished task, as "tasks", and of stages inside those at work (:func:`tell`), summed.

    Raises
    ------
    ConfigError
        For names that agree, a shard out of range, or a scheduler that doesn't answer.
    StorageError
        When a folder was made from something else.
    """
    names = [task.name for task in tasks]
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ConfigError(f"tasks: got {', '.join(twice)} more than once, expected names that differ")
    part, parts = shard
    if not 1 <= part <= parts:
        raise ConfigError(f"--shard: got {part}/{parts}, expected I/N with I from 1 to N, for example 1/4")
    own = tasks[part - 1 :: parts]
    open_tasks = [task for task in own if task_record(root, task) is None]
    found = [task.name for task in own if task not in open_tasks]
    made, failed = list[str](), dict[str, str]()
    progress("tasks", len(found), len(own))
    if open_tasks:
        with _client(workers or default_workers(), len(open_tasks), scheduler) as client:
            for name, state, error in _results(client, open_tasks, root, progress):
                if error:
                    failed[name] = error
                else:
                    (made if state == "made" else found).append(name)
                progress("tasks", len(found) + len(made) + len(failed), len(own))
    return Outcome(tuple(made), tuple(found), failed)


def tell(stage: str, done: int, total: int) -> None:
    """Report progress from inside a task to the process that waits for it."""
    _listener.get()(stage, done, total)


def _results(
    client: Any, tasks: Sequence[Task], root: Path, progress: Progress
) -> Generator[tuple[str, str, str]]:
    """Yield (name, state, error) of each task as it ends."""
    from distributed import as_completed

    stages: dict[str, dict[str, tuple[int, int]]] = {}
    ended, topic = set[str](), f"optsim {uuid4()}"

    def heard(event: tuple[float, tuple[str, str, int, int]]) -> None:
        name, stage, done, total = event[1]
        # What is said last may arrive after the end.
        at_work = {key: n for key, n in stages.get(stage, {}).items() if key not in ended} | {
            name: (done, total)
        }
        stages[stage] = at_work
        progress(stage, sum(n for n, _ in at_work.values()), sum(n for _, n in at_work.values()))

    client.subscribe_topic(topic, heard)
    futures = {
        client.submit(_attempt, root.absolute(), task, topic, pure=False, retries=ATTEMPTS - 1): task.name
        for task in tasks
    }
    for future in as_completed(futures):
        name = futures[future]
        ended.add(name)
        if future.status == "finished":
            yield name, *future.result()
        else:
            yield name, "", _why(future.exception())


def _why(error: BaseException) -> str:
    """Say in a line why a task was put aside."""
    from distributed.scheduler import KilledWorker

    if isinstance(error, KilledWorker):
        return f"{ATTEMPTS} workers died at it: killed, or out of memory; cure: fewer --workers"
    return f"{type(error).__name__}: {error}".splitlines()[0]


def _attempt(root: Path, task: Task, topic: str) -> tuple[str, str]:
    """Do a task in a worker; what the user can mend is not tried again."""
    from distributed import get_worker

    keep_freed_memory()
    worker, said_s = get_worker(), dict[str, float]()

    def listener(stage: str, done: int, total: int) -> None:
        if done == total or time.monotonic() - said_s.get(stage, 0.0) > _TELL_EVERY_S:
            said_s[stage] = time.monotonic()
            worker.log_event(topic, (task.name, stage, done, total))

    before = _listener.set(listener)
    try:
        return make_folder(root, task), ""
    except OptsimError as error:
        return "", str(error)
    finally:
        _listener.reset(before)


@contextmanager
def _client(workers: int, n_tasks: int, scheduler: str | None) -> Generator[Any]:
    """Connect to workers: to a scheduler's, or to new ones, which end with the block."""
    from dask import config
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    if scheduler is not None and scheduler.endswith(".toml"):
        with running(read_cluster(Path(scheduler)), n_tasks) as jobs, Client(jobs) as client:
            yield client
        return
    if scheduler is not None:
        try:
            client = Client(scheduler, timeout=_PATIENCE_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise ConfigError(
                f"--scheduler: got {scheduler!r}, where no dask scheduler answers ({error}); expected "
                "tcp://host:port; cure: start 'dask scheduler' there, or leave it out to work on this machine"
            ) from None
        with client:
            yield client
        return
    settings = {
        # A task is put aside when its third worker died; no other task waits on a worker that may die.
        "distributed.scheduler.allowed-failures": ATTEMPTS - 1,
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.logging.distributed": "critical",
    }
    workers = min(workers, n_tasks)
    environment = {"OPTSIM_THREADS": str(max(1, CORES // workers)), "PYTHONWARNINGS": "ignore"}
    with (
        config.set(settings),
        TemporaryDirectory(prefix="optsim-") as scratch,
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",
            host="127.0.0.1",
            local_directory=scratch,
            env={**environment, "PYTHONPATH": os.environ.get("PYTHONPATH", "")},
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client
