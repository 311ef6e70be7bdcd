"""Movers: pure functions of time that return vertices; the topology never changes.

A mover has ``rest()``, its mesh at time 0, and ``vertices(time_s)``. Faces and texture coordinates never
change. Any instant can be evaluated alone. The walker has its own file.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from optsim.core.config import Part
from optsim.core.quantities import Doubles
from optsim.scene import geometry
from optsim.scene.fields import Positive, Vector
from optsim.scene.geometry import Mesh


def a_direction(axis: Vector) -> Vector:
    """Check an axis while the part is built, so that the error names the key."""
    if not np.linalg.norm(axis) > 0:
        raise ValueError("expected a direction, not the zero vector")
    return axis


def frame_about(axis: Vector) -> Doubles:
    """Rotation matrix (rows: right, up, axis) whose third row is the unit vector along ``axis``."""
    w = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    up = np.array([0.0, 0.0, 1.0]) if abs(w[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(up, w)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(w, right), w])


class Fan(Part):
    """Rotor of a fan: pitched blades and a hub, rotating about an axis.

    Parameters
    ----------
    center_m, axis : vector
        Hub, and the direction that the rotor faces.
    radius_m : float
        Hub to blade tip.
    n_blades : int
        Blades.
    turns_hz : float
        Revolutions per second.
    pitch_rad : float
        Angle of a blade out of the plane of the rotor.
    """

    kind: Literal["fan"] = "fan"
    material: str
    center_m: Vector
    axis: Vector = (0.0, -1.0, 0.0)
    radius_m: Positive
    n_blades: int = Field(4, ge=2, le=8)
    turns_hz: float = 3.0
    pitch_rad: float = 0.35

    _direction = field_validator("axis")(a_direction)

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        mesh = self._rotor()
        return Mesh(self.vertices(0.0), mesh.faces, mesh.uv)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        turned = geometry.turn(self._rotor().vertices_m, 2 * np.pi * self.turns_hz * time_s)
        return turned @ frame_about(self.axis) + np.asarray(self.center_m)

    def _rotor(self) -> Mesh:
        """Make the rotor in its own frame: x, y in its plane, z along the axis."""
        r = self.radius_m
        side = (0.0, np.cos(self.pitch_rad), np.sin(self.pitch_rad))
        blade = geometry.limb((0.22 * r, 0, 0), (0.8 * r, 0, 0), 0.09 * r, 0.2 * r, side=side, flatness=0.12)
        blades = [
            Mesh(geometry.turn(blade.vertices_m, 2 * np.pi * i / self.n_blades), blade.faces, blade.uv)
            for i in range(self.n_blades)
        ]
        hub = geometry.limb(
            (0, 0, -0.06 * r), (0, 0, 0.06 * r), 0.17 * r, 0.13 * r, flatness=1.0, band=(0.0, 0.25)
        )
        return geometry.merge([*blades, hub])


class Pendulum(Part):
    """Rod and bob swinging in a vertical plane: a sinusoidal angle (small-swing solution).

    Parameters
    ----------
    pivot_m : vector
        Point it hangs from.
    length_m, bob_radius_m : float
        Pivot to the bob's centre, and the bob's radius.
    swing_rad, period_s : float
        Amplitude and period (free choice: clocks and toys are not point masses).
    heading_rad : float
        Azimuth of the plane of swing from the x axis.
    """

    kind: Literal["pendulum"] = "pendulum"
    material: str
    pivot_m: Vector
    length_m: Positive
    bob_radius_m: Positive
    swing_rad: float = 0.35
    period_s: Positive = 1.4
    heading_rad: float = 0.0

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        return self._posed(0.0)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        return self._posed(time_s).vertices_m

    def _posed(self, time_s: float) -> Mesh:
        angle = self.swing_rad * np.sin(2 * np.pi * time_s / self.period_s)
        down = geometry.turn(np.array([[np.sin(angle), 0, -np.cos(angle)]]), self.heading_rad)[0]
        across = geometry.turn(np.array([[0.0, 1.0, 0.0]]), self.heading_rad)[0]
        pivot = np.asarray(self.pivot_m)
        thin = 0.12 * self.bob_radius_m
        bob = pivot + down * self.length_m
        rod = geometry.limb(pivot, bob, thin, thin, side=across, around=8, band=(0.0, 0.1))
        disc = geometry.limb(
            bob - across * 0.2 * self.bob_radius_m,
            bob + across * 0.2 * self.bob_radius_m,
            self.bob_radius_m,
            self.bob_radius_m,
            side=down,
            around=32,
        )
        return geometry.merge([rod, disc])


class BouncingBall(Part):
    """Ball that bounces for ever to the same height, and spins.

    Parameters
    ----------
    floor_m : vector
        Point where its lowest point touches down at time 0.
    radius_m, height_m : float
        Radius, and height of the apex of its lowest point; gravity is 9.81 m/s^2.
    velocity_m_s : vector
        Horizontal drift (its third component is ignored).
    spin_hz : float
        Turns per second about the vertical.
    """

    kind: Literal["bouncing_ball"] = "bouncing_ball"
    material: str
    floor_m: Vector
    radius_m: Positive
    height_m: Positive
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    spin_hz: float = 0.7

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        return Mesh(self.vertices(0.0), *_parts(geometry.ball((0, 0, 0), self.radius_m)))

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        half = np.sqrt(2 * self.height_m / 9.81)
        fall = time_s % (2 * half) - half  # time from the nearest apex
        rise = self.height_m - 9.81 / 2 * fall**2
        drift = np.asarray(self.velocity_m_s) * (1, 1, 0) * time_s
        place = np.asarray(self.floor_m) + drift + np.array([0, 0, self.radius_m + rise])
        shape = geometry.ball((0, 0, 0), self.radius_m).vertices_m
        return geometry.turn(shape, 2 * np.pi * self.spin_hz * time_s) + place


class Card(Part):
    """Textured sheet that drifts, sways, turns in its plane and ripples.

    Parameters
    ----------
    center_m : vector
        Centre at time 0; at rest the sheet is upright and faces -y.
    size_m : (float, float)
        Width and height.
    velocity_m_s : vector
        Drift.
    sway_m, sway_hz : vector, float
        Amplitude and frequency of a sinusoidal sway.
    turns_hz : float
        Rotation in its plane, revolutions per second.
    tilt_rad : float
        Angle in its plane at time 0.
    ripple_m, ripple_hz : float
        Amplitude and frequency of a wave that runs along its width (half of it out of the plane).
    """

    kind: Literal["card"] = "card"
    material: str
    center_m: Vector
    size_m: tuple[Positive, Positive]
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    sway_m: Vector = (0.0, 0.0, 0.0)
    sway_hz: float = 1.0
    turns_hz: float = 0.0
    tilt_rad: float = 0.0
    ripple_m: float = 0.0
    ripple_hz: float = 1.5

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        return Mesh(self.vertices(0.0), *_parts(geometry.sheet(17, 13)))

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        x, _, z = (geometry.sheet(17, 13).vertices_m * (self.size_m[0], 1.0, self.size_m[1])).T
        wave = self.ripple_m * np.sin(2 * np.pi * (1.5 * x / self.size_m[0] - self.ripple_hz * time_s))
        z = z + wave
        angle = self.tilt_rad + 2 * np.pi * self.turns_hz * time_s
        turned = np.stack(
            [x * np.cos(angle) - z * np.sin(angle), wave / 2, x * np.sin(angle) + z * np.cos(angle)], axis=-1
        )
        sway = np.asarray(self.sway_m) * np.sin(2 * np.pi * self.sway_hz * time_s)
        return turned + np.asarray(self.center_m) + np.asarray(self.velocity_m_s) * time_s + sway


def _parts(mesh: Mesh) -> tuple[geometry.Faces, Doubles]:
    return mesh.faces, mesh.uv


SimpleMover = Annotated[Fan | Pendulum | BouncingBall | Card, Field(discriminator="kind")]
