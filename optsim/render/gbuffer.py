# pyright: reportUnknownMemberType=false
"""G-buffer: the first surface along camera rays, and its object, in one wavefront without light.

Mitsuba's ``aov`` around a path tracer traces every camera ray twice. A wavefront of primary rays alone is
cheaper. It needs no film, hence no filter: ids and edges stay sharp.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.core.quantities import Doubles, Ids, Ints, View
from optsim.render.describe import unit_m
from optsim.render.first_hit import first_hit, first_place
from optsim.render.lens import undistorted
from optsim.render.stage import RenderStage
from optsim.scene.bodies import bodies
from optsim.scene.camera_pose import CameraPose
from optsim.scene.scene import Scene

# A shading normal shorter than this is invalid: the normals of its vertices cancel out.
_SHORTEST_NORMAL = 0.5


@dataclass(frozen=True, eq=False)
class Hits:
    """First surface along each of n rays."""

    distance_m: Doubles  # along the ray from the pinhole; 0 without a surface
    shape: Ints  # Mitsuba's, -1 without a surface
    face: Ints  # triangle of it
    weights: Doubles  # (n, 2), barycentric, of the second and third vertex
    normal: Doubles  # (n, 3), unit shading normal in the world, on the ray's side
    albedo: Doubles  # diffuse reflectance in the band: of the base under a coat; of principled all


def intrinsics(view: View) -> Doubles:
    """Matrix from the camera frame to (column, row, 1) times depth, of the image without distortion."""
    focal_px = view.cols / 2 / view.tan_half_width
    return np.array([[focal_px, 0, view.cols / 2], [0, focal_px, view.rows / 2], [0, 0, 1]], np.float64)


def camera_to_world(pose: CameraPose) -> Doubles:
    """Matrix (4, 4) from the camera frame (x right, y down, z forward) of a motionless pose to the world."""
    origin = np.asarray(pose.position_m, np.float64)
    forward = np.asarray(pose.target_m) - origin
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(forward, right), forward, origin], axis=1)
    return matrix


def sample_rays(view: View) -> Doubles:
    """Compute the unit directions of all samples' chief rays, in the camera frame: (n, 3), row-major."""
    row, col = np.indices((view.rows, view.cols)).reshape(2, -1) + 0.5
    row, col = undistorted(row, col, view)
    scale = 2 * view.tan_half_width / view.cols
    across, down = (col - view.cols / 2) * scale, (row - view.rows / 2) * scale
    length = np.sqrt(across**2 + down**2 + 1)
    return np.stack([across / length, down / length, 1 / length], axis=-1)


def cast(stage: RenderStage, pose: CameraPose, directions: Doubles) -> Hits:
    """Find the first surface along unit directions (n, 3) from the pinhole, within the depth range."""
    found, before, unit = _along(stage, pose, directions, _surface_columns)
    hit = np.isfinite(found[:, 0])
    found[~hit] = 0.0
    normal = found[:, 5:8]
    length = np.linalg.norm(normal, axis=1)
    normal = np.where((length > _SHORTEST_NORMAL)[:, None], normal, found[:, 8:11])
    length = np.where(hit, np.linalg.norm(normal, axis=1), 1.0)
    side = np.where(np.einsum("ij,ij->i", normal, directions) > 0, -1.0, 1.0)
    return Hits(
        distance_m=np.where(hit, found[:, 0] * unit + before, 0.0),
        shape=np.where(hit, found[:, 1], -1).astype(np.int64),
        face=found[:, 2].astype(np.int64),
        weights=found[:, 3:5],
        normal=normal * (side / length)[:, None],
        albedo=np.clip(found[:, 11], 0.0, 1.0),
    )


def first_objects(stage: RenderStage, pose: CameraPose, directions: Doubles) -> tuple[Doubles, Ints, Ints]:
    """Distance, m, shape and face as of :func:`cast`, in a third of its time."""
    found, before, unit = _along(stage, pose, directions, _place_columns)
    hit = np.isfinite(found[:, 0])
    found[~hit] = 0.0
    distance_m = np.where(hit, found[:, 0] * unit + before, 0.0)
    return distance_m, np.where(hit, found[:, 1], -1).astype(np.int64), found[:, 2].astype(np.int64)


