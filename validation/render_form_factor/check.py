"""Direct light of a square lamp on a parallel floor."""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import View
from optsim.render.backend import activate
from optsim.render.stage import RenderStage
from optsim.scene import Scene

CLAIM = "a diffuse floor below the centre of a square lamp has the radiance that the form factor says"
ORACLE = "form factor from a differential element to a parallel rectangle, four quarters; numpy only"
SOURCE = "J. R. Howell, A Catalog of Radiation Heat Transfer Configuration Factors, 3rd ed., B-3"
TOLERANCE = 1e-3
REASON = "Standard error 2e-4 (9 samples of 65 536 paths); 1e-4 for the width of the spot. Thrice their sum."
FILES = ("optsim/render/stage.py", "optsim/render/sampler.py", "optsim/scene/parts.py")

_RHO, _LAMP, _HEIGHT_M = 0.6, 3.0, 2.0


def measure() -> float:
    return _deviation(_HEIGHT_M)


def perturbed() -> float:
    """With the lamp hung half a per cent too low."""
    return _deviation(_HEIGHT_M * 0.995)


def _deviation(height_m: float) -> float:
    activate()
    scene = Scene.model_validate(
        {
            "name": "floor",
            "white_w_m2_sr": 1.0,
            "max_depth": 2,
            "camera": {"position_m": (0.0, -3.0, 1.2), "target_m": (0.0, 0.0, 0.0)},
            "materials": {"floor": {"reflectance": _RHO}},
            "lamps": {
                "lamp": {
                    "center_m": (0.0, 0.0, height_m),
                    "edge_u_m": (1.0, 0.0, 0.0),
                    "edge_v_m": (0.0, -1.0, 0.0),
                    "radiance_w_m2_sr": _LAMP,
                }
            },
            "objects": {
                "floor": {
                    "kind": "quad",
                    "material": "floor",
                    "corner_m": (-4.0, -4.0, 0.0),
                    "edge_u_m": (8.0, 0.0, 0.0),
                    "edge_v_m": (0.0, 8.0, 0.0),
                }
            },
        }
    )
    stage = RenderStage(scene, View(3, 3, 1, 0.005))
    rendered = stage.radiance(np.arange(9), 1 << 16, (1,)).mean()
    side = 0.5 / _HEIGHT_M
    root = np.sqrt(1 + side**2)
    factor = 4 * (2 * side / root * np.arctan(side / root)) / (2 * np.pi)
    return float(rendered / (_RHO * _LAMP * factor) - 1)
