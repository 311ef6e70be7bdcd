"""Readings of the bench: single numbers of a calibration, far more exact than any score of a video.

A changed noise, blur or alignment moves a score little. It moves its own reading by many times the reading's
scatter, so a comparison of runs judges both.
"""

from __future__ import annotations

import numpy as np

from optsim.calibration import Calibration
from optsim.metrics.records import Reading


def bench_readings(calibration: Calibration) -> list[Reading]:
    """Read off a calibration what a change of the camera or of its estimation would move."""
    valid, middle = calibration.valid, calibration.crosstalk.shape[-1] // 2
    own = calibration.crosstalk[valid][:, middle, middle]
    values = {
        "read noise": (calibration.read_noise_dn, "DN"),
        "gain": (calibration.dn_per_e, "DN/e"),
        "saturation": (_mean(calibration.saturation_dn[valid]), "DN"),
        "responsivity": (_mean(calibration.responsivity_dn[valid]), "DN/(W/m2)"),
        "crosstalk": (1 - _mean(own), "share"),
        "pixel map, row": (_mean(calibration.centre_row[valid]), "px"),
        "pixel map, column": (_mean(calibration.centre_col[valid]), "px"),
    }
    return [Reading(name=name, value=value, unit=unit) for name, (value, unit) in values.items()]


def _mean(values: np.ndarray) -> float:
    return float(values.mean(dtype=np.float64))
