# pyright: reportMissingTypeStubs=false
"""Rigid motion of objects along keyframes: doors, drawers, cars, wheels."""

from __future__ import annotations

import functools
from dataclasses import replace
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from optsim.core.config import Part
from optsim.core.quantities import Doubles
from optsim.scene import geometry
from optsim.scene.fields import Vector
from optsim.scene.geometry import Faces, Mesh, merge
from optsim.scene.movers import a_direction
from optsim.scene.parts import StillObject

# Keyframes added on either side of a periodic curve: a PCHIP's slope at a key depends on no more.
_BORROWED = 2


class Keyframed(Part):
    """Objects of the scene that move together as one rigid body.

    At any time the body is spun about ``spin_axis`` through ``spin_center_m``. Then it is rotated by the yaw
    about the vertical through ``pivot_m``, and then shifted. Before the first and after the last keyframe it
    rests (except for its steady spin and velocity), unless it repeats.

    Parameters
    ----------
    objects : tuple of str
        Names in the scene's ``objects``; no other mover may name them.
    times_s : tuple of float
        Instants of the keyframes, increasing.
    positions_m : tuple of vector
        Shift from the rest position, one a keyframe; empty for none.
    yaw_rad : tuple of float
        Angle about the vertical, anticlockwise seen from above, one a keyframe; empty for none.
    pivot_m : vector
        Point on the axis of the yaw, at rest.
    spin_axis : vector
        Axis of the spin, at rest; right-handed.
    spin_center_m : vector or None
        Point on the axis of the spin, at rest; by default ``pivot_m``.
    spin_hz : float
        Steady spin, revolutions per second.
    spin_rad : tuple of float
        Angle of the spin on top of the steady one, one a keyframe; empty for none.
    rotations_wxyz : tuple of (float, float, float, float)
        Rotation about ``pivot_m`` from the rest position after spin and yaw, a unit quaternion a keyframe;
        between two it turns steadily. Empty for none.
    velocity_m_s, acceleration_m_s2 : vector
        Steady velocity and acceleration on top of the keyframes; a body that is thrown falls by
        (0, 0, -9.81).
    interpolation : "linear" or "smooth"
        Between keyframes: linear, or the monotone cubic of F. N. Fritsch and J. Butland, "A method for
        constructing local monotone piecewise cubic interpolants", SIAM J. Sci. Stat. Comput. 5 (1984) 300.
        The cubic never overshoots a keyframe.
    repeat : bool
        Start again after the last keyframe. It must have the pose of the first (angles: up to whole turns),
        as a body that jumps has no path.
    """

    kind: Literal["keyframed"] = "keyframed"
    objects: tuple[str, ...] = Field(min_length=1)
    times_s: tuple[float, ...] = ()
    positions_m: tuple[Vector, ...] = ()
    yaw_rad: tuple[float, ...] = ()
    pivot_m: Vector = (0.0, 0.0, 0.0)
    spin_axis: Vector = (0.0, 0.0, 1.0)
    spin_center_m: Vector | None = None
    spin_hz: float = 0.0
    spin_rad: tuple[float, ...] = ()
    rotations_wxyz: tuple[tuple[float, float, float, float], ...] = ()
    velocity_m_s: Vector = (0.0, 0.0, 0.0)
    acceleration_m_s2: Vector = (0.0, 0.0, 0.0)
    interpolation: Literal["linear", "smooth"] = "smooth"
    repeat: bool = False

    _direction = field_validator("spin_axis")(a_direction)

    @model_validator(mode="after")
    def _keys_fit(self) -> Keyframed:
        for earlier, later in pairwise(self.times_s):
            if not later > earlier:
                raise ValueError(
                    f"times_s must increase; got {later} after {earlier}; cure: sort the keyframes by time"
                )
        for name in ("positions_m", "yaw_rad", "spin_rad", "rotations_wxyz"):
            count = len(getattr(self, name))
            if count not in (0, len(self.times_s)):
                raise ValueError(
                    f"{name}: got {count} values for {len(self.times_s)} times_s; expected one a keyframe, "
                    "or none"
                )
        if any(abs(np.linalg.norm(turn) - 1) > 1e-6 for turn in self.rotations_wxyz):
            raise ValueError("rotations_wxyz: got a quaternion that is not of length 1; cure: normalise it")
        if self.repeat and self.rotations_wxyz:
            raise ValueError("repeat: got it beside rotations_wxyz, expected one of the two; cure: drop it")
        if self.repeat:
            self._check_round()
        return self

    def _check_round(self) -> None:
        if len(self.times_s) < 2:
            raise ValueError(f"repeat needs at least two times_s; got {len(self.times_s)}")
        if self.positions_m and not np.allclose(self.positions_m[0], self.positions_m[-1], atol=1e-9):
            raise ValueError(
                f"repeat: positions_m ends at {list(self.positions_m[-1])}, expected the first, "
                f"{list(self.positions_m[0])}; cure: add a keyframe that leads back"
            )
        for name in ("yaw_rad", "spin_rad"):
            angles: tuple[float, ...] = getattr(self, name)
            turns = (angles[-1] - angles[0]) / (2 * np.pi) if angles else 0.0
            if abs(turns - round(turns)) > 1e-6:
                raise ValueError(f"repeat: {name} makes {turns:.6g} turns, expected a whole number of them")

    def placed(self, points_m: Doubles, time_s: float) -> Doubles:
        """Move points from their rest positions to those at a time: (n, 3), m."""
        pivot = np.asarray(self.pivot_m)
        center = pivot if self.spin_center_m is None else np.asarray(self.spin_center_m)
        spin = self._at(self.spin_rad, time_s) + 2 * np.pi * self.spin_hz * time_s
        spun = (points_m - center) @ rotation(self.spin_axis, float(spin)).T + center
        turned = geometry.turn(spun - pivot, float(self._at(self.yaw_rad, time_s))) + pivot
        if self.rotations_wxyz:
            turned = (turned - pivot) @ self._turn(time_s).T + pivot
        steady = np.asarray(self.velocity_m_s) * time_s + np.asarray(self.acceleration_m_s2) / 2 * time_s**2
        return turned + self._at(self.positions_m, time_s) + steady

    def _turn(self, time_s: float) -> Doubles:
        """Rotation matrix of the quaternions at a time."""
        from scipy.spatial.transform import Rotation, Slerp

        times = np.asarray(self.times_s)
        first = int(np.clip(np.searchsorted(times, time_s) - 1, 0, max(len(times) - 2, 0)))
        near = Rotation.from_quat(np.roll(self.rotations_wxyz[first : first + 2], -1, axis=1))
        if len(times) == 1:
            return near.as_matrix()[0]
        at = np.clip(time_s, times[first], times[first + 1])
        return Slerp(times[first : first + 2], near)(at).as_matrix()

    def _at(self, values: tuple[float, ...] | tuple[Vector, ...], time_s: float) -> Doubles:
        if not values:
            return np.zeros(())
        keys, times = np.asarray(values, np.float64), np.asarray(self.times_s)
        if len(times) == 1:
            return np.asarray(keys[0])
        if self.repeat:
            time_s = times[0] + (time_s - times[0]) % (times[-1] - times[0])
        time_s = float(np.clip(time_s, times[0], times[-1]))
        if self.interpolation == "linear":
            after = int(np.clip(np.searchsorted(times, time_s), 1, len(times) - 1))
            share = (time_s - times[after - 1]) / (times[after] - times[after - 1])
            return (1 - share) * keys[after - 1] + share * keys[after]
        if self.repeat:
            times, keys = _unrolled(times, keys)
        # Imported here: it is slow to import, and few scenes need it.
        from scipy.interpolate import PchipInterpolator

        return PchipInterpolator(times, keys, axis=0)(time_s)


