"""Bench files -> Calibration, for schemes and decoders. It uses no camera: real bench files work too."""

from optsim.calibration.bench import Bench, Flat, Patches, Step
from optsim.calibration.calibration import Calibration, Observation
from optsim.calibration.estimate import calibrate_from
from optsim.calibration.glare import Glare
from optsim.calibration.grey_curve import read_grey_curve
from optsim.calibration.linear_operator import linear_operator
from optsim.calibration.stored import read_calibration, write_calibration

__all__ = [
    "Bench",
    "Calibration",
    "Flat",
    "Glare",
    "Observation",
    "Patches",
    "Step",
    "calibrate_from",
    "linear_operator",
    "read_calibration",
    "read_grey_curve",
    "write_calibration",
]
