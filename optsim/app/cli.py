"""The command line: thin; every command imports what it needs when it runs.

Exit codes: 0 success, 1 a check failed, 2 bad input, 130 interrupted.
"""

from __future__ import annotations

import logging
import os
import sys
import warnings
from pathlib import Path
from typing import Annotated

import typer

from optsim import __version__
from optsim.app.calibrate import calibrate, laboratory
from optsim.app.compare import UsageIsThree, accept, compare
from optsim.app.dataset import dataset_app
from optsim.app.error_net import guarded
from optsim.app.groups import cache_app, config_app
from optsim.app.measure import benchmark, validate
from optsim.app.options import (
    Backend,
    ExperimentName,
    Json,
    Known,
    Seed,
    Set,
    Tolerance,
    print_json,
    refuse_without,
    with_tolerance,
)
from optsim.app.reconstruct import reconstruct_files
from optsim.app.regress import regress
from optsim.app.report import remake_reports
from optsim.app.scene import check, scene_app
from optsim.app.skips import show_skip_check
from optsim.app.study import operators, sweep, tolerance, waterfall, yield_
from optsim.app.trace import trace
from optsim.app.train import train
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.memory import keep_freed_memory

# Markdown: Rich's own markup would swallow a "[one a core]" in a help text.
app = typer.Typer(
    rich_markup_mode="markdown",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Validate an adaptive pixel-wise coded-exposure camera before its hardware exists.",
    epilog="Start with: optsim doctor, then optsim run demo",
)
app.add_typer(config_app, name="config")
app.add_typer(cache_app, name="cache")
app.add_typer(dataset_app, name="dataset")
app.add_typer(scene_app, name="scene")


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"optsim {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    verbose: Annotated[int, typer.Option("-v", "--verbose", count=True, help="Say more; twice: debug.")] = 0,
) -> None:
    """Validate an adaptive pixel-wise coded-exposure camera before its hardware exists."""
    level = {0: logging.WARNING, 1: logging.INFO}.get(verbose, logging.DEBUG)
    logging.basicConfig(level=level, format="%(name)s: %(message)s", stream=sys.stderr)


@app.command()
def run(
    experiment: ExperimentName,
    assignments: Set = None,
    methods: Annotated[
        str | None, typer.Option(metavar="A,B", help="Only these of the experiment's methods.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Run folder; default reports/runs/NAME-TIME.")] = None,
    seed: Seed = None,
    tolerance: Tolerance = None,
    calibration: Known = None,
    backend: Backend = None,
    as_json: Json = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check everything, render nothing.")] = False,
    export_truth: Annotated[bool, typer.Option(help="Copy the truth into the run folder.")] = False,
    check_skips: Annotated[
        bool,
        typer.Option("--check-skips", help="Only expose a frame a method with and without what is left out."),
    ] = False,
) -> None:
    """Render, expose, decode and score an experiment; write a run folder with report.html."""
    from optsim.core.console import page, people, progress_bars
    from optsim.core.folder_claims import free_folder, output_folder
    from optsim.experiment import job
    from optsim.experiment.experiment import load_experiment
    from optsim.experiment.explain import too_short
    from optsim.experiment.run_folder import finished_run

    chosen = with_tolerance(assignments, tolerance, calibration)
    loaded = load_experiment(experiment, chosen, seed=seed)
    if methods is not None:
        loaded = loaded.only([name.strip() for name in methods.split(",")])
    if check_skips:
        show_skip_check(loaded, backend, as_json)
        return
    if out is not None:
        job.run_folder(loaded, out)
    if dry_run:
        folder = out or free_folder(loaded.name)
        needs = job.check(loaded, folder, backend)
        if as_json:
            print_json({"experiment": loaded.model_dump(mode="json"), "folder": str(folder), **needs})
        else:
            people.print(f"{loaded.name}: fine. Would write to {folder} on backend {needs['backend']}.")
            if short := too_short(loaded.n_frames, loaded.camera.latency_frames):
                people.print(short)
        return
    command = " ".join(["optsim", *sys.argv[1:]])
    with output_folder(out, loaded.name) as folder:
        job.check(loaded, folder, backend)
        results, why = finished_run(loaded, folder, backend=backend, export_truth=export_truth)
        if results is not None:
            people.print(f"{folder} holds a finished run of this experiment, by this code: nothing to do.")
        else:
            if why:
                people.print(f"{folder} holds a finished run of this experiment, made anew because: {why}.")
            try:
                with progress_bars() as progress:
                    results = job.execute(
                        loaded,
                        folder,
                        command=command,
                        backend=backend,
                        export_truth=export_truth,
                        progress=progress,
                    )
            except KeyboardInterrupt:
                if (folder / job.UNFINISHED).exists():
                    people.print(
                        f"Finished frames are in {folder}: with --out {folder} the same command finds them."
                    )
                raise
    if as_json:
        print_json(results.as_json())
    else:
        page.print(job.summary(results))
        page.print(f"Report: {folder / 'report.html'}")


