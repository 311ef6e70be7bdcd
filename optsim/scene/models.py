# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Models from files (glTF, OBJ, PLY, STL), read by trimesh: triangles by material, checked at once."""

from __future__ import annotations

import functools
import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.core.errors import ConfigError
from optsim.core.foreign import reading
from optsim.core.quantities import Doubles, Floats
from optsim.optics.srgb import srgb_to_linear
from optsim.scene.geometry import Faces, Mesh
from optsim.scene.gltf import StatedMaterial, check_readable, gltf_parts, stated_materials
from optsim.scene.model_files import files_of
from optsim.scene.node_animation import NodeAnimation, read_animation, world_matrices
from optsim.scene.pictures import checked_map

FORMATS = {".glb": "y", ".gltf": "y", ".obj": None, ".ply": None, ".stl": None}
"""Suffix -> axis that points up by the format's own rule; None where files differ."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What a file says of a material.

    Parameters
    ----------
    name : str
        Name in the file; may be empty.
    colour : ndarray of shape (3,)
        Base colour, linear sRGB, 0..1.
    picture : ndarray of shape (y, x, 3), float32, or None
        Reflectance map, linear sRGB, that the base colour multiplies, row 0 at the lower edge.
    cutout : ndarray of shape (y, x), float32, or None
        Opacity map, where the file has one.
    opacity, roughness, metallic : float
        0..1.
    maps : dict
        Maps of raw numbers by the keys of :data:`optsim.scene.pictures.MAPS`: normals (y, x, 3), whose
        vectors are 2 values - 1; roughness and metallic (y, x), which the numbers above multiply.
    lost : str
        A texture that the file states and that could not be read; empty if there is none.
    """

    name: str
    colour: Doubles
    picture: Floats | None
    cutout: Floats | None
    opacity: float
    roughness: float
    metallic: float
    maps: Mapping[str, Floats] = field(default_factory=dict[str, Floats])
    lost: str = ""


@dataclass(frozen=True, eq=False)
class Model:
    """A model as its file has it: no unit, axis or place is changed.

    Parameters
    ----------
    parts : tuple of (Surface, Mesh)
        Triangles of one material each; texture v points up.
    dropped : int
        Degenerate triangles that were left out.
    played : tuple of (int, ndarray)
        Of each part its node, and its vertices in the node's frame, (n, 3); empty without an animation.
    animation : NodeAnimation or None
        How nodes move.
    roots : tuple of int
        Nodes at the top.
    """

    parts: tuple[tuple[Surface, Mesh], ...]
    dropped: int
    played: tuple[tuple[int, Doubles], ...] = ()
    animation: NodeAnimation | None = None
    roots: tuple[int, ...] = ()

    def vertices(self, part: int, time_s: float) -> Doubles:
        """Vertices of a part at a time of the animation, (n, 3), in the file's frame and unit."""
        if self.animation is None:
            return self.parts[part][1].vertices_m
        node, points = self.played[part]
        matrix = world_matrices(self.animation, self.roots, time_s)[node]
        return points @ matrix[:3, :3].T + matrix[:3, 3]

    def moves(self) -> bool:
        """Whether the animation moves any part."""
        if self.animation is None:
            return False
        times = np.linspace(0, self.animation.duration_s, 9)
        return any(
            (self.vertices(part, time) != self.vertices(part, 0.0)).any()
            for part in range(len(self.parts))
            for time in times
        )


def read_model(path: Path) -> Model:
    """Read a model; the file is read again only when it has changed.

    Raises
    ------
    ConfigError
        For a missing or damaged file, another format, no faces, indices out of range, numbers that are
        not finite, or what :func:`optsim.scene.gltf.check_readable` refuses.
    """
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: got {path.suffix!r}, expected one of: {', '.join(FORMATS)}")
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; cure: put the model into the scene's folder")
    stats = [file.stat() for file in files_of(path)]
    return _read(path, tuple((stat.st_mtime_ns, stat.st_size) for stat in stats))


def inside(folder: Path, name: str, where: str, *, or_folder: bool = False) -> Path:
    """Find a file of the scene's folder; a scene must be complete in itself.

    Raises
    ------
    ConfigError
        For a path that leads out of the folder, or to nothing.
    """
    root = folder.resolve()
    path = (root / name).resolve()
    if not name or not path.is_relative_to(root):
        raise ConfigError(f"{where}: got {name!r}, expected a path inside {root}; cure: copy the file there")
    if not (path.is_file() or (or_folder and path.is_dir())):
        raise ConfigError(f"{where}: got {name!r}, but there is no such file in {root}")
    return path


