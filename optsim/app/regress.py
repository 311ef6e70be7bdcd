"""The command of the regression matrix: run it, and compare it with its baseline."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optsim.app.options import Json, Workers

_OUT = Path("reports") / "runs" / "regress"


def regress(
    out: Annotated[Path, typer.Option(help="Folder of the runs, one below it a state of the code.")] = _OUT,
    seeds: Annotated[
        str, typer.Option(metavar="A,B,...", help="Seeds; the baseline has the default ones.")
    ] = "1,2,3,4",
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Run the regression matrix (3 scenes, 4 schemes, 2 cameras, 4 seeds) against its baseline."""
    from optsim.app.compare import compare
    from optsim.core.console import people, progress_bars
    from optsim.core.errors import ConfigError, StorageError
    from optsim.study.regression import BASELINE, matrix, run_matrix

    if not all(seed.strip().isdigit() for seed in seeds.split(",")):
        raise ConfigError(f"--seeds: got {seeds!r}, expected whole numbers such as 1,2,3,4")
    experiments = matrix([int(seed) for seed in seeds.split(",")])
    with progress_bars(quiet=as_json) as progress:
        folder, outcome = run_matrix(experiments, out, workers=workers, progress=progress)
    if outcome.failed:
        name, why = next(iter(outcome.failed.items()))
        raise StorageError(f"{len(outcome.failed)} runs failed, the first {name}: {why}")
    people.print(f"Runs: {folder}. To make them the baseline: optsim accept {folder} --name {BASELINE}")
    compare(BASELINE, folder, as_json=as_json)
