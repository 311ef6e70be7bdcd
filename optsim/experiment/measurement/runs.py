"""The frames of a finished run as a measurement, for another decoder."""

from __future__ import annotations

from collections.abc import Sequence
from math import prod
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from optsim.calibration import read_calibration
from optsim.calibration.choice import CalibrationChoice
from optsim.camera.true_calibration import stored_calibration
from optsim.core.config import Table, build
from optsim.core.errors import ConfigError, StorageError, unknown_name
from optsim.core.files import read_record
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.decoding import Decoder
from optsim.experiment.experiment import Experiment, Method
from optsim.experiment.measurement.coded import Measurement
from optsim.experiment.run_folder import CHECKSUMS, RECORD, calibration_names, changed_file, frame_files
from optsim.footage.measured import read_pictures

_CURE = "cure: copy the run's folder again, or run the experiment again"


def decoder_of_run(folder: Path, method: str | None) -> Decoder:
    """Read the decoder of one of a run's methods; parameters and errors as in :func:`read_run`."""
    return _method_of_run(folder, method)[1].decoder


def read_run(folder: Path, method: str | None, calibration: Path | None = None) -> Measurement:
    """Read the frames of one of a run's methods, with its calibration or another one.

    Parameters
    ----------
    folder : Path
        Folder of ``optsim run``.
    method : str or None
        Name of the method; None where there is only one.
    calibration : Path or None
        Calibration to use instead of the run's own.

    Raises
    ------
    ConfigError, StorageError
        For an unknown method, or a folder without a complete run.
    """
    experiment, chosen = _method_of_run(folder, method)
    camera = experiment.camera
    ccd = camera.sensor.rows, camera.sensor.cols
    code = camera.slots_per_frame, camera.panel_rows, camera.panel_cols
    frames = read_frames(folder, chosen.name, experiment.n_frames, ccd, code)
    choice = experiment.choice_of(chosen)
    if calibration is None:
        kept = folder / calibration_names(experiment)[choice]
        _check_written(folder, [kept], "a calibration")
        found = read_calibration(kept)
    else:
        choice = CalibrationChoice(str(calibration), choice.reading_px)
        found = stored_calibration(choice, camera)
    origin = {
        "run": str(folder),
        "method": chosen.name,
        "fingerprint": experiment.fingerprint(),
        "calibration": str(choice),
    }
    return Measurement(tuple(frames), found, (), "W m^-2 on the modulator", 0.0, origin)


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


def read_frames(
    folder: Path, method: str, n_frames: int, ccd: tuple[int, int], code: tuple[int, int, int]
) -> list[CodedFrame]:
    """Read the frames of a method as the run wrote them."""
    files = [frame_files(folder, method, index) for index in range(n_frames)]
    found = sorted((folder / "frames" / method).glob("*.png"))
    if found != [each[0] for each in files]:
        raise StorageError(
            f"{folder}: got {len(found)} frames of {method!r}, expected {n_frames}, numbered from 0; "
            "cure: optsim run with --out, which goes on where it stopped"
        )
    sizes = [" x ".join(map(str, shape)) for shape in (ccd, code)]
    frames: list[CodedFrame] = []
    for index, (dn_file, mask_file, code_file) in enumerate(files):
        _check_written(folder, files[index], f"a frame of {sizes[0]} pixels, with a code of {sizes[1]}")
        dn = _picture(dn_file, ccd, np.uint16)
        mask = _picture(mask_file, code[1:], np.uint8)
        levels = _picture(code_file, code, np.float32)
        if not np.isin(levels, np.arange(256)).all():
            raise StorageError(f"{code_file}: got drive levels that are no whole numbers 0 to 255; {_CURE}")
        frames.append(CodedFrame(index, dn, ExposureCode(levels.astype(np.uint8), mask > 0)))
    return frames


def _picture(path: Path, shape: tuple[int, ...], dtype: type[np.generic]) -> NDArray[Any]:
    found = read_pictures(path, "frames", slots=len(shape) == 3)
    if found.dtype != dtype or found.shape[-2:] != shape[-2:] or found.size != prod(shape):
        raise StorageError(
            f"{path}: got {found.dtype} of {' x '.join(map(str, found.shape[1:]))}, expected "
            f"{np.dtype(dtype)} of {' x '.join(map(str, shape))}; {_CURE}"
        )
    return found.reshape(shape)


def _check_written(folder: Path, files: Sequence[Path], what: str) -> None:
    """Refuse a file that is missing or changed since the run."""
    if not (folder / CHECKSUMS).is_file():
        raise StorageError(f"{folder / CHECKSUMS}: got no such file, expected what the run wrote; {_CURE}")
    changed = changed_file(folder, [path.relative_to(folder).as_posix() for path in files])
    if changed:
        got = "other content" if (folder / changed).is_file() else "no such file"
        raise StorageError(
            f"{folder / changed}: got {got}, expected what the run wrote by {CHECKSUMS}, {what}; {_CURE}; "
            "to decode images of your own, name them in a TOML file"
        )
