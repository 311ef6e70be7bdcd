"""Spoked wheels, and a car that drives straight on while its wheels roll.

Shapes and sizes are free choices near those of real ones (no source). Lamps that move are not modelled: a
car's headlamps are light paint, unlit.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from optsim.core.config import Part
from optsim.core.quantities import Doubles
from optsim.scene import geometry
from optsim.scene.fields import Positive, Vector
from optsim.scene.geometry import Mesh
from optsim.scene.movers import frame_about

# Bands in v of the textures "spokes" and "bodywork".
_TYRE, _METAL = (0.0, 0.48), (0.55, 0.95)
_PAINT, _WINDOW, _LAMP = (0.01, 0.49), (0.55, 0.7), (0.8, 0.95)


class Wheel(Part):
    """Wheel of a tyre, spokes and a hub, rotating about its axle, in place or moving along.

    Parameters
    ----------
    center_m, axis : vector
        Hub at time 0, and the direction of the axle; the wheel turns anticlockwise seen from its tip.
    radius_m : float
        Hub to the tread.
    tyre_m, spoke_m : float
        Thickness of the tyre, and of a spoke.
    n_spokes : int
        Spokes.
    turns_hz : float
        Revolutions per second.
    velocity_m_s : vector
        Velocity of the hub.
    """

    kind: Literal["wheel"] = "wheel"
    material: str
    center_m: Vector
    axis: Vector = (0.0, -1.0, 0.0)
    radius_m: Positive
    tyre_m: Positive = 0.03
    spoke_m: Positive = 0.01
    n_spokes: int = Field(12, ge=2, le=64)
    turns_hz: float = 3.0
    velocity_m_s: Vector = (0.0, 0.0, 0.0)

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        mesh = self._rotor()
        return Mesh(self.vertices(0.0), mesh.faces, mesh.uv)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        turned = geometry.turn(self._rotor().vertices_m, 2 * np.pi * self.turns_hz * time_s)
        place = np.asarray(self.center_m) + np.asarray(self.velocity_m_s) * time_s
        return turned @ frame_about(self.axis) + place

    def _rotor(self) -> Mesh:
        """Make the wheel in its own frame: x, y in its plane, z along the axle."""
        rim = self.radius_m - self.tyre_m / 2
        hub_m = 0.12 * self.radius_m
        spoke = geometry.limb(
            (hub_m / 2, 0, 0),
            (rim, 0, 0),
            self.spoke_m / 2,
            self.spoke_m / 2,
            side=(0, 0, 1),
            band=_METAL,
            around=6,
        )
        spokes = [
            Mesh(geometry.turn(spoke.vertices_m, angle), spoke.faces, spoke.uv)
            for angle in 2 * np.pi * np.arange(self.n_spokes) / self.n_spokes
        ]
        hub = geometry.limb((0, 0, -hub_m / 2), (0, 0, hub_m / 2), hub_m, hub_m, band=_METAL)
        return geometry.merge([geometry.ring(rim, self.tyre_m / 2, band=_TYRE), *spokes, hub])


class CarBody(Part):
    """Hull, windows and unlit lamps of a :class:`Car`."""

    kind: Literal["car_body"] = "car_body"
    material: str
    ground_m: Vector
    heading_rad: float
    speed_m_s: float

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        mesh = _hull()
        return Mesh(self.vertices(0.0), mesh.faces, mesh.uv)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        travelled_m = _along(self.heading_rad) * self.speed_m_s * time_s
        return geometry.turn(_hull().vertices_m, self.heading_rad) + np.asarray(self.ground_m) + travelled_m


class Car(Part):
    """Car of 4 m that drives straight on; becomes a body and four rolling wheels.

    Parameters
    ----------
    material, wheel_material : str
        Materials of the body (made for the texture ``bodywork``) and of the wheels (``spokes``).
    ground_m : vector
        Point on the ground below its middle at time 0.
    heading_rad : float
        Azimuth of its driving direction, from the x axis.
    speed_m_s : float
        Speed; the wheels roll without slip.
    """

    kind: Literal["car"] = "car"
    material: str
    wheel_material: str
    ground_m: Vector
    heading_rad: float = 0.0
    speed_m_s: float = 5.0

    def members(self) -> dict[str, CarBody | Wheel]:
        """Body and wheels, by name."""
        ahead, left = _along(self.heading_rad), _along(self.heading_rad + np.pi / 2)
        result: dict[str, CarBody | Wheel] = {
            "body": CarBody(
                material=self.material,
                ground_m=self.ground_m,
                heading_rad=self.heading_rad,
                speed_m_s=self.speed_m_s,
            )
        }
        for name, x, y in (("fl", 1.25, 1), ("fr", 1.25, -1), ("rl", -1.25, 1), ("rr", -1.25, -1)):
            hub = np.asarray(self.ground_m) + ahead * x + left * y * 0.8 + (0, 0, _WHEEL_M)
            result[f"wheel_{name}"] = Wheel(
                material=self.wheel_material,
                center_m=_vector(hub),
                axis=_vector(left),
                radius_m=_WHEEL_M,
                tyre_m=0.16,
                spoke_m=0.07,
                n_spokes=6,
                turns_hz=self.speed_m_s / (2 * np.pi * _WHEEL_M),
                velocity_m_s=_vector(ahead * self.speed_m_s),
            )
        return result


_WHEEL_M = 0.31


def _along(azimuth_rad: float) -> Doubles:
    return np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0])


def _vector(values: Doubles) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _face(corners_m: ArrayLike, band: tuple[float, float]) -> Mesh:
    """Flat four-cornered face; texture v runs through a band from its first two corners to its last two."""
    low, high = band
    uv = np.array([[0, low], [1, low], [1, high], [0, high]])
    return Mesh(np.asarray(corners_m, np.float64), np.array([[0, 1, 2], [0, 2, 3]], np.int32), uv)


def _hull() -> Mesh:
    """Car in its own frame: x ahead, y left, z up, ground at z = 0 below its middle."""
    # Silhouette of the lower body (x, upper z), from the tail to the nose.
    outline = [(-2.0, 0.74), (-1.85, 0.88), (-0.9, 0.92), (0.85, 0.9), (1.8, 0.76), (2.0, 0.62)]
    low, half = 0.24, 0.82
    faces: list[Mesh] = []
    for (x0, z0), (x1, z1) in pairwise(outline):
        faces += [
            *(_face([(x0, y, low), (x1, y, low), (x1, y, z1), (x0, y, z0)], _PAINT) for y in (-half, half)),
            _face([(x0, -half, z0), (x1, -half, z1), (x1, half, z1), (x0, half, z0)], (0.1, 0.2)),
        ]
    for x, z in (outline[0], outline[-1]):
        faces.append(_face([(x, -half, low), (x, half, low), (x, half, z), (x, -half, z)], (0.1, 0.2)))
        out = x + 0.006 * np.sign(x)
        for y in (-0.58, 0.58):
            corners = [(out, y + a, 0.53 + b) for a, b in ((-0.16, -0.06), (0.16, -0.06), (0.16, 0.06))]
            faces.append(_face([*corners, (out, y - 0.16, 0.59)], _LAMP))
    faces.append(_face([(-2, -half, low), (2, -half, low), (2, half, low), (-2, half, low)], _WINDOW))
    return geometry.merge([*faces, *_cabin()])


def _cabin() -> list[Mesh]:
    """Frustum with a roof; each side is paint with a slightly smaller window just before it."""
    foot = [(-1.6, -0.76, 0.88), (0.95, -0.76, 0.88), (0.95, 0.76, 0.88), (-1.6, 0.76, 0.88)]
    roof = [(-1.1, -0.6, 1.4), (0.3, -0.6, 1.4), (0.3, 0.6, 1.4), (-1.1, 0.6, 1.4)]
    faces = [_face(roof, (0.1, 0.2))]
    for i in range(4):
        j = (i + 1) % 4
        side = np.array([foot[i], foot[j], roof[j], roof[i]])
        normal = np.cross(side[1] - side[0], side[3] - side[0])
        window = side.mean(0) + (side - side.mean(0)) * (0.88, 0.88, 0.78)
        faces += [
            _face(side, (0.1, 0.2)),
            _face(window + 0.006 * normal / np.linalg.norm(normal), _WINDOW),
        ]
    return faces
