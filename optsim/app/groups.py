"""Commands in groups: ``optsim config ...`` and ``optsim cache ...``."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from optsim.app.options import ExperimentName, Json, Set, print_json

config_app = typer.Typer(
    rich_markup_mode="markdown",
    no_args_is_help=True,
    help="Show a resolved experiment, or the schema of all keys.",
)
cache_app = typer.Typer(
    rich_markup_mode="markdown",
    no_args_is_help=True,
    help="Show or clear the cache of rendered truth.",
    epilog="OPTSIM_CACHE chooses its folder, OPTSIM_CACHE_MAX_GB its size [20]: the oldest entries go first.",
)


@config_app.command("show")
def config_show(experiment: ExperimentName, assignments: Set = None) -> None:
    """Print an experiment with every default resolved, as JSON."""
    from optsim.experiment.experiment import load_experiment

    print_json(load_experiment(experiment, assignments or []).model_dump(mode="json"))


@config_app.command("schema")
def config_schema(
    key: Annotated[
        str | None,
        typer.Argument(metavar="KEY", help="For example camera.relay.shift_x_px, or a table: camera.relay."),
    ] = None,
) -> None:
    """Print meaning, unit, sign, typical value, source and default of KEY; without it, all as JSON schema."""
    from optsim.experiment.schema import experiment_schema, explain_key

    if key is None:
        print_json(experiment_schema())
    else:
        typer.echo("\n".join(explain_key(key)))


@cache_app.command("show")
def cache_show(as_json: Json = False) -> None:
    """Print where the cache is and what it holds."""
    from optsim.core.cache import Cache

    record: dict[str, Any] = Cache().show()
    if as_json:
        print_json(record)
    else:
        for key, value in record.items():
            typer.echo(f"{key}: {value}")


@cache_app.command("clear")
def cache_clear() -> None:
    """Remove everything from the cache."""
    from optsim.core.cache import Cache

    freed = Cache().clear()
    typer.echo(f"Freed {freed / 1e6:.1f} MB.")
