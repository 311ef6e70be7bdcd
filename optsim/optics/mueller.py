"""Mueller algebra for a splitter and a reflective panel.

Source: R. A. Chipman, W.-S. T. Lam and G. Young, *Polarized Light and Optical Systems*, CRC Press 2018,
chapters 5 and 6. Stokes vectors are (S0, S1, S2, S3) with S1 > 0 for p, S2 > 0 at 45 degrees. Matrices are
float64 of shape (..., 4, 4) and act on columns, so light meets the rightmost factor first. Arguments may be
arrays: one matrix for each ray.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from optsim.core.quantities import Doubles

UNPOLARISED: Doubles = np.array([1.0, 0.0, 0.0, 0.0])


def polariser(pass_p: ArrayLike, pass_s: ArrayLike) -> Doubles:
    """Diattenuator along p and s: a polariser, or one port of a beam splitter.

    Parameters
    ----------
    pass_p, pass_s : float or array
        Share of the power of p and of s light that passes, 0..1.
    """
    p, s = np.broadcast_arrays(np.asarray(pass_p, np.float64), np.asarray(pass_s, np.float64))
    matrix = np.zeros((*p.shape, 4, 4))
    matrix[..., 0, 0] = matrix[..., 1, 1] = (p + s) / 2
    matrix[..., 0, 1] = matrix[..., 1, 0] = (p - s) / 2
    matrix[..., 2, 2] = matrix[..., 3, 3] = np.sqrt(p * s)
    return matrix


def turned(matrix: Doubles, angle_rad: ArrayLike) -> Doubles:
    """Return the matrix of an element rotated about the ray, from p towards 45 degrees."""
    angle = np.asarray(angle_rad, np.float64)
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    turn = np.zeros((*angle.shape, 4, 4))
    turn[..., 0, 0] = turn[..., 3, 3] = 1
    turn[..., 1, 1] = turn[..., 2, 2] = c
    turn[..., 1, 2], turn[..., 2, 1] = -s, s
    return turn @ matrix @ np.swapaxes(turn, -1, -2)


def retarder_45(retardance_rad: float) -> Doubles:
    """Linear retarder whose fast axis is at 45 degrees to p."""
    c, s = np.cos(retardance_rad), np.sin(retardance_rad)
    return np.array([[1.0, 0, 0, 0], [0, c, 0, -s], [0, 0, 1.0, 0], [0, s, 0, c]])


def depolariser(share: float) -> Doubles:
    """Turn a share of the light into unpolarised light; the rest keeps its state."""
    return np.diag([1.0, 1 - share, 1 - share, 1 - share])


def mirror() -> Doubles:
    """Reflection at normal incidence: handedness and the 45-degree axis change sign."""
    return np.diag([1.0, 1.0, -1.0, -1.0])
