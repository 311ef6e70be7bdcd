"""Passes of one instant: the first surfaces, and their positions in the image a step later and earlier.

A surface point moves with its triangle. The triangle's vertices at another instant are a mover's pure
function of time. So rigid and deforming movers, a moving camera and both directions share one code, and flow
always agrees with poses. A ray tests whether the point is visible then.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.core.quantities import Bools, Doubles, Ids, ObjectPose, Passes, View
from optsim.render.backend import activate
from optsim.render.extents import Extents
from optsim.render.gbuffer import (
    Hits,
    ObjectIds,
    camera_to_world,
    cast,
    first_objects,
    intrinsics,
    sample_rays,
)
from optsim.render.lens import distorted, radial_k1
from optsim.render.stage import RenderStage
from optsim.scene.bodies import bodies
from optsim.scene.camera_pose import CameraPose
from optsim.scene.scene import Scene

# A ray meets the same surface point if its length agrees to this share; rays and vertices are float32 there
# (1e-7 of the distance, more on grazing surfaces).
SAME_POINT = 2e-4
# A mover is rigid if no vertex deviates from a rigid motion by more than this share of its size.
_RIGID = 1e-6


def render_passes(
    scene: Scene, view: View, time_s: float, step_s: float, *, backend: str | None = None
) -> Passes:
    """Render depth, normals, albedo, ids, flow, masks and poses of one instant."""
    return PassRenderer(scene, view, backend=backend).at(time_s, step_s)


class PassRenderer:
    """A scene loaded once, for the passes of many instants."""

    def __init__(self, scene: Scene, view: View, *, backend: str | None = None) -> None:
        activate(backend)
        self._scene, self._view = scene, view
        self._stage = RenderStage(scene, view)
        self._ids = ObjectIds(scene, self._stage.loaded)
        self._movers = scene.singles()
        self._faces = {name: mover.rest().faces for name, mover in self._movers.items()}
        self._rays = sample_rays(view)
        self._bodies = bodies(scene)
        self._extents = Extents(self._bodies, view)

    def at(self, time_s: float, step_s: float) -> Passes:
        """Render the passes of one instant; parameters as in :func:`render_passes`."""
        view, ids = self._view, self._ids
        now = self._moment(time_s)
        directions = np.einsum("nj,kj->nk", self._rays, now.matrix[:3, :3])
        self._stage.pose(time_s)
        hits = cast(self._stage, now.pose, directions)
        numbers = ids.of(hits.shape, hits.face)
        points = now.matrix[:3, 3] + hits.distance_m[:, None] * directions
        # Projected instead of taken from the grid, so that points at rest have exactly no flow.
        before = self._places(points, now)
        ends = [self._moment(time_s - step_s), self._moment(time_s + step_s)]
        (back, lost_back), (ahead, lost_ahead) = (
            self._flow(hits, numbers, before, self._reprojected(hits, points, now, end), end) for end in ends
        )
        moments = (ends[0], now, ends[1])
        poses = self._object_poses(moments)
        seen = ids.owner[numbers].reshape(view.rows, view.cols)

        def plane(values: Doubles) -> np.ndarray:
            return values.reshape(view.rows, view.cols, *values.shape[1:]).astype(np.float32)

        def mask(values: Bools) -> Bools:
            return values.reshape(view.rows, view.cols)

        return Passes(
            times_s=(ends[0].time_s, time_s, ends[1].time_s),
            depth_m=plane(hits.distance_m * self._rays[:, 2]),
            distance_m=plane(hits.distance_m),
            normal=plane(hits.normal),
            albedo=plane(hits.albedo),
            ids=seen,
            parts=numbers.reshape(view.rows, view.cols),
            moving=mask(ids.moving[numbers]),
            flow_forward_px=plane(ahead),
            flow_backward_px=plane(back),
            occluded_forward=mask(lost_ahead),
            occluded_backward=mask(lost_back),
            id_table=ids.table,
            part_table=ids.part_table,
            intrinsics_px=intrinsics(view),
            radial_k1=radial_k1(view),
            camera_to_world=np.stack([moment.matrix for moment in moments]),
            object_poses=poses,
            extents=self._extents.at(now.pose, now.matrix, now.vertices_m, poses, seen, ids.table),
        )

    def _object_poses(self, moments: tuple[_Moment, ...]) -> dict[str, ObjectPose]:
        """Poses of all movers by name; of one that isn't rigid as a whole also those of its moving parts."""

        def pose(parts: Mapping[str, Any]) -> ObjectPose:
            names = [part.removeprefix("mover/") for part in parts]
            still = [part.mesh().vertices_m for part in parts.values() if hasattr(part, "mesh")]
            moving = [name for name in names if name in self._movers]
            rest = np.concatenate([*still, *(self._movers[name].vertices(0.0) for name in moving)])
            return _object_pose(
                rest,
                [np.concatenate([*still, *(moment.vertices_m[n] for n in moving)]) for moment in moments],
            )

        found: dict[str, ObjectPose] = {}
        for name, body in self._bodies.items():
            if name.startswith("mover/"):
                found[name] = pose(body.parts)
                if found[name].matrices is None and len(body.parts) > 1:
                    found |= {
                        key: pose({key: part}) for key, part in body.parts.items() if key.startswith("mover/")
                    }
        return found

    def _moment(self, time_s: float) -> _Moment:
        pose = self._scene.camera.at(time_s)
        vertices = {name: mover.vertices(time_s) for name, mover in self._movers.items()}
        return _Moment(time_s, pose, camera_to_world(pose), vertices)

    def _reprojected(self, hits: Hits, points: Doubles, now: _Moment, end: _Moment) -> Doubles:
        """Positions of surface points (n, 3) at another instant, m."""
        reprojected = points.copy()
        for shape, name in self._ids.movers.items():
            mine = np.flatnonzero(hits.shape == shape)
            corners = self._faces[name][hits.face[mine]]
            second, third = hits.weights[mine].T
            weights = np.stack([1 - second - third, second, third], axis=-1)
            displacement_m = end.vertices_m[name] - now.vertices_m[name]
            reprojected[mine] += np.einsum("nk,nkx->nx", weights, displacement_m[corners])
        return reprojected

    def _places(self, points: Doubles, moment: _Moment) -> Doubles:
        """Row, column and depth (n, 3) of points; without meaning where the depth isn't positive."""
        # Not BLAS, whose threads wait for the next product at full speed.
        right, down, depth = np.einsum("nj,jk->kn", points - moment.matrix[:3, 3], moment.matrix[:3, :3])
        (focal_px, _, col_0), (_, _, row_0), _ = intrinsics(self._view)
        with np.errstate(divide="ignore", invalid="ignore"):
            row, col = focal_px * down / depth + row_0, focal_px * right / depth + col_0
            row, col = distorted(row, col, self._view)
        return np.stack([row, col, depth], axis=-1)

    def _flow(
        self, hits: Hits, numbers: Ids, before: Doubles, reprojected: Doubles, end: _Moment
    ) -> tuple[Doubles, Bools]:
        """Flow (n, 2) from places ``before`` to the points' later positions, and the occluded points."""
        after = self._places(reprojected, end)
        row, col, depth = after.T
        sensible = (hits.shape >= 0) & (depth > end.pose.near_m) & (depth < end.pose.far_m)
        flow = np.where(sensible[:, None], (after - before)[:, :2], 0.0)
        seen = sensible & (row >= 0) & (row < self._view.rows) & (col >= 0) & (col < self._view.cols)
        lanes = np.flatnonzero(seen)
        rays_m = reprojected[lanes] - end.matrix[:3, 3]
        distance = np.linalg.norm(rays_m, axis=1)
        self._stage.pose(end.time_s)
        met, *place = first_objects(self._stage, end.pose, rays_m / distance[:, None])
        same = self._ids.of(*place) == numbers[lanes]
        seen[lanes] = same & (np.abs(met - distance) <= SAME_POINT * distance)
        return flow, ~seen


