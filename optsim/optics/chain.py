"""What splitter, polarisers and panel let through together: contrast is an output, never an input."""

from __future__ import annotations

import numpy as np

from optsim.forward.mueller import UNPOLARISED
from optsim.optics.modulator import Modulator
from optsim.optics.splitter import Splitter
from optsim.quantities import Doubles


def stage_transmissions(
    splitter: Splitter, modulator: Modulator, retardance_rad: float, panel_f_number: float, x_m: Doubles
) -> Doubles:
    """Power transmission of the way in, of the panel and of the way out, for unpolarised light.

    Parameters
    ----------
    splitter, modulator
        True parts.
    retardance_rad : float
        Round-trip retardance of the panel: 0 dark, pi bright.
    panel_f_number : float
        Of the cone that lands on the panel, taken as evenly filled.
    x_m : ndarray of shape (point,), float64
        Places on the panel from the axis, along its rows.

    Returns
    -------
    ndarray of shape (3, point), float64
        Mean over the rays of each point.
    """
    rays = splitter.rays(x_m, panel_f_number)
    at_panel = splitter.inbound(rays) @ UNPOLARISED
    back = (modulator.mueller(retardance_rad) @ at_panel[..., None])[..., 0]
    out = (splitter.outbound(rays) @ back[..., None])[..., 0]
    passed = np.stack([stokes[..., 0].mean(axis=-1) for stokes in (at_panel, back, out)])
    before = passed[:-1].copy()
    # Of no light nothing passes: a coating far from its angle, or ideal polarisers that are crossed.
    passed[1:] = np.divide(passed[1:], before, out=np.zeros_like(before), where=before > 0)
    return passed


def throughput(
    splitter: Splitter, modulator: Modulator, retardance_rad: float, panel_f_number: float, x_m: Doubles
) -> Doubles:
    """Power transmission of the whole chain for unpolarised light at points of the panel, (point,).

    Affine in cos(retardance); arguments as of :func:`stage_transmissions`.
    """
    return stage_transmissions(splitter, modulator, retardance_rad, panel_f_number, x_m).prod(axis=0)


def leak(splitter: Splitter, modulator: Modulator, panel_f_number: float, x_m: Doubles) -> Doubles:
    """Transmission fully off over fully on at points of the panel, (point,): one over the system contrast.

    0 where nothing passes at all.
    """
    off, on = (throughput(splitter, modulator, g, panel_f_number, x_m) for g in (0.0, np.pi))
    return np.divide(off, on, out=np.zeros_like(on), where=on > 0)
