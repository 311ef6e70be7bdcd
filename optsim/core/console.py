"""Terminal output: results go to stdout, progress bars and remarks to stderr."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Generator, Sequence
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars
from rich.table import Table

from optsim.core.progress import Progress

# Brackets and colons are part of names and paths here, never markup.
people = Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)
page = Console(highlight=False, soft_wrap=True, markup=False, emoji=False)
_EVERY_S = 10.0  # seconds between lines of a log


@contextlib.contextmanager
def progress_bars(quiet: bool = False) -> Generator[Progress, None, None]:
    """Yield progress as one bar a stage; without a terminal a line every ten seconds."""
    if not (quiet or people.is_terminal):
        yield _lines()
        return
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=people, disable=quiet) as bars:
        tasks: dict[str, Any] = {}

        def progress(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total)
            bars.update(tasks[stage], completed=done, total=total)

        yield progress


def _lines() -> Progress:
    said: dict[str, tuple[float, int]] = {}

    def progress(stage: str, done: int, total: int) -> None:
        when, before = said.get(stage, (-_EVERY_S, -1))
        if done != before and (done == total or time.monotonic() - when >= _EVERY_S):
            said[stage] = time.monotonic(), done
            people.print(f"{stage}: {done} of {total}")

    return progress


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> Table:
    """Make a table with numbers aligned right and words aligned left."""
    made = Table(title=title, title_justify="left", show_edge=False, pad_edge=False)
    for index, column in enumerate(columns):
        numeric = any(isinstance(row[index], int | float) for row in rows)
        # Folded, since a narrow page would cut words otherwise.
        made.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        made.add_row(*(_text(cell) for cell in row))
    return made


def _text(cell: object) -> str:
    if isinstance(cell, bool):
        return "yes" if cell else "no"
    if isinstance(cell, float):
        return f"{cell:.4g}"
    return "" if cell is None else str(cell)
