"""Smear of an interline CCD against charge shifted row by row."""

from __future__ import annotations

import numpy as np

from optsim.camera.hardware import icx674

CLAIM = "under steady light smear adds the same charge to all pixels of a column: its light, leak and dwell"
ORACLE = (
    "two readouts of a vertical register in a loop: all packets move down a row, each then takes the leaked "
    "light of the row it stands at for one dwell; numpy only"
)
SOURCE = (
    "interline transfer, continuous readout: ccd-sensor.de, 'Smear'; Theuwissen, Solid-State Imaging (1995)"
)
TOLERANCE = 1e-9
REASON = (
    "A packet has moved off its own row before the first dwell and comes to rest on it in the readout "
    "before: once is right, and float64 sums leave nothing."
)
FILES = ("optsim/camera/parts/ccd.py",)

_ROWS, _COLS, _EXPOSURE_S = 60, 5, 0.2


def _shifted(light_e: np.ndarray, leak: float, dwell_s: float) -> np.ndarray:
    """Smear in each packet when it leaves the chip, by the row that it came from: (y, x)."""
    rows = len(light_e)
    leaked = light_e / _EXPOSURE_S * leak * dwell_s
    register = np.zeros_like(light_e)
    for _ in range(rows):  # readout before: empty packets come in at the top and end up in their rows
        register = np.vstack([np.zeros((1, light_e.shape[1])), register[:-1]])
        register += leaked
    smear = np.zeros_like(light_e)
    for step in range(rows):  # this readout: row 'rows - 1' leaves first
        smear[rows - 1 - step] = register[-1]
        register = np.vstack([np.zeros((1, light_e.shape[1])), register[:-1]])
        register += leaked
    return smear


def _worst(scale: float) -> float:
    sensor = icx674().model_copy(update={"rows": _ROWS, "cols": _COLS})
    light_e = np.random.default_rng(4).uniform(0, 1e6, (_ROWS, _COLS))
    expected = _shifted(light_e, scale * sensor.smear_share, sensor.readout_s / sensor.readout_rows)
    found = sensor.smear_e(light_e + sensor.dark_rate_e_s * _EXPOSURE_S, _EXPOSURE_S)
    error = found / expected - 1
    return float(error.ravel()[np.abs(error).argmax()])


def measure() -> float:
    """Find the largest relative deviation over pixels."""
    return _worst(1.0)


def perturbed() -> float:
    """With a shield that leaks a tenth more."""
    return _worst(1.1)
