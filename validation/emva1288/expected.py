"""What EMVA 1288 must find on a sensor of given data-sheet numbers: moments in closed form, no images.

The sensor of PHYSICS 28 bends before it clips, so EMVA's straight lines are not the data sheet's: on the
ICX674 the gain comes out 1 % low. This computes the noise-free characteristic and photon-transfer curve as
sums over the Poisson distribution, averaged over the pixels' responses, and puts the standard's definitions
(release 4.0 Linear, sections 6 to 8) on them. It takes no code of the sensor, nor of
the package. Neither sensor's converter clips before its well, so none is here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import poisson

_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(15)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()
_QUANTISATION = 1 / 12


def expected(
    sensor: Any, photons: np.ndarray, spatial_photons: float, dark_e: float, exposure_s: float
) -> dict[str, float]:
    """Results of the standard's evaluation for an endless bench, by the names of reference.py.

    Parameters
    ----------
    sensor : Ccd
        Only its data-sheet numbers are read; its rows are those of the region on the bench.
    photons : ndarray of shape (level,)
        Photons a pixel in an exposure, evenly spaced, of each pair.
    spatial_photons : float
        The same, of the bright stack.
    dark_e, exposure_s : float
        Dark signal of an exposure, and its length.
    """

    def at(level: float) -> tuple[float, float, float]:
        return _moments(sensor, level, dark_e, exposure_s)

    dark_mean, dark_variance, dark_pattern = at(0.0)
    means, variances, _ = np.array([at(p) for p in photons]).T
    peak = photons[variances.argmax()]
    fitted = means - dark_mean <= 0.7 * (means[variances.argmax()] - dark_mean)
    signal, noise = (means - dark_mean)[fitted], (variances - dark_variance)[fitted]
    gain = (signal * noise).sum() / (signal**2).sum()
    responsivity = (photons[fitted] * signal).sum() / (photons[fitted] ** 2).sum()
    bright_mean, _, bright_pattern = at(spatial_photons)
    return {
        "QE": responsivity / gain,
        "K_dn_e": gain,
        "sigma_d_e": np.sqrt(dark_variance - _QUANTISATION) / gain,
        "PRNU": np.sqrt(bright_pattern - dark_pattern) / (bright_mean - dark_mean),
        "DSNU_e": np.sqrt(dark_pattern) / gain,
        "capacity_e": responsivity / gain * peak,
        "saturated_dn": at(photons[-1])[0],
    }


def saturation_photons(sensor: Any, photons: np.ndarray, dark_e: float, exposure_s: float) -> float:
    """Level of a bench at which the temporal variance is largest: EMVA's saturation."""
    return float(photons[np.argmax([_moments(sensor, p, dark_e, exposure_s)[1] for p in photons])])


def _moments(sensor: Any, photons: float, dark_e: float, exposure_s: float) -> tuple[float, float, float]:
    """Mean, DN, and temporal and spatial variance, DN^2, of pixels under uniform light."""
    readout_s = sensor.readout_s * sensor.rows / sensor.readout_rows
    leak = sensor.smear_share * readout_s / exposure_s
    smear = leak * (sensor.quantum_efficiency * photons + dark_e)
    response = 1 + sensor.prnu * _NODES
    mean, variance = np.array(
        [_collected(sensor, sensor.quantum_efficiency * r * photons + dark_e, smear) for r in response]
    ).T
    average = (_WEIGHTS * mean).sum()
    temporal = (_WEIGHTS * variance).sum() + sensor.read_noise_e**2 + smear
    spatial = (_WEIGHTS * (mean - average) ** 2).sum() + sensor.dsnu_e**2
    k = 1 / sensor.gain_e
    return average * k + sensor.black_dn, temporal * k**2 + _QUANTISATION, spatial * k**2


def _collected(sensor: Any, expected_e: float, smear_e: float) -> tuple[float, float]:
    """Mean and variance of a pixel's electrons after clip, smear and bend."""
    spread = 9 * np.sqrt(expected_e) + 9
    counts = np.arange(max(0, int(expected_e - spread)), int(expected_e + spread) + 1)
    share = poisson.pmf(counts, expected_e)
    e = np.minimum(counts, sensor.full_well_e) + smear_e
    signal = e * (1 - sensor.bend_at_full_well * np.minimum(e / sensor.full_well_e, 1) ** 5)
    mean = (share * signal).sum()
    return float(mean), float((share * (signal - mean) ** 2).sum())
