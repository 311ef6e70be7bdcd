"""Stray light by other pixels' codes, found because it adds equally to short and long exposures."""

from __future__ import annotations

from functools import partial

import numpy as np

from optsim.core.quantities import Bools, Floats
from optsim.optics.neighbourhoods import Reals, sum_around

# Half side of the squares in which stray light counts as uniform, pixels; significance, standard deviations.
_REACH_PX, _SIGMA = 7, 3.0


def stray_light(signal: Floats, exposure: Floats, variance: Floats, electron: Floats, known: Bools) -> Reals:
    """Estimate the light around each pixel that is independent of its code, beyond the noise.

    A saturated lamp's light far from it is unknown, and so are its slots, but it adds equally to short and
    long exposures: it is the intercept of a line through signals against exposures.
    """
    around = partial(sum_around, reach_px=_REACH_PX)
    own = np.where(known, signal, 0).astype(np.float64)
    opened = np.where(known, exposure, 0).astype(np.float64)
    mean = np.maximum(around(own) / np.maximum(around(opened), 1e-30), 0)
    read = np.maximum(variance - electron * np.maximum(own, 0), 0)
    # Texture makes the pixels differ, by half of the mean.
    weights = known / np.maximum(read + electron * opened * mean + (opened * mean / 2) ** 2, 1e-30)
    n, x, xx = around(weights), around(weights * opened), around(weights * opened**2)
    y, xy = around(weights * own), around(weights * opened * own)
    spread = n * xx - x**2
    # With equal exposures the two cannot be separated.
    separable = spread > 1e-6 * n * xx
    intercept = np.divide(y * xx - xy * x, spread, out=np.zeros_like(y), where=separable)
    noise = np.divide(xx, spread, out=np.zeros_like(y), where=separable)
    return np.sqrt(np.maximum(intercept**2 - _SIGMA**2 * noise, 0))