def _unrolled(times: Doubles, keys: Doubles) -> tuple[Doubles, Doubles]:
    """Keyframes of one period with some of the periods before and after: a curve on these is periodic."""
    laps = [(times + n * (times[-1] - times[0]), keys + n * (keys[-1] - keys[0])) for n in (-1, 0, 1)]
    before, here, after = laps
    n = _BORROWED
    return (
        np.concatenate([before[0][-1 - n : -1], here[0], after[0][1 : 1 + n]]),
        np.concatenate([before[1][-1 - n : -1], here[1], after[1][1 : 1 + n]]),
    )


def rotation(axis: Vector, angle_rad: float) -> Doubles:
    """Matrix (3, 3) that rotates column vectors about an axis, right-handed (Rodrigues)."""
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle_rad) * cross + (1 - np.cos(angle_rad)) * (cross @ cross)


class KeyframedObjects(Part):
    """The objects of one material in a keyframed motion: a single mover.

    Parameters
    ----------
    material : str
        Their material.
    motion : Keyframed
        How they move.
    items : tuple
        The objects, at rest.
    """

    material: str
    motion: Keyframed
    items: tuple[StillObject, ...]

    @property
    def faces(self) -> Faces:
        """Triangles, the same at all times."""
        return _resting(self.items).faces

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        mesh = _resting(self.items)
        return replace(mesh, vertices_m=self.vertices(0.0))

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        return self.motion.placed(_resting(self.items).vertices_m, time_s)


@functools.lru_cache(maxsize=512)
def _resting(items: tuple[StillObject, ...]) -> Mesh:
    """One mesh of objects at rest; cached, since every pose starts from it."""
    return merge([item.mesh() for item in items])


def keyframed_objects(
    name: str, motion: Keyframed, objects: dict[str, StillObject]
) -> dict[str, KeyframedObjects]:
    """Split a keyframed motion into one single mover a material, called ``<name>_<material>``."""
    groups: dict[str, tuple[StillObject, ...]] = {}
    for key in motion.objects:
        item = objects[key]
        groups[item.material] = (*groups.get(item.material, ()), item)
    return {
        f"{name}_{material}": KeyframedObjects.model_construct(material=material, motion=motion, items=items)
        for material, items in groups.items()
    }
