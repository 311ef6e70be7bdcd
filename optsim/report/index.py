"""One page for several runs: a row a run, and the history of each experiment's scores."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from optsim.core.files import write_text
from optsim.metrics.records import Phase
from optsim.report import headline, plots, verdict, words
from optsim.report.html import flat, page_environment
from optsim.report.schema import Picture, Results

_MOST_CHANGES = 4


@dataclass(frozen=True)
class Entry:
    """One run on the page: its address from there, and its verdict everywhere."""

    link: str
    stills: list[Picture]
    results: Results
    phase: Phase
    line: verdict.Line
    halves: dict[str, str]
    changes: str

    @property
    def label(self) -> str:
        """Commit, or the date for runs without one."""
        return self.results.commit or self.results.finished_utc[:10]

    def value(self, method: str) -> float | None:
        """Score of a method everywhere; None where the run lacks it."""
        return _value(self.line.row, self.line.row.metric, method)


def write_index(path: Path, runs: Sequence[tuple[Path, Results]]) -> Path:
    """Write the page.

    Parameters
    ----------
    path : Path
        The page; links to the runs are relative to its folder.
    runs : sequence of (Path, Results)
        Run folders with their records, in any order.

    Returns
    -------
    Path
        The page.
    """
    ordered = sorted(runs, key=lambda run: run[1].finished_utc)
    titles = dict.fromkeys(results.title for _, results in ordered)
    groups = [(title, _entries(path, [run for run in ordered if run[1].title == title])) for title in titles]
    context = {
        "groups": [(title, entries, _histories(entries)) for title, entries in groups if entries],
        "unscored": [folder.name for folder, results in ordered if not headline.phases_reached(results)],
        "style_of": headline.style_of,
        "n_runs": len(ordered),
    }
    write_text(path, page_environment().get_template("index.html.j2").render(**context))
    return path


def _entries(path: Path, runs: Sequence[tuple[Path, Results]]) -> list[Entry]:
    """List the runs of one experiment that have scores, oldest first."""
    found: list[Entry] = []
    before: Results | None = None
    for folder, results in runs:
        phases = headline.phases_reached(results)
        lines = verdict.verdict(results, phases[0]) if phases else []
        if not lines:
            continue
        row = lines[0].row
        halves = {
            score.method: words.plus_minus(score.half, row.unit) for score in row.scores if score is not None
        }
        link = quote(os.path.relpath(folder.resolve(), path.resolve().parent))
        stills = [p for p in results.pictures if p.section == "compare"]
        changes = _changes(before, results) if before else ""
        found.append(Entry(link, stills, results, phases[0], lines[0], halves, changes))
        before = results
    return found


def _changes(before: Results, after: Results) -> str:
    """Name the settings that differ from the run before, with their new values."""
    old, new = dict(flat(before.experiment)), dict(flat(after.experiment))
    changed = [f"{key} = {new.get(key, '–')}" for key in {**old, **new} if old.get(key) != new.get(key)]
    more = len(changed) - _MOST_CHANGES
    return "; ".join(changed[:_MOST_CHANGES]) + (f"; {more} more" if more > 0 else "")


def _histories(entries: Sequence[Entry]) -> list[tuple[str, str, object]]:
    """One plot a headline metric: metric, region in words, and the score of each method run by run."""
    if len(entries) < 2:
        return []
    methods = list(dict.fromkeys(name for entry in entries for name in entry.results.methods))
    rows = [{row.region: row for row in headline.headline_rows(e.results, e.phase)} for e in entries]
    found: list[tuple[str, str, object]] = []
    for row in rows[-1].values():
        lines: list[plots.Line] = []
        for name in methods:
            values = [_value(of_run.get(row.region), row.metric, name) for of_run in rows]
            lines.append((name, headline.style_of(methods, name), list(range(len(entries))), values))
        plot = plots.line_plot(
            lines,
            title=f"{row.metric} of each run",
            x_label="run",
            y_label=row.unit,
            ticks=[(place, entry.label) for place, entry in enumerate(entries)],
        )
        found.append((row.metric, row.where, plot))
    return found


def _value(row: headline.Row | None, metric: str, method: str) -> float | None:
    """Score of a method in a run; None where the run has none of this metric."""
    if row is None or row.metric != metric:
        return None
    return next((s.value for s in row.scores if s is not None and s.method == method), None)
