"""Commands of the bench: take its images, and calibrate a camera from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from optsim.app.options import (
    ExperimentName,
    Json,
    Seed,
    Set,
    Tolerance,
    print_json,
    refuse_without,
    with_tolerance,
)
from optsim.core.errors import ConfigError, unknown_name


def laboratory(
    experiment: ExperimentName,
    out: Annotated[Path, typer.Option(help="Folder, new or empty; the same bench goes on.")],
    assignments: Set = None,
    seed: Seed = None,
    tolerance: Tolerance = None,
    few: Annotated[
        bool, typer.Option("--few", help="60 images instead of about 150, with wider intervals.")
    ] = False,
    image_format: Annotated[
        str, typer.Option("--format", help="Format of the images, 16 bit: png or tiff.")
    ] = "png",
) -> None:
    """Take the images of a virtual bench, as a real laboratory would: 16-bit images and a manifest.

    They are those that 'optsim run' calibrates from. Stopped, it goes on where it was.
    """
    from optsim.calibration.bench_images import WRITERS
    from optsim.calibration.choice import BENCH_FILE
    from optsim.camera.bench_folder import take_bench
    from optsim.camera.laboratory import ALL_FRAMES, FEW_FRAMES
    from optsim.core.console import people, progress_bars
    from optsim.experiment.calibration_record import bench_camera
    from optsim.experiment.calibrations import bench_noise
    from optsim.experiment.experiment import load_experiment

    if image_format not in WRITERS:
        raise unknown_name("format", image_format, WRITERS)
    loaded = load_experiment(experiment, with_tolerance(assignments, tolerance), seed=seed)
    with progress_bars() as progress:
        made = take_bench(
            bench_camera(loaded),
            bench_noise(loaded),
            out,
            about={"experiment": loaded.name, "seed": loaded.seed},
            frames=FEW_FRAMES if few else ALL_FRAMES,
            suffix=image_format,
            progress=progress,
        )
    if not made:
        people.print(f"{out} holds this bench: nothing to do.")
    people.print(f"Manifest: {out / BENCH_FILE}. Calibrate with: optsim calibrate {out}")


def calibrate(
    bench: Annotated[
        Path, typer.Argument(metavar="BENCH", help="Folder of images with a bench.json, simulated or real.")
    ],
    out: Annotated[Path, typer.Option(help="File to write; a page and a .json lie beside it.")] = Path(
        "calibration.npz"
    ),
    reading_px: Annotated[
        int, typer.Option(min=1, max=9, help="Side of the readout window, CCD pixels, odd.")
    ] = 1,
    truth: Annotated[
        str | None,
        typer.Option(metavar="EXPERIMENT", help="Score against the camera of this experiment."),
    ] = None,
    before: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Earlier calibration: flag this one unless it explains held-out images better.",
        ),
    ] = None,
    assignments: Set = None,
    as_json: Json = False,
) -> None:
    """Calibrate a camera from the images of a bench; write the calibration, its numbers and a page.

    'optsim run' and 'optsim reconstruct' take the file with --calibration. --set is of --truth.
    """
    from optsim.calibration import Bench, write_calibration
    from optsim.calibration.estimate import calibrate_from, measure_calibration
    from optsim.calibration.held_out import check_same_camera, explained, held_out
    from optsim.calibration.stored import read_calibration
    from optsim.core.console import page, people, progress_bars
    from optsim.core.files import writable_folder, write_json
    from optsim.experiment.calibration_record import (
        bench_camera,
        calibration_record,
        field_images,
        with_before,
        with_truth,
    )
    from optsim.experiment.experiment import load_experiment
    from optsim.report.calibration_page import summary, write_calibration_page

    if out.suffix != ".npz":
        raise ConfigError(f"--out {out}: got {out.suffix or 'no suffix'}, expected .npz; cure: {out}.npz")
    if reading_px % 2 == 0:
        raise ConfigError(f"--reading-px: got {reading_px}, expected an odd number; cure: {reading_px + 1}")
    if truth is None:
        refuse_without("--truth", "--truth EXPERIMENT", {"--set": assignments})
    writable_folder(out.parent, "--out", "choose another one")
    known = None if truth is None else load_experiment(truth, assignments or [])
    earlier = None if before is None else read_calibration(before)
    images = Bench.read(bench)
    rest, spared = (images, ()) if before is None else held_out(images)
    if earlier is not None:
        check_same_camera(earlier, images, before)
    with progress_bars(quiet=as_json) as progress:
        measured = measure_calibration(images, reading_px, progress)
    record = calibration_record(measured, images, bench)
    if known is not None:
        record = with_truth(record, measured, images, bench_camera(known), known.name)
    if before is not None and earlier is not None:
        record = with_before(record, explained(earlier, calibrate_from(rest, reading_px), spared), before)
    write_calibration(out, measured.calibration)
    write_json(out.with_suffix(".json"), record.as_json())
    pixel_map = measured.pixel_map
    write_calibration_page(
        out.with_suffix(".html"),
        record,
        dots_px=pixel_map.dots_px,
        off_px=pixel_map.on_panel(pixel_map.off_ccd_px),
        fields=field_images(measured),
    )
    if as_json:
        print_json(record.as_json())
    else:
        for item in summary(record):
            page.print(item)
        people.print(f"Wrote {out}. Page: {out.with_suffix('.html')}. Use it with: --calibration {out}")
