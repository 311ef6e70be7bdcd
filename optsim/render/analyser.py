"""A polariser before the lens: the part of a path's light that it passes, in Mitsuba's polarised variants.

Signs and frame are those of ``render.stokes``: S1 > 0 is a field along the picture's rows. A polariser at
azimuth a, anticlockwise from there in the upright picture, passes

    (S0 + S1 cos 2a + S2 sin 2a) / 2

(R. A. Chipman, W.-S. T. Lam and G. Young, *Polarized Light and Optical Systems*, CRC Press 2018, chapter 6).
"""

from __future__ import annotations

import math
from typing import Any


def stokes_vector(mi: Any, loaded: Any, ray: Any, light: Any) -> list[Any]:
    """Stokes components of the light along camera rays, from the integrator's result."""
    import drjit as dr

    level = dr.cross(ray.d, loaded.sensors()[0].world_transform() @ mi.Vector3f(0, 1, 0))
    turned = mi.mueller.rotate_stokes_basis(-ray.d, mi.mueller.stokes_basis(-ray.d), level) @ light
    # Lamps are unpolarised, so the first column is the light; its one band is stored as three equal colours.
    return [turned[component, 0][0] for component in range(4)]


def twice_analysed(mi: Any, loaded: Any, ray: Any, light: Any, azimuth_rad: float) -> Any:
    """Twice the light that a polariser passes along rays: the radiance itself if unpolarised."""
    s0, s1, s2, _ = stokes_vector(mi, loaded, ray, light)
    return s0 + math.cos(2 * azimuth_rad) * s1 + math.sin(2 * azimuth_rad) * s2
