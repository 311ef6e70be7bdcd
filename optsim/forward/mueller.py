"""The little Mueller algebra that a splitter and a reflective panel need.

Source: R. A. Chipman, W.-S. T. Lam and G. Young, *Polarized Light and Optical Systems*, CRC Press 2018,
chapters 5 and 6. Stokes vectors are (S0, S1, S2, S3) with S1 > 0 for p, S2 > 0 at 45 degrees; matrices
are 4 x 4 float64 and act on columns, so light meets the rightmost factor first.
"""

from __future__ import annotations

import numpy as np

from optsim.quantities import Doubles

UNPOLARISED: Doubles = np.array([1.0, 0.0, 0.0, 0.0])


def polariser(pass_p: float, pass_s: float) -> Doubles:
    """Diattenuator along p and s: a polariser, or one port of a beam splitter.

    Parameters
    ----------
    pass_p, pass_s : float
        Share of the power of p and of s light that goes on, 0..1.
    """
    mean, half = (pass_p + pass_s) / 2, (pass_p - pass_s) / 2
    cross = np.sqrt(pass_p * pass_s)
    return np.array([[mean, half, 0, 0], [half, mean, 0, 0], [0, 0, cross, 0], [0, 0, 0, cross]])


def retarder_45(retardance_rad: float) -> Doubles:
    """Linear retarder whose fast axis is at 45 degrees to p."""
    c, s = np.cos(retardance_rad), np.sin(retardance_rad)
    return np.array([[1.0, 0, 0, 0], [0, c, 0, -s], [0, 0, 1.0, 0], [0, s, 0, c]])


def depolariser(share: float) -> Doubles:
    """Turn a share of the light into unpolarised light; the rest keeps its state."""
    return np.diag([1.0, 1 - share, 1 - share, 1 - share])


def mirror() -> Doubles:
    """Reflection at normal incidence: handedness and the sign of the 45-degree axis turn over."""
    return np.diag([1.0, 1.0, -1.0, -1.0])
