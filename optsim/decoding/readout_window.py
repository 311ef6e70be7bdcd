# pyright: reportMissingTypeStubs=false
"""Error of a readout window narrower than its panel pixel."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import cast

import numpy as np

from optsim.core.quantities import Doubles, Floats

# Upper frequency of the spectra, cycles a panel pixel, and frequencies along an axis: with twice the range or
# density no fourth digit changes for 0.3 to 10 CCD pixels a panel pixel.
_CYCLES, _FREQUENCIES = 16, 256
_SIGMA_OVER_MEDIAN = 1.4826  # of a Gaussian's absolute value


def missed(irradiance: Floats, variance: Floats, ratio: float) -> Floats:
    """Estimate the rms difference between each pixel's readout window, narrower by ``ratio``, and its mean.

    The larger of two estimates counts. Curvature: where light curves by E'' over a pixel, the mean over a
    width w exceeds the central value by E''/2 w^2/12 along each axis. Roughness: in natural images power
    falls with the square of the frequency (D. J. Field, J. Opt. Soc. Am. A 4, 2379, 1987,
    doi:10.1364/JOSAA.4.002379), so roughness between pixels gives that within. A lens's smoothing is ignored:
    this is an upper estimate.
    """
    from scipy import ndimage

    laplace = cast("Callable[..., Floats]", ndimage.laplace)
    convolve = cast("Callable[..., Floats]", ndimage.convolve)
    median = cast("Callable[..., Floats]", ndimage.median_filter)
    curvature = np.abs(laplace(irradiance, mode="nearest"))
    noise = convolve(variance, np.array([[0, 1, 0], [1, 16, 1], [0, 1, 0]], np.float32), mode="nearest")
    # The median over 3 x 3: edges and lamps don't move it.
    roughness = (_SIGMA_OVER_MEDIAN * median(curvature, size=3, mode="nearest")) ** 2
    rough = np.sqrt(np.maximum(roughness - noise, 0)) * missed_of_roughness(ratio)
    return np.maximum(curvature * abs(1 - ratio**-2) / 24, rough).astype(np.float32)


@lru_cache
def missed_of_roughness(ratio: float) -> float:
    """Rms of window minus pixel mean over that of the Laplacian between windows, for power as f^-2."""
    frequency = np.fft.fftfreq(_FREQUENCIES, 1 / (2 * _CYCLES))
    x, y = frequency, frequency[:, None]
    square = x**2 + y**2
    square[0, 0] = np.inf

    def seen(width_px: float) -> Doubles:
        return np.sinc(x * width_px) * np.sinc(y * width_px)

    window = seen(1 / ratio)
    laplacian = window * (2 * np.cos(2 * np.pi * x) + 2 * np.cos(2 * np.pi * y) - 4)
    return float(np.sqrt((((seen(1.0) - window) ** 2) / square).sum() / (laplacian**2 / square).sum()))
