"""Objects and movers made of models from files, and their expansion into the parts of one material each.

A model with three materials becomes three objects, ``statue-0`` to ``statue-2``, and three materials of these
names, before the scene is checked. So all that is known of objects holds for models.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from pydantic import Field

from optsim.core.config import Part, Table
from optsim.core.errors import ConfigError
from optsim.core.foreign import reading
from optsim.core.quantities import Doubles
from optsim.scene.fields import Positive, Vector
from optsim.scene.geometry import Mesh
from optsim.scene.models import FORMATS, Model, inside, read_model, sha256_of
from optsim.scene.solids import rotated

Unit = Literal["m", "cm", "mm", "in", "ft"]
_UNITS_M: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
_UPRIGHT = {
    "x": np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
# Size over distance to the camera's target beyond which a model is taken to be in another unit.
_LARGEST, _SMALLEST = 200.0, 1e-4


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
            low, high = _upright(model, self.up or "z")
            return self.height_m / max(float(high[2] - low[2]), 1e-12)
        return _UNITS_M[self.unit or "m"]


class AnimatedModel(Part):
    """Part of a model that its file's own animation moves; scenes write it as a mover of kind ``mesh``.

    Parameters
    ----------
    item : MeshObject
        The part, at rest.
    speed : float
        Times as fast as the file says.
    repeat : bool
        Start again after the last keyframe.
    """

    kind: Literal["animated"] = "animated"
    item: MeshObject
    speed: Positive = 1.0
    repeat: bool = True

    @property
    def material(self) -> str:
        """Material of the part."""
        return self.item.material

    def rest(self) -> Mesh:
        """Mesh at time 0."""
        mesh = self.item.mesh()
        return Mesh(self.vertices(0.0), mesh.faces, mesh.uv)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        model = read_model(Path(self.item.file))
        place = time_s * self.speed
        if self.repeat and model.animation is not None:
            place %= max(model.animation.duration_s, 1e-9)
        return _in_scene(self.item, model, model.vertices(self.item.part, place))


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
        steps, faces, uv = _steps(Path(self.file), self.sha256)
        return Mesh(steps[0] + np.asarray(self.position_m), faces, uv)

    def vertices(self, time_s: float) -> Doubles:
        """Positions (n, 3), m."""
        steps, _, _ = _steps(Path(self.file), self.sha256)
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
    return Mesh(_in_scene(item, model, mesh.vertices_m), mesh.faces, mesh.uv)


def _in_scene(item: MeshObject, model: Model, vertices: Doubles) -> Doubles:
    """Take vertices of the file to the scene, m."""
    up = item.up or "z"
    low, high = _upright(model, up)
    anchor = (low + high) / 2 if item.anchor != "origin" else np.zeros(3)
    if item.anchor == "base":
        anchor[2] = low[2]
    points = vertices @ _UPRIGHT[up].T - anchor
    return points * item.scale(model) @ rotated(item.rotation_rad).T + np.asarray(item.position_m)


def _upright(model: Model, up: str) -> tuple[Doubles, Doubles]:
    """Lowest and highest corner with the file's up axis along z."""
    points = [mesh.vertices_m @ _UPRIGHT[up].T for _, mesh in model.parts]
    return np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0)


@functools.lru_cache(maxsize=32)
def _steps(path: Path, _sha256: str) -> tuple[Doubles, Any, Doubles]:
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


