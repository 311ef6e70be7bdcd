"""Commands of studies: ``optsim sweep``, ``operators``, ``tolerance``, ``waterfall`` and ``yield``."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from optsim.app.options import ExperimentName, Json, Scheduler, Set, Workers, print_json
from optsim.core.errors import ConfigError, unknown_name

if TYPE_CHECKING:
    from optsim.core.progress import Progress
    from optsim.experiment.experiment import Experiment
    from optsim.study.comparison import Seeds
    from optsim.study.folder import Workplace

Record = dict[str, Any]
Out = Annotated[Path | None, typer.Option(help="Folder [reports/runs/STUDY-NAME-TIME]; the same goes on.")]
Methods = Annotated[
    str | None, typer.Option(metavar="NAME,NAME", help="Methods of the experiment to compare; default all.")
]
Frames = Annotated[int, typer.Option(min=1, max=100, help="Coded frames of the steady phase to score.")]
SeedRange = Annotated[
    str, typer.Option("--seeds", metavar="LEAST:MOST", help="Seeds of codes and photons, and the cap.")
]


def sweep(
    experiment: ExperimentName,
    vary: Annotated[
        list[str],
        typer.Option(
            metavar="KEY=FIRST:LAST:COUNT",
            help="A parameter and its values, or KEY=VALUE,VALUE; twice for a pair.",
        ),
    ],
    curves: Annotated[
        str, typer.Option(metavar="MODE,MODE", help="Some of known, unknown and compensated.")
    ] = "known,unknown,compensated",
    mark: Annotated[list[float] | None, typer.Option(help="Show pictures at this value; repeatable.")] = None,
    assignments: Set = None,
    methods: Methods = None,
    frames: Frames = 1,
    seeds: SeedRange = "2:2",
    precision: Annotated[
        float, typer.Option(min=1e-3, help="Half of an interval, dB, at which no seed is added.")
    ] = 0.1,
    out: Out = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Vary one or two parameters: loss when calibrated, when drifted, and after a quick registration."""
    from optsim.core.console import table
    from optsim.study.point import MODES, parse_axis
    from optsim.study.sweep import SweepPlan
    from optsim.study.sweep import sweep as measure
    from optsim.study.sweep_page import lead, write_sweep_page

    base = _base(experiment, assignments, methods)
    chosen = _names(curves)
    for name in chosen:
        if name not in MODES:
            raise unknown_name("curve", name, MODES)
    plan = SweepPlan(
        axes=tuple(parse_axis(base, each) for each in vary),
        modes=tuple(mode for mode in MODES if mode in chosen),
        frames=frames,
        seeds=_seeds(seeds, precision),
        marks=tuple(mark or ()),
    )

    def said(record: Record) -> list[Any]:
        names = [axis.label for axis in plan.axes]
        keys = (*names, "mode", "method", "db", "change_db", "change_half")
        rows = [[row[key] for key in keys] for row in record["rows"] if row.get("region") == "all"]
        return [table("", (*names, "curve", "method", "dB", "change, dB", "±"), rows), lead(record)]

    work = partial(measure, base, plan)
    _study(f"sweep-{base.name}", out, workers, scheduler, as_json, work, write_sweep_page, said)


