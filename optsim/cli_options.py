"""Arguments and output that several commands share."""

from __future__ import annotations

import json
from typing import Annotated

import typer

ExperimentName = Annotated[str, typer.Argument(metavar="EXPERIMENT", help="A preset's name or a TOML file.")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Override a key; repeatable.")
]
Seed = Annotated[int | None, typer.Option(help="Replace the experiment's seed.")]
Backend = Annotated[
    str | None, typer.Option(help="Mitsuba variant to use instead of the one chosen by probing.")
]
Json = Annotated[bool, typer.Option("--json", help="Machine-readable output on stdout.")]
Names = Annotated[list[str] | None, typer.Argument(metavar="[NAME]...", help="Which ones; default all.")]


def print_json(record: object) -> None:
    """Print a record on stdout; NaN and infinity are errors, never output."""
    typer.echo(json.dumps(record, indent=1, allow_nan=False))
