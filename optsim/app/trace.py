"""The command that follows the light of one pixel."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optsim.app.options import Backend, ExperimentName, Json, Set, Tolerance, print_json, with_tolerance


def trace(
    experiment: ExperimentName,
    pixel: Annotated[str, typer.Option(metavar="Y,X", help="CCD pixel: row and column, from 0.")],
    frame: Annotated[
        int | None, typer.Option(help="Coded frame, from 0; default the first steady one, else the last.")
    ] = None,
    method: Annotated[str | None, typer.Option(metavar="NAME", help="Method; default the first.")] = None,
    assignments: Set = None,
    tolerance: Tolerance = None,
    out: Annotated[Path | None, typer.Option(help="Folder; default reports/runs/trace-NAME-TIME.")] = None,
    backend: Backend = None,
    as_json: Json = False,
) -> None:
    """Follow the light of one CCD pixel in one exposure; write trace.json and trace.svg."""
    from dataclasses import asdict

    from optsim.core.console import page, progress_bars
    from optsim.core.files import write_json, write_text
    from optsim.core.folder_claims import claimed_empty, output_folder
    from optsim.experiment import job
    from optsim.experiment.experiment import load_experiment
    from optsim.experiment.trace import choose_pixel, show, trace_experiment
    from optsim.report.trace_plot import trace_plot

    loaded = load_experiment(experiment, with_tolerance(assignments, tolerance))
    traced = choose_pixel(loaded, pixel, frame, method)
    with output_folder(out, f"trace-{loaded.name}") as folder, claimed_empty(folder):
        job.check(loaded, folder, backend)
        with progress_bars() as progress:
            found = trace_experiment(loaded, traced, backend=backend, progress=progress)
        write_json(folder / "trace.json", asdict(found))
        write_text(folder / "trace.svg", trace_plot(found))
    if as_json:
        print_json(asdict(found))
    else:
        for item in show(found):
            page.print(item)
        page.print(f"Picture: {folder / 'trace.svg'}")
