"""Gain by the photon-transfer method on simulated flats, as a laboratory would measure it on the real CCD."""

from __future__ import annotations

import numpy as np

from optsim.camera.hardware import icx674
from optsim.camera.parts import Ccd

CLAIM = "pairs of flats give back the sensor's gain by the photon-transfer method, with PRNU and DSNU present"
ORACLE = (
    "EMVA 1288 estimator: variance of differences of two flats over twice the mean's rise above dark, fitted "
    "by least squares with weights over 12 levels below half of the well; numpy only"
)
SOURCE = "EMVA Standard 1288, release 4.0 Linear, section 6; J. R. Janesick, Photon Transfer, SPIE 2007"
TOLERANCE = 5e-3
REASON = (
    "12 variances of 187 500 pixels each: the fitted slope has a standard error of 1e-3, and the bend of "
    "the response takes another 1e-3. Four standard errors more: one false alarm in 15 000 seeds; the "
    "seed is fixed."
)
FILES = ("optsim/camera/parts/*.py", "optsim/camera/hardware/sensors.py")

_LEVELS_E = np.linspace(100, 7000, 12)


def measure() -> float:
    return _deviation(1.0)


def perturbed() -> float:
    """With light 5 % short of Poisson noise: the expected electrons are drawn in packets of 0.95."""
    return _deviation(0.95)


def _deviation(packet: float) -> float:
    sensor = icx674().model_copy(update={"rows": 375, "cols": 500})
    rng = np.random.default_rng(12)
    dark_mean, dark_variance = _pair(sensor, 0.0, rng, packet)
    points = np.array([_pair(sensor, level, rng, packet) for level in _LEVELS_E])
    mean, variance = points[:, 0] - dark_mean, points[:, 1] - dark_variance
    weight = 1 / points[:, 1] ** 2
    slope = (weight * mean * variance).sum() / (weight * mean**2).sum()
    return float(slope * sensor.gain_e - 1)


def _pair(sensor: Ccd, electrons: float, rng: np.random.Generator, packet: float) -> tuple[float, float]:
    """Mean and temporal variance of two flats; the difference takes the fixed patterns away."""
    expected = electrons * sensor.pixel_response(3).astype(np.float64) / packet
    coarse = sensor.model_copy(update={"gain_e": sensor.gain_e / packet})
    frames = [coarse.digitise(expected, 0.2, 3, rng)[0].astype(np.float64) for _ in range(2)]
    difference = frames[0] - frames[1]
    return float((frames[0] + frames[1]).mean() / 2), float(difference.var() / 2)
