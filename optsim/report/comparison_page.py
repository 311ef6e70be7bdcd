"""The folder of a comparison: page, JSON, Markdown, JUnit XML, and the pictures of what failed."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from optsim.core.files import read_record, write_json, write_text
from optsim.report.baseline import run_folders
from optsim.report.comparison import ALL_CASES, Comparison, Kept
from optsim.report.comparison_text import (
    COLUMNS,
    as_junit,
    as_markdown,
    cells,
    detectable_lines,
    headline,
    ranked,
    shown,
)
from optsim.report.html import page_environment
from optsim.report.schema import RESULTS, Results, check_results

_MOST_PICTURES = 60


def write_comparison(folder: Path, found: Comparison, places: Mapping[str, Path]) -> Path:
    """Write page, JSON, Markdown, JUnit XML and pictures of the sides with runs; return the page."""
    found = found.model_copy(update={"pictures": _keep_pictures(folder, found, places)})
    write_json(folder / "comparison.json", found.as_json())
    write_text(folder / "comparison.md", as_markdown(found))
    write_text(folder / "junit.xml", as_junit(found))
    groups: dict[tuple[str, str], list[Kept]] = {}
    for picture in found.pictures:
        groups.setdefault((picture.case, picture.method), []).append(picture)
    page = (
        page_environment()
        .get_template("comparison.html.j2")
        .render(
            c=found,
            headline=headline(found),
            detectable=detectable_lines(found),
            columns=COLUMNS,
            first=[(d.alarm, cells(d)) for d in shown(found)],
            rest=[(d.alarm, cells(d)) for d in ranked(found.deltas)],
            groups=groups,
        )
    )
    path = folder / "comparison.html"
    write_text(path, page)
    return path


def _keep_pictures(folder: Path, found: Comparison, places: Mapping[str, Path]) -> list[Kept]:
    """Copy the pictures of the methods that failed, of both sides where they have any."""
    failed = {(d.case, d.method) for d in found.deltas if d.alarm == "fail"}
    kept: list[Kept] = []
    sides: tuple[Literal["before", "after"], ...] = ("before", "after")
    for side in sides:
        done = set[str]()
        for run in run_folders(places[side]) if side in places else ():
            results = check_results(read_record(run / RESULTS))
            case = str(results.experiment.get("name", results.title))
            if case not in done:
                done.add(case)
                kept += _of_run(folder, run, results, side, failed)
    return kept[:_MOST_PICTURES]


def _of_run(
    folder: Path, run: Path, results: Results, side: Literal["before", "after"], failed: set[tuple[str, str]]
) -> list[Kept]:
    case = str(results.experiment.get("name", results.title))
    # Of two methods each side shows its own; a mean over scenes shows all scenes.
    rows = {row for where, row in failed if where in (case, ALL_CASES)}
    names = {row: row.split(" over ")[-1 if side == "before" else 0] for row in rows}
    kept: list[Kept] = []
    for row, name in names.items():
        for picture in results.pictures:
            if picture.section not in ("compare", "errors") or picture.label != name:
                continue
            file = f"pictures/{case}-{side}-{Path(picture.file).name}"
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(run / picture.file, folder / file)
            label = f"{'error' if picture.section == 'errors' else 'picture'} of {name}"
            kept.append(Kept(file=file, side=side, case=case, method=row, label=label))
    return kept
