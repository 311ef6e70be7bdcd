"""Multiple bounces inside a sphere, where every bounce spreads its light exactly evenly."""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import View
from optsim.render.backend import activate
from optsim.render.stage import RenderStage
from optsim.scene import Scene
from optsim.scene.geometry import Mesh, ball

CLAIM = "light of one to four bounces inside a diffuse sphere has the radiance of the integrating sphere"
ORACLE = (
    "integrating sphere: any two surface elements exchange light by dA/A, so bounce k gives irradiance "
    "rho^k flux / area everywhere; numpy only"
)
SOURCE = "D. G. Goebel, Generalized Integrating-Sphere Theory, Applied Optics 6(1), 125-128 (1967)"
TOLERANCE = 6e-3
REASON = (
    "Standard error 5e-4 by the scatter of 64 x 16 samples x pixels; 1e-3 for facets of 1.8 degrees; 3e-4 "
    "for light that the lamp itself blocks. Thrice their sum."
)
FILES = ("optsim/render/stage.py", "optsim/render/sampler.py", "optsim/scene/geometry.py")

_RHO, _SIDE_M, _LAMP = 0.8, 0.02, 1000.0


class _Sphere(Scene):
    def still_meshes(self) -> dict[str, Mesh]:
        return {"wall": ball((0, 0, 0), 1.0, around=200, along=101)}


def measure() -> float:
    return _deviation(max_depth=6)


def perturbed() -> float:
    """With the last bounce cut off."""
    return _deviation(max_depth=5)


def _deviation(max_depth: int) -> float:
    activate()
    scene = _Sphere.model_validate(
        {
            "name": "sphere",
            "white_w_m2_sr": 1.0,
            "max_depth": max_depth,
            # Looks at the side that the one-sided lamp at the centre does not light directly.
            "camera": {"position_m": (0.3, -0.3, 0.1), "target_m": (0.0, -1.0, 0.0)},
            "materials": {"wall": {"reflectance": _RHO}},
            "lamps": {
                "lamp": {
                    "center_m": (0.0, 0.0, 0.0),
                    "edge_u_m": (_SIDE_M, 0.0, 0.0),
                    "edge_v_m": (0.0, 0.0, -_SIDE_M),
                    "radiance_w_m2_sr": _LAMP,
                }
            },
        }
    )
    stage = RenderStage(scene, View(24, 24, 1, 0.3))
    rendered = stage.radiance(np.arange(24 * 24), 256, (1, 2)).mean()
    flux_w = np.pi * _LAMP * _SIDE_M**2
    bounces = sum(_RHO**k for k in range(1, 5))
    return float(rendered / (_RHO / np.pi * bounces * flux_w / (4 * np.pi)) - 1)
