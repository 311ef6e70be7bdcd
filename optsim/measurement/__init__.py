"""Coded measurements of any camera, from arrays or files, and what a decoder makes of them."""

from optsim.measurement.coded import Measurement, Sensor, coded_measurement
from optsim.measurement.files import MeasurementFiles, read_measurement
from optsim.measurement.job import decode_measurement

__all__ = [
    "Measurement",
    "MeasurementFiles",
    "Sensor",
    "coded_measurement",
    "decode_measurement",
    "read_measurement",
]
