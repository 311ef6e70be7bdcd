"""Ghost image: light mirrored through the axis and far out of focus, on the grid of panel pixels."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from optsim.core.quantities import Doubles
from optsim.optics.psf import Blur, make_blur, psf_kernel


def mirrored(image: NDArray[np.floating], sigma_px: float) -> Doubles:
    """Turn an image, (v, u), by half a turn and blur it by a Gaussian; dark outside. Its own adjoint."""
    return _blur(sigma_px, (image.shape[0], image.shape[1])).apply(image[::-1, ::-1])


@lru_cache(maxsize=8)
def _blur(sigma_px: float, shape: tuple[int, int]) -> Blur:
    # Only the Gaussian, on a grid of panel pixels.
    return make_blur(psf_kernel(1.0, sigma_px, 1.0, 1.0, 0.1, diffraction=False), shape)
