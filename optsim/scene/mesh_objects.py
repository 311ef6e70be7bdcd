"""Objects and movers made of models from files: a part of one material each, and sequences of vertices."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from pydantic import Field

from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.core.foreign import reading
from optsim.core.quantities import Doubles
from optsim.scene.fields import Positive, Vector
from optsim.scene.geometry import Mesh, merge
from optsim.scene.models import FORMATS, Model, read_model
from optsim.scene.solids import rotated

Unit = Literal["m", "cm", "mm", "in", "ft"]
UNITS_M: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
UPRIGHT = {
    "x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}


class MeshObject(Part):
    """Model from a file: glTF, OBJ, PLY or STL.

    Parameters
    ----------
    file : str
        Path relative to the scene's folder.
    material : str or None
        One of the scene's materials for all of it; by default the file's own.
    unit : {"m", "cm", "mm", "in", "ft"} or None
        Length of 1 in the file; metres by the rule of glTF. Other formats need it, or ``height_m``.
    height_m : float or None
        Scale the model to this height instead.
    up : {"x", "y", "z"} or None
        Axis of the file that points up; y by the rule of glTF. Other formats need it.
    anchor : {"base", "middle", "origin"}
        Point of the model that is placed: the middle of its lowest side, the middle of its bounding box, or
        the file's own origin.
    position_m : vector
        Place of this point.
    rotation_rad : vector
        Angles about x, then y, then z through this point, right-handed.
    part : int
        Number of the part; set by the expansion.
    sha256 : str
        Hash of the file; set by the expansion.
    """

    kind: Literal["mesh"] = "mesh"
    file: str = Field(exclude=True)
    material: str
    unit: Unit | None = None
    height_m: Positive | None = None
    up: Literal["x", "y", "z"] | None = None
    anchor: Literal["base", "middle", "origin"] = "base"
    position_m: Vector = (0.0, 0.0, 0.0)
    rotation_rad: Vector = (0.0, 0.0, 0.0)
    part: int = Field(default=0, ge=0)
    sha256: str = ""

    def mesh(self) -> Mesh:
        """Make the triangles."""
        return _placed(cast("Any", self))

    def scale(self, model: Model) -> float:
        """Metres to a unit of the file."""
        if self.height_m is not None:
            low, high = upright(model, self.up or "z")
            return self.height_m / max(float(high[2] - low[2]), 1e-12)
        return UNITS_M[self.unit or "m"]


class AnimatedModel(Part):
    """Parts of a model that its file's own animation moves; scenes write them as a mover of kind ``mesh``.

    Parameters
    ----------
    items : tuple of MeshObject
        The parts, at rest: of one file and material, and moved as one.
    speed : float
        Times as fast as the file says.
    repeat : bool
        Start again after the last keyframe.
    """

    kind: Literal["animated"] = "animated"
    items: tuple[MeshObject, ...]
    speed: Positive = 1.0
    repeat: bool = True

    @property
    def material(self) -> str:
        """Material of the parts."""
        return self.items[0].material

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        mesh = merge([item.mesh() for item in self.items])
        return replace(mesh, vertices_m=self.vertices(0.0))

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        model = read_model(Path(self.items[0].file))
        place = time_s * self.speed
        if self.repeat and model.animation is not None:
            place %= max(model.animation.duration_s, 1e-9)
        return np.concatenate(
            [_in_scene(item, model, model.vertices(item.part, place)) for item in self.items]
        )


class VertexSequence(Part):
    """Mesh whose vertices are known at times: bodies, cloth; between them they move in straight lines.

    Parameters
    ----------
    file : str
        Path relative to the scene's folder of an ``.npz`` with ``vertices`` (t, n, 3), m, z up, ``faces``
        (m, 3) and perhaps ``uv`` (n, 2); or a folder of models of one topology, taken in the order of names.
    material : str
        One of the scene's.
    rate_hz : float
        Steps a second.
    repeat : bool
        Start again after the last step; otherwise it rests there.
    position_m : vector
        Shift of all vertices.
    sha256 : str
        Hash of the content; set when the scene is read.
    """

    kind: Literal["vertices"] = "vertices"
    file: str = Field(exclude=True)
    material: str
    rate_hz: Positive
    repeat: bool = False
    position_m: Vector = (0.0, 0.0, 0.0)
    sha256: str = ""

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        steps, faces, uv = steps_of(Path(self.file), self.sha256)
        return Mesh(steps[0] + np.asarray(self.position_m), faces, uv)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        steps, _, _ = steps_of(Path(self.file), self.sha256)
        n = len(steps)
        place = time_s * self.rate_hz
        place = place % n if self.repeat else float(np.clip(place, 0, n - 1))
        before = min(int(place), n - 1)
        after = (before + 1) % n if self.repeat else min(before + 1, n - 1)
        share = place - before
        return (1 - share) * steps[before] + share * steps[after] + np.asarray(self.position_m)


@functools.lru_cache(maxsize=512)
def _placed(item: MeshObject) -> Mesh:
    """Triangles of a part in the scene's frame; cached, since every pose starts from it."""
    model = read_model(Path(item.file))
    mesh = model.parts[item.part][1]
    return replace(mesh, vertices_m=_in_scene(item, model, mesh.vertices_m))


