"""The folder of a run: its owner, its files, and whether a finished run is still valid."""

from __future__ import annotations

import contextlib
import os
import platform
import subprocess
from collections.abc import Generator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from optsim import __version__
from optsim.calibration import Calibration, write_calibration
from optsim.calibration.choice import CALIBRATION_FILE, CalibrationChoice
from optsim.core.code_hash import hash_files
from optsim.core.errors import OptsimError, StorageError
from optsim.core.extensions import extension_versions
from optsim.core.files import (
    content_hash,
    holds_nothing,
    read_record,
    sum_of,
    write_exr,
    write_json,
    write_png8,
    write_png16,
)
from optsim.core.quantities import CodedFrame, Floats, Reconstruction
from optsim.experiment.experiment import Experiment
from optsim.experiment.resume import UNFINISHED, run_key
from optsim.experiment.truth import renderer
from optsim.report.schema import RESULTS, CalibrationFile, Results, check_results

RECORD = "experiment.json"
"""Whose folder it is: an experiment and its fingerprint."""
CHECKSUMS = "checksums.json"
"""Size and CRC-32 of what :data:`_KEPT` matches, by its place in the folder."""
_KEPT = (
    "calibration*.npz",
    "frames/*/*.png",
    "masks/*/*.png",
    "codes/*/*.exr",
    "reconstructions/*/*.exr",
    "truth/*.exr",
)
_PACKAGES = ("mitsuba", "drjit", "numpy", "scipy", "numba", "OpenEXR", "scikit-image", "colour-science")
# Files that a report shows beside the numbers of its run.
_SHOWN = ("optsim/experiment/evidence.json", "optsim/report/template/*")


def run_folder(experiment: Experiment, out: Path) -> Path:
    """Return the folder of a run; refuse one of another experiment, or with other files."""
    if out.is_file():
        raise StorageError(f"--out {out} is a file; expected a folder")
    if out.is_dir() and not holds_nothing(out):
        if not (out / RECORD).is_file():
            raise StorageError(f"--out {out} is not empty and holds no run; choose a new or an empty folder")
        if read_record(out / RECORD).get("fingerprint") != experiment.fingerprint():
            raise StorageError(
                f"--out {out} holds a run of another experiment; choose another folder, "
                f"or run that experiment (its resolved form is in {RECORD})"
            )
    return out


@contextlib.contextmanager
def stated(folder: Path, experiment: Experiment) -> Generator[None, None, None]:
    """Write the folder's experiment; if the truth is then refused before any result, remove it again."""
    path = folder / RECORD
    begun = path.exists()
    statement = {"fingerprint": experiment.fingerprint(), "experiment": experiment.model_dump(mode="json")}
    write_json(path, statement)
    try:
        yield
    except OptsimError:
        if not begun:
            path.unlink()
        raise


# --- what is written ------------------------------------------------------------------------------------


def calibration_names(experiment: Experiment) -> dict[CalibrationChoice, str]:
    """Name the file of each calibration in a run's folder: one by the first method that alone has it."""
    first, suffix = Path(CALIBRATION_FILE).stem, Path(CALIBRATION_FILE).suffix
    names = {experiment.calibration_choice: CALIBRATION_FILE}
    for method in experiment.methods:
        names.setdefault(experiment.choice_of(method), f"{first}-{method.name}{suffix}")
    return names


def write_calibrations(
    experiment: Experiment, folder: Path, calibrations: Mapping[CalibrationChoice, Calibration]
) -> list[CalibrationFile]:
    """Write all calibrations of a run into its folder; return their entry of results.json."""
    records: list[CalibrationFile] = []
    for choice, name in calibration_names(experiment).items():
        write_calibration(folder / name, calibrations[choice])
        records.append(
            CalibrationFile(
                calibration=str(choice),
                file=name,
                sha256=content_hash(folder / name),
                methods=[m.name for m in experiment.methods if experiment.choice_of(m) == choice],
            )
        )
    return records


def frame_files(folder: Path, method: str, index: int) -> tuple[Path, Path, Path]:
    """Files of a coded frame: digital numbers, mask, code."""
    return (
        folder / "frames" / method / f"{index:06d}.png",
        folder / "masks" / method / f"{index:06d}.png",
        folder / "codes" / method / f"{index:06d}.exr",
    )


