"""Bright lights in the picture, the source of PSF tails and glare, found from lamps and pose alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.scene.bands import mono
from optsim.scene.scene import Scene


@dataclass(frozen=True)
class BrightLight:
    """A light source in the picture.

    Parameters
    ----------
    over_white : float
        Its radiance over the scene's declared white.
    share : float
        Share of the field that it covers, 0..1.
    """

    over_white: float
    share: float

    @property
    def light(self) -> float:
        """Its light over that of a whole picture in declared white."""
        return self.over_white * self.share


def bright_lights(scene: Scene, tan_half_width: float, rows_over_cols: float) -> list[BrightLight]:
    """Find the lamps in the picture at time 0, by the light they bring, largest first.

    Occlusion is ignored.

    Parameters
    ----------
    scene : Scene
        Scene in one band.
    tan_half_width : float
        Tangent of the horizontal half field.
    rows_over_cols : float
        Shape of the picture.

    Returns
    -------
    list of BrightLight
        Empty where no lamp is in the picture.
    """
    pose = scene.camera.at(0.0)
    origin = np.asarray(pose.position_m)
    ahead = np.asarray(pose.target_m) - origin
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, ahead), ahead])
    found: list[BrightLight] = []
    for lamp in scene.lamps.values():
        edge_u, edge_v = np.asarray(lamp.edge_u_m), np.asarray(lamp.edge_v_m)
        centre = np.asarray(lamp.center_m) - origin
        faces = float(np.cross(edge_u, edge_v) @ -centre)
        # A lamp may be partly in the picture: a grid of its points is tested.
        steps = np.linspace(-0.5, 0.5, 9)
        points = centre + steps[:, None, None] * edge_u + steps[:, None] * edge_v
        x, y, depth = np.moveaxis(points @ axes.T, -1, 0)
        inside = (depth > 0) & (np.abs(x) < depth * tan_half_width)
        inside &= np.abs(y) < depth * tan_half_width * rows_over_cols
        if not lamp.lit or faces <= 0 or not inside.any():
            continue
        distance = float(np.linalg.norm(centre))
        solid = faces / distance**3 * inside.mean()
        field = 4 * tan_half_width**2 * rows_over_cols
        over_white = mono(lamp.radiance_w_m2_sr) / scene.white_w_m2_sr
        found.append(BrightLight(over_white, float(min(solid / field, 1.0))))
    return sorted(found, key=lambda light: light.light, reverse=True)
