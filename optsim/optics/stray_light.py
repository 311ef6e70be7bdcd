"""Light that adds as much to short exposures as to long ones: it came by another pixel's code."""

from __future__ import annotations

from functools import partial

import numpy as np

from optsim.core.quantities import Bools, Floats
from optsim.optics.neighbourhoods import Reals, sum_around

# Half side of the squares in which stray light counts as even, pixels; what counts, in standard deviations.
_REACH_PX, _SIGMA = 7, 3.0


def stray_light(signal: Floats, exposure: Floats, variance: Floats, electron: Floats, known: Bools) -> Reals:
    """Find the light around each pixel that its own code had no part in, beyond what noise explains.

    How much of a saturated lamp's light arrives far from it, and for how many slots, nobody can tell. But it
    adds as much to short exposures as to long ones: it is the intercept of a line through signals against
    exposures. Textures make the pixels differ; they count as differing by half.

    Parameters
    ----------
    signal, exposure, variance : ndarray of shape (v, u), float32
        As of :func:`optsim.optics.motion.bounds`.
    electron : ndarray of shape (v, u), float32
        Of the signal.
    known : ndarray of shape (v, u), bool
        Pixels whose signal is measured.

    Returns
    -------
    ndarray of shape (v, u)
        In the unit of the signal.
    """
    around = partial(sum_around, reach_px=_REACH_PX)
    own = np.where(known, signal, 0).astype(np.float64)
    opened = np.where(known, exposure, 0).astype(np.float64)
    mean = np.maximum(around(own) / np.maximum(around(opened), 1e-30), 0)
    read = np.maximum(variance - electron * np.maximum(own, 0), 0)
    weights = known / np.maximum(read + electron * opened * mean + (opened * mean / 2) ** 2, 1e-30)
    n, x, xx = around(weights), around(weights * opened), around(weights * opened**2)
    y, xy = around(weights * own), around(weights * opened * own)
    spread = n * xx - x**2
    # Where all are open alike, nothing tells the two apart.
    told = spread > 1e-6 * n * xx
    intercept = np.divide(y * xx - xy * x, spread, out=np.zeros_like(y), where=told)
    noise = np.divide(xx, spread, out=np.zeros_like(y), where=told)
    return np.sqrt(np.maximum(intercept**2 - _SIGMA**2 * noise, 0))
