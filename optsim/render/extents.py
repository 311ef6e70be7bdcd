# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
"""Extents of objects at an instant: boxes in the picture and in space, and how much of each is visible.

Coverage is asked of the same rays as the passes: a ray meets a triangle if it is a sum of the directions to
its corners with weights that are not negative (M. Olano and T. Greer, Triangle scan conversion using 2D
homogeneous coordinates, 1997). So nothing is clipped at the camera's near side.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, Ids, Ints, ObjectExtent, ObjectPose, View
from optsim.render.lens import distorted, radial_k1, undistorted
from optsim.scene.bodies import Body
from optsim.scene.camera_pose import CameraPose
from optsim.scene.solids import rotated

Box = tuple[float, float, float, float]


class Extents:
    """Bodies of a scene, ready to be measured at many instants.

    Parameters
    ----------
    bodies : Mapping
        By name.
    view : View
        Fine grid and field of view.
    rays : ndarray of shape (n, 3)
        Directions of all samples' chief rays in the camera frame, row-major.
    """

    def __init__(self, bodies: Mapping[str, Body], view: View, rays: Doubles) -> None:
        self._bodies, self._view = bodies, view
        self._tangents = (rays[:, :2] / rays[:, 2:]).reshape(view.rows, view.cols, 2)
        meshes = {
            name: [part.mesh() if hasattr(part, "mesh") else part.rest() for part in body.parts.values()]
            for name, body in bodies.items()
        }
        self._rest = {name: [mesh.vertices_m for mesh in each] for name, each in meshes.items()}
        self._faces = {name: [mesh.faces for mesh in each] for name, each in meshes.items()}
        self._at_rest: dict[str, tuple[bytes, Box | None, int]] = {}

    def at(
        self,
        pose: CameraPose,
        matrix: Doubles,
        vertices_m: Mapping[str, Doubles],
        poses: Mapping[str, ObjectPose],
        ids: Ids,
        table: Mapping[int, str],
    ) -> dict[int, ObjectExtent]:
        """Measure every body: camera and its matrix, movers' vertices and poses, and the ids seen."""
        counts, boxes = np.bincount(ids.ravel(), minlength=len(table) + 1), _boxes(ids, len(table))
        found: dict[int, ObjectExtent] = {}
        for number, name in table.items():
            if (body := self._bodies.get(name)) is None:
                continue
            moved = [vertices_m.get(part.removeprefix("mover/")) for part in body.parts]
            now = [rest if new is None else new for rest, new in zip(self._rest[name], moved, strict=True)]
            resting = all(new is None for new in moved)
            box, covered = self._outline(name, pose, matrix, now, resting)
            found[number] = ObjectExtent(
                body.category,
                box,
                boxes[number],
                int(counts[number]),
                max(covered, int(counts[number])),
                *self._in_space(name, body, now, poses.get(name)),
            )
        return found

    def _outline(
        self, name: str, pose: CameraPose, matrix: Doubles, now: list[Doubles], resting: bool
    ) -> tuple[Box | None, int]:
        """Amodal box and covered samples; those of a body at rest are remembered until the camera moves."""
        before, box, count = self._at_rest.get(name, (b"", None, 0))
        if not (resting and before == matrix.tobytes()):
            covered = np.zeros((self._view.rows, self._view.cols), np.bool_)
            places = [np.zeros((0, 2))]
            for part, faces in zip(now, self._faces[name], strict=True):
                points = (part - matrix[:3, 3]) @ matrix[:3, :3]
                places.append(self._places(points, faces, pose.near_m))
                self._cover(points[faces], pose, covered)
            box, count = self._clipped(np.concatenate(places)), int(covered.sum())
            self._at_rest[name] = matrix.tobytes(), box, count
        return box, count

    def _places(self, points: Doubles, faces: Ints, near_m: float) -> Doubles:
        """Columns and rows (n, 2) of vertices, and of the points where edges cross the near plane."""
        start, stop = points[faces[:, [0, 1, 2]].ravel()], points[faces[:, [1, 2, 0]].ravel()]
        crossing = (start[:, 2] < near_m) != (stop[:, 2] < near_m)
        start, stop = start[crossing], stop[crossing]
        share = (near_m - start[:, 2]) / (stop[:, 2] - start[:, 2])
        points = np.concatenate([points[points[:, 2] >= near_m], start + share[:, None] * (stop - start)])
        return self._projected(points)

    def _projected(self, points: Doubles) -> Doubles:
        """Columns and rows of points before the camera, (..., 2); far outside of the picture only roughly."""
        rows, cols = self._view.rows, self._view.cols
        focal = cols / 2 / self._view.tan_half_width
        top, left = (min(float(end), 0.0) - 1 for end in undistorted(0.0, 0.0, self._view))
        # Beyond its field a lens's polynomial may turn back.
        col = np.clip(focal * points[..., 0] / points[..., 2] + cols / 2, left, cols - left)
        row = np.clip(focal * points[..., 1] / points[..., 2] + rows / 2, top, rows - top)
        return np.stack(distorted(row, col, self._view)[::-1], axis=-1)

    def _clipped(self, places: Doubles) -> Box | None:
        if not len(places):
            return None
        ends = np.array([self._view.cols, self._view.rows])
        low, high = np.clip(places.min(axis=0), 0, ends), np.clip(places.max(axis=0), 0, ends)
        return (*low.tolist(), *high.tolist()) if (high > low).all() else None

    def _cover(self, corners: Doubles, pose: CameraPose, covered: Bools) -> None:
        """Mark the samples whose rays meet triangles (n, corner, 3) in the camera frame."""
        first, second, third = np.moveaxis(corners, 1, 0)
        weights = np.stack([np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            weights /= np.einsum("ni,ni->n", first, weights[:, 0])[:, None, None]
        view = self._view
        near: Bools = corners[..., 2] < pose.near_m
        ahead: Bools = np.logical_not(near.any(axis=1))
        shown = corners.copy()
        shown[~ahead] = 1.0
        places = self._projected(shown)
        # An edge bows by less than the corner of the picture is displaced.
        corner = (view.cols**2 + view.rows**2) * (view.tan_half_width / view.cols) ** 2
        margin = 1 + abs(radial_k1(view)) * corner * max(view.rows, view.cols)
        low, high = places.min(axis=1) - margin, places.max(axis=1) + margin
        low[~ahead], high[~ahead] = 0, (view.cols, view.rows)
        high[near.all(axis=1)] = 0
        ends = np.array([view.cols, view.rows])
        first_px, last_px = (np.clip(each, 0, ends).astype(np.int64) for each in (low, np.ceil(high)))
        _mark(weights, self._tangents, first_px, last_px, pose.near_m, pose.far_m, covered)

    def _in_space(
        self, name: str, body: Body, now: list[Doubles], pose: ObjectPose | None
    ) -> tuple[Doubles, Doubles, Doubles]:
        """Middle, sides and axes of the box in space."""
        own, motion, points = rotated(body.turn_rad), np.eye(4), np.concatenate(self._rest[name])
        if pose is not None and pose.matrices is not None:
            motion = pose.matrices[1]
        elif pose is not None:
            own, points = np.eye(3), np.concatenate(now)
        low, high = (points @ own).min(axis=0), (points @ own).max(axis=0)
        middle = own @ (low + high) / 2
        return motion[:3, :3] @ middle + motion[:3, 3], high - low, motion[:3, :3] @ own


def _boxes(ids: Ids, count: int) -> list[tuple[int, int, int, int] | None]:
    """Boxes of the samples of each id, left, top, right, bottom."""
    from scipy.ndimage import find_objects

    found: list[Any] = find_objects(ids.astype(np.int64), max_label=count)
    boxes = [None if at is None else (at[1].start, at[0].start, at[1].stop, at[0].stop) for at in found]
    return [None, *boxes]


def _loop(
    weights: Doubles,
    tangents: Doubles,
    first: Ints,
    last: Ints,
    near: float,
    far: float,
    covered: Bools,
) -> None:
    for n in range(len(weights)):
        w = weights[n]
        for row in range(first[n, 1], last[n, 1]):
            for col in range(first[n, 0], last[n, 0]):
                x, y = tangents[row, col, 0], tangents[row, col, 1]
                a = w[0, 0] * x + w[0, 1] * y + w[0, 2]
                b = w[1, 0] * x + w[1, 1] * y + w[1, 2]
                c = w[2, 0] * x + w[2, 1] * y + w[2, 2]
                total = a + b + c
                if a >= 0 and b >= 0 and c >= 0 and total * far >= 1 and total * near <= 1:
                    covered[row, col] = True


_mark: Callable[..., None] = compiled(makes_arrays=False)(_loop)
