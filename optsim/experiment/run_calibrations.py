"""The calibrations of a run, in its folder: they join frames (CCD pixels) with codes (panel pixels)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from optsim.calibration import Calibration, read_calibration, write_calibration
from optsim.calibration.choice import CALIBRATION_FILE, CalibrationChoice
from optsim.core.errors import StorageError
from optsim.core.files import read_record
from optsim.experiment.experiment import Experiment

_RESULTS = "results.json"
_KEY = "calibration_files"


def calibration_names(experiment: Experiment) -> dict[CalibrationChoice, str]:
    """File of each calibration in a run's folder: one by the first method that alone knows it."""
    first, suffix = Path(CALIBRATION_FILE).stem, Path(CALIBRATION_FILE).suffix
    names = {experiment.calibration_choice: CALIBRATION_FILE}
    for method in experiment.methods:
        names.setdefault(experiment.choice_of(method), f"{first}-{method.name}{suffix}")
    return names


def keep_calibrations(
    experiment: Experiment, folder: Path, calibrations: Mapping[CalibrationChoice, Calibration]
) -> list[dict[str, Any]]:
    """Write all calibrations of a run into its folder; return what results.json says of them."""
    records: list[dict[str, Any]] = []
    for known, name in calibration_names(experiment).items():
        write_calibration(folder / name, calibrations[known])
        records.append(
            {
                "calibration": str(known),
                "file": name,
                "sha256": sha256_of(folder / name),
                "methods": [m.name for m in experiment.methods if experiment.choice_of(m) == known],
            }
        )
    return records


def calibration_of_run(experiment: Experiment, folder: Path, known: CalibrationChoice) -> Calibration | None:
    """Read what a run kept; None of one that kept none, as earlier versions did.

    Raises
    ------
    StorageError
        When the file is lost or damaged, or is not the one that the run wrote.
    """
    name = calibration_names(experiment)[known]
    path = folder / name
    said = read_record(folder / _RESULTS).get(_KEY) if (folder / _RESULTS).is_file() else None
    if not isinstance(said, list):
        return read_calibration(path) if path.is_file() else None
    hashes = {each.get("file"): each.get("sha256") for each in cast("list[dict[str, object]]", said)}
    if not path.is_file() or sha256_of(path) != hashes.get(name):
        got = "another file than the run wrote" if path.is_file() else "no such file"
        raise StorageError(f"{path}: got {got}, expected that of {_RESULTS}; cure: run the experiment again")
    return read_calibration(path)


def sha256_of(path: Path) -> str:
    """Hash a file as results.json states it."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
