# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""Bands of rows, one a core: compiled loops that leave Python alone run in them side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from typing import TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")

CORES = os.cpu_count() or 1
_alone: ContextVar[bool] = ContextVar("_alone", default=False)
# For fewer rows starting threads takes longer than the work.
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
        Must let go of Python's lock to gain anything, and write to its own rows only: then results do
        not depend on the number of cores.
    few : int
        Fewer rows than these stay together.
    """
    if rows < few:
        work(0, rows)
        return
    n = n_threads()
    edges = [rows * band // n for band in range(n + 1)]
    side_by_side(lambda a=a, b=b: work(a, b) for a, b in pairwise(edges) if b > a)


def side_by_side(pieces: Iterable[Callable[[], T]]) -> list[T]:
    """Do pieces of work that don't wait for each other, as many at a time as there are cores.

    A piece that itself has pieces does them one after the other.
    """
    work = list(pieces)
    if len(work) == 1 or n_threads() == 1:
        return [piece() for piece in work]
    with ThreadPoolExecutor(CORES, initializer=_alone.set, initargs=(True,)) as pool:
        return [done.result() for done in [pool.submit(piece) for piece in work]]
