"""Commands of scenes: ``optsim scene show``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

scene_app = typer.Typer(no_args_is_help=True, help="Look at scenes and models.")


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
    from optsim.render.preview import preview, sizes
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
    preview(scene, out, time_s=time_s, samples=samples)
    people.print(f"{out}: written")
