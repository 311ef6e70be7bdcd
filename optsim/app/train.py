"""The command that learns priors."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from optsim.app.options import Backend, refuse_without


def train(
    prior: Annotated[Literal["dictionary", "mixture"], typer.Argument(help="What to learn.")] = "dictionary",
    out: Annotated[
        Path | None, typer.Option(help="File to write; default the shipped one, but not with --clips.")
    ] = None,
    size: Annotated[int | None, typer.Option(min=1, max=20000, help="Atoms or Gaussians.")] = None,
    method: Annotated[
        Literal["mod", "ksvd"] | None,
        typer.Option(help="Of a dictionary: least squares or approximate K-SVD; default mod."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of footage, patches and start.")] = 1,
    footage: Annotated[
        Literal["scene", "leaves", "both"] | None,
        typer.Option(help="What to learn from; default as for the shipped ones, and none beside --clips."),
    ] = None,
    clips: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="PATH",
            help="Your own high-speed footage, repeatable: a folder or pattern of EXR, PNG or TIFF, an npz, "
            "npy or mat array, or a video. Never what will be scored.",
        ),
    ] = None,
    frames_per_slot: Annotated[
        int | None, typer.Option(min=1, help="Of --clips: frames that a slot is the mean of [1].")
    ] = None,
    linearisation: Annotated[
        Literal["linear", "srgb"] | None,
        typer.Option(help="Of --clips; default srgb for 8 bits and videos, else linear."),
    ] = None,
    black_level: Annotated[
        float | None, typer.Option(min=0, help="Of linear --clips: stored value of no light [0].")
    ] = None,
    backend: Backend = None,
) -> None:
    """Learn a prior from your own footage, renders of scenes/training_mix, moving leaves, or several of them.

    Stopped, it goes on where it was when the same command runs again.
    """
    from optsim.core.console import people, progress_bars
    from optsim.experiment.train import prior_path, train_prior
    from optsim.footage.clips import open_clips

    about_clips = {
        "--frames-per-slot": frames_per_slot,
        "--linearisation": linearisation,
        "--black-level": black_level,
    }
    if not clips:
        refuse_without("--clips", "--clips PATH", about_clips)
    path = prior_path(prior, out, method, imported=bool(clips))
    opened = open_clips(
        clips or [],
        frames_per_slot=frames_per_slot or 1,
        linearisation=linearisation,
        black_level=black_level or 0.0,
    )
    with progress_bars() as progress:
        train_prior(
            prior,
            out,
            size=size,
            method=method,
            seed=seed,
            footage=footage,
            clips=opened,
            backend=backend,
            progress=progress,
        )
    people.print(f"Wrote {path}")
