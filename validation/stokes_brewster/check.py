"""Reflection off a smooth, level dielectric: how far it is polarised, and in which direction."""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import View
from optsim.render.stokes import render_stokes
from optsim.scene import Scene

CLAIM = (
    "light reflected by level glass is polarised horizontally (S1 > 0) as far as Fresnel says, fully at "
    "Brewster's angle"
)
ORACLE = "(Rs - Rp) / (Rs + Rp) of Fresnel's amplitude coefficients at five angles; numpy only"
SOURCE = "E. Hecht, Optics, 5th ed., sections 4.6.2 and 8.6.1"
TOLERANCE = 1e-4
REASON = (
    "Single precision, and a view 0.002 wide: DoLP changes by at most 2.7 a radian, evenly to both sides."
)
FILES = ("optsim/render/stokes.py", "optsim/render/describe.py", "optsim/scene/materials.py")

_IOR = 1.5
_ANGLES_DEG = (30.0, 45.0, float(np.degrees(np.arctan(_IOR))), 70.0, 80.0)


def measure() -> float:
    return _deviation(_IOR)


def perturbed() -> float:
    """With glass of a refractive index half a hundredth too high."""
    return _deviation(_IOR + 0.005)


def _deviation(ior: float) -> float:
    """Largest deviation of S1/S0, S2/S0 and S3/S0 at any angle."""
    worst = 0.0
    for angle_deg in _ANGLES_DEG:
        angle = np.radians(angle_deg)
        total = render_stokes(_hall(ior, angle), View(4, 4, 1, 0.001), 0.0, 4096, 1).sum(axis=(1, 2))
        law = np.array([_polarisation(angle), 0.0, 0.0])
        worst = max(worst, float(np.abs(total[1:] / total[0] - law).max()))
    return worst


def _polarisation(angle: float) -> float:
    inside = np.arcsin(np.sin(angle) / _IOR)
    s = np.sin(angle - inside) / np.sin(angle + inside)
    p = np.tan(angle - inside) / np.tan(angle + inside)
    return float((s**2 - p**2) / (s**2 + p**2))


def _hall(ior: float, angle: float) -> Scene:
    """Put a glass floor under a wide bright ceiling, and look at it from 1 m above."""
    return Scene.model_validate(
        {
            "name": "glass_floor",
            "white_w_m2_sr": 1.0,
            "max_depth": 3,
            "camera": {"position_m": (0.0, -float(np.tan(angle)), 1.0), "target_m": (0.0, 0.0, 0.0)},
            "materials": {"floor": {"kind": "glass", "ior": ior, "thin": False}},
            "lamps": {
                "ceiling": {
                    "center_m": (0.0, 0.0, 5.0),
                    "edge_u_m": (200.0, 0.0, 0.0),
                    "edge_v_m": (0.0, -200.0, 0.0),
                    "radiance_w_m2_sr": 1.0,
                }
            },
            "objects": {
                "floor": {
                    "kind": "quad",
                    "material": "floor",
                    "corner_m": (-1.0, -1.0, 0.0),
                    "edge_u_m": (2.0, 0.0, 0.0),
                    "edge_v_m": (0.0, 2.0, 0.0),
                }
            },
        }
    )
