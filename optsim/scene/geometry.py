"""Triangle meshes as pure functions of their dimensions, in metres, z up, texture included.

Texture coordinates on flat surfaces are metres, so a material sets the size of a texture tile. A limb's mesh
has the same topology in every pose: movers change vertices only.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from optsim.core.quantities import Doubles, Floats

Faces = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with texture coordinates; anticlockwise seen from outside."""

    vertices_m: Doubles  # (n, 3)
    faces: Faces  # (m, 3), indices of vertices
    uv: Doubles  # (n, 2)
    colours: Floats | None = None  # (n, 3), linear reflectances, for a material that takes them


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """Merge meshes into one; those without colours are white where others have some."""
    colours = None
    if any(mesh.colours is not None for mesh in meshes):
        white = [np.ones((len(mesh.vertices_m), 3), np.float32) for mesh in meshes]
        colours = np.concatenate(
            [each if mesh.colours is None else mesh.colours for mesh, each in zip(meshes, white, strict=True)]
        )
    offsets = np.cumsum([0] + [len(mesh.vertices_m) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate(
            [mesh.faces + np.int32(offset) for mesh, offset in zip(meshes, offsets, strict=True)]
        ).astype(np.int32),
        np.concatenate([mesh.uv for mesh in meshes]),
        colours,
    )


def quad(corner_m: ArrayLike, edge_u_m: ArrayLike, edge_v_m: ArrayLike, uv: ArrayLike | None = None) -> Mesh:
    """Parallelogram facing ``edge_u x edge_v``; texture coordinates in metres, or as ``uv`` (4, 2)."""
    corner, u, v = (np.asarray(x, np.float64) for x in (corner_m, edge_u_m, edge_v_m))
    if uv is None:
        width, height = np.linalg.norm(u), np.linalg.norm(v)
        uv = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    vertices = np.stack([corner, corner + u, corner + u + v, corner + v])
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.asarray(uv, np.float64))


def box(center_m: ArrayLike, size_m: ArrayLike, yaw_rad: float = 0.0) -> Mesh:
    """Box with outward faces, rotated by ``yaw_rad`` about the vertical."""
    half = np.asarray(size_m, np.float64) / 2
    sides: list[Mesh] = []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        if axis == 1:
            u, v = v, u  # keeps v upright on both pairs of side walls
        for sign in (-1.0, 1.0):
            normal = np.eye(3)[axis] * sign
            flip = 1.0 if np.dot(np.cross(u, v), normal) > 0 else -1.0
            edge = 2 * u * half * flip
            sides.append(quad(normal * half - edge / 2 - v * half, edge, 2 * v * half))
    mesh = merge(sides)
    return Mesh(turn(mesh.vertices_m, yaw_rad) + np.asarray(center_m, np.float64), mesh.faces, mesh.uv)


