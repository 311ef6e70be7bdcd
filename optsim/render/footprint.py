# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""Footprint of movers on the fine grid: projection, coverage and path lengths, without rays."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, cast

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, View
from optsim.render.lens import blur_px
from optsim.render.lens import margin_px as margin_of
from optsim.scene.camera_pose import CameraPose
from optsim.scene.geometry import Faces
from optsim.scene.keyframed import KeyframedObjects
from optsim.scene.scene import SingleMover

# A square pixel cannot see a triangle farther from its centre than half its diagonal.
_MARGIN_PX = 0.75
# Vertices that are retained: number of arrays, bytes, and an array's bytes from which bytes are counted: as
# many smaller ones fit.
_MOST_ARRAYS, _MOST_BYTES, _FINE_BYTES = 8192, 256e6, 31e3
_retained: dict[tuple[Any, float], Doubles] = {}


def vertices_at(mover: SingleMover, time_s: float) -> Doubles:
    """Return a mover's vertices at an instant, (n, 3), m; cached, since several stages use the same ones."""
    # Keyframed objects hold a dict, so they can't be cached; they are quick to move.
    return (
        mover.vertices(time_s)
        if isinstance(mover, KeyframedObjects)
        else _vertices_at(cast("Any", mover), time_s)
    )


def faces_of(mover: SingleMover) -> Faces:
    """Return a mover's triangles, the same at all times."""
    return mover.faces if isinstance(mover, KeyframedObjects) else _faces_of(cast("Any", mover))


def _vertices_at(mover: Any, time_s: float) -> Doubles:
    key = mover, time_s
    if (vertices := _retained.pop(key, None)) is None:
        vertices = mover.vertices(time_s)
        vertices.flags.writeable = False
        # As many as fit: a thousand movers take a thousand arrays a pose, a fine mesh takes megabytes.
        size = sum(each.nbytes for each in _retained.values()) if vertices.nbytes > _FINE_BYTES else 0
        while _retained and (len(_retained) >= _MOST_ARRAYS or size + vertices.nbytes > _MOST_BYTES):
            size -= _retained.pop(next(iter(_retained))).nbytes
    _retained[key] = vertices  # as the newest
    return vertices


@functools.lru_cache(maxsize=1024)
def _faces_of(mover: Any) -> Faces:
    return mover.rest().faces


def project(points_m: Doubles, camera: CameraPose, view: View) -> Doubles:
    """Row, column in the ideal image, fine samples, and depth, m; NaN behind the camera: (n, 3)."""
    origin = np.asarray(camera.position_m)
    forward = np.asarray(camera.target_m) - origin
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(forward, right), forward])
    across, down, depth = axes @ (points_m - origin).T
    depth = np.where(depth < camera.near_m, np.nan, depth)
    scale = view.cols / 2 / view.tan_half_width
    return np.stack([view.rows / 2 + scale * down / depth, view.cols / 2 + scale * across / depth, depth], -1)


def path_px(
    vertices: Callable[[float], Doubles],
    times_s: Sequence[float],
    camera: CameraPose,
    view: View,
    margin_px: float = 0.0,
) -> float:
    """Longest path of a mover's point within a margin of the picture, fine samples, by straight pieces."""
    total = 0.0
    margin_px += margin_of(view)
    before = project(vertices(times_s[0]), camera.at(times_s[0]), view)
    for time_s in times_s[1:]:
        after = project(vertices(time_s), camera.at(time_s), view)
        reach = margin_px + np.fmax(*(blur_px(each[:, 2], camera, view) / 2 for each in (before, after)))
        seen = _in_view(before, view, reach) | _in_view(after, view, reach)
        moved = np.hypot(*(after - before)[:, :2].T)[seen]
        # A point that passes the camera plane counts as crossing the whole picture.
        moved = np.where(np.isfinite(moved), moved, np.hypot(view.rows, view.cols))
        total += float(moved.max()) if moved.size else 0.0
        before = after
    return total


def _in_view(places: Doubles, view: View, margin_px: Doubles) -> Bools:
    row, col = places[:, 0], places[:, 1]
    with np.errstate(invalid="ignore"):
        rows = (row > -margin_px) & (row < view.rows + margin_px)
        return rows & (col > -margin_px) & (col < view.cols + margin_px)


def cover(mask: Bools, vertices_m: Doubles, faces: Faces, camera: CameraPose, view: View) -> None:
    """Mark every sample of the ideal grid (y, x) that a triangle, spread by defocus, may touch."""
    # Each point of the lens sees it displaced, linearly in 1/depth, so farthest at a vertex.
    places = project(vertices_m, camera, view)
    places[:, :2] += margin_of(view)
    _cover(mask, places, faces, _MARGIN_PX + blur_px(places[:, 2], camera, view) / 2)


def fill(mask: Bools, places: Doubles, faces: Faces) -> None:
    """Mark, in place, every sample whose centre lies in a triangle; of vertices before the camera, (n, 2)."""
    _cover(mask, places, faces, np.zeros(len(places)))


@compiled()
def _cover(mask, places, faces, margins):  # type: ignore[no-untyped-def]
    rows, cols = mask.shape
    edges = np.empty((3, 3))
    for f in range(faces.shape[0]):
        a, b, c = places[faces[f, 0]], places[faces[f, 1]], places[faces[f, 2]]
        behind = np.isnan(a[0]) + np.isnan(b[0]) + np.isnan(c[0])
        if behind == 3:
            continue
        if behind > 0:  # reaches behind the camera: it may be anywhere
            mask[:, :] = True
            return
        margin = max(margins[faces[f, 0]], margins[faces[f, 1]], margins[faces[f, 2]])
        top = max(0, int(np.floor(min(a[0], b[0], c[0]) - margin)))
        bottom = min(rows - 1, int(np.ceil(max(a[0], b[0], c[0]) + margin)))
        left = max(0, int(np.floor(min(a[1], b[1], c[1]) - margin)))
        right = min(cols - 1, int(np.ceil(max(a[1], b[1], c[1]) + margin)))
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        sign = 1.0 if area >= 0 else -1.0
        # Distance of a sample's centre to each edge, inside positive: dy x + dx y + offset.
        for k, (p, q) in enumerate(((a, b), (b, c), (c, a))):
            dy, dx = q[0] - p[0], q[1] - p[1]
            length = np.sqrt(dy * dy + dx * dx)
            scale = sign / length if length > 1e-9 else 0.0
            edges[k, 0], edges[k, 1] = scale * dy, -scale * dx
            edges[k, 2] = scale * (dy * (0.5 - p[1]) - dx * (0.5 - p[0]))
        for y in range(top, bottom + 1):
            for x in range(left, right + 1):
                if mask[y, x]:
                    continue
                inside = True
                for k in range(3):
                    if edges[k, 0] * x + edges[k, 1] * y + edges[k, 2] < -margin:
                        inside = False
                if inside:
                    mask[y, x] = True
