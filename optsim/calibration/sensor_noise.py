"""Read noise, gain and saturation of the CCD, from darks, repeated flats and clipped flats.

The method is the photon transfer of EMVA Standard 1288 release 4.0, section 6. Photon noise is Poisson, so a
pixel's temporal variance rises with its mean by the gain. The difference of two frames in the same light
removes the fixed pattern. Non-linearity is not modelled. If it grows with the fifth power, the variance
changes twelve times as much as the signal. So the flats stay below half of full well.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from optsim.calibration.bench import Bench
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats, Words

# One clipped reading in 30 000 (Gaussian) falls below the threshold and counts as measured.
_SATURATION_SIGMAS = 4.0
# No source, a sensible default: bench frames that fill the wells several times have more smear than later
# frames. So the clip level is lowered by this share.
_SMEAR_MARGIN = 1e-3
# What a bend takes from the gain of flats below half of full well, relative: on benches of the demo's CCD.
_BEND = 3e-3


@dataclass(frozen=True)
class SensorNoise:
    """Read noise and gain of the CCD, from darks and flats.

    Parameters
    ----------
    read_noise_dn : float
        Temporal noise in the dark, quantisation included, DN.
    dn_per_e : float
        System gain, DN per electron.
    read_noise_error_dn, dn_per_e_error : float
        Their standard errors. That of the gain includes its change with the light, up to that of the flats.
    """

    read_noise_dn: float
    dn_per_e: float
    read_noise_error_dn: float = 0.0
    dn_per_e_error: float = 0.0

    def of_mean(self, n_pixels: int) -> SensorNoise:
        """Noise of the mean of some pixels, treated as one pixel that collects the sum of their electrons."""
        side = np.sqrt(n_pixels)
        return SensorNoise(
            self.read_noise_dn / side,
            self.dn_per_e / n_pixels,
            self.read_noise_error_dn / side,
            self.dn_per_e_error / n_pixels,
        )


def temporal_variance(frames: Words) -> float:
    """Variance in time, averaged over pixels, from differences of successive frames (n, ...), DN^2."""
    difference = np.diff(frames.astype(np.float32), axis=0)
    return float(np.mean(np.square(difference), dtype=np.float64)) / 2


def photon_transfer(bench: Bench, black_dn: Floats, lit: tuple[slice, slice]) -> SensorNoise:
    """Estimate read noise and gain."""
    read_variance = temporal_variance(bench.darks)
    read_error = read_variance * _relative_error(bench.darks)
    signals, excesses, errors = list[float](), list[float](), list[float]()
    for flat in bench.flats:
        frames = flat.dn[:, *lit]
        signals.append(float(np.mean(frames, dtype=np.float64) - np.mean(black_dn[lit], dtype=np.float64)))
        variance = temporal_variance(frames)
        excesses.append(variance - read_variance)
        errors.append(variance * _relative_error(frames))
    signal, excess = sum(signals), sum(excesses)
    if signal <= 0 or excess <= 0.1 * read_variance:
        raise BenchError(
            f"{bench.where('flats[0]')}: got a temporal variance that exceeds that of the darks by "
            f"{excess:.3g} DN^2 only, expected photon noise, or the gain cannot be measured; cure: take "
            "flats up to half of full well"
        )
    gain = excess / signal
    by_noise = float(np.hypot(np.linalg.norm(errors), len(errors) * read_error)) / signal
    light, gains = np.array(signals), np.array(excesses) / np.array(signals)
    # Its change with the light, beyond what noise makes of it: dim flats, whose gain is noisy, weigh most.
    change = towards_zero(light, gains) - gain
    weights = np.array([towards_zero(light, flat) for flat in np.eye(len(light))]) - light / signal
    by_light = max(change**2 - float(np.sum((weights * np.array(errors) / light) ** 2)), 0.0) ** 0.5
    # Identical darks still have rounding noise.
    read_noise = float(np.sqrt(max(read_variance, 1 / 12)))
    return SensorNoise(
        read_noise, gain, read_error / (2 * read_noise), math.hypot(by_noise, by_light, _BEND * gain)
    )


def towards_zero(light: Doubles, values: Doubles) -> float:
    """Extrapolate what should not depend on light to none of it, by a line; of one value itself."""
    if len(light) < 2 or np.ptp(light) == 0:
        return float(values.mean())
    return float(np.polynomial.Polynomial.fit(light, values, 1)(0.0))


def _relative_error(frames: Words) -> float:
    """Relative standard error of :func:`temporal_variance` (J. von Neumann et al., 1941)."""
    n, pixels = len(frames), frames[0].size
    return float(np.sqrt((3 * n - 4) / ((n - 1) ** 2 * pixels)))


def saturation_threshold(
    clipped: Words, black_dn: Floats, inside: Bools, noise: SensorNoise, where: str = "bench saturated"
) -> Floats:
    """Raw DN from which a pixel is saturated: mean clip level minus four sigma, and 0.1 % for smear."""
    mean = clipped.mean(axis=0, dtype=np.float64)
    variance = temporal_variance(clipped[:, inside])
    signal = float((mean - black_dn)[inside].mean())
    if variance > noise.read_noise_dn**2 + 0.5 * noise.dn_per_e * signal:
        raise BenchError(
            f"{where}: got a temporal noise of {np.sqrt(variance):.1f} DN, that of light, expected that of a "
            "clip; cure: take them with at least three times the light that fills the wells"
        )
    sigma = max(float(np.sqrt(variance)), noise.read_noise_dn)
    margin = _SATURATION_SIGMAS * sigma + _SMEAR_MARGIN * np.maximum(mean - black_dn, 0)
    return (mean - margin).astype(np.float32)
