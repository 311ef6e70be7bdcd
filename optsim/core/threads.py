# pyright: reportMissingTypeStubs=false
"""Threads: how many this run may use, and parallel work in them.

Compiled loops and FFTs release Python's lock, so threads are enough. Results never depend on their number.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

from threadpoolctl import threadpool_limits

from optsim.core.errors import ConfigError

T = TypeVar("T")

# Time and period of a control group's quota, microseconds: version 2 in one file, version 1 in two.
_QUOTAS = ("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us")


def usable_cores(groups: Path = Path("/sys/fs/cgroup")) -> int:
    """Cores that this process may use: ``$OPTSIM_THREADS``, else by affinity and container quota."""
    if chosen := os.environ.get("OPTSIM_THREADS", "").strip():
        if not chosen.isdecimal() or int(chosen) == 0:
            raise ConfigError(f"OPTSIM_THREADS: got {chosen!r}, expected a number of threads, for example 2")
        return int(chosen)
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    for files in _QUOTAS:
        # No such file or no number ("max", -1): no quota.
        with suppress(OSError, ValueError):
            time_us, period_us = map(float, " ".join((groups / name).read_text() for name in files).split())
            if time_us > 0 and period_us > 0:
                allowed = min(allowed, math.ceil(time_us / period_us))
    return max(allowed, 1)


CORES = usable_cores()
_alone: ContextVar[bool] = ContextVar("_alone", default=False)
# Below this many rows starting threads takes longer than the work.
_FEW = 64


@contextmanager
def one_thread() -> Generator[None]:
    """Use one thread only, here and in BLAS: for work so small that threads would wait for each other."""
    before = _alone.set(True)
    try:
        with threadpool_limits(1):
            yield
    finally:
        _alone.reset(before)


def n_threads() -> int:
    """Threads that work may use."""
    return 1 if _alone.get() else CORES


def in_bands(rows: int, work: Callable[[int, int], None], few: int = _FEW) -> None:
    """Call ``work(first, end)`` for bands that together cover all rows.

    Parameters
    ----------
    rows : int
        Rows to cover.
    work : callable
        Must release Python's lock to gain speed, and write to its own rows only. Then results do not depend
        on the number of cores.
    few : int
        Fewer rows than these are not divided.
    """
    if rows < few:
        work(0, rows)
        return
    n = n_threads()
    edges = [rows * band // n for band in range(n + 1)]
    side_by_side(lambda a=a, b=b: work(a, b) for a, b in pairwise(edges) if b > a)


def side_by_side(pieces: Iterable[Callable[[], T]]) -> list[T]:
    """Run independent pieces of work, as many at a time as there are cores.

    Nested pieces run one after the other.
    """
    work = list(pieces)
    if len(work) == 1 or n_threads() == 1:
        return [piece() for piece in work]
    with ThreadPoolExecutor(CORES, initializer=_alone.set, initargs=(True,)) as pool:
        return [done.result() for done in [pool.submit(piece) for piece in work]]
