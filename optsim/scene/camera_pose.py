"""Pose and motion of the camera: a pure function of time."""

from __future__ import annotations

import numpy as np
from pydantic import model_validator

from optsim.core.config import Part
from optsim.scene import geometry
from optsim.scene.fields import Vector

# Rays start this share of the viewing distance (at most 1 cm) before the pinhole: nearer points are not
# visible.
_NEAREST = 1e-3
# Points farther than this many viewing distances (at least 1 km) are not visible.
_FARTHEST = 1e3


class CameraPose(Part):
    """Pose of the camera; z is up, the picture is upright, roll is always zero.

    Parameters
    ----------
    position_m, target_m : vector
        Pinhole, and a point on the optical axis, at time 0.
    velocity_m_s : vector
        Velocity of the pinhole; the target moves with it, so the camera keeps its direction.
    sway_m, sway_hz : vector, float
        Amplitude and frequency of a sinusoidal shift of both, zero at time 0.
    pan_rad_s : float
        Turning rate about the vertical through the pinhole, anticlockwise seen from above.
    """

    position_m: Vector
    target_m: Vector
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    sway_m: Vector = (0.0, 0.0, 0.0)
    sway_hz: float = 0.0
    pan_rad_s: float = 0.0

    @model_validator(mode="after")
    def _sees(self) -> CameraPose:
        direction = np.asarray(self.target_m) - np.asarray(self.position_m)
        if not np.hypot(direction[0], direction[1]) > 1e-6 * np.linalg.norm(direction):
            raise ValueError(
                "target_m must not lie at position_m or straight above or below it, "
                "since the picture is upright; "
                f"got position_m = {list(self.position_m)} and target_m = {list(self.target_m)}; "
                "cure: move the target sideways"
            )
        return self

    @property
    def moves(self) -> bool:
        """Whether the pose depends on time."""
        sways = self.sway_hz != 0 and any(self.sway_m)
        return sways or self.pan_rad_s != 0 or any(self.velocity_m_s)

    @property
    def distance_m(self) -> float:
        """Distance from the pinhole to the target, the same at all times, m."""
        return float(np.linalg.norm(np.asarray(self.target_m) - np.asarray(self.position_m)))

    @property
    def near_m(self) -> float:
        """Least visible depth, m."""
        return min(0.01, _NEAREST * self.distance_m)

    @property
    def far_m(self) -> float:
        """Greatest visible depth, m."""
        return max(1000.0, _FARTHEST * self.distance_m)

    def at(self, time_s: float) -> CameraPose:
        """Return the motionless pose at an instant.

        Parameters
        ----------
        time_s : float
            Time, s.

        Returns
        -------
        CameraPose
            Without motion; the same object for a camera that never moves.
        """
        if not self.moves:
            return self
        shift = np.asarray(self.velocity_m_s) * time_s
        shift += np.asarray(self.sway_m) * np.sin(2 * np.pi * self.sway_hz * time_s)
        position = np.asarray(self.position_m) + shift
        direction = np.asarray(self.target_m) - np.asarray(self.position_m)
        target = position + geometry.turn(direction[None], self.pan_rad_s * time_s)[0]
        return CameraPose(position_m=_vector(position), target_m=_vector(target))


def _vector(values: np.ndarray) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z