@functools.lru_cache(maxsize=64)
def _read(path: Path, _changed: tuple[tuple[int, int], ...]) -> Model:
    import trimesh

    # What it warns of leaves no triangles, which is refused below.
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    with reading(path, "a model with triangles", "export it again, for example as GLB"):
        stated: dict[str, StatedMaterial] = {}
        if path.suffix.lower() in (".glb", ".gltf"):
            header, _ = gltf_parts(path)
            check_readable(path, header)
            stated = stated_materials(path, header)
        scene = cast("Any", trimesh.load_scene(path, process=False))
        found: list[tuple[Surface, Mesh]] = []
        played: list[tuple[int, Doubles]] = []
        animation = read_animation(path) if path.suffix.lower() in (".glb", ".gltf") else None
        numbers = _node_numbers(animation)
        dropped = 0
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph[node]
            geometry = scene.geometry[name]
            if not isinstance(geometry, trimesh.Trimesh):
                continue
            mesh, bad = _mesh(path, name, geometry, np.asarray(matrix, np.float64))
            dropped += bad
            surface = _surface(path, geometry, stated)
            for part in _by_hand(surface, mesh):
                found.append(part)
                if animation is not None:
                    above = scene.graph.transforms.parents.get(node)
                    played.append((numbers.get(node, numbers.get(above, -1)), np.asarray(geometry.vertices)))
    if not found:
        raise ConfigError(f"{path}: got no triangles, expected a mesh; cure: triangulate and export it again")
    if animation is None or any(node < 0 for node, _ in played):
        return Model(tuple(found), dropped)
    below = {child for node in animation.nodes for child in node.get("children", [])}
    roots = tuple(node for node in range(len(animation.nodes)) if node not in below)
    return Model(tuple(found), dropped, tuple(played), animation, roots)


def _node_numbers(animation: NodeAnimation | None) -> dict[str, int]:
    """Numbers of the nodes by the names that trimesh gives them."""
    from trimesh.util import unique_name

    found: dict[str, int] = {}
    counts: dict[str, int] = {}
    for number, node in enumerate(animation.nodes if animation is not None else []):
        name = cast("Any", unique_name)(node.get("name", str(number)), found, counts=counts)
        found[name] = number
    return found


def _mesh(path: Path, name: str, geometry: Any, matrix: Doubles) -> tuple[Mesh, int]:
    """Triangles of one geometry in the file's frame, without degenerate ones."""
    vertices = np.asarray(geometry.vertices, np.float64)
    faces = np.asarray(geometry.faces, np.int64)
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        worst = int(faces.max() if faces.max() >= len(vertices) else faces.min())
        raise ConfigError(
            f"{path}: {name}: got a face with vertex {worst}, expected 0 to {len(vertices) - 1}; "
            "cure: export the model again"
        )
    if not np.isfinite(vertices[np.unique(faces)]).all():
        raise ConfigError(f"{path}: {name}: got a vertex that is not finite; cure: export the model again")
    vertices = np.nan_to_num(vertices) @ matrix[:3, :3].T + matrix[:3, 3]
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    good = area > 1e-14 * np.ptp(vertices, axis=0).max(initial=0.0) ** 2
    uv = getattr(geometry.visual, "uv", None)
    texture = np.zeros((len(vertices), 2)) if uv is None else np.asarray(uv, np.float64)[:, :2]
    if not np.isfinite(texture).all():
        raise ConfigError(
            f"{path}: {name}: got texture coordinates that are not finite; cure: export it again"
        )
    # A mirroring node turns triangles inside out.
    order = [0, 2, 1] if np.linalg.det(matrix[:3, :3]) < 0 else [0, 1, 2]
    kept: Faces = faces[good][:, order].astype(np.int32)
    return Mesh(vertices, kept, texture), int((~good).sum())


