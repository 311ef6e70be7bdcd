"""Gloss of a level dielectric as the camera's splitter passes it, by the azimuth of its p axis."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from optsim.camera.hardware import demo
from optsim.core.cache import Cache
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, render_truth
from optsim.scene import Scene

CLAIM = (
    "the truth of a glass floor's reflection is Rs of the lamp for p along the rows (azimuth 0), Rp for p "
    "along the columns, together twice the plain radiance, and follows Malus in between"
)
ORACLE = "Fresnel's Rs and Rp at three angles, one of them Brewster's; Rs cos^2 a + Rp sin^2 a; numpy only"
SOURCE = "E. Hecht, Optics, 5th ed., sections 4.6.2, 8.2.1 and 8.6.1"
TOLERANCE = 1.5e-4
REASON = (
    "Relative to the lamp. Reflection or refraction is drawn at random, stratified over a pixel's "
    "samples: their count is off by about one of 4096, the mean over 48 pixels and two halves by 2.5e-5; "
    "six of these."
)
FILES = (
    "optsim/render/analyser.py",
    "optsim/render/stage.py",
    "optsim/render/truth.py",
    "optsim/camera/parts/splitter.py",
)

_IOR, _LAMP = 1.5, 2.0
_ANGLES_DEG = (40.0, float(np.degrees(np.arctan(_IOR))), 70.0)
_AZIMUTHS = (0.0, np.pi / 2, 0.5)
_VIEW, _TIMING = View(6, 8, 1, 0.001), Timing(1 / 180, 1, 1)
_SETTINGS = RenderSettings(static_error=0.002)


def measure() -> float:
    # The camera as it is built has p along the rows.
    return _deviation(demo().splitter.azimuth_rad)


def perturbed() -> float:
    """With the splitter turned by one degree."""
    return _deviation(np.radians(1.0))


def _deviation(turned_rad: float) -> float:
    worst = 0.0
    for angle_deg in _ANGLES_DEG:
        angle = np.radians(angle_deg)
        share_s, share_p = _shares(angle)
        scene = _hall(angle)
        seen = {azimuth: _seen(scene, azimuth + turned_rad) for azimuth in _AZIMUTHS}
        plain = _seen(scene, None)
        law = [share_s * np.cos(a) ** 2 + share_p * np.sin(a) ** 2 for a in _AZIMUTHS]
        found = [
            *(seen[a] - expected for a, expected in zip(_AZIMUTHS, law, strict=True)),
            (seen[0.0] + seen[np.pi / 2]) / 2 - plain,
            plain - (share_s + share_p) / 2,
        ]
        worst = max(worst, float(np.abs(found).max()))
    return worst


def _seen(scene: Scene, azimuth_rad: float | None) -> float:
    """Mean radiance of the truth over the lamp's."""
    with tempfile.TemporaryDirectory() as folder:
        truth = render_truth(
            scene, _VIEW, _TIMING, _SETTINGS, cache=Cache(Path(folder)), azimuth_rad=azimuth_rad
        )
        return float(truth.load(0).start.mean(dtype=np.float64)) / _LAMP


def _shares(angle: float) -> tuple[float, float]:
    inside = np.sqrt(1 - (np.sin(angle) / _IOR) ** 2)
    s = (np.cos(angle) - _IOR * inside) / (np.cos(angle) + _IOR * inside)
    p = (_IOR * np.cos(angle) - inside) / (_IOR * np.cos(angle) + inside)
    return float(s**2), float(p**2)


def _hall(angle: float) -> Scene:
    """Put a glass floor under a wide bright ceiling, and look at it from 1 m above."""
    return Scene.model_validate(
        {
            "name": "glass_floor",
            "white_w_m2_sr": 1.0,
            "max_depth": 3,
            "camera": {"position_m": (0.0, -float(np.tan(angle)), 1.0), "target_m": (0.0, 0.0, 0.0)},
            "materials": {"floor": {"kind": "glass", "ior": _IOR, "thin": False}},
            "lamps": {
                "ceiling": {
                    "center_m": (0.0, 0.0, 5.0),
                    "edge_u_m": (200.0, 0.0, 0.0),
                    "edge_v_m": (0.0, -200.0, 0.0),
                    "radiance_w_m2_sr": _LAMP,
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