def with_models(table: Table, folder: Path, where: str) -> Table:
    """Expand the models of a scene's table: each part an object, each material of a file a material.

    Parameters
    ----------
    table : dict
        A scene's table in one variation.
    folder : Path
        Folder of ``scene.toml``; no file outside of it is read.
    where : str
        Name of the file, for messages.

    Raises
    ------
    ConfigError
        For a file that is missing, outside of the folder or no model, a unit or axis that must be stated, or
        a size that does not fit the scene.
    """
    objects, movers = dict(table.get("objects", {})), dict(table.get("movers", {}))
    materials = dict(table.get("materials", {}))
    parts: dict[str, list[str]] = {}
    for name, mover in list(movers.items()):
        if _kind(mover) == "vertices":
            movers[name] = {**mover, **_hashed(folder, f"{where}: movers.{name}", mover)}
        elif _kind(mover) == "mesh":
            own = {key: value for key, value in mover.items() if key in MeshObject.model_fields}
            if mover.get("animation") is not None:
                del movers[name]
                movers |= _animated(own, mover, name, folder, where, materials, _distance(table))
                continue
            # A model that moves otherwise is an object on keyframes.
            objects[name] = own
            path = {key: value for key, value in mover.items() if key not in own or key == "kind"}
            movers[name] = {**path, "kind": "keyframed", "objects": [name]}
    for name, item in list(objects.items()):
        if _kind(item) == "mesh":
            del objects[name]
            made = _expanded(item, name, folder, f"{where}: objects.{name}", _distance(table))
            parts[name] = [key for key, _ in made]
            for key, (part, material) in made:
                objects[key] = part
                if material is not None:
                    materials[key] = material
    for name, material in list(materials.items()):
        if isinstance(material, Mapping) and "picture" in material and "sha256" not in material:
            stated = cast("Table", material)
            file = inside(folder, str(stated["picture"]), f"{where}: materials.{name}.picture")
            materials[name] = {**stated, "picture": str(file), "sha256": sha256_of(file)}
    for name, mover in movers.items():
        if _kind(mover) == "keyframed" and isinstance(mover.get("objects"), list):
            listed = [part for key in mover["objects"] for part in parts.get(key, [key])]
            movers[name] = {**mover, "objects": listed}
    changed = {"objects": objects, "movers": movers, "materials": materials}
    return {**table, **{key: value for key, value in changed.items() if value or key in table}}


def _animated(
    own: Table, mover: Table, name: str, folder: Path, where: str, materials: Table, distance_m: float
) -> Table:
    """Movers that a model with an animation becomes; its materials are added."""
    place = f"{where}: movers.{name}"
    if mover["animation"] != "play":
        raise ConfigError(
            f'{place}.animation: got {mover["animation"]!r}, expected "play"; cure: leave it out'
        )
    if extra := sorted({*mover} - {*own, "kind", "animation", "speed", "repeat"}):
        raise ConfigError(f"{place}.{extra[0]}: got it beside an animation, expected one of the two; drop it")
    found: Table = {}
    parts = _expanded(own, name, folder, place, distance_m)
    model = read_model(Path(parts[0][1][0]["file"]))
    if not model.moves():
        raise ConfigError(
            f'{place}.animation: got "play", but the nodes of {own["file"]} rest (skins and morph targets '
            "are not read); cure: leave it out, or export the vertices and take a mover of kind vertices"
        )
    for key, (part, material) in parts:
        further = {each: mover[each] for each in ("speed", "repeat") if each in mover}
        found[key] = {"kind": "animated", "item": {**part, "kind": "mesh"}, **further}
        if material is not None:
            materials[key] = material
    return found


