"""Frames in the dark at several temperatures: the doubling law, and the statistics of their counts."""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import demo
from optsim.core.quantities import ExposureCode
from optsim.footage.made import still

CLAIM = (
    "a frame in the dark has dark current x time electrons on average, twice as many every 7 K, shot noise "
    "of its own besides read noise and rounding, and from pixel to pixel the fixed pattern alone"
)
ORACLE = (
    "doubling law by hand; moments of a Poisson count, a Gaussian and an even rounding error; quantiles of "
    "the normal law by scipy"
)
SOURCE = "EMVA Standard 1288, release 4.0 Linear (2021), sections 2 and 7.2"
TOLERANCE = 1.0
REASON = (
    "In units of what is allowed: 1e-12 for the expected electrons, which are float64; for a mean or a "
    "variance what chance exceeds once in 1e5. The twelve of them raise a false alarm once in 8000 "
    "measures."
)
FILES = ("optsim/camera/camera.py", "optsim/camera/parts/ccd.py", "optsim/camera/hardware/sensors.py")

_EXACT, _QUANTILE = 1e-12, float(norm.isf(1e-5 / 2))
_CELSIUS = (-20.0, 25.0, 60.0, 95.0)
_FRAMES, _GAIN_E, _BLACK_DN, _READ_E, _DSNU_E = 24, 0.96, 64.0, 9.39, 1.5


def measure() -> float:
    """Find the largest deviation, in units of what is allowed."""
    return max(_by_law(7.0), _by_statistics(1.0), key=abs)


def perturbed() -> float:
    """Break each, return the least: twice as many every 8 K; exposed for 28 slots instead of 36."""
    return min(_by_law(8.0), _by_statistics(28 / 36), key=abs)


def _camera(celsius: float, doubling_k: float = 7.0) -> CodedCamera:
    camera = demo()
    # Smear has a check of its own.
    update = {"temperature_c": celsius, "dark_doubling_k": doubling_k, "smear_share": 0.0}
    return camera.model_copy(update={"sensor": camera.sensor.model_copy(update=update)})


def _dark_e(celsius: float) -> float:
    return 1.27 * 36 / 180 * 2 ** ((celsius - 25) / 7)


def _by_law(doubling_k: float) -> float:
    errors = [_expected(_camera(each, doubling_k)) / _dark_e(each) - 1 for each in _CELSIUS]
    return float(max(np.ravel(errors), key=abs) / _EXACT)


def _by_statistics(exposed: float) -> float:
    return max((error for each in _CELSIUS for error in _counted(each, exposed)), key=abs)


def _expected(camera: CodedCamera) -> np.ndarray:
    shape = (camera.panel_rows, camera.panel_cols)
    black = still(
        np.zeros((3 * shape[0], 3 * shape[1]), np.float32),
        n_slots=36,
        slot_s=camera.slot_s,
        samples_per_pitch=3,
    )
    code = ExposureCode(np.full((36, *shape), 255, np.uint8), np.zeros(shape, np.bool_))
    return camera.expected_electrons(camera.form_image(black), 0, code, None)[0]


def _counted(celsius: float, exposed: float) -> list[float]:
    """Mean, temporal and spatial variance of raw frames, in quantiles of what chance may do to them."""
    camera, dark_e, rng = _camera(celsius), _dark_e(celsius), np.random.default_rng(int(celsius) + 100)
    serial, time_s, mean_e = camera.serial_number, camera.exposure_s, exposed * _expected(camera)
    raw = [camera.sensor.digitise(mean_e, time_s, serial, rng)[0] for _ in range(_FRAMES)]
    dn = np.array(raw, np.float64)
    # Of this sensor's fixed pattern the mean is taken as it is.
    mean = _BLACK_DN + (dark_e + camera.sensor.dark_signal_e(serial).mean(dtype=np.float64)) / _GAIN_E
    variance = (dark_e + _READ_E**2) / _GAIN_E**2 + 1 / 12
    spatial = (_DSNU_E / _GAIN_E) ** 2 + variance / _FRAMES
    # Variance of a sample variance: 2 s^4 / (n - 1) + fourth cumulant / n, and only a Poisson count has one.
    fourth = dark_e / _GAIN_E**4 / _FRAMES
    pixels = dn[0].size
    found = (
        (dn.mean() - mean, variance / dn.size),
        (dn.var(axis=0, ddof=1).mean() - variance, (2 * variance**2 / (_FRAMES - 1) + fourth) / pixels),
        (dn.mean(axis=0).var() - spatial, 2 * spatial**2 / pixels),
    )
    return [float(error / np.sqrt(chance) / _QUANTILE) for error, chance in found]
