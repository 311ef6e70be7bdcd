"""Geometry of a lens: displacement of image points by distortion, and their spread by defocus.

Distances from the axis are in units of half the diagonal of the used field. A lens without distortion images
a point at q, a real one at r = q (1 + k q^2). This is the third-order term (M. Born and E. Wolf, *Principles
of Optics*, 7th ed., section 5.3; the first of D. C. Brown's radial terms, Photogramm. Eng. 32, 444, 1966). k
is the relative displacement at the corner, negative for a barrel.

Functions of squared distances are plain arithmetic, so they accept NumPy's arrays and the renderer's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optsim.core.quantities import Doubles

# Beyond this coefficient a fifth-order term matters, and a barrel's image soon folds back.
STRONGEST_DISTORTION = 0.1
# Newton's steps: with the strongest barrel the corner is then within 1e-9.
_STEPS = 5


def image_scale(squared_q: Doubles, k: float) -> Doubles:
    """Find r / q of points of the ideal image, from q^2.

    Far outside the picture, where a barrel's polynomial would fold back, the scale stays constant.
    """
    turn = 1 / (3 * -k) if k < 0 else np.inf
    return np.asarray(1 + k * np.minimum(squared_q, turn))


def object_scale(squared_r: Any, k: float) -> Any:
    """Find q / r of points of the real image, from r^2: the inverse of :func:`image_scale`."""
    scale, bend = 1.0 + 0.0 * squared_r, k * squared_r
    for _ in range(_STEPS):
        square = scale * scale
        scale = scale - (scale + bend * square * scale - 1) / (1 + 3 * bend * square)
    return scale


def area_scale(squared_q: Doubles, k: float) -> Doubles:
    """Area in the real image over that in the ideal one, from q^2."""
    return (1 + k * squared_q) * (1 + 3 * k * squared_q)


def corner_tan(rows: float, cols: float, tan_half_width: float) -> float:
    """Tangent of the field angle whose ideal image is the corner of a used field."""
    return float(tan_half_width * np.hypot(rows, cols) / cols)


def blur_tan(aperture_m: float, focus_m: float, depth_m: Doubles) -> Doubles:
    """Diameter of the circle of confusion of points in front of a thin lens, as a tangent of field angle.

    With aperture D and focus at s, a point at depth z has a circle of D |1/s - 1/z|, as an angle from the
    lens (S. F. Ray, *Applied Photographic Optics*, 3rd ed., section 22.3, in the object space). Times the
    image distance it is the diameter in the image.

    Parameters
    ----------
    aperture_m : float
        Diameter of the lens.
    focus_m : float
        Depth in focus, along the axis.
    depth_m : ndarray
        Depths, along the axis; infinity too.
    """
    return aperture_m * np.abs(1 / focus_m - 1 / np.asarray(depth_m, np.float64))