def operators(
    experiment: ExperimentName,
    assignments: Set = None,
    methods: Methods = None,
    frames: Frames = 3,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Seeds of codes and photons.")] = 4,
    out: Out = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Decode the same frames with the ideal, the calibrated, a blindly moved and the true operator.

    With a drift (--set drift.relay.shift_x_px=0.5) the calibration is of the camera before it.
    """
    from optsim.core.console import table
    from optsim.study.comparison import Seeds
    from optsim.study.operators import OperatorsPlan
    from optsim.study.operators import operators as measure
    from optsim.study.operators_page import (
        FOUND,
        HEADS,
        SHORT,
        found_lines,
        lead,
        lines_of,
        write_operators_page,
    )

    base = _base(experiment, assignments, methods)
    plan = OperatorsPlan(frames, Seeds(seeds, seeds))

    def said(record: Record) -> list[Any]:
        names = dict.fromkeys(row["method"] for row in record["rows"])
        tables = [table(f"{name}, PU21-PSNR, dB", HEADS, lines_of(record["rows"], name)) for name in names]
        lines = [[line[column] for column in SHORT] for line in found_lines(record)]
        found = table("found blind (true)", [FOUND[column] for column in SHORT], lines)
        return [*tables, found, lead(record)]

    work = partial(measure, base, plan)
    _study(f"operators-{base.name}", out, workers, scheduler, as_json, work, write_operators_page, said)


def tolerance(
    experiment: ExperimentName,
    loss: Annotated[str, typer.Option(metavar="DB", help="Loss that is allowed, for example 1dB.")] = "1dB",
    parameters: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="Parameters of the sheet; default all.")
    ] = None,
    regions: Annotated[
        str, typer.Option(metavar="NAME,NAME", help="Regions whose scores decide.")
    ] = "all,moving,static",
    drift_only: Annotated[
        bool,
        typer.Option("--drift-only", help="Leave out cameras that are calibrated with it: benches."),
    ] = False,
    draws: Annotated[int, typer.Option(min=0, max=10_000, help="Cameras of the Monte-Carlo budget.")] = 8,
    no_pairs: Annotated[bool, typer.Option("--no-pairs", help="Leave out pairs of the worst five.")] = False,
    assignments: Set = None,
    methods: Methods = None,
    frames: Frames = 3,
    seeds: SeedRange = "4:6",
    out: Out = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Write the tolerance sheet: the largest change of each parameter that costs at most a loss."""
    from optsim.core.console import table
    from optsim.study.parameters import ALL
    from optsim.study.tolerance import TolerancePlan
    from optsim.study.tolerance import tolerance as measure
    from optsim.study.tolerance_page import HEADS, MODES, lead, notes, sheet, write_tolerance_page

    base, loss_db = _base(experiment, assignments, methods), _decibels(loss)
    plan = TolerancePlan(
        loss_db=loss_db,
        names=_names(parameters) or tuple(ALL),
        regions=_names(regions),
        known=not drift_only,
        draws=draws,
        interactions=not no_pairs,
        frames=frames,
        # An interval of a tenth of the loss.
        seeds=_seeds(seeds, loss_db / 10),
    )

    def said(record: Record) -> list[Any]:
        tables = [
            table(f"{title}: {loss_db:g} dB", HEADS, lines)
            for mode, title in MODES.items()
            if (lines := sheet(record["rows"], mode))
        ]
        return [*tables, *notes(record["rows"]), lead(record)]

    work = partial(measure, base, plan)
    _study(f"tolerance-{base.name}", out, workers, scheduler, as_json, work, write_tolerance_page, said)


def waterfall(
    experiment: ExperimentName,
    effects: Annotated[
        str | None, typer.Option(metavar="NAME,NAME", help="Effects; default all that the camera has.")
    ] = None,
    orders: Annotated[
        int, typer.Option(min=1, max=1000, help="Orders that shares are means of, each with its reverse.")
    ] = 2,
    assignments: Set = None,
    methods: Methods = None,
    frames: Frames = 3,
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Seeds of codes and photons.")] = 4,
    out: Out = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Switch effects on from the ideal camera to the nominal one: what each costs, and its fair share."""
    from optsim.core.console import table
    from optsim.study.comparison import Seeds
    from optsim.study.waterfall import WaterfallPlan, effects_of
    from optsim.study.waterfall import waterfall as measure
    from optsim.study.waterfall_page import HEADS, lead, lines_of, write_waterfall_page

    base = _base(experiment, assignments, methods)
    plan = WaterfallPlan(effects_of(base, _names(effects)), orders, frames, Seeds(seeds, seeds))

    def said(record: Record) -> list[Any]:
        rows = record["rows"]
        methods = dict.fromkeys(row["method"] for row in rows)
        tables = [table(f"{each}, everywhere", HEADS, lines_of(rows, each, "all")) for each in methods]
        return [*tables, lead(record)]

    work = partial(measure, base, plan)
    _study(f"waterfall-{base.name}", out, workers, scheduler, as_json, work, write_waterfall_page, said)


def yield_(
    experiment: ExperimentName,
    sheet: Annotated[
        str,
        typer.Option(
            metavar="SHEET",
            help="A finished tolerance study, a TOML file, or machining: a bad specimen's changes.",
        ),
    ] = "machining",
    draws: Annotated[int, typer.Option(min=1, max=100_000, help="Cameras to draw.")] = 100,
    calibration: Annotated[
        str, typer.Option(metavar="MODE", help="known, unknown or compensated: what a bench knows.")
    ] = "known",
    compensators: Annotated[
        str,
        typer.Option(metavar="NAME,NAME", help="In this order: registration, focus, black_gain, bench."),
    ] = "registration",
    target: Annotated[
        str | None, typer.Option(metavar="DB", help="Score of a good camera [the unchanged one less --loss].")
    ] = None,
    loss: Annotated[str, typer.Option(metavar="DB", help="Without --target: loss that is allowed.")] = "1dB",
    method: Annotated[str | None, typer.Option(help="Method whose score counts [the first].")] = None,
    region: Annotated[str, typer.Option(help="Region whose score counts: all, moving or static.")] = "all",
    halve: Annotated[
        bool, typer.Option("--halve", help="Measure what each parameter's limits half as wide win.")
    ] = False,
    rebuild: Annotated[
        int | None, typer.Option(min=0, help="Only print the command that builds this camera again.")
    ] = None,
    assignments: Set = None,
    frames: Frames = 3,
    out: Out = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Draw cameras within a tolerance sheet: how many reach a score, and what the others share."""
    from optsim.core.console import page, table
    from optsim.metrics.records import REGIONS
    from optsim.study.compensation import COMPENSATORS
    from optsim.study.point import MODES
    from optsim.study.sheets import read_sheet
    from optsim.study.yields import YieldPlan, assignments_of, yields
    from optsim.study.yields_page import (
        SHARED,
        TRAVEL,
        WON,
        lead,
        shared_lines,
        travel_lines,
        won_lines,
        write_yield_page,
    )

    whole = _base(experiment, assignments, None)
    base = _base(experiment, assignments, method or whole.methods[0].name)
    for what, got, valid in (("--calibration", calibration, MODES), ("--region", region, REGIONS)):
        if got not in valid:
            raise unknown_name(what, got, valid)
    chosen = _names(compensators) if calibration == "compensated" else ()
    for name in chosen:
        if name not in COMPENSATORS:
            raise unknown_name("compensator", name, COMPENSATORS)
    if calibration == "compensated" and not chosen:
        raise ConfigError(f"--compensators: got none, expected some of {', '.join(COMPENSATORS)}")
    plan = YieldPlan(
        sheet=read_sheet(sheet),
        draws=draws,
        mode=next(mode for mode in MODES if mode == calibration),
        compensators=chosen,
        method=base.methods[0].name,
        region=region,
        target_db=None if target is None else _decibels(target, "--target"),
        loss_db=_decibels(loss),
        frames=frames,
        halve=halve,
    )
    if rebuild is not None:
        words = [f"--set {shlex.quote(each)}" for each in assignments_of(base, plan, rebuild)]
        given = [f"--set {shlex.quote(each)}" for each in assignments or []]
        page.print(" ".join(["optsim run", shlex.quote(experiment), *given, *words]))
        return

    def said(record: Record) -> list[Any]:
        return [
            table("What failures share", SHARED, shared_lines(record)),
            *([table("Limits half as wide", WON, won_lines(record))] if halve else []),
            *(
                [table("Travel of the compensators", TRAVEL, travel_lines(record))]
                if record["travel"]
                else []
            ),
            lead(record),
        ]

    work = partial(yields, base, plan)
    _study(f"yield-{base.name}", out, workers, scheduler, as_json, work, write_yield_page, said)


def _study(
    name: str,
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    as_json: bool,
    measure: Callable[[Workplace, Progress], Record],
    write_page: Callable[[Path, Record], object],
    said: Callable[[Record], list[Any]],
) -> None:
    """Measure a study into its folder, write its page, and print its record or what is said of it."""
    from optsim.core.console import page, progress_bars
    from optsim.core.folder_claims import output_folder
    from optsim.study.folder import Workplace

    with output_folder(out, name) as folder:
        place = Workplace(folder, workers, scheduler, shlex.join(["optsim", *sys.argv[1:]]))
        with progress_bars(quiet=as_json) as progress:
            record = measure(place, progress)
        write_page(folder, record)
        if as_json:
            print_json(record)
        else:
            for each in said(record):
                page.print(each)
            _close(folder, record)
    _fail(record)


def _names(text: str | None) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",")) if text else ()


