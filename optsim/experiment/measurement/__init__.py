"""Coded measurements of any camera, from arrays or files, and their decoding."""

from optsim.experiment.measurement.coded import Measurement, Sensor, coded_measurement
from optsim.experiment.measurement.files import MeasurementFiles, read_measurement
from optsim.experiment.measurement.job import decode_measurement

__all__ = [
    "Measurement",
    "MeasurementFiles",
    "Sensor",
    "coded_measurement",
    "decode_measurement",
    "read_measurement",
]
