"""Bench files -> Calibration. Knows no camera, so the files of a real bench work too."""

from optsim.calibrate.bench import Bench, Flat, Patches, Step
from optsim.calibrate.calibration import Calibration, Observation
from optsim.calibrate.estimate import calibrate_from

__all__ = ["Bench", "Calibration", "Flat", "Observation", "Patches", "Step", "calibrate_from"]