def _expanded(
    item: Mapping[str, Any], name: str, folder: Path, where: str, distance_m: float
) -> list[tuple[str, tuple[Table, Table | None]]]:
    """Objects and materials that a model becomes."""
    stated = dict(item)
    file = inside(folder, str(stated.get("file", "")), f"{where}.file")
    model = read_model(file)
    up, unit = stated.get("up") or FORMATS[file.suffix.lower()], stated.get("unit")
    if up not in _UPRIGHT:
        raise ConfigError(
            f"{where}.up: got {stated.get('up')!r}, expected x, y or z, as {file.suffix} files differ; "
            'cure: up = "z"'
        )
    if unit is None and stated.get("height_m") is None and FORMATS[file.suffix.lower()] is None:
        raise ConfigError(
            f"{where}.unit: got none, expected one of {', '.join(_UNITS_M)}, as {file.suffix} files have no "
            'unit; cure: unit = "mm", or height_m = 0.3 to scale it to a height'
        )
    stated |= {"file": str(file), "sha256": sha256_of(file), "up": up}
    low, high = _upright(model, up)
    height_m = stated.get("height_m")
    # Anything else is refused when the object is built.
    if unit in (None, *_UNITS_M) and isinstance(height_m, int | float | type(None)):
        scale = _UNITS_M[unit or "m"] if height_m is None else height_m / max(float(high[2] - low[2]), 1e-12)
        size_m = float((high - low).max()) * scale
        if not _SMALLEST * distance_m < size_m < _LARGEST * distance_m:
            raise ConfigError(
                f"{where}: got a model of {size_m:.3g} m, expected one that fits a scene seen from "
                f'{distance_m:.3g} m; is it in another unit? cure: unit = "mm", or height_m = 0.3'
            )
    found: list[tuple[str, tuple[Table, Table | None]]] = []
    for number, (surface, _) in enumerate(model.parts):
        key = name if len(model.parts) == 1 else f"{name}-{number}"
        material: Table | None = None
        if stated.get("material") is None:
            material = {
                "kind": "principled",
                "reflectance": min(surface.reflectance, 1.0),
                "roughness": float(np.clip(surface.roughness, 0.01, 1)),
                "metallic": float(np.clip(surface.metallic, 0, 1)),
                "opacity": float(np.clip(surface.opacity, 0, 1)),
            }
            if surface.picture is not None or surface.cutout is not None:
                material |= {"picture": str(file), "sha256": stated["sha256"], "part": number}
        found.append((key, ({**stated, "material": stated.get("material") or key, "part": number}, material)))
    return found


def _hashed(folder: Path, where: str, mover: Mapping[str, Any]) -> Table:
    path = inside(folder, str(mover.get("file", "")), f"{where}.file", or_folder=True)
    if path.is_dir():
        import hashlib

        files = sorted(file for file in path.iterdir() if file.suffix.lower() in FORMATS)
        digest = hashlib.sha256("".join(map(sha256_of, files)).encode()).hexdigest()
    else:
        digest = sha256_of(path)
    _steps(path, digest)
    return {"file": str(path), "sha256": digest}


def _kind(item: object) -> str | None:
    return cast("Mapping[str, Any]", item).get("kind") if isinstance(item, Mapping) else None


def _distance(table: Table) -> float:
    camera: object = table.get("camera", {})
    known = cast("Mapping[str, Any]", camera if isinstance(camera, Mapping) else {})
    ends = known.get("position_m"), known.get("target_m")
    try:
        start, stop = (np.asarray(end, np.float64) for end in ends)
        return float(np.linalg.norm(stop - start)) or 1.0
    except (TypeError, ValueError):
        return 1.0


def model_table(path: Path) -> Table:
    """Table of a scene that shows a model from its front and above, under one large lamp."""
    model = read_model(path.resolve())
    up = FORMATS[path.suffix.lower()] or "z"
    low, high = _upright(model, up)
    size = float((high - low).max()) or 1.0
    height = float(high[2] - low[2]) / size
    return {
        "name": path.stem,
        "white_w_m2_sr": 1.0,
        "camera": {
            "position_m": [0.7 * size, -2.0 * size, 1.1 * size],
            "target_m": [0.0, 0.0, 0.45 * height * size],
        },
        "materials": {"ground": {"reflectance": 0.4}},
        "lamps": {
            "sky": {
                "center_m": [-size, -size, 4 * size],
                "edge_u_m": [3 * size, 0.0, 0.0],
                "edge_v_m": [0.0, -3 * size, 0.0],
                "radiance_w_m2_sr": 4.0,
            }
        },
        "objects": {
            "model": {"kind": "mesh", "file": path.name, "unit": "m", "up": up},
            "ground": {
                "kind": "quad",
                "material": "ground",
                "corner_m": [-20 * size, -20 * size, -1e-3 * size],
                "edge_u_m": [40 * size, 0.0, 0.0],
                "edge_v_m": [0.0, 40 * size, 0.0],
            },
        },
    }