@app.command()
def render(
    experiment: ExperimentName,
    assignments: Set = None,
    out: Annotated[
        Path | None, typer.Option(help="Also write slot means as OpenEXR into this folder.")
    ] = None,
    backend: Backend = None,
    passes: Annotated[
        bool,
        typer.Option(
            "--passes",
            help="Write one OpenEXR a slot into --out instead: radiance on the fine grid, colour, depth, "
            "normals, albedo, ids, flow, masks and poses.",
        ),
    ] = False,
    slots: Annotated[
        str | None, typer.Option(metavar="FIRST:LAST", help="With --passes: which slots, LAST not included.")
    ] = None,
    half: Annotated[
        bool, typer.Option("--half", help="With --passes: radiance, normals and albedo in 16 bit.")
    ] = False,
    light_groups: Annotated[
        bool, typer.Option("--light-groups", help="With --passes: the light of each group of lamps too.")
    ] = False,
    stokes: Annotated[bool, typer.Option("--stokes", help="With --passes: Stokes radiance too.")] = False,
    denoise: Annotated[bool, typer.Option("--denoise", help="With --passes: denoised radiance too.")] = False,
    independent_noise: Annotated[
        bool,
        typer.Option(
            "--independent-noise",
            help="With --passes: fresh noise in every slot, where nothing moves too, of render.static_error. "
            "Without it all slots share the noise of what stands still.",
        ),
    ] = False,
    noise_share: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="With --passes: --independent-noise, until it is X of (radiance + 1 % of white) in each "
            "slot, rms over the picture; the manifest says what was reached.",
        ),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option(help="Of a fine sample and slot, for light groups and Stokes [64], and for colour [2]."),
    ] = None,
) -> None:
    """Render an experiment's truth into the cache (and, with --out, as OpenEXR files)."""
    from contextlib import nullcontext

    from optsim.core.console import people, progress_bars
    from optsim.core.folder_claims import claimed_empty
    from optsim.experiment import job
    from optsim.experiment.experiment import load_experiment
    from optsim.experiment.truth import render_truth

    loaded = load_experiment(experiment, assignments or [])
    if not passes:
        of_passes = {
            "--slots": slots,
            "--half": half,
            "--light-groups": light_groups,
            "--stokes": stokes,
            "--denoise": denoise,
            "--independent-noise": independent_noise,
            "--noise-share": noise_share,
            "--samples": samples,
        }
        refuse_without("--passes", "--passes", of_passes)
    elif out is None:
        raise ConfigError("--passes: got no --out, expected a folder for its files; cure: add --out DIR")
    job.check(loaded, out, backend)
    if passes and out is not None:
        from optsim.dataset import choose_extras, export_passes, parse_slots

        chosen = None if slots is None else parse_slots(slots)
        wanted = {"light_groups": light_groups, "stokes": stokes, "denoise": denoise}
        extras = choose_extras(loaded, samples, **wanted)
        with progress_bars() as progress:
            export_passes(
                loaded,
                out,
                chosen,
                half=half,
                extras=extras,
                independent_noise=independent_noise,
                noise_share=noise_share,
                backend=backend,
                progress=progress,
            )
        people.print(f"The passes are in {out}; {out / 'passes.png'} shows them.")
        return
    with nullcontext() if out is None else claimed_empty(out), progress_bars() as progress:
        radiance = render_truth(loaded, backend=backend, progress=progress)
        if out is not None:
            job.export_radiance(radiance, out, loaded, progress)
    people.print("The truth is in the cache." if out is None else f"The truth is in {out}.")


