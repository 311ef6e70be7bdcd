"""What a finished run's folder holds: the same command on the same code doesn't make it again."""

from __future__ import annotations

import os
import platform
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

from optsim import __version__
from optsim.core.code_hash import hash_files
from optsim.core.errors import OptsimError
from optsim.core.files import read_record, sum_of
from optsim.experiment.experiment import Experiment
from optsim.experiment.journal import run_key
from optsim.experiment.run_calibrations import sha256_of
from optsim.experiment.run_frames import CHECKSUMS
from optsim.experiment.truth import renderer
from optsim.report.schema import check_results

UNFINISHED = "unfinished"
"""Folder in a run's, of its journal; gone when the run is done."""

_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "numba", "OpenEXR", "scikit-image", "colour-science")
# What a report shows beside the numbers of its run.
_SHOWN = ("optsim/experiment/evidence.json", "optsim/report/template/*")


def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    return {
        "optsim": __version__,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors",
        **{name: version(name) for name in _PACKAGES},
    }


def results_key(experiment: Experiment, backend: str) -> str:
    """Hash of what decides the numbers and the report of a run; ``backend`` is the one chosen."""
    return run_key(experiment, backend, versions(), hash_files(_SHOWN))


def finished_run(
    experiment: Experiment, folder: Path, *, backend: str | None = None, export_truth: bool = False
) -> tuple[dict[str, Any] | None, str]:
    """Find what an earlier run of an experiment left in its folder, and whether it is still what it would be.

    Parameters
    ----------
    experiment : Experiment
        The folder's own.
    folder : Path
        Of the run, or none yet.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    export_truth : bool
        Whether the folder must hold the truth too.

    Returns
    -------
    results : dict or None
        Content of results.json; None when the run is to be made, for the first time or anew.
    why : str
        Why a finished run is made anew; empty when there is none.
    """
    if not (folder / "results.json").exists():
        return None, ""
    if (folder / UNFINISHED).exists():
        return None, "another run into it was stopped"
    results: dict[str, Any] = {}
    with suppress(OptsimError):
        results = cast("dict[str, Any]", check_results(read_record(folder / "results.json")))
    if not results:
        return None, "its results.json is damaged, or of another version"
    chosen, _ = renderer(experiment, backend)
    if results.get("run_key") != results_key(experiment, chosen):
        return None, _changes(results, chosen)
    # A truth of another run may lie there, whose results these aren't.
    if export_truth and not results.get("exported_truth"):
        return None, "it holds no truth"
    series = [f"reconstructions/{name}" for name in experiment.save_reconstructions]
    lost = _lost(folder, results, [*series, *(["truth"] if export_truth else [])], experiment.n_frames)
    if lost:
        return None, f"{lost} is lost or changed"
    return results, ""


def _changes(results: dict[str, Any], backend: str) -> str:
    """Say what is other than when a run was made."""
    before, now = results["versions"], versions()
    changes = [
        f"{name} was {before.get(name, 'absent')} and is {now.get(name, 'absent')}"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    ]
    was = results["backend"].partition(":")[0]
    if was != backend:
        changes.append(f"backend was {was} and is {backend}")
    return ", ".join(changes) or "the code of optsim, or a file that the experiment names, has changed since"


def _lost(folder: Path, results: dict[str, Any], series: list[str], n_frames: int) -> str:
    """Name what of a run isn't there any more, or isn't as it was written; empty when all is."""
    for name in ("report.html", *(picture["file"] for picture in results["pictures"])):
        path = folder / name
        if not path.is_file() or not path.stat().st_size:
            return name
    for name in series:
        if len(list((folder / name).glob("*.exr"))) != n_frames:
            return name
    name = CHECKSUMS
    try:
        for each in results["calibration_files"]:
            name = each["file"]
            if sha256_of(folder / name) != each["sha256"]:
                return name
        for name, written in read_record(folder / CHECKSUMS).items():
            if list(sum_of(folder / name)) != written:
                return name
    except (OSError, OptsimError):
        return name
    return ""
