"""The command that decodes measurements of any camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, cast

import typer

from optsim.app.options import Json, Known, Set, print_json
from optsim.core.errors import ConfigError

_MANY = 0.25  # of all pixels: saturated ones that are worth a word (no source)


def reconstruct_files(
    measurement: Annotated[
        Path,
        typer.Argument(help="A TOML file, an .npz or .mat file with image and code, or the folder of a run."),
    ],
    assignments: Set = None,
    decoder: Annotated[
        str | None, typer.Option(help="Kind of decoder; default interpolation, or the run's own.")
    ] = None,
    method: Annotated[str | None, typer.Option(help="Of a run: whose frames.")] = None,
    calibration: Known = None,
    peak: Annotated[
        float | None, typer.Option(help="Peak of the PSNR; default the brightest of the truth.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder, new or empty; default a new one among the runs."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Decode coded images of any camera: light slot by slot as OpenEXR, a picture, a film and scores."""
    from optsim.core.config import build, override
    from optsim.core.console import page, people, progress_bars, table
    from optsim.core.files import check_empty
    from optsim.core.folder_claims import output_folder
    from optsim.experiment.measurement import decode_measurement, read_measurement
    from optsim.experiment.measurement.files import DecoderChoice, measurement_files
    from optsim.experiment.measurement.runs import decoder_of_run, read_run
    from optsim.experiment.run_folder import RECORD

    if out is not None:
        check_empty(out)
    if decoder and any(each.strip().startswith("decoder.kind") for each in assignments or ()):
        raise ConfigError(f"--decoder {decoder}: --set decoder.kind says the same; drop one of them")
    wanted = [*([f"decoder.kind={decoder}"] if decoder else []), *(assignments or [])]
    if (measurement / RECORD).is_file():
        own = decoder_of_run(measurement, method)
        start = {} if decoder else {"decoder": own.model_dump(mode="json")}
        where = "--decoder, --set" if decoder else "--set"
        chosen = build(DecoderChoice, override(start, wanted), where=where).decoder
        found = read_run(measurement, method, calibration)
    elif method is not None:
        raise ConfigError(f"--method {method}: {measurement} is no folder of a run; drop it")
    else:
        # Paths in the file start at its folder, those of the command line here.
        known = [] if calibration is None else [f"calibration={calibration.expanduser().absolute()}"]
        files = measurement_files(measurement, [*wanted, *known])
        found, chosen = read_measurement(files), files.decoder
    with (
        output_folder(out, f"reconstruct-{measurement.stem}") as folder,
        progress_bars(quiet=as_json) as progress,
    ):
        record = decode_measurement(found, chosen, folder, peak=peak, progress=progress)
    if as_json:
        print_json(record)
    else:
        inner = ("optsim", "measurement", "decoder", "psnr_db")
        shown = [(key, value) for key, value in record.items() if key not in inner]
        page.print(table(f"decoded by {chosen.kind}", ("what", "value"), shown))
        if scores := cast("list[float | None] | None", record["psnr_db"]):
            rows = [(index, each) for index, each in enumerate(scores)]
            page.print(table("PSNR", ("coded image", "dB"), rows))
        else:
            people.print(_no_score(found.origin, chosen.kind))
        if record["saturated_share"] > _MANY:
            people.print(
                f"{record['saturated_share']:.0%} of the pixels are saturated: of their light nothing is "
                "known but that it is bright. Expose less, or correct sensor.saturation."
            )
        if not record["valid_share"]:
            people.print(
                "No pixel is valid: each is dead or saturated, or its code never opens it. "
                "What is written is a guess."
            )
        people.print(f"Wrote {folder}")


def _no_score(origin: Mapping[str, object], decoder: str) -> str:
    """Say why a measurement has none, and how it could have one."""
    if "run" not in origin:
        return "No score: the measurement says no truth."
    return (
        "No score: a run's folder holds no truth. To score a decoder, run the experiment with "
        f"--set methods.{origin['method']}.decoder.kind={decoder}; the cache has the truth."
    )
