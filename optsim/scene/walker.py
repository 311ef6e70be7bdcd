"""An articulated person of tapered capsules whose joints follow sinusoids of time.

The gait has the phases of human walking: arms against legs, knees bent in the swing phase, two bobs of the
trunk a cycle. Its amplitudes have no source, they are sensible defaults.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from optsim.core.config import Part
from optsim.core.quantities import Doubles
from optsim.scene import geometry
from optsim.scene.fields import Positive, Vector
from optsim.scene.geometry import Mesh

# Bands in v of the texture "wardrobe".
_SKIN, _SHIRT, _TROUSERS, _SHOES, _HAIR = ((i / 5 + 0.004, (i + 1) / 5 - 0.004) for i in range(5))


class Walker(Part):
    """A person walking in place or along a path.

    Parameters
    ----------
    feet_m : vector
        Point on the ground below the hips at time 0.
    height_m : float
        Height.
    heading_rad : float
        Azimuth of the facing direction, from the x axis; -pi/2 is towards a camera that looks along +y.
    steps_hz : float
        Gait cycles (two steps) per second.
    stride_rad, arm_rad, knee_rad : float
        Amplitude of hips and shoulders, and the knees' largest bend.
    velocity_m_s : vector
        Velocity of the whole body.
    sway_m : float
        Sideways and up-and-down amplitude of the trunk.
    phase_s : float
        Time offset of the gait.
    """

    kind: Literal["walker"] = "walker"
    material: str
    feet_m: Vector
    height_m: Positive = 1.75
    heading_rad: float = -1.2
    steps_hz: float = Field(0.9, ge=0)
    stride_rad: float = 0.42
    arm_rad: float = 0.55
    knee_rad: float = 0.9
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    sway_m: float = 0.012
    phase_s: float = 0.0

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        return self._posed(0.0)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        return self._posed(time_s).vertices_m

    def _posed(self, time_s: float) -> Mesh:
        """Pose the body in its own frame (x forward, y left, z up); then scale, rotate and place it."""
        phase = 2 * np.pi * self.steps_hz * (time_s + self.phase_s)
        sway = self.sway_m / 1.75 * self.height_m
        trunk = np.array([0.0, sway * np.sin(phase), sway * np.cos(2 * phase)])
        body = geometry.merge([*self._trunk(trunk, phase), *self._limbs(trunk, phase)])
        scaled = body.vertices_m * (self.height_m / 1.75)
        place = np.asarray(self.feet_m) + np.asarray(self.velocity_m_s) * time_s
        return Mesh(geometry.turn(scaled, self.heading_rad) + place, body.faces, body.uv)

    def _trunk(self, trunk: Doubles, phase: float) -> list[Mesh]:
        twist = 0.1 * np.sin(phase)
        shoulders = np.array([-np.sin(twist), np.cos(twist), 0.0])
        hips = np.array([np.sin(twist), np.cos(twist), 0.0])
        pelvis, chest = trunk + _at(0, 0, 0.95), trunk + _at(0.02, 0, 1.34)
        head = chest + _at(0.025, 0, 0.27)
        return [
            geometry.limb(
                pelvis, pelvis + _at(0.01, 0, 0.12), 0.165, 0.15, side=hips, flatness=0.72, band=_TROUSERS
            ),
            geometry.limb(
                pelvis + _at(0.01, 0, 0.13), chest, 0.15, 0.2, side=shoulders, flatness=0.6, band=_SHIRT
            ),
            geometry.limb(
                chest + _at(0, 0, 0.14), head - _at(0, 0, 0.06), 0.055, 0.052, side=shoulders, band=_SKIN
            ),
            geometry.limb(
                head - _at(0, 0, 0.035),
                head + _at(0, 0, 0.05),
                0.085,
                0.098,
                side=shoulders,
                flatness=1.12,
                band=_SKIN,
            ),
            geometry.limb(
                head + _at(-0.035, 0, 0.045),
                head + _at(-0.015, 0, 0.085),
                0.098,
                0.09,
                side=shoulders,
                flatness=1.1,
                band=_HAIR,
            ),
        ]

    def _limbs(self, trunk: Doubles, phase: float) -> list[Mesh]:
        limbs: list[Mesh] = []
        for sign, leg in ((1.0, phase), (-1.0, phase + np.pi)):
            left = np.array([0.0, 1.0, 0.0])
            hip = trunk + _at(0.0, sign * 0.095, 0.93)
            thigh = 0.06 + self.stride_rad * np.sin(leg)
            # The knee bends most while the thigh swings forward (its derivative is largest).
            bend = 0.08 + self.knee_rad * (0.5 + 0.5 * np.cos(leg + 0.35)) ** 2
            knee = hip + 0.43 * _swung(thigh)
            ankle = knee + 0.42 * _swung(thigh - bend)
            toe = ankle + 0.15 * _swung(thigh - bend + 1.45)
            limbs += [
                geometry.limb(hip, knee, 0.092, 0.062, side=left, band=_TROUSERS),
                geometry.limb(knee, ankle, 0.06, 0.048, side=left, band=_TROUSERS),
                geometry.limb(
                    ankle - 0.035 * _swung(thigh - bend + 1.45),
                    toe,
                    0.052,
                    0.04,
                    side=left,
                    flatness=0.85,
                    band=_SHOES,
                ),
            ]
            shoulder = trunk + _at(0.02, sign * 0.235, 1.42)
            swing = -self.arm_rad * np.sin(leg)
            fold = 0.35 + 0.3 * (0.5 - 0.5 * np.sin(leg))
            elbow = shoulder + 0.29 * _swung(swing, sign * 0.12)
            wrist = elbow + 0.25 * _swung(swing + fold, sign * 0.04)
            hand = wrist + 0.09 * _swung(swing + fold + 0.1)
            limbs += [
                geometry.limb(shoulder, elbow, 0.058, 0.046, side=left, band=_SHIRT),
                geometry.limb(elbow, wrist, 0.044, 0.034, side=left, band=_SKIN),
                geometry.limb(wrist, hand, 0.036, 0.042, side=left, flatness=1.2, band=_SKIN),
            ]
        return limbs


def _at(x: float, y: float, z: float) -> Doubles:
    """Offset in the body's frame."""
    return np.array([x, y, z])


def _swung(angle_rad: float, outward_rad: float = 0.0) -> Doubles:
    """Return the unit vector downwards, swung forward by an angle and outward (to +y) by another."""
    return np.array(
        [
            np.sin(angle_rad) * np.cos(outward_rad),
            np.sin(outward_rad),
            -np.cos(angle_rad) * np.cos(outward_rad),
        ]
    )