@app.command()
def doctor(as_json: Json = False) -> None:
    """Say what was chosen on this machine and why, and the cure for each problem."""
    from dataclasses import asdict

    from optsim.app import doctor as physician
    from optsim.core.console import page, table

    findings = physician.diagnose()
    if as_json:
        print_json([asdict(f) for f in findings])
    else:
        for f in findings:
            page.print("ok " if f.ok else "BAD", style="green" if f.ok else "red", end=" ")
            page.print(f"{f.what}: {f.found}")
            if f.cure and not f.ok:
                page.print(f"    cure: {f.cure}")
        page.print(table("", ("findings", "problems"), [(len(findings), sum(not f.ok for f in findings))]))
    if not all(f.ok for f in findings):
        raise typer.Exit(1)


@app.command()
def explain(
    experiment: ExperimentName, assignments: Set = None, tolerance: Tolerance = None, as_json: Json = False
) -> None:
    """Geometry fit, photon ledger, latency, size of each imperfection and what is left out; no rendering."""
    # Its matrices are small, and BLAS's threads wait for work at full speed, in the way of others.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from optsim.core.console import page
    from optsim.experiment.experiment import experiment_path
    from optsim.experiment.explain import explanation, show

    experiment_path(experiment)
    record = explanation(experiment, with_tolerance(assignments, tolerance))
    if as_json:
        print_json(record)
    else:
        for item in show(record):
            page.print(item)
    if not record["geometry"]["fits"]:
        raise typer.Exit(2)


app.command("trace")(trace)
app.command("check")(check)
app.command("laboratory")(laboratory)
app.command("calibrate")(calibrate)
app.command("reconstruct")(reconstruct_files)
app.command("report")(remake_reports)
app.command("train")(train)
app.command("compare", cls=UsageIsThree)(compare)
app.command("accept")(accept)
app.command("regress")(regress)
app.command("sweep")(sweep)
app.command("operators")(operators)
app.command("tolerance")(tolerance)
app.command("waterfall")(waterfall)
app.command("yield")(yield_)
app.command("benchmark")(benchmark)
app.command("validate")(validate)
_LEAST_COLUMNS = 40
LISTS = ("scenes", "presets", "schemes", "decoders", "metrics", "effects", "parts", "objects")


@app.command("list")
def list_names(
    what: Annotated[str, typer.Argument(metavar=f"[{'|'.join(LISTS)}]")] = "presets", as_json: Json = False
) -> None:
    """List what is shipped, with one line each."""
    from optsim.app.catalogue import catalogue

    if what not in LISTS:
        raise unknown_name("list", what, LISTS)
    rows = catalogue(what)
    if as_json:
        print_json([{"name": name, "about": about} for name, about in rows])
    else:
        width = max(len(name) for name, _ in rows)
        for name, about in rows:
            typer.echo(f"{name:<{width}}  {about}")


@app.command()
def init(
    preset: Annotated[str, typer.Argument(metavar="NAME", help="Preset to copy.")],
    out: Annotated[Path | None, typer.Option(help="File to write; default NAME.toml here.")] = None,
) -> None:
    """Copy a preset to edit."""
    from optsim.core.files import write_new_text
    from optsim.experiment.experiment import experiment_path

    source = experiment_path(preset)
    target = out or Path(f"{source.stem}.toml")
    write_new_text(target, source.read_text(encoding="utf-8"))
    typer.echo(f"Wrote {target}. Run it with: optsim run {target if target.is_absolute() else f'./{target}'}")


def _remark(message: Warning | str, *_: object, **__: object) -> str:
    return f"optsim: {message}\n"


def main() -> None:
    """Run the command line; errors a user can cause end with exit code 2 and one message."""
    keep_freed_memory()
    _keep_width_readable()
    warnings.formatwarning = _remark
    command = typer.main.get_command(app)
    raise SystemExit(guarded(lambda: command.main(standalone_mode=False)))


def _keep_width_readable() -> None:
    """Ignore a width below 40 columns, or none: editors and build servers set 0, and Rich prints nothing."""
    width = os.environ.get("COLUMNS", "")
    if width and not (width.isdecimal() and int(width) >= _LEAST_COLUMNS):
        del os.environ["COLUMNS"]
