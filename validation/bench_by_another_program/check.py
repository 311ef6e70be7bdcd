"""A bench that a second program wrote, of a camera that it made, calibrated by the command."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType

import numpy as np

from optsim.calibration import Bench, read_calibration
from optsim.calibration.estimate import measure_calibration

CLAIM = (
    "`optsim calibrate` takes a folder that another program wrote, and finds its camera: gain and read noise "
    "to 1 %, the panel's time constants to 2 %, when its rows turn to 0.005 slots, the leak to 2 %, the grey "
    "exponent to 0.5 %, veiling glare to 15 %, and the centres of the panel's pixels to 0.03 panel pixels "
    "rms under shift, rotation, tilt, distortion and a magnification that is not nominal"
)
ORACLE = (
    "second_program.py: a camera and a PNG writer in numpy and the standard library, without a line of optsim"
)
SOURCE = "docs/how-to/calibration.md, the format; ISO/IEC 15948 (PNG)"
TOLERANCE = 1.0
REASON = "The deviation of each number is divided by the bound claimed for it: 1 is the edge of the claim."
FILES = ("optsim/calibration/*.py", "optsim/app/calibrate.py")

_HERE = Path(__file__).parent


def second_program() -> ModuleType:
    """Load the program as a module."""
    spec = importlib.util.spec_from_file_location("second_program", _HERE / "second_program.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def deviation(folder: Path) -> float:
    """Largest deviation of what the command finds, each over its claimed bound."""
    program = second_program()
    camera = program.MISALIGNED
    out = folder / "found.npz"
    command = [sys.executable, "-m", "optsim", "calibrate", str(folder), "--out", str(out)]
    subprocess.run(command, check=True, capture_output=True, cwd=_HERE.parents[1])
    found = read_calibration(out)
    numbers = {
        each["key"]: each["value"] for each in json.loads(out.with_suffix(".json").read_text())["quantities"]
    }
    truth = camera.truth()
    bounds = {"dn_per_e": 0.01, "read_noise_dn": 0.01, "tau_on_s": 0.02, "tau_off_s": 0.02, "leak": 0.02}
    bounds |= {"drive_exponent": 0.005}
    off = {key: (numbers[key] / truth[key] - 1) / bound for key, bound in bounds.items()}
    rows = (np.arange(camera.panel[0]) + 0.5) / camera.panel[0]
    late_s = camera.delay_s + camera.scan_s * rows
    off["rows"] = np.abs(found.response.row_delays_s(len(rows)) - late_s).max() / program.SLOT_S / 0.005
    # Its veil is a share of the CCD's mean; a calibration's of the panel's, which the whole CCD dilutes.
    diluted = np.prod(camera.panel) * (camera.ratio * camera.magnification) ** 2 / np.prod(camera.ccd)
    off["veil"] = (numbers["glare_veil"] / (camera.veil * diluted) - 1) / 0.15
    centres = np.indices(camera.panel).reshape(2, -1).T + 0.5
    there = measure_calibration(Bench.read(folder)).pixel_map.on_ccd(centres)
    off["map"] = np.sqrt(np.mean(np.sum((there - camera.centres()) ** 2, axis=1))) / camera.ratio / 0.03
    return float(max(off.values(), key=abs))


def measure() -> float:
    with tempfile.TemporaryDirectory() as folder:
        program = _HERE / "second_program.py"
        # -I: not even a path to optsim.
        subprocess.run([sys.executable, "-I", str(program), folder], check=True)
        return deviation(Path(folder))


def perturbed() -> float:
    """Do the same with a wrong clock: every flash is stated a fiftieth of a slot too late."""
    program = second_program()
    with tempfile.TemporaryDirectory() as folder:
        program.write(Path(folder), program.bench(program.MISALIGNED, seed=20, clock=1 / 50))
        return deviation(Path(folder))