def _along(
    stage: RenderStage, pose: CameraPose, directions: Doubles, columns: Callable[[Any, Any, Any], list[Any]]
) -> tuple[Doubles, Doubles, float]:
    """Trace rays within the depth range: columns found, distance where each ray starts, m, unit of length."""
    unit = unit_m(stage.scene)
    slope = np.einsum("nj,j->n", directions, camera_to_world(pose)[:3, 2])
    before = pose.near_m / slope
    start = np.asarray(pose.position_m) + before[:, None] * directions
    reach = (pose.far_m - pose.near_m) / slope / unit
    return _intersect(stage.loaded, start / unit, directions, reach, columns), before, unit


def _intersect(
    loaded: Any,
    start: Doubles,
    directions: Doubles,
    reach: Doubles,
    columns: Callable[[Any, Any, Any], list[Any]],
) -> Doubles:
    """Trace rays; the first column is the distance, infinite for nothing."""
    import drjit as dr
    import mitsuba as mi

    if not len(start):
        return np.zeros((0, 12))
    if str(mi.variant()).startswith("scalar"):
        rays = zip(start.tolist(), directions.tolist(), reach.tolist(), strict=True)
        each = [columns(mi, loaded, _rays(mi, *ray)) for ray in rays]
        return np.array([np.concatenate([np.ravel(column) for column in hit]) for hit in each])
    rays = _rays(mi, mi.Point3f(start.T), mi.Vector3f(directions.T), mi.Float(reach))
    found = columns(mi, loaded, rays)
    dr.eval(found)  # at once: each column by itself would trace all rays again
    # Rays without a hit leave uninitialised memory: conversion may meet a signalling NaN there.
    with np.errstate(invalid="ignore"):
        return np.vstack([np.asarray(column.numpy(), np.float64) for column in found]).T


def _rays(mi: Any, start: Any, direction: Any, reach: Any) -> Any:
    return mi.Ray3f(start, direction, reach, 0.0, [])


def _surface_columns(mi: Any, loaded: Any, rays: Any) -> list[Any]:
    hit = first_hit(mi, loaded, rays)
    return [hit.distance, hit.shape, hit.face, hit.weights, hit.normal, hit.flat_normal, hit.albedo]


def _place_columns(mi: Any, loaded: Any, rays: Any) -> list[Any]:
    return list(first_place(mi, loaded, rays))


class ObjectIds:
    """Objects and parts that own the triangles in Mitsuba's scene, each kind 1, 2, ... by sorted names."""

    def __init__(self, scene: Scene, loaded: Any) -> None:
        parts = [_parts_of(scene, str(shape.id())) for shape in loaded.shapes()]
        names = sorted({name for shape in parts for name, _ in shape})
        owner = {part: name for name, body in bodies(scene).items() for part in body.parts}
        self.table = dict(enumerate(sorted({owner.get(name, name) for name in names}), start=1))
        number = {name: index for index, name in self.table.items()}
        self.part_table = {
            index: (number[owner.get(name, name)], name) for index, name in enumerate(names, start=1)
        }
        self.owner = np.array([0, *(number for number, _ in self.part_table.values())], np.uint32)
        self.moving = np.array([False, *(name.startswith("mover/") for name in names)])
        self.movers = {
            index: name.removeprefix("mover/")
            for index, shape in enumerate(parts)
            for name, _ in shape
            if name.startswith("mover/")
        }
        index = {name: index for index, name in enumerate(names, start=1)}
        owners, counts = zip(*((index[name], n) for shape in parts for name, n in shape), strict=True)
        self._number = np.array([0, *np.repeat(owners, counts)], np.uint32)
        self._start = np.cumsum([0, *(sum(n for _, n in shape) for shape in parts)])

    def of(self, shape: Ints, face: Ints) -> Ids:
        """Part of each hit, uint32; ``owner`` and ``moving`` take it to its object's id and to a mask."""
        start, stop = self._start[shape], self._start[shape + 1] - 1
        place = np.minimum(start + face, stop) + 1
        return self._number[np.where(shape < 0, 0, place)]


def _parts_of(scene: Scene, shape: str) -> list[tuple[str, int]]:
    """Parts in a shape, each with its number of triangles; 1 for a shape of a single part."""
    kind, _, rest = shape.partition("_")
    if kind == "still" and rest in scene.materials:
        mine = {name: item for name, item in scene.still_objects().items() if item.material == rest}
        return [(f"object/{name}", len(item.mesh().faces)) for name, item in mine.items()]
    if (kind == "lamp" and rest in scene.lamps) or (kind == "mover" and rest in scene.singles()):
        return [(f"{kind}/{rest}", 1)]
    return [(f"static/{shape.removeprefix('static_')}", 1)]
