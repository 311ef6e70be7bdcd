"""The frames of a finished run as a measurement, to be decoded again in another way."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from optsim.core.config import Table, build
from optsim.core.errors import ConfigError, StorageError, unknown_name
from optsim.core.files import read_record
from optsim.decoding import Decoder
from optsim.experiment.experiment import Experiment, Method
from optsim.experiment.loop import calibrate, planned
from optsim.experiment.measurement.coded import Measurement
from optsim.experiment.run_calibrations import calibration_of_run
from optsim.experiment.run_frames import read_frames

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
    camera = experiment.camera
    ccd = camera.sensor.rows, camera.sensor.cols
    code = camera.slots_per_frame, camera.panel_rows, camera.panel_cols
    frames = read_frames(folder, chosen.name, experiment.n_frames, ccd, code)
    known = experiment.choice_of(chosen)
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
    record = read_record(folder / RECORD)
    stated = record.get("experiment")
    if not isinstance(stated, dict):
        raise StorageError(f"{folder / RECORD}: got no experiment in it, expected what 'optsim run' writes")
    experiment = build(Experiment, cast("Table", stated), where=str(folder / RECORD))
    if record.get("fingerprint") != experiment.fingerprint():
        raise StorageError(
            f"{folder / RECORD}: its fingerprint is not that of the experiment in it, which was edited or "
            "is of another version of optsim; cure: decode it with that version, or run the experiment again"
        )
    names = [each.name for each in experiment.methods]
    if method is None and len(names) > 1:
        raise ConfigError(f"--method: missing; {folder} holds {', '.join(names)}")
    chosen = next((each for each in experiment.methods if method in (None, each.name)), None)
    if chosen is None:
        raise unknown_name("--method", str(method), names)
    return experiment, chosen
