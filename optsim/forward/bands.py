"""Bands of rows, one a core: compiled loops that leave Python alone run in them side by side."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")

CORES = os.cpu_count() or 1
# For fewer rows starting threads takes longer than the work.
_FEW = 64


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
    edges = [rows * band // CORES for band in range(CORES + 1)]
    side_by_side(lambda a=a, b=b: work(a, b) for a, b in pairwise(edges) if b > a)


def side_by_side(pieces: Iterable[Callable[[], T]]) -> list[T]:
    """Do pieces of work that don't wait for each other, as many at a time as there are cores."""
    work = list(pieces)
    if len(work) == 1:
        return [work[0]()]
    with ThreadPoolExecutor(CORES) as pool:
        return [done.result() for done in [pool.submit(piece) for piece in work]]
