"""Crowd of random movers: training material for priors, unlike any scored scene."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from optsim.core.config import Part
from optsim.scene.fields import Positive
from optsim.scene.movers import BouncingBall, Card, Fan, Pendulum
from optsim.scene.vehicle import CarBody, Wheel
from optsim.scene.walker import Walker

Single = Walker | Fan | Pendulum | BouncingBall | Card | Wheel | CarBody


class Crowd(Part):
    """Movers of all kinds at random places before a camera at the origin that looks along +y.

    Parameters
    ----------
    seed : int
        Seed of the crowd.
    n_cards, n_small : int
        Large cards, and small fast ones.
    materials : tuple of str
        Names of the scene's materials, used by the movers in turn.
    near_m, far_m : float
        Range of distances from the camera.
    speed_m_s : float
        Largest drift of a card, at the far distance; nearer ones are slower in proportion.
    """

    kind: Literal["crowd"] = "crowd"
    seed: int = Field(ge=0)
    n_cards: int = Field(5, ge=0, le=40)
    n_small: int = Field(5, ge=0, le=40)
    materials: tuple[str, ...] = Field(min_length=1)
    near_m: Positive = 3.0
    far_m: Positive = 7.0
    speed_m_s: float = Field(0.8, ge=0)

    def members(self) -> dict[str, Single]:
        """Draw the single movers, by name."""
        rng = np.random.default_rng(self.seed)
        result: dict[str, Single] = {}
        for index in range(self.n_cards + self.n_small):
            small = index >= self.n_cards
            y = float(rng.uniform(self.near_m, self.far_m))
            x, z = (float(v) * y for v in rng.uniform((-0.3, -0.22), (0.3, 0.22)))
            speed = self.speed_m_s * y / self.far_m * (2.0 if small else 1.0)
            drift = rng.uniform(-speed, speed, 3) * (1, 0.3, 1)
            size = y * rng.uniform(0.02, 0.05, 2) if small else y * rng.uniform(0.1, 0.26, 2)
            result[f"card{index}"] = Card(
                material=self._material(index),
                center_m=(x, y, z),
                size_m=(float(size[0]), float(size[1])),
                velocity_m_s=(float(drift[0]), float(drift[1]), float(drift[2])),
                sway_m=(float(rng.uniform(0, 0.03) * y), 0.0, float(rng.uniform(0, 0.03) * y)),
                sway_hz=float(rng.uniform(0.5, 3)),
                turns_hz=float(rng.choice([0.0, 0.0, 0.4, -0.8, 1.5])),
                tilt_rad=float(rng.uniform(0, 6.28)),
                ripple_m=float(rng.choice([0.0, 0.015, 0.03]) * y / 5),
                ripple_hz=float(rng.uniform(0.5, 3)),
            )
        count = len(result)
        y = float(rng.uniform(4, 5.5))
        result["walker"] = Walker(
            material=self._material(count),
            feet_m=(float(rng.uniform(-0.2, 0.2) * y), y, -1.0),
            heading_rad=float(rng.uniform(-3.1, 0)),
            steps_hz=float(rng.uniform(0.6, 1.4)),
            phase_s=float(rng.uniform(0, 1)),
            velocity_m_s=(float(rng.uniform(-0.4, 0.4)), 0.0, 0.0),
        )
        y = float(rng.uniform(3.5, 5))
        result["fan"] = Fan(
            material=self._material(count + 1),
            center_m=(float(rng.uniform(-0.2, 0.2) * y), y, float(rng.uniform(-0.1, 0.15) * y)),
            radius_m=float(rng.uniform(0.05, 0.09) * y),
            n_blades=int(rng.integers(3, 6)),
            turns_hz=float(rng.uniform(0.6, 3)),
        )
        y = float(rng.uniform(3.5, 5))
        result["ball"] = BouncingBall(
            material=self._material(count + 2),
            floor_m=(float(rng.uniform(-0.2, 0.2) * y), y, -0.2 * y),
            radius_m=float(rng.uniform(0.012, 0.03) * y),
            height_m=float(rng.uniform(0.3, 0.9)),
            velocity_m_s=(float(rng.uniform(-0.8, 0.8)), 0.0, 0.0),
        )
        y = float(rng.uniform(3.5, 5))
        result["pendulum"] = Pendulum(
            material=self._material(count + 3),
            pivot_m=(float(rng.uniform(-0.2, 0.2) * y), y, 0.24 * y),
            length_m=0.24 * y,
            bob_radius_m=0.03 * y,
            swing_rad=float(rng.uniform(0.2, 0.5)),
            period_s=float(rng.uniform(0.7, 1.6)),
        )
        return result

    def _material(self, index: int) -> str:
        return self.materials[(index + self.seed) % len(self.materials)]
