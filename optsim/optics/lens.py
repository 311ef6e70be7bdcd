"""A lens as rays see it: where distortion puts a point of the ideal image, and how far defocus spreads it.

Distances from the axis are in units of half the diagonal of the used field. A lens without distortion images
a point at q, a real one at r = q (1 + k q^2), the third-order term (M. Born and E. Wolf, *Principles of
Optics*, 7th ed., section 5.3; the first of D. C. Brown's radial terms, Photogramm. Eng. 32, 444, 1966): k is
the relative displacement of what belongs into the corner, negative for a barrel.

Functions of squared distances are plain arithmetic, so that they take NumPy's arrays and the renderer's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from optsim.core.quantities import Doubles

# Beyond this coefficient a fifth-order term matters, and a barrel soon folds back into the picture.
STRONGEST_DISTORTION = 0.1
# Newton's steps: with the strongest barrel the corner is then within 1e-9.
_STEPS = 5


def image_scale(squared_q: Doubles, k: float) -> Doubles:
    """Find r / q of points of the ideal image, from q^2.

    Where a barrel's polynomial would turn back, far outside the picture, the scale stays.
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

    A point at depth z fills the aperture D with a cone that is D |1/s - 1/z| wide, seen from the lens, where
    the lens is focused at s (S. F. Ray, *Applied Photographic Optics*, 3rd ed., section 22.3, in the object
    space). Times the image distance it is the diameter in the image.

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
