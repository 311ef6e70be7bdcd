# pyright: reportMissingTypeStubs=false
"""What a picked CCD pixel misses of light that changes within its panel pixel."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import cast

import numpy as np

from optsim.core.quantities import Doubles, Floats

# Cycles a panel pixel to which spectra are summed, and frequencies along an axis: twice as fine or as far
# changes no fourth digit for 0.3 to 10 CCD pixels a panel pixel.
_CYCLES, _FREQUENCIES = 16, 256
_SIGMA_OVER_MEDIAN = 1.4826  # of a Gaussian's absolute value


def missed(irradiance: Floats, variance: Floats, ratio: float) -> Floats:
    """How far the pick of each pixel may be off the pixel's mean, rms.

    A pick is a ratio narrower than its panel pixel. Two things are looked for, and the larger one counts.
    Where light curves by E'' over a pixel the mean over a width w is E''/2 w^2/12 more than in the middle,
    along each axis; the curvature is that between pixels. Where it is rough it is so within pixels too: in
    pictures of the world power falls with the square of the frequency (D. J. Field, J. Opt. Soc. Am. A 4,
    2379, 1987, doi:10.1364/JOSAA.4.002379), so that roughness between pixels (the Laplacian, median over
    3 x 3, which edges and lamps don't move; what noise makes of it taken off) tells that within. What a lens
    smooths of it isn't known and counts.

    Parameters
    ----------
    irradiance : ndarray of shape (v, u), float32
        W m^-2.
    variance : ndarray of shape (v, u), float32
        Of its noise, W^2 m^-4.
    ratio : float
        Of a panel pixel's width to that of what is read.

    Returns
    -------
    ndarray of shape (v, u), float32
        W m^-2.
    """
    from scipy import ndimage

    laplace = cast("Callable[..., Floats]", ndimage.laplace)
    convolve = cast("Callable[..., Floats]", ndimage.convolve)
    median = cast("Callable[..., Floats]", ndimage.median_filter)
    curvature = np.abs(laplace(irradiance, mode="nearest"))
    noise = convolve(variance, np.array([[0, 1, 0], [1, 16, 1], [0, 1, 0]], np.float32), mode="nearest")
    roughness = (_SIGMA_OVER_MEDIAN * median(curvature, size=3, mode="nearest")) ** 2
    rough = np.sqrt(np.maximum(roughness - noise, 0)) * missed_of_roughness(ratio)
    return np.maximum(curvature * abs(1 - ratio**-2) / 24, rough).astype(np.float32)


@lru_cache
def missed_of_roughness(ratio: float) -> float:
    """Rms of a pick less its pixel's mean over that of the Laplacian between picks, for power as f^-2."""
    frequency = np.fft.fftfreq(_FREQUENCIES, 1 / (2 * _CYCLES))
    x, y = frequency, frequency[:, None]
    square = x**2 + y**2
    square[0, 0] = np.inf

    def seen(width_px: float) -> Doubles:
        return np.sinc(x * width_px) * np.sinc(y * width_px)

    pick = seen(1 / ratio)
    laplacian = pick * (2 * np.cos(2 * np.pi * x) + 2 * np.cos(2 * np.pi * y) - 4)
    return float(np.sqrt((((seen(1.0) - pick) ** 2) / square).sum() / (laplacian**2 / square).sum()))