def _decibels(text: str, option: str = "--loss") -> float:
    try:
        return float(text.strip().removesuffix("dB").removesuffix("db"))
    except ValueError:
        raise ConfigError(f"{option}: got {text!r}, expected a number of dB, for example 1dB") from None


def _base(experiment: str, assignments: list[str] | None, methods: str | None) -> Experiment:
    from optsim.experiment.experiment import load_experiment
    from optsim.study.folder import chosen_methods

    loaded = load_experiment(experiment, assignments or [])
    return chosen_methods(loaded, _names(methods))


def _seeds(text: str, precision: float) -> Seeds:
    from optsim.study.comparison import Seeds

    least, _, most = text.partition(":")
    numbers = [int(each) if each.strip().isdecimal() else 0 for each in (least, most or least)]
    if not 1 <= numbers[0] <= numbers[1] <= 1000:
        raise ConfigError(f"--seeds: got {text!r}, expected LEAST:MOST, for example 2:4")
    return Seeds(numbers[0], numbers[1], precision)


def _close(folder: Path, record: dict[str, Any]) -> None:
    """Say how often what was refused, and where the page is."""
    from optsim.core.console import page
    from optsim.study.folder import PAGE

    refused = [row["refused"] for row in record["rows"] if row.get("refused")]
    refused += [*record.get("refused", {}).values()]
    if refused:
        page.print(f"{len(refused)} points refused; the first: {refused[0]}")
    page.print(f"Page: {folder / PAGE}")


def _fail(record: dict[str, Any]) -> None:
    """Name what was put aside, and end with exit code 1; nothing when all is well."""
    for name, why in record["put_aside"].items():
        typer.echo(f"{name}: {why}", err=True)
    if record["put_aside"]:
        raise typer.Exit(1)
