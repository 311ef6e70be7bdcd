"""Commands of data sets: ``optsim dataset build`` and what reads, checks and converts the outcome."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from optsim.app.options import Json, Scheduler, Workers, print_json
from optsim.core.errors import ConfigError

dataset_app = typer.Typer(
    rich_markup_mode="markdown",
    no_args_is_help=True,
    help="Build, read, check and convert data sets.",
    epilog="Start with: optsim dataset build demo --out reports/datasets/demo",
)
Folder = Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of a data set.")]


@dataset_app.command("build")
def build(
    spec: Annotated[str, typer.Argument(metavar="SPEC", help="A shipped spec's name or a TOML file.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder [reports/datasets/NAME]; the same goes on.")
    ] = None,
    layout: Annotated[
        Literal["exr", "npy"], typer.Option(help="npy: a memory-mapped array a pass beside the EXR files.")
    ] = "exr",
    recipe: Annotated[
        bool, typer.Option("--recipe", help="Keep hashes only; 'regenerate' makes any sequence again.")
    ] = False,
    plan: Annotated[
        bool, typer.Option("--plan", help="Build two sequences a scene unless there; say time, disk, memory.")
    ] = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="The I-th of N parts of the list, for job arrays.")
    ] = None,
) -> None:
    """Build a data set: every scene, variation, camera and seed of SPEC. Stopped, it goes on."""
    from optsim.core.console import people, progress_bars
    from optsim.core.files import read_record
    from optsim.core.threads import CORES
    from optsim.dataset import build_dataset, forecast, load_spec
    from optsim.dataset.filters import lines
    from optsim.dataset.reading import CARD
    from optsim.dataset.spec import check_spec, remarks

    loaded = load_spec(spec)
    folder = out or Path("reports") / "datasets" / loaded.name
    check_spec(loaded)
    for each in remarks(loaded):
        people.print(f"remark: {each}")
    if plan:
        with progress_bars() as progress:
            said = forecast(loaded, folder, workers=workers, layout=layout, progress=progress)
        _fail(said.failed)
        times = ", ".join(f"{said.wall_s(n) / 60:.1f} min by {n}" for n in sorted({1, 2, workers or CORES}))
        people.print(
            f"{said.sequences} sequences, {said.to_do} to do: {said.core_s:.0f} core-seconds, "
            f"{said.disk_mb:.0f} MB of disk in all, {said.peak_mb:.0f} MB of memory a worker "
            f"(measured on {said.measured} sequences, which are kept)"
        )
        people.print(
            f"time on {CORES} cores by workers: {times}; by n with a core each: "
            f"{said.wall_s(1, 1) / 60:.1f} min / n"
        )
        return
    with progress_bars() as progress:
        outcome = build_dataset(
            loaded,
            folder,
            layout=layout,
            recipe=recipe,
            workers=workers,
            scheduler=scheduler,
            shard=_part(shard),
            progress=progress,
        )
    people.print(f"{len(outcome.made)} sequences made, {len(outcome.found)} were there: {folder}")
    if (folder / CARD).is_file():
        card = read_record(folder / CARD)
        for line in lines(card["filters"], card["built"]):
            people.print(f"filter {line}")
    _fail(outcome.failed)


@dataset_app.command("regenerate")
def regenerate_sequences(
    folder: Folder, names: Annotated[list[str], typer.Argument(metavar="NAME...", help="Sequences.")]
) -> None:
    """Make sequences again beside the data set, and compare every file with the manifest."""
    from optsim.core.console import people, progress_bars
    from optsim.dataset import open_dataset
    from optsim.dataset.regenerating import regenerate

    with progress_bars() as progress:
        problems, restored = regenerate(open_dataset(folder), names, progress)
    _fail(problems)
    people.print(f"{', '.join(names)}: made again, every file as the manifest says; {restored} were put back")


@dataset_app.command("verify")
def verify_files(folder: Folder) -> None:
    """Check every file against the manifest; exit code 1 when one is missing, changed or unknown."""
    from optsim.core.console import people, progress_bars
    from optsim.dataset import open_dataset
    from optsim.dataset.verify import verify

    dataset = open_dataset(folder)
    with progress_bars() as progress:
        problems = verify(dataset, progress)
    _fail(dict.fromkeys(problems, ""))
    people.print(f"{folder}: every file is as it was written")


@dataset_app.command("show")
def show(
    folder: Folder,
    sequence: Annotated[str | None, typer.Argument(help="List its objects instead.")] = None,
    as_json: Json = False,
) -> None:
    """List the sequences of a data set, checks and what filters dropped; or a sequence's objects."""
    from optsim.core.errors import unknown_name
    from optsim.dataset import open_dataset
    from optsim.dataset.filters import lines
    from optsim.dataset.reading import Sample

    card = open_dataset(folder).card
    if sequence is not None:
        known = {each["name"]: each for each in card["sequences"]}
        if sequence not in known:
            raise unknown_name("sequence", sequence, known)
        sample = Sample(folder / sequence, None, known[sequence])
        labels = sample.labels(sample.n_slots // 2)
        if as_json:
            print_json({str(number): label for number, label in labels.items()})
        for number, label in labels.items() if not as_json else ():
            size = " x ".join(f"{side:.3g}" for side in label["box_m"]["size"])
            seen = f"{label['visibility']:.0%} visible, box {label['box_px']}"
            typer.echo(f"{number} {label['name']} ({label['category']}): {size} m, {seen}")
        return
    if as_json:
        print_json(card)
        return
    typer.echo(f"{card['name']}: {card['description']} ({card['licence']})")
    for each in card["sequences"]:
        seeds = f", seeds {', '.join(map(str, each['seeds']))}" if each["seeds"] else ""
        typer.echo(f"  {each['name']}{seeds}")
    for check in card["checks"].values():
        typer.echo(f"{check['what']}: {check['worst']:.3g} ({check['in']})")
    for line in lines(card["filters"], card.get("built", len(card["sequences"]))):
        typer.echo(f"filter {line}")


@dataset_app.command("stats")
def stats(folder: Folder, as_json: Json = False) -> None:
    """Count luminance in stops, speeds, and the share that moves."""
    from optsim.core.console import progress_bars
    from optsim.dataset import open_dataset
    from optsim.dataset.verify import statistics

    with progress_bars() as progress:
        found = statistics(open_dataset(folder), progress)
    if as_json:
        print_json(found)
        return
    for split, counts in found.items():
        if not counts["samples"]:
            continue
        least, mean, most = counts["moving"]
        typer.echo(f"{split}: {counts['samples']} samples; {least:.1%} to {most:.1%} moves, mean {mean:.1%}")
        for title, key in (("stops below the brightest", "stops"), ("samples a slot", "speeds_px")):
            for label, share in counts[key].items():
                typer.echo(f"  {label:>7} {title}  {share:6.1%} {'#' * round(50 * share)}")


@dataset_app.command("export")
def export(
    folder: Folder,
    kind: Annotated[Literal["webdataset", "hdf5", "nerf", "coco"], typer.Option("--to", help="Form.")],
    out: Annotated[Path, typer.Option(help="New folder; of hdf5 a new file.")],
) -> None:
    """Convert a data set for other loaders."""
    from optsim.core.console import people, progress_bars
    from optsim.dataset import open_dataset
    from optsim.dataset.exports import EXPORTS

    with progress_bars() as progress:
        EXPORTS[kind](open_dataset(folder), out, progress)
    people.print(f"{out}: written")


def _part(shard: str | None) -> tuple[int, int]:
    if shard is None:
        return 1, 1
    part, slash, parts = shard.partition("/")
    if not (slash and part.isdecimal() and parts.isdecimal()):
        raise ConfigError(f"--shard: got {shard!r}, expected I/N, for example 1/4")
    return int(part), int(parts)


def _fail(problems: dict[str, str]) -> None:
    """Print what went wrong, a line each, and end with exit code 1; nothing when all is well."""
    for what, why in problems.items():
        typer.echo(f"{what}: {why}" if why else what, err=True)
    if problems:
        raise typer.Exit(1)
