"""The commands that measure optsim itself: its speed, and how true it is of the world."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from optsim.app.options import Json, Names, print_json


def benchmark(
    names: Names = None,
    as_json: Json = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for records.json and pictures of renders and decoders.")
    ] = None,
) -> None:
    """Measure run time against peers in the same run; ratio above 1 is better than the peer.

    A NAME is a record or a family of them: calibrate, capture, dataset, gmm, mask, omp, reconstruct, render,
    study.
    """
    from contextlib import nullcontext

    from optsim.core.console import page, people, progress_bars, table
    from optsim.core.files import write_json, write_text
    from optsim.core.folder_claims import claimed_empty

    benchmarks = _benchmarks()
    with nullcontext() if out is None else claimed_empty(out):
        with progress_bars(quiet=as_json) as progress:
            found = benchmarks.measure_all(names or [], progress)
        if out is not None:
            write_json(out / "records.json", found)
            for name, drawing in benchmarks.pictures(found).items():
                write_text(out / name, drawing)
            people.print(f"Written to {out}.")
    if as_json:
        print_json(found)
    else:
        keys = ("name", "value", "unit", "peer", "peer_value", "ratio")
        page.print(table("benchmarks", keys, [[r[k] for k in keys] for r in found]))


def validate(
    names: Names = None,
    as_json: Json = False,
    write: Annotated[bool, typer.Option(help="Keep the records in optsim/experiment/evidence.json.")] = False,
) -> None:
    """Measure the model against oracles that aren't our code; a NAME is a folder of validation/."""
    from dataclasses import asdict

    from optsim.core.console import page, progress_bars, table
    from optsim.experiment import evidence

    with progress_bars(quiet=as_json) as progress:
        found = evidence.measure_all(names or [], write=write, progress=progress)
    if as_json:
        print_json([asdict(e) for e in found])
    else:
        rows = [(e.effect, e.measured, e.tolerance, e.perturbed, e.passed, e.oracle) for e in found]
        page.print(table("", ("effect", "measured", "tolerance", "broken", "passed", "oracle"), rows))
    if not all(e.passed for e in found):
        raise typer.Exit(1)


def _benchmarks() -> ModuleType:
    """Find the benchmarks beside the package: the wheel has none."""
    from optsim.core.errors import StorageError

    root = Path(__file__).parents[2]
    if not (root / "benchmarks" / "__init__.py").is_file():
        raise StorageError(
            "benchmark needs the repository: its benchmarks are not part of the installed package. "
            "Cure: clone the repository and run 'make benchmark' there."
        )
    sys.path.insert(0, str(root))
    return import_module("benchmarks")