@dataclass(frozen=True, eq=False)
class _Moment:
    """Camera and movers at an instant."""

    time_s: float
    pose: CameraPose
    matrix: Doubles
    vertices_m: dict[str, Doubles]


def _object_pose(rest: Doubles, moved: list[Doubles]) -> ObjectPose:
    """Fit a rigid motion to each set of vertices, if there is one."""
    fits = [rigid_motion(rest, vertices) for vertices in moved]
    size = float(np.ptp(rest, axis=0).max())
    worst = max(deviation for _, deviation in fits)
    rigid = worst <= _RIGID * size
    return ObjectPose(
        matrices=np.stack([matrix for matrix, _ in fits]) if rigid else None,
        reason="" if rigid else f"deforms: {worst:.3g} m from a rigid motion",
        center_m=np.stack([vertices.mean(axis=0) for vertices in moved]),
    )


def rigid_motion(start: Doubles, stop: Doubles) -> tuple[Doubles, float]:
    """Fit the rigid motion (4, 4) that takes points to points, and its largest deviation, m."""
    # W. Kabsch, Acta Cryst. A 32, 922 (1976), by a singular value decomposition.
    center, target = start.mean(axis=0), stop.mean(axis=0)
    u, _, vt = np.linalg.svd((start - center).T @ (stop - target))
    # S. Umeyama, IEEE TPAMI 13, 376 (1991): flat sets are not mirrored.
    sign = np.sign(np.linalg.det(u @ vt))
    turn = vt.T @ np.diag([1, 1, sign]) @ u.T
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, target - turn @ center
    deviation = np.linalg.norm(start @ turn.T + matrix[:3, 3] - stop, axis=1)
    return matrix, float(deviation.max())
