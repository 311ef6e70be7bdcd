"""Light through two polarisers: how much of it, and how it is polarised then."""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import View
from optsim.render.stokes import polarised, stokes_image

CLAIM = (
    "behind two polarisers the Stokes vector follows Malus's law, its signs as the Stokes pass states them"
)
ORACLE = (
    "S = L/2 cos^2(b - a) (1, cos 2b, sin 2b, 0) for axes at a and b, anticlockwise from the right; "
    "numpy only"
)
SOURCE = "E. Hecht, Optics, 5th ed., sections 8.2.1 and 8.13"
TOLERANCE = 1e-5
REASON = "Single precision, and a view 0.002 degrees wide whose rays meet the polarisers at a slant."
FILES = ("optsim/render/stokes.py", "optsim/render/rays.py")

_LAMP = 2.0
_FIRST_DEG = 20.0


def measure() -> float:
    return _deviation(0.0)


def perturbed() -> float:
    """With the second polariser turned by a tenth of a degree too far."""
    return _deviation(0.1)


def _deviation(error_deg: float) -> float:
    """Largest deviation of any component over 0 .. 90 degrees between the axes, of the lamp's radiance."""
    worst = 0.0
    for between_deg in range(0, 91, 15):
        second_deg = _FIRST_DEG + between_deg
        seen = _stokes((_FIRST_DEG, second_deg + error_deg))
        through, axis = np.cos(np.radians(between_deg)) ** 2 / 2, np.radians(2 * second_deg)
        law = _LAMP * through * np.array([1, np.cos(axis), np.sin(axis), 0])
        worst = max(worst, float(np.abs(seen - law).max()) / _LAMP)
    return worst


def _stokes(axes_deg: tuple[float, ...]) -> np.ndarray:
    """Stokes vector of a lamp seen along +y through polarisers, the one beside the lamp first."""
    with polarised() as mi:
        turn = mi.ScalarTransform4f()

        def facing_us(y: float, roll_deg: float = 0.0) -> object:
            # A rectangle whose own x axis points right in the picture, rolled anticlockwise.
            towards = turn.look_at(origin=[0, y, 0], target=[0, 0, 0], up=[0, 0, 1])
            return towards @ turn.rotate([0, 0, 1], roll_deg)

        # A polariser passes its rectangle's own x axis; its parameter theta is left alone, since it turns
        # with the light, the other way round than the picture.
        filters = {
            f"polariser_{k}": {
                "type": "rectangle",
                "to_world": facing_us(4.0 - k, roll_deg),
                "bsdf": {"type": "polarizer"},
            }
            for k, roll_deg in enumerate(axes_deg)
        }
        content = {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "to_world": turn.look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 0, 1]),
                "fov": 0.002,
                "film": {
                    "type": "hdrfilm",
                    "width": 2,
                    "height": 2,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                    "component_format": "float32",
                },
            },
            "lamp": {
                "type": "rectangle",
                "to_world": facing_us(5.0),
                "emitter": {"type": "area", "radiance": {"type": "uniform", "value": _LAMP}},
            },
            **filters,
        }
        loaded = mi.load_dict(content, optimize=False)
        return stokes_image(mi, loaded, View(2, 2, 1, 1e-5), 4, 1, max_depth=6).mean(
            axis=(1, 2), dtype=np.float64
        )