def _by_hand(surface: Surface, mesh: Mesh) -> list[tuple[Surface, Mesh]]:
    """Split a part where its picture is mirrored, for the renderer takes a normal map's y from its x.

    What is mirrored has its pictures turned over, so that they look the same, and the map's x with them.
    """
    if "normal_map" not in surface.maps:
        return [(surface, mesh)] if len(mesh.faces) else []
    corners = mesh.uv[mesh.faces]
    (across, up), (further, higher) = (corners[:, 1] - corners[:, 0]).T, (corners[:, 2] - corners[:, 0]).T
    mirrored = across * higher < up * further
    # Copies: they are changed here.
    maps = {key: image[:, ::-1].copy() for key, image in surface.maps.items()}
    maps["normal_map"][..., 0] = 1 - maps["normal_map"][..., 0]
    over = replace(
        surface,
        picture=None if surface.picture is None else np.ascontiguousarray(surface.picture[:, ::-1]),
        cutout=None if surface.cutout is None else np.ascontiguousarray(surface.cutout[:, ::-1]),
        maps=maps,
    )
    parts = [
        (surface, replace(mesh, faces=mesh.faces[~mirrored])),
        (over, replace(mesh, faces=mesh.faces[mirrored], uv=mesh.uv * (-1, 1))),
    ]
    return [part for part in parts if len(part[1].faces)]


def _surface(path: Path, geometry: Any, stated: Mapping[str, StatedMaterial]) -> Surface:
    """Read what the file says of a geometry's material; plain grey where it says nothing."""
    from trimesh.visual.material import PBRMaterial

    material = getattr(geometry.visual, "material", None)
    if material is None:
        color: Doubles = np.array([0.5, 0.5, 0.5])
        if getattr(geometry.visual, "kind", None) in ("vertex", "face"):
            color = srgb_to_linear(np.asarray(geometry.visual.main_color[:3], np.float64) / 255)
        return Surface("", color, None, None, 1.0, 1.0, 0.0)
    if not isinstance(material, PBRMaterial):
        material = material.to_pbr()
    about = stated.get(str(material.name or ""), StatedMaterial({}, 1.0))
    lost = [f"{key} ({picture})" for key, picture in about.textures.items() if getattr(material, key) is None]
    factor = material.baseColorFactor
    # trimesh holds the linear factors of glTF in 8 bits.
    color = (
        np.ones(4) if factor is None else np.asarray(factor, np.float64) / (255 if np.max(factor) > 1 else 1)
    )
    picture = cutout = None
    if material.baseColorTexture is not None:
        rgba = np.asarray(material.baseColorTexture.convert("RGBA"), np.float64)[::-1] / 255
        picture = srgb_to_linear(rgba[..., :3]).astype(np.float32)
        if material.alphaMode in ("MASK", "BLEND") and (rgba[..., 3] < 1).any():
            cutout = rgba[..., 3].astype(np.float32)
            if material.alphaMode == "MASK":
                cutout = (cutout >= (material.alphaCutoff or 0.5)).astype(np.float32)
    # glTF 2.0: both factors are 1 by default.
    return Surface(
        str(material.name or ""),
        np.asarray(color[:3], np.float64),
        picture,
        cutout,
        float(color[3]) if material.alphaMode == "BLEND" and len(color) > 3 else 1.0,
        1.0 if material.roughnessFactor is None else float(material.roughnessFactor),
        1.0 if material.metallicFactor is None else float(material.metallicFactor),
        _maps(path, material, about.normal_scale),
        ", ".join(lost),
    )


def _maps(path: Path, material: Any, normal_scale: float) -> dict[str, Floats]:
    """Read the maps of raw numbers of a glTF material, row 0 at the lower edge."""
    found: dict[str, Floats] = {}
    if material.metallicRoughnessTexture is not None:
        packed = _raw(material.metallicRoughnessTexture)
        # glTF 2.0, section 3.9.2: roughness is green, metal is blue.
        found = {"roughness_map": packed[..., 1], "metallic_map": packed[..., 2]}
    if material.normalTexture is not None:
        coded = checked_map(_raw(material.normalTexture), "normal_map", f"{path}: normalTexture")
        slopes = (coded - 0.5) * np.array([normal_scale, normal_scale, 1.0], np.float32)
        length = np.linalg.norm(slopes, axis=-1, keepdims=True)
        found["normal_map"] = slopes / np.maximum(2 * length, 1e-6) + np.float32(0.5)
    return {key: np.ascontiguousarray(image, np.float32) for key, image in found.items()}


def _raw(picture: Any) -> Floats:
    """Values of a picture as they are stored, 0..1, row 0 at the lower edge."""
    return np.asarray(picture.convert("RGB"), np.float32)[::-1] / np.float32(255)
