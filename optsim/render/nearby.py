"""Select the random paths that come near a mover, by boxes around all positions of the movers.

A path that meets none of these boxes is the same with and without movers, so it is not traced again at every
pose. Such paths are found by a render without movers in which the boxes glow. The boxes are opaque, far
brighter than any lamp, and never chosen as a light source. So all earlier random choices stay the same. Every
path that misses them gives bitwise the same radiance as without boxes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.core.quantities import Doubles
from optsim.render.footprint import vertices_at
from optsim.scene import geometry
from optsim.scene.geometry import Mesh
from optsim.scene.scene import Scene

# Pieces of a mover with a box each; more pieces fit more tightly and cost more to trace.
_PIECES = 8
# Slack around a box, relative to its size, for rounding vertices to float32.
_SLACK = 1e-4
_GLOW_W_M2_SR = 1e7


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes that contain pieces of movers at all sampled times."""

    pieces: Mapping[str, list[np.ndarray]]  # Mover -> vertex indices of each of its pieces.
    low_m: Mapping[str, Doubles]  # Mover -> corner of each piece's box, (piece, 3).
    high_m: Mapping[str, Doubles]

    def hold(self, scene: Scene, time_s: float) -> bool:
        """Whether every mover is inside its boxes at an instant; if not, any path may meet it."""
        for name, mover in scene.singles().items():
            low, high = _extents(vertices_at(mover, time_s), self.pieces[name])
            if (low < self.low_m[name]).any() or (high > self.high_m[name]).any():
                return False
        return True

    def mesh(self) -> Mesh:
        """All boxes in one mesh."""
        corners = [
            (low, high)
            for name in self.pieces
            for low, high in zip(self.low_m[name], self.high_m[name], strict=True)
        ]
        return geometry.merge([geometry.box((low + high) / 2, high - low) for low, high in corners])


def boxes_around(scene: Scene, times_s: Doubles, lens_m: float = 0.0) -> Boxes | None:
    """Box the movers' pieces over some times, with room for their motion between."""
    pieces: dict[str, list[np.ndarray]] = {}
    low_m: dict[str, Doubles] = {}
    high_m: dict[str, Doubles] = {}
    eye = np.asarray(scene.camera.position_m)
    for name, mover in scene.singles().items():
        rest = mover.rest()
        pieces[name] = _split(rest, _PIECES)
        before = low = high = None
        step = 0.0
        for time_s in times_s:
            vertices = vertices_at(mover, float(time_s))
            a, b = _extents(vertices, pieces[name])
            low, high = (a, b) if low is None or high is None else (np.minimum(low, a), np.maximum(high, b))
            step = step if before is None else max(step, float(np.abs(vertices - before).max()))
            before = vertices
        assert low is not None
        assert high is not None
        slack = step + _SLACK * float(np.max(high - low))
        low_m[name], high_m[name] = low - slack, high + slack
        # A box nearer than the sensor's near plane would not be hit either.
        reach = scene.camera.near_m * 2 + lens_m
        if ((low_m[name] - reach < eye) & (eye < high_m[name] + reach)).all(axis=1).any():
            return None
    return Boxes(pieces, low_m, high_m) if pieces else None


def _split(mesh: Mesh, n: int) -> list[np.ndarray]:
    """Vertex indices of pieces of a mesh, halved repeatedly along the longest extent."""
    groups = [np.arange(len(mesh.faces))]
    centers = mesh.vertices_m[mesh.faces].mean(axis=1)
    while len(groups) < n and max(len(g) for g in groups) > 1:
        group = max(groups, key=lambda g: float(np.ptp(centers[g], axis=0).max()) if len(g) > 1 else -1.0)
        groups = [g for g in groups if g is not group]
        order = group[np.argsort(centers[group][:, int(np.argmax(np.ptp(centers[group], axis=0)))])]
        groups += [order[: len(order) // 2], order[len(order) // 2 :]]
    return [np.unique(mesh.faces[g]) for g in groups]


def _extents(vertices_m: Doubles, pieces: list[np.ndarray]) -> tuple[Doubles, Doubles]:
    return (
        np.stack([vertices_m[piece].min(axis=0) for piece in pieces]),
        np.stack([vertices_m[piece].max(axis=0) for piece in pieces]),
    )


def glowing(mi: Any, boxes: Boxes, unit_m: float, *, shown: bool) -> Any:
    """Make the boxes a Mitsuba shape that glows, or an invisible one of the same kind."""
    # Even a light source that is never chosen changes Mitsuba's choices, so every compared scene has one.
    mesh = boxes.mesh()
    vertices, faces = mesh.vertices_m / unit_m, mesh.faces
    if not shown:
        # A tiny triangle far outside the scene.
        vertices, faces = 1e5 + 1e-3 * np.eye(3), np.array([[0, 1, 2]])
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}})
    glow = {"type": "uniform", "value": _GLOW_W_M2_SR if shown else 0.0}
    properties["emitter"] = mi.load_dict({"type": "area", "radiance": glow, "sampling_weight": 0.0})
    shape = mi.Mesh("near", len(vertices), len(faces), props=properties)
    parameters = mi.traverse(shape)
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters.update()
    shape.set_id("near")
    return shape
