"""Depth range of the picture, found from shapes alone: it decides whether depth of field matters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from optsim.core.quantities import Doubles
from optsim.scene.camera_pose import CameraPose
from optsim.scene.materials import Diffuse
from optsim.scene.scene import Scene

# Number of instants at which movers and camera are evaluated.
_INSTANTS = 9
# Relative slack of the picture's borders, so that rounding loses no corner.
_SLACK = 1e-9


def depth_range_m(
    scene: Scene, tan_half_width: float, rows_over_cols: float, duration_s: float
) -> tuple[float, float]:
    """Find the least and the greatest depth in the picture; occlusion is ignored.

    Parameters
    ----------
    scene : Scene
        Its still shapes, lamps and movers are used; shapes in its own file are unknown.
    tan_half_width, rows_over_cols : float
        Tangent of the horizontal half field, and shape of the picture.
    duration_s : float
        Time in which movers and camera move, s.

    Returns
    -------
    near_m, far_m : float
        Depths along the axis, m. Far is infinite under a sky, or if a surface is glossy, clear or a mirror,
        which may show arbitrary depths. Near is the camera's least depth if shapes are unknown or none is in
        the picture.
    """
    half = np.array([tan_half_width, tan_half_width * rows_over_cols])
    still = [mesh.vertices_m[mesh.faces] for mesh in scene.still_meshes().values()]
    for lamp in scene.lamps.values():
        u, v = np.asarray(lamp.edge_u_m) / 2, np.asarray(lamp.edge_v_m) / 2
        corner = np.asarray(lamp.center_m) + np.array([-u - v, u - v, u + v, v - u])
        still.append(corner[[[0, 1, 2], [0, 2, 3]]])
    faces = {name: mover.rest().faces for name, mover in scene.singles().items()}
    movers, moves = scene.singles(), scene.camera.moves
    found = [np.zeros(0)]
    for time_s in np.linspace(0, duration_s, _INSTANTS if movers or moves else 1).tolist():
        seen = still if moves or len(found) == 1 else []
        seen = [*seen, *(mover.vertices(time_s)[faces[name]] for name, mover in movers.items())]
        found.append(_depths(np.concatenate(seen), scene.camera.at(time_s), half))
    depths = np.concatenate(found)
    near_m, far_m = float(depths.min(initial=np.inf)), float(depths.max(initial=0.0))
    if scene.static is not None or not np.isfinite(near_m):
        return scene.camera.near_m, np.inf
    matt = all(isinstance(material, Diffuse) for material in scene.materials.values())
    return max(near_m, scene.camera.near_m), far_m if matt and scene.sky is None else np.inf


def _depths(triangles: Doubles, pose: CameraPose, half: Doubles) -> Doubles:
    """Depths at the corners of triangles (n, 3, 3) clipped to the picture."""
    origin = np.asarray(pose.position_m)
    ahead = np.asarray(pose.target_m) - origin
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right = right / np.linalg.norm(right)
    axes = np.stack([right / half[0], np.cross(ahead, right) / half[1], ahead])
    corners = (triangles - origin) @ axes.T
    return np.concatenate([_inside(corners.reshape(-1, 3)), *_cut_edges(corners), _at_corners(corners)])


def _inside(points: Doubles) -> Doubles:
    """Depths of the points (x, y, depth) within |x| <= depth, |y| <= depth."""
    depth = points[:, 2]
    within = np.abs(points[:, :2]).max(axis=1, initial=0.0) <= depth * (1 + _SLACK)
    return depth[within & (depth > 0)]


def _cut_edges(corners: Doubles) -> Iterator[Doubles]:
    """Depths at which edges of triangles cross the picture's sides."""
    start = corners.reshape(-1, 3)
    side_m = np.roll(corners, -1, axis=1).reshape(-1, 3) - start
    for axis in (0, 1):
        for side in (-1.0, 1.0):
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (side * start[:, 2] - start[:, axis]) / (side_m[:, axis] - side * side_m[:, 2])
            cut = (share >= 0) & (share <= 1)
            yield _inside(start[cut] + share[cut, None] * side_m[cut])


def _at_corners(corners: Doubles) -> Doubles:
    """Depths of triangles along the rays of the picture's four corners."""
    a, b, c = np.moveaxis(corners, 1, 0)
    rays = np.array([[x, y, 1.0] for x in (-1, 1) for y in (-1, 1)]).T
    # Side of each ray against the planes through the lens and each edge.
    sides = np.stack([np.cross(p, q) @ rays for p, q in ((a, b), (b, c), (c, a))])
    within = (sides >= 0).all(axis=0) | (sides <= 0).all(axis=0)
    normal = np.cross(b - a, c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (normal * a).sum(axis=1)[:, None] / (normal @ rays)
    return depth[within & (depth > 0) & np.isfinite(depth)]