def write_frames(folder: Path, frames: Mapping[str, Sequence[CodedFrame]]) -> None:
    """Write the coded frames of each method: digital numbers, masks and codes."""
    for name, taken in frames.items():
        for frame in taken:
            dn, mask, code = frame_files(folder, name, frame.index)
            write_png16(dn, frame.dn)
            write_png8(mask, frame.code.moving.astype(np.uint8) * 255)
            levels: Floats = frame.code.levels.astype(np.float32)
            write_exr(
                code,
                {f"slot{slot:02d}": levels[slot] for slot in range(len(levels))},
                attributes={"unit": "drive level 0..255", "axes": "slot, v, u", "frame": frame.index},
                half=True,
            )


def write_reconstruction(folder: Path, name: str, video: Reconstruction, per_radiance: float) -> None:
    """Half floats of radiance: in half precision the small irradiance on the panel would lose dark parts."""
    radiance = (video.irradiance_w_m2 / per_radiance).astype(np.float32)
    write_exr(
        folder / "reconstructions" / name / f"{video.index:06d}.exr",
        {f"slot{slot:02d}": radiance[slot] for slot in range(len(radiance))},
        attributes={
            "unit": "W m^-2 sr^-1, irradiance on the modulator over irradiance_per_radiance",
            "irradiance_per_radiance": per_radiance,
            "axes": "slot, v, u",
            "frame": video.index,
        },
        half=True,
    )


# --- whether it still holds -----------------------------------------------------------------------------


def write_checksums(folder: Path) -> None:
    """Write :data:`CHECKSUMS` of the present files in a run's folder."""
    paths = [path for pattern in _KEPT for path in sorted(folder.glob(pattern))]
    write_json(folder / CHECKSUMS, {path.relative_to(folder).as_posix(): sum_of(path) for path in paths})


def changed_file(folder: Path, names: Sequence[str] | None = None) -> str:
    """Name the first file, of all listed ones by default, that differs from :data:`CHECKSUMS`; else empty."""
    sums = read_record(folder / CHECKSUMS)
    for name in sums if names is None else names:
        if not (folder / name).is_file() or list(sum_of(folder / name)) != sums.get(name):
            return name
    return ""


def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    return {
        "optsim": __version__,
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}, {os.cpu_count()} processors",
        **{name: version(name) for name in _PACKAGES},
        **extension_versions(),
    }


def libraries() -> dict[str, str]:
    """Versions without the machine's, for files that machines with the same libraries make alike."""
    return {name: text for name, text in versions().items() if name != "platform"}


def commit() -> str | None:
    """Name the commit of the source tree, with a plus where files differ from it; None outside of one."""
    root = Path(__file__).parents[2]
    if not (root / ".git").exists():
        return None
    said: list[str] = []
    for words in (("rev-parse", "--short=10", "HEAD"), ("status", "--porcelain", "--untracked-files=no")):
        try:
            output = subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            return None
        said.append(output.stdout.strip())
    return said[0] + ("+" if said[1] else "")


def results_key(experiment: Experiment, backend: str) -> str:
    """Hash all that determines the numbers and the report of a run; ``backend`` is the one chosen."""
    return run_key(experiment, backend, versions(), hash_files(_SHOWN))


def finished_run(
    experiment: Experiment, folder: Path, *, backend: str | None = None, export_truth: bool = False
) -> tuple[Results | None, str]:
    """Results of an earlier run that still hold, or None and the reason to repeat a finished run."""
    if not (folder / RESULTS).exists():
        return None, ""
    if (folder / UNFINISHED).exists():
        return None, "another run into it was stopped"
    results = None
    with contextlib.suppress(OptsimError):
        results = check_results(read_record(folder / RESULTS))
    if results is None:
        return None, f"its {RESULTS} is damaged, or of another version"
    chosen, _ = renderer(experiment, backend)
    if results.run_key != results_key(experiment, chosen):
        return None, _changes(results, chosen)
    # A truth of another run may lie there, with other results.
    if export_truth and not results.exported_truth:
        return None, "it holds no truth"
    shown = ("report.html", CHECKSUMS, *results.files)
    empty = [name for name in shown if not ((folder / name).is_file() and (folder / name).stat().st_size)]
    try:
        lost = empty[0] if empty else changed_file(folder)
    except StorageError:
        lost = CHECKSUMS
    return (None, f"{lost} is lost or changed") if lost else (results, "")


def _changes(results: Results, backend: str) -> str:
    """Describe the differences from the conditions of a run."""
    before, now = results.versions, versions()
    changes = [
        f"{name} was {before.get(name, 'absent')} and is {now.get(name, 'absent')}"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    ]
    was = results.backend.partition(":")[0]
    if was != backend:
        changes.append(f"backend was {was} and is {backend}")
    return ", ".join(changes) or "the code of optsim, or a file that the experiment names, has changed since"
