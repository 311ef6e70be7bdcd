"""Bench files -> Calibration. Knows no camera, so the files of a real bench work too."""

from optsim.calibrate.bench import Bench, Flat, Patches, Step
from optsim.calibrate.calibration import Calibration, Observation
from optsim.calibrate.estimate import calibrate_from
from optsim.calibrate.glare import Glare
from optsim.calibrate.stored import read_calibration, write_calibration

__all__ = [
    "Bench",
    "Calibration",
    "Flat",
    "Glare",
    "Observation",
    "Patches",
    "Step",
    "calibrate_from",
    "read_calibration",
    "write_calibration",
]
