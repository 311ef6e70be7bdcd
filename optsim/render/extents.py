# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false
"""Extents of objects at an instant: boxes in the picture and in space, and how much of each is visible.

Distortion moves vertices; the bow of edges between them is left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from optsim.core.quantities import Doubles, Ids, ObjectExtent, ObjectPose, View
from optsim.render.footprint import fill
from optsim.render.lens import distorted, ideal, margin_px
from optsim.scene.bodies import Body
from optsim.scene.camera_pose import CameraPose
from optsim.scene.geometry import Faces
from optsim.scene.solids import rotated

Plane = tuple[tuple[float, float, float], float]
Box = tuple[float, float, float, float]


class Extents:
    """Bodies of a scene, ready to be measured at many instants."""

    def __init__(self, bodies: Mapping[str, Body], view: View) -> None:
        self._bodies, self._view = bodies, view
        wide = ideal(view).tan_half_width
        high = wide * view.rows / view.cols
        self._sides = [((x, y, wide if x else high), 0.0) for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))]
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
            places, ends = [np.zeros((0, 2))], [((0, 0, 1), pose.near_m), ((0, 0, -1), -pose.far_m)]
            for part, faces in zip(now, self._faces[name], strict=True):
                points, cut = _cut((part - matrix[:3, 3]) @ matrix[:3, :3], faces, ends)
                places.append(self._places(points))
                if self._view.distortion:
                    points, cut = _cut(points, cut, self._sides)
                fill(covered, self._places(points), cut)
            box, count = self._clipped(np.concatenate(places)[:, ::-1]), int(covered.sum())
            self._at_rest[name] = matrix.tobytes(), box, count
        return box, count

    def _places(self, points: Doubles) -> Doubles:
        """Rows and columns (n, 2) of points before the camera."""
        view = self._view
        place = np.array([view.rows, view.cols]) / 2
        place = place + view.cols / 2 / view.tan_half_width * points[:, 1::-1] / points[:, 2:]
        if view.distortion:
            # Beyond its field a lens's polynomial may turn back.
            more = margin_px(view) + 1
            place = np.clip(place, -more, np.array([view.rows, view.cols]) + more)
            place = np.stack(distorted(place[:, 0], place[:, 1], view), axis=-1)
        return place

    def _clipped(self, places: Doubles) -> Box | None:
        if not len(places):
            return None
        ends = np.array([self._view.cols, self._view.rows])
        low, high = np.clip(places.min(axis=0), 0, ends), np.clip(places.max(axis=0), 0, ends)
        return (*low.tolist(), *high.tolist()) if (high > low).all() else None

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


def _cut(points: Doubles, faces: Faces, planes: Sequence[Plane]) -> tuple[Doubles, Faces]:
    """Vertices and triangles on the inner side of planes: inward normal, and least product with it."""
    from trimesh.intersections import slice_faces_plane

    for normal, least in planes:
        if (points @ np.array(normal, np.float64) < least).any():
            cut: Any = slice_faces_plane(points, faces, normal, least * np.array(normal, np.float64))
            points, faces = cut[0], cut[1].astype(np.int32)
    return points, faces


def _boxes(ids: Ids, count: int) -> list[tuple[int, int, int, int] | None]:
    """Boxes of the samples of each id, left, top, right, bottom."""
    from scipy.ndimage import find_objects

    found: list[Any] = find_objects(ids.astype(np.int64), max_label=count)
    boxes = [None if at is None else (at[1].start, at[0].start, at[1].stop, at[0].stop) for at in found]
    return [None, *boxes]
