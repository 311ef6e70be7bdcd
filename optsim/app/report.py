"""``optsim report``: pages of finished runs, made anew from their results and assets."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from optsim.report import Results

Runs = Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of finished runs.")]


def remake_reports(
    runs: Runs,
    index: Annotated[
        Path | None,
        typer.Option(help="Page that lists the runs; of several [index.html in their common folder]."),
    ] = None,
) -> None:
    """Make report.html anew from results.json and assets; of several runs also a page with their history."""
    from optsim.core.console import page
    from optsim.report import write_report
    from optsim.report.index import write_index

    read = [(folder, _results(folder)) for folder in runs]
    for folder, results in read:
        page.print(f"Report: {write_report(folder, results)}")
    if index is None and len(read) > 1:
        index = Path(os.path.commonpath([folder.resolve() for folder in runs])) / "index.html"
    if index is not None:
        page.print(f"Index: {write_index(index, read)}")


def _results(folder: Path) -> Results:
    """Read the record of a run."""
    from optsim.core.errors import StorageError
    from optsim.core.files import read_record
    from optsim.experiment.run_folder import RESULTS
    from optsim.report import check_results

    if not (folder / RESULTS).is_file():
        raise StorageError(
            f"RUN: got {folder}, expected the folder of a finished run, with {RESULTS}; "
            "cure: give the folder that optsim run printed"
        )
    return check_results(read_record(folder / RESULTS))
