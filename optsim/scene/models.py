"""Models from files (glTF, OBJ, PLY, STL): triangles by material, checked at once."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from optsim.core.errors import ConfigError
from optsim.core.foreign import reading
from optsim.core.quantities import Bools, Doubles
from optsim.scene.geometry import Mesh
from optsim.scene.gltf_model import read_gltf
from optsim.scene.model_files import check_size, files_of
from optsim.scene.model_surface import Surface, SurfacePiece, listed, split_by_hand
from optsim.scene.node_animation import NodeTree
from optsim.scene.obj_files import read_obj
from optsim.scene.ply_files import read_ply
from optsim.scene.stl_files import read_stl

FORMATS = {".glb": "y", ".gltf": "y", ".obj": None, ".ply": None, ".stl": None}
"""Suffix -> axis that points up by the format's own rule; None where files differ."""


@dataclass(frozen=True, eq=False)
class Model:
    """A model as its file has it: no unit, axis or place is changed."""

    parts: tuple[tuple[Surface, Mesh], ...]  # of one material each; texture v points up
    dropped: int  # degenerate triangles that were left out
    lost: str = ""  # left out beyond its parts, and the user is told
    played: tuple[tuple[int, Doubles], ...] = ()  # node of each part, and vertices in its frame
    animation: NodeTree | None = None

    def vertices(self, part: int, time_s: float) -> Doubles:
        """Vertices of a part at a time of the animation, (n, 3), in the file's frame and unit."""
        if self.animation is None:
            return self.parts[part][1].vertices_m
        node, points = self.played[part]
        matrix = _matrices(self.animation, time_s)[node]
        return points @ matrix[:3, :3].T + matrix[:3, 3]

    def moving_parts(self) -> dict[int, int]:
        """Parts that the animation moves, or puts elsewhere than at rest; those of one number move as one."""
        moving = dict[int, int]() if self.animation is None else self.animation.moving()
        return {part: moving[node] for part, (node, _) in enumerate(self.played) if node in moving}


@functools.lru_cache(maxsize=16)
def _matrices(nodes: NodeTree, time_s: float) -> dict[int, Doubles]:
    """Matrices of all nodes, which every part asks for in turn."""
    return nodes.matrices(time_s)


def read_model(path: Path) -> Model:
    """Read a model; the file is read again only when it has changed."""
    if path.suffix.lower() not in FORMATS:
        raise ConfigError(f"{path}: got {path.suffix!r}, expected one of: {', '.join(FORMATS)}")
    if not path.is_file():
        raise ConfigError(f"{path}: no such file; cure: put the model into the scene's folder")
    stats = [file.stat() for file in files_of(path)]
    return _read(path, tuple((stat.st_mtime_ns, stat.st_size) for stat in stats))


def inside(folder: Path, name: str, where: str, *, or_folder: bool = False) -> Path:
    """Find a file of the scene's folder; a scene must be complete in itself."""
    root = folder.resolve()
    path = (root / name).resolve()
    if not name or not path.is_relative_to(root):
        raise ConfigError(f"{where}: got {name!r}, expected a path inside {root}; cure: copy the file there")
    if not (path.is_file() or (or_folder and path.is_dir())):
        raise ConfigError(f"{where}: got {name!r}, but there is no such file in {root}")
    return path


@functools.lru_cache(maxsize=64)
def _read(path: Path, _changed: tuple[tuple[int, int], ...]) -> Model:
    check_size(path)
    readers = {".obj": read_obj, ".ply": read_ply, ".stl": read_stl}
    nodes, matrices = None, dict[int, Doubles]()
    with reading(path, "a model with triangles", "export it again, for example as GLB"):
        if (read := readers.get(path.suffix.lower())) is not None:
            pieces, lost = read(path)
        else:
            pieces, lost, nodes = read_gltf(path)
            matrices = nodes.matrices()
    parts: list[tuple[Surface, Mesh]] = []
    played: list[tuple[int, Doubles]] = []
    dropped = 0
    for piece in [each for each in pieces if len(each.faces)]:
        for surface, mesh in split_by_hand(_checked(piece.surface), _mesh(path, piece)):
            good = _spanned(mesh)
            dropped += int((~good).sum())
            if good.any():
                played.append((piece.node, mesh.vertices_m))
                kept = replace(mesh, faces=mesh.faces[good])
                parts.append((surface, _placed(path, kept, matrices.get(piece.node, np.eye(4)))))
    if not parts:
        there = f" ({lost})" if lost else ""
        raise ConfigError(f"{path}: got no triangles{there}, expected a mesh; cure: export it with faces")
    if nodes is None or not nodes.channels:
        return Model(tuple(parts), dropped, lost)
    return Model(tuple(parts), dropped, lost, tuple(played), nodes)


def _checked(surface: Surface) -> Surface:
    """Surface whose numbers are 0 to 1; those beyond are clipped, which is said."""
    numbers = [surface.opacity, surface.roughness, surface.metallic]
    found = np.array([*surface.colour, *numbers])
    if not np.isfinite(found).all():
        return replace(
            surface, colour=np.full(3, 0.5), refused=f"material {surface.name!r}: got {found.tolist()}"
        )
    beyond = "a colour or number beyond 0 to 1 (clipped)" if (found.clip(0, 1) != found).any() else ""
    return replace(surface, lost=listed(surface.lost, beyond))


def _mesh(path: Path, piece: SurfacePiece) -> Mesh:
    """Triangles of a piece in its own frame."""
    if not np.isfinite(piece.points)[piece.faces].all():
        raise ConfigError(f"{path}: {piece.name}: got a vertex that is not finite; cure: export it again")
    uv = np.zeros((len(piece.points), 2)) if piece.uv is None else piece.uv
    if not all(np.isfinite(each).all() for each in (uv, piece.colours) if each is not None):
        raise ConfigError(
            f"{path}: {piece.name}: got texture coordinates or colours that are not finite; "
            "cure: export it again"
        )
    return Mesh(np.nan_to_num(piece.points), piece.faces.astype(np.int32), uv, piece.colours)


def _spanned(mesh: Mesh) -> Bools:
    """Which triangles have an area, judged in the piece's own frame: a node may scale it to nothing."""
    corners = mesh.vertices_m[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return area > 1e-14 * np.ptp(mesh.vertices_m, axis=0).max(initial=0.0) ** 2


def _placed(path: Path, mesh: Mesh, matrix: Doubles) -> Mesh:
    """Triangles in the file's frame; a node that mirrors turns them inside out."""
    if (matrix == np.eye(4)).all():
        return mesh
    vertices = mesh.vertices_m @ matrix[:3, :3].T + matrix[:3, 3]
    if not np.isfinite(vertices).all():
        raise ConfigError(f"{path}: got a node whose matrix is not finite; cure: export it again")
    mirrors = np.linalg.det(matrix[:3, :3]) < 0
    return replace(mesh, vertices_m=vertices, faces=mesh.faces[:, [0, 2, 1]] if mirrors else mesh.faces)
