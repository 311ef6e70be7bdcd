"""Commands of scenes: ``optsim scene show``, ``optsim scene drop`` and ``optsim check``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optsim.app.options import Backend, Json, print_json
from optsim.core.errors import ConfigError

scene_app = typer.Typer(rich_markup_mode="markdown", no_args_is_help=True, help="Look at scenes and models.")


@scene_app.command("show")
def show(
    name: Annotated[
        str, typer.Argument(metavar="SCENE_OR_MODEL", help="Scene, its folder, or a model file.")
    ],
    out: Annotated[Path, typer.Option(help="PNG to write.")],
    variation: Annotated[str, typer.Option(help="Of a scene.")] = "main",
    time_s: Annotated[float, typer.Option(help="Instant, s.")] = 0.0,
    samples: Annotated[int, typer.Option(min=1, max=4096, help="Paths a pixel.")] = 64,
) -> None:
    """Draw a quick preview, and list what is in it with sizes."""
    from optsim.core.console import people
    from optsim.core.files import write_png8
    from optsim.render.preview import preview, sizes
    from optsim.report.pictures import by_logarithm
    from optsim.scene import load_scene
    from optsim.scene.models import FORMATS
    from optsim.scene.scene import model_scene

    path = Path(name)
    is_model = path.suffix.lower() in FORMATS
    scene = model_scene(path) if is_model else load_scene(name, variation)
    unit = "units" if is_model else "m"
    for each, (low, high) in sizes(scene, time_s).items():
        size = " x ".join(f"{side:.3g}" for side in high - low)
        typer.echo(f"{each}: {size} {unit}, middle at {', '.join(f'{x:.3g}' for x in (low + high) / 2)}")
    write_png8(out, by_logarithm(preview(scene, time_s=time_s, samples=samples)))
    people.print(f"{out}: written")


@scene_app.command("drop")
def drop(
    scene: Annotated[Path, typer.Argument(metavar="SCENE", help="A scene's folder.")],
    variation: Annotated[str, typer.Option(help="A variation, or numbers FIRST:LAST, LAST not included.")],
    duration_s: Annotated[float, typer.Option(min=0.01, max=60, help="Length, s.")] = 2.0,
    rate_hz: Annotated[float, typer.Option(min=10, max=2000, help="Poses a second.")] = 180.0,
) -> None:
    """Let populations with `physics = true` fall and collide, and write their poses beside the scene."""
    from optsim.core.console import people
    from optsim.core.files import write_json
    from optsim.scene.physics import drop as dropped

    first, colon, last = variation.partition(":")
    if colon and not (first.isdecimal() and last.isdecimal() and int(first) < int(last)):
        raise ConfigError(f"--variation: got {variation!r}, expected FIRST:LAST, for example 0:32")
    for name in map(str, range(int(first), int(last))) if colon else [variation]:
        out = scene / "physics" / f"{name}.json"
        write_json(out, dropped(scene, name, duration_s, rate_hz))
        people.print(f"{out}: written")


def check(
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="A shipped scene's name, or a scene folder.")],
    variation: Annotated[str, typer.Option(help="Which of its variations, or a number.")] = "main",
    backend: Backend = None,
    as_json: Json = False,
) -> None:
    """Look for fireflies in a scene with a quick pilot, and name the light paths that make them."""
    from optsim.core.console import page, progress_bars, table
    from optsim.render import fireflies
    from optsim.scene import load_scene

    loaded = load_scene(scene, variation).in_band()
    with progress_bars(quiet=as_json) as progress:
        found = fireflies.pilot(loaded, backend=backend, progress=progress)
    record = fireflies.record(loaded, found)
    if as_json:
        print_json(record)
    else:
        page.print(fireflies.headline(loaded))
        for one in found:
            page.print(one.text())
            if one.fireflies:
                page.print(table("", fireflies.COLUMNS, one.by_cause()))
    if not record["fit"]:
        raise typer.Exit(1)