def _in_scene(item: MeshObject, model: Model, vertices: Doubles) -> Doubles:
    """Take vertices of the file to the scene, m."""
    up = item.up or "z"
    low, high = upright(model, up)
    anchor = (low + high) / 2 if item.anchor != "origin" else np.zeros(3)
    if item.anchor == "base":
        anchor[2] = low[2]
    points = vertices @ UPRIGHT[up].T - anchor
    return points * item.scale(model) @ rotated(item.rotation_rad).T + np.asarray(item.position_m)


def upright(model: Model, up: str) -> tuple[Doubles, Doubles]:
    """Lowest and highest corner with the file's up axis along z."""
    found = [mesh.vertices_m for _, mesh in model.parts]
    if model.animation is not None and not any(np.ptp(each, axis=0).any() for each in found):
        # Hidden by scale 0 at rest: as large as at the end.
        found = [model.vertices(part, model.animation.duration_s) for part in range(len(found))]
    points = [each @ UPRIGHT[up].T for each in found]
    return np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0)


@functools.lru_cache(maxsize=32)
def steps_of(path: Path, _sha256: str) -> tuple[Doubles, Any, Doubles]:
    """Vertices (t, n, 3), faces and texture coordinates of a sequence."""
    if path.is_dir():
        models = [read_model(file) for file in sorted(path.iterdir()) if file.suffix.lower() in FORMATS]
        if len(models) < 2:
            raise ConfigError(f"{path}: got {len(models)} models, expected two or more of one topology")
        first = models[0].parts[0][1]
        for model in models:
            faces = model.parts[0][1].faces
            if len(model.parts) != 1 or faces.shape != first.faces.shape or (faces != first.faces).any():
                raise ConfigError(f"{path}: got models of other triangles, expected one topology in all")
        return np.stack([model.parts[0][1].vertices_m for model in models]), first.faces, first.uv
    with reading(path, "an npz with vertices (t, n, 3) and faces (m, 3)"), np.load(path) as stored:
        found = {key: stored[key] for key in ("vertices", "faces", "uv") if key in stored}
    vertices, faces = found.get("vertices"), found.get("faces")
    if vertices is None or faces is None or vertices.ndim != 3 or vertices.shape[2] != 3 or faces.ndim != 2:
        got = ", ".join(f"{key} {array.shape}" for key, array in found.items()) or "neither"
        raise ConfigError(f"{path}: got {got}, expected vertices (t, n, 3) and faces (m, 3)")
    if faces.shape[1] != 3 or faces.min(initial=0) < 0 or faces.max(initial=0) >= vertices.shape[1]:
        raise ConfigError(f"{path}: faces: expected (m, 3) indices of 0 to {vertices.shape[1] - 1}")
    if not np.isfinite(vertices).all() or not len(faces) or not len(vertices):
        raise ConfigError(f"{path}: vertices: got none, or one that is not finite; cure: export it again")
    uv = found.get("uv", np.zeros((vertices.shape[1], 2)))
    if uv.shape != (vertices.shape[1], 2):
        raise ConfigError(f"{path}: uv: got {uv.shape}, expected ({vertices.shape[1]}, 2)")
    return vertices.astype(np.float64), faces.astype(np.int32), uv.astype(np.float64)
