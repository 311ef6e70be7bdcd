"""Arguments and output that several commands share."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer

from optsim.core.errors import ConfigError

ExperimentName = Annotated[str, typer.Argument(metavar="EXPERIMENT", help="A preset's name or a TOML file.")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key; repeatable.")
]
Tolerance = Annotated[
    float | None,
    typer.Option(
        help="Error that leaving out may make, rms, relative to a frame's noise; 0 models everything [0.1]."
    ),
]
Known = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        help="Calibration to know the camera by: a file of 'optsim calibrate', a run's folder, or a bench's.",
    ),
]
Seed = Annotated[int | None, typer.Option(help="Replace the experiment's seed.")]
Backend = Annotated[
    str | None, typer.Option(help="Mitsuba variant to use instead of the one chosen by probing.")
]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes [one a core].")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="tcp://HOST:PORT|FILE.toml",
        help="Workers of this dask scheduler instead, or of the jobs that a [cluster] table asks for.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Machine-readable output on stdout.")]
Names = Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Which ones; default all.")]


def with_tolerance(
    assignments: list[str] | None, tolerance: float | None, calibration: Path | None = None
) -> list[str]:
    """Put the tolerance and the calibration of a command line among its overrides."""
    return [
        *(assignments or []),
        *([] if tolerance is None else [f"tolerance={tolerance!r}"]),
        *([] if calibration is None else [f"calibration={calibration}"]),
    ]


def refuse_without(option: str, cure: str, options: Mapping[str, object]) -> None:
    """Refuse options that say how another one is meant which wasn't given, by the names of those given."""
    lost = [name for name, value in options.items() if value is not None and value is not False]
    if lost:
        raise ConfigError(f"{', '.join(lost)}: got without {option}, of which this is said; cure: add {cure}")


def print_json(record: object) -> None:
    """Print a record on stdout; NaN and infinity are errors, never output."""
    typer.echo(json.dumps(record, indent=1, allow_nan=False))