def turn(vertices_m: Doubles, yaw_rad: float) -> Doubles:
    """Rotate (n, 3) points about the vertical axis through the origin."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return vertices_m @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def wall(
    corner_m: ArrayLike,
    edge_u_m: ArrayLike,
    edge_v_m: ArrayLike,
    holes_m: Sequence[tuple[float, float, float, float]],
    depth_m: float,
) -> Mesh:
    """Wall on orthogonal edges with holes (u0, v0, u1, v1), m along them, and reveals behind them."""
    corner, u, v = (np.asarray(x, np.float64) for x in (corner_m, edge_u_m, edge_v_m))
    width, height = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    u, v = u / width, v / height
    back = -np.cross(u, v) * depth_m
    us = sorted({0.0, width, *(x for hole in holes_m for x in (hole[0], hole[2]))})
    vs = sorted({0.0, height, *(x for hole in holes_m for x in (hole[1], hole[3]))})
    pieces: list[Mesh] = []
    for u0, u1 in pairwise(us):
        for v0, v1 in pairwise(vs):
            middle = (u0 + u1) / 2, (v0 + v1) / 2
            if any(h[0] < middle[0] < h[2] and h[1] < middle[1] < h[3] for h in holes_m):
                continue
            uv = [[u0, v0], [u1, v0], [u1, v1], [u0, v1]]
            pieces.append(quad(corner + u * u0 + v * v0, u * (u1 - u0), v * (v1 - v0), uv))
    for u0, v0, u1, v1 in holes_m:
        low, right, high, left = (corner + u * a + v * b for a, b in ((u0, v0), (u1, v0), (u1, v1), (u0, v1)))
        pieces += [
            quad(low, right - low, back),
            quad(right, high - right, back),
            quad(high, left - high, back),
            quad(left, low - left, back),
        ]
    return merge(pieces)


def limb(
    start_m: ArrayLike,
    stop_m: ArrayLike,
    radius_start_m: float,
    radius_stop_m: float,
    *,
    side: ArrayLike = (1.0, 0.0, 0.0),
    flatness: float = 1.0,
    band: tuple[float, float] = (0.0, 1.0),
    around: int = 14,
) -> Mesh:
    """Tapered capsule, ``side`` its wide axis: texture v goes through ``band`` along it, u round it."""
    start, stop = np.asarray(start_m, np.float64), np.asarray(stop_m, np.float64)
    length = float(np.linalg.norm(stop - start))
    axis = (stop - start) / length
    wide = np.asarray(side, np.float64) - np.dot(side, axis) * axis
    wide /= np.linalg.norm(wide)
    thin = np.cross(axis, wide)
    caps = np.linspace(0, np.pi / 2, 4)[:-1]
    shaft = np.array([0.0, 1.0])
    # Rings (position along the axis, radius) from pole to pole.
    place = np.concatenate(
        [-radius_start_m * np.cos(caps), shaft * length, length + radius_stop_m * np.sin(caps[1:])]
    )
    radius = np.concatenate(
        [
            radius_start_m * np.sin(caps),
            radius_start_m + (radius_stop_m - radius_start_m) * shaft,
            radius_stop_m * np.cos(caps[1:]),
        ]
    )
    place, radius = np.append(place, length + radius_stop_m), np.append(radius, 0.0)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    ring = np.cos(angle)[:, None] * wide + flatness * np.sin(angle)[:, None] * thin
    vertices = start + place[:, None, None] * axis + radius[:, None, None] * ring
    share = (place - place[0]) / (place[-1] - place[0])
    uv = np.stack(
        np.broadcast_arrays(angle[None] / (2 * np.pi), (band[0] + (band[1] - band[0]) * share)[:, None]),
        axis=-1,
    )
    return Mesh(vertices.reshape(-1, 3), _grid_faces(len(place), around + 1), uv.reshape(-1, 2))


def ball(center_m: ArrayLike, radius_m: float, *, around: int = 32, along: int = 17) -> Mesh:
    """Ball with texture u round and v from lower to the upper pole."""
    polar = np.linspace(-np.pi / 2, np.pi / 2, along)
    angle = np.linspace(0, 2 * np.pi, around + 1)
    vertices = np.stack(
        np.broadcast_arrays(
            np.cos(polar)[:, None] * np.cos(angle),
            np.cos(polar)[:, None] * np.sin(angle),
            np.sin(polar)[:, None],
        ),
        axis=-1,
    )
    uv = np.stack(
        np.broadcast_arrays(angle[None] / (2 * np.pi), (polar[:, None] + np.pi / 2) / np.pi), axis=-1
    )
    vertices = vertices.reshape(-1, 3) * radius_m + np.asarray(center_m, np.float64)
    return Mesh(vertices, _grid_faces(along, around + 1), uv.reshape(-1, 2))


def ring(
    radius_m: float, thick_m: float, *, band: tuple[float, float] = (0.0, 1.0), around: int = 48
) -> Mesh:
    """Torus about z: texture v goes through ``band`` round the cross-section, u round the axis."""
    angle = np.linspace(0, 2 * np.pi, around + 1)
    turn_of_section = np.linspace(0, 2 * np.pi, 11)
    reach = radius_m - thick_m * np.cos(turn_of_section)[:, None]
    height = np.broadcast_to(-thick_m * np.sin(turn_of_section)[:, None], (11, around + 1))
    vertices = np.stack([reach * np.cos(angle), reach * np.sin(angle), height], axis=-1)
    share = turn_of_section[:, None] / (2 * np.pi)
    uv = np.stack(
        np.broadcast_arrays(angle[None] / (2 * np.pi), band[0] + (band[1] - band[0]) * share), axis=-1
    )
    return Mesh(vertices.reshape(-1, 3), _grid_faces(11, around + 1), uv.reshape(-1, 2))


def sheet(n_u: int, n_v: int) -> Mesh:
    """Make a unit square in the x-z plane facing -y, centred, of n_u x n_v vertices; texture 0 .. 1."""
    u, v = np.meshgrid(np.linspace(0, 1, n_u), np.linspace(0, 1, n_v))
    vertices = np.stack([u - 0.5, np.zeros_like(u), v - 0.5], axis=-1).reshape(-1, 3)
    return Mesh(vertices, _grid_faces(n_v, n_u), np.stack([u, v], axis=-1).reshape(-1, 2))


@functools.cache
def _grid_faces(rows: int, cols: int) -> Faces:
    """Two triangles a cell of a (rows, cols) grid of vertices, row-major; cached, as each pose needs them."""
    index = np.arange(rows * cols, dtype=np.int32).reshape(rows, cols)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    faces.flags.writeable = False
    return faces
