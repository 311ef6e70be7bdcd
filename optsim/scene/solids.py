# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""Simple solids of any size and attitude, made by trimesh; texture coordinates are metres."""

from __future__ import annotations

import functools
from typing import Any, Literal, cast, get_args

import numpy as np

from optsim.core.config import Part
from optsim.core.quantities import Doubles
from optsim.scene.fields import Positive, Vector
from optsim.scene.geometry import Mesh

Shape = Literal["box", "ball", "cylinder", "cone", "torus", "capsule", "icosahedron", "slab", "column"]
SHAPES: tuple[Shape, ...] = get_args(Shape)


class Solid(Part):
    """Solid of a shape.

    Parameters
    ----------
    shape : str
        ``box``, ``ball``, ``cylinder``, ``cone``, ``torus``, ``capsule``, ``icosahedron``, ``slab`` (a wide
        box) or ``column`` (a tall box).
    height_m : float
        Height before it is turned.
    anchor : {"base", "middle"}
        Point that is placed: the middle of its lowest side, or of its bounding box.
    position_m : vector
        Place of this point.
    rotation_rad : vector
        Angles about x, then y, then z through this point, right-handed.
    """

    kind: Literal["solid"] = "solid"
    shape: Shape
    material: str
    height_m: Positive
    anchor: Literal["base", "middle"] = "base"
    position_m: Vector = (0.0, 0.0, 0.0)
    rotation_rad: Vector = (0.0, 0.0, 0.0)

    def mesh(self) -> Mesh:
        """Make the triangles."""
        unit = _unit(self.shape)
        points = unit.vertices_m + (np.array([0, 0, 0.5]) if self.anchor == "base" else 0)
        turned = points * self.height_m @ rotated(self.rotation_rad).T
        return Mesh(turned + np.asarray(self.position_m), unit.faces, unit.uv * self.height_m)


def rotated(angles_rad: Vector) -> Doubles:
    """Matrix (3, 3) that rotates column vectors about x, then y, then z, right-handed."""
    from scipy.spatial.transform import Rotation  # pyright: ignore[reportMissingTypeStubs]

    return np.asarray(Rotation.from_euler("xyz", angles_rad).as_matrix(), np.float64)


def widest(kind: str) -> float:
    """Largest side of a shape over its height; 1 for what is no shape."""
    return float(np.ptp(_unit(kind).vertices_m, axis=0).max()) if kind in SHAPES else 1.0


def reach(kind: str) -> float:
    """Radius of the sphere about a shape's middle that holds it, over its largest side; 1 for a model."""
    if kind not in SHAPES:
        return 1.0
    return float(np.linalg.norm(_unit(kind).vertices_m, axis=1).max()) / widest(kind)


@functools.cache
def _unit(shape: Shape) -> Mesh:
    """Solid of height 1 about the origin, with hard edges where it has any."""
    import trimesh

    make = cast("Any", trimesh.creation)
    solid: Any = {
        "box": lambda: make.box((1, 1, 1)),
        "slab": lambda: make.box((2.2, 1.6, 1)),
        "column": lambda: make.box((0.45, 0.45, 1)),
        "ball": lambda: make.icosphere(subdivisions=3, radius=0.5),
        "cylinder": lambda: make.cylinder(0.4, 1.0, sections=48),
        "cone": lambda: make.cone(0.5, 1.0, sections=48),
        "torus": lambda: make.torus(1.0, 0.5, major_sections=48, minor_sections=20),
        "capsule": lambda: make.capsule(height=0.5, radius=0.25, count=(24, 24)),
        "icosahedron": lambda: make.icosahedron(),
    }[shape]()
    # Triangles that meet at more than 30 degrees keep an edge: they share no vertices.
    is_round = shape in ("ball", "torus")
    smooth: Any = solid if is_round else cast("Any", trimesh.graph).smooth_shade(solid, angle=np.radians(30))
    low, high = (np.asarray(corner, np.float64) for corner in solid.bounds)
    points: Doubles = (np.asarray(smooth.vertices, np.float64) - (low + high) / 2) / (high[2] - low[2])
    return _textured(points, np.asarray(smooth.faces, np.int64), np.asarray(smooth.face_normals, np.float64))


def _textured(points: Doubles, faces: Any, normals: Doubles) -> Mesh:
    """Project texture along the axis that each triangle faces most; no two axes share vertices."""
    axis = np.abs(normals).argmax(axis=1)
    corners = np.stack([faces.ravel(), np.repeat(axis, 3)], axis=1)
    unique, index = np.unique(corners, axis=0, return_inverse=True)
    placed = points[unique[:, 0]]
    across = np.array([[1, 2], [0, 2], [0, 1]])[unique[:, 1]]
    uv = np.take_along_axis(placed, across, axis=1)
    return Mesh(placed, index.reshape(-1, 3).astype(np.int32), uv)
