"""Bright lights in the picture, the source of PSF tails and glare, found from lamps, sky and pose alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.core.quantities import Doubles
from optsim.scene.bands import MONO, Band, mono, value_in
from optsim.scene.scene import Scene
from optsim.scene.sky import irradiance, looked_up

# Step of the grid on which the sky is looked at, as a tangent: a fourth of the sun's disc.
_SKY_STEP = 0.0023


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

    Occlusion is ignored. Of the sky, what is brighter than white counts: one light for each power of ten.

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
        Empty where no lamp and no bright sky is in the picture.
    """
    pose = scene.camera.at(0.0)
    origin = np.asarray(pose.position_m)
    ahead = np.asarray(pose.target_m) - origin
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right = right / np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, ahead), ahead])
    found = _bright_sky(scene, axes, tan_half_width, rows_over_cols)
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


def _bright_sky(
    scene: Scene, axes: Doubles, tan_half_width: float, rows_over_cols: float
) -> list[BrightLight]:
    """Find what of the sky is over white, by a grid of directions finer than the sun's disc."""
    if scene.sky is None or not scene.sky.lit:
        return []
    n_cols = int(np.ceil(2 * tan_half_width / _SKY_STEP))
    across = ((np.arange(n_cols) + 0.5) / n_cols * 2 - 1) * tan_half_width
    n_rows = int(np.ceil(n_cols * rows_over_cols))
    down = ((np.arange(n_rows) + 0.5) / n_rows * 2 - 1) * tan_half_width * rows_over_cols
    directions = across[:, None] * axes[0] + down[:, None, None] * axes[1] + axes[2]
    band = scene.bands[0] if scene.bands else MONO
    over = looked_up(scene.sky, directions, band) / scene.white_w_m2_sr
    decade = np.floor(np.log10(np.maximum(over, 0.1)))
    parts = [decade == number for number in np.unique(decade[decade >= 0])]
    return [BrightLight(float(over[part].mean()), float(part.mean())) for part in parts]


def light_ratio(scene: Scene, band: Band, other: Band) -> float:
    """Light of all lamps and the sky in a band over that in another one, roughly: their power, once each."""

    def power(seen: Band) -> float:
        lamps = [lamp for lamp in scene.lamps.values() if lamp.lit]
        area = (np.linalg.norm(np.cross(lamp.edge_u_m, lamp.edge_v_m)) for lamp in lamps)
        total = sum(
            np.pi * value_in(lamp.radiance_w_m2_sr, seen) * each
            for lamp, each in zip(lamps, area, strict=True)
        )
        if scene.sky is not None and scene.sky.lit:
            # The sky lights a ground about as wide as the camera is far.
            total += irradiance(scene.sky.radiance(seen)) * scene.camera.distance_m**2
        return float(total)

    return power(band) / power(other)
