# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""The frames of a finished run as a measurement, to be decoded again in another way."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
from skimage.io import imread

from optsim.config import Table, build
from optsim.errors import ConfigError, StorageError, unknown_name
from optsim.experiment import Experiment, Method
from optsim.files import read_exr, read_png16, read_record
from optsim.loop import calibrate, planned
from optsim.measurement.coded import Measurement
from optsim.quantities import CodedFrame, ExposureCode
from optsim.reconstruct import Decoder
from optsim.run_calibrations import calibration_of_run

RECORD = "experiment.json"


def decoder_of_run(folder: Path, method: str | None) -> Decoder:
    """Read which decoder one of a run's methods had; parameters and errors as of :func:`read_run`."""
    return _method_of_run(folder, method)[1].decoder


def read_run(folder: Path, method: str | None) -> Measurement:
    """Read the frames of one of a run's methods, with what its decoder knew of the camera.

    A run that kept no calibration, as earlier versions did, is calibrated anew.

    Parameters
    ----------
    folder : Path
        Of ``optsim run``.
    method : str or None
        Its name; None where there is only one.

    Raises
    ------
    ConfigError, StorageError
        For an unknown method, or a folder that is no whole run.
    """
    experiment, chosen = _method_of_run(folder, method)
    paths = sorted((folder / "frames" / chosen.name).glob("*.png"))
    if len(paths) != experiment.n_frames:
        raise StorageError(
            f"{folder}: got {len(paths)} frames of {chosen.name!r}, expected {experiment.n_frames}; "
            "cure: optsim run with --out, which goes on where it stopped"
        )
    frames = [_frame(folder, chosen.name, index) for index in range(experiment.n_frames)]
    known = experiment.known_to(chosen)
    calibration = calibration_of_run(experiment, folder, known)
    if calibration is None:
        calibration = calibrate(planned(experiment)[0], known)
    origin = {
        "run": str(folder),
        "method": chosen.name,
        "fingerprint": experiment.fingerprint(),
        "calibration": str(known),
    }
    return Measurement(tuple(frames), calibration, (), "W m^-2 on the modulator", 0.0, origin)


def _method_of_run(folder: Path, method: str | None) -> tuple[Experiment, Method]:
    stated = read_record(folder / RECORD).get("experiment")
    if not isinstance(stated, dict):
        raise StorageError(f"{folder / RECORD}: got no experiment in it, expected what 'optsim run' writes")
    experiment = build(Experiment, cast("Table", stated), where=str(folder / RECORD))
    names = [each.name for each in experiment.methods]
    if method is None and len(names) > 1:
        raise ConfigError(f"--method: missing; {folder} holds {', '.join(names)}")
    chosen = next((each for each in experiment.methods if method in (None, each.name)), None)
    if chosen is None:
        raise unknown_name("--method", str(method), names)
    return experiment, chosen


def _frame(folder: Path, name: str, index: int) -> CodedFrame:
    stem = f"{index:06d}"
    channels, _ = read_exr(folder / "codes" / name / f"{stem}.exr")
    levels = np.stack([channels[slot] for slot in sorted(channels)]).astype(np.uint8)
    mask = imread(folder / "masks" / name / f"{stem}.png") > 0
    return CodedFrame(index, read_png16(folder / "frames" / name / f"{stem}.png"), ExposureCode(levels, mask))
