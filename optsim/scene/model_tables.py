"""Models in a scene's table: expanded into parts of one material each before the scene is checked.

A model with three materials becomes three objects, ``statue-0`` to ``statue-2``, and three materials of these
names. So all that is known of objects holds for models.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.core.config import Table, build
from optsim.core.errors import ConfigError
from optsim.core.files import content_hash
from optsim.scene.gltf import morphs, moving_animations, open_gltf
from optsim.scene.mesh_objects import UNITS_M, UPRIGHT, MeshObject, steps_of, upright
from optsim.scene.model_files import check_files, model_hash
from optsim.scene.model_surface import listed
from optsim.scene.models import FORMATS, inside, read_model
from optsim.scene.pictures import MAPS, read_map, read_picture
from optsim.scene.vehicle import Car

# Size over distance to the camera's target beyond which a model is taken to be in another unit.
_LARGEST, _SMALLEST = 200.0, 1e-4


def with_models(table: Table, folder: Path, where: str) -> Table:
    """Expand the models of a scene's table: each part an object, each material of a file a material."""
    objects, movers = dict(table.get("objects", {})), dict(table.get("movers", {}))
    materials = dict(table.get("materials", {}))
    if stated := sorted({"owners", "categories"} & {*table}):
        raise ConfigError(f"{where}: {stated[0]}: unknown key; cure: category = ... in an object or a mover")
    categories = _categories({"object": objects, "mover": movers}, where)
    owners: dict[str, str] = {}
    parts: dict[str, list[str]] = {}
    resting: dict[str, Table] = {}
    for name, mover in list(movers.items()):
        if _kind(mover) == "vertices":
            movers[name] = {**mover, **_hashed(folder, f"{where}: movers.{name}", mover)}
        elif _kind(mover) == "mesh":
            own = {key: value for key, value in mover.items() if key in MeshObject.model_fields}
            if mover.get("animation") is not None:
                del movers[name]
                made, still = _animated(own, mover, name, folder, where, materials, _distance(table))
                owners |= {f"mover/{key}": f"mover/{name}" for key in made}
                owners |= {f"object/{key}": f"mover/{name}" for key in still}
                movers |= made
                resting |= still
                continue
            # A model that moves otherwise is an object on keyframes.
            objects[name] = own
            path = {key: value for key, value in mover.items() if key not in own or key == "kind"}
            movers[name] = {**path, "kind": "keyframed", "objects": [name]}
        elif _kind(mover) == "car":
            members = build(Car, mover, where=f"{where}: movers.{name}").members()
            owners |= {f"mover/{name}_{key}": f"mover/{name}" for key in members}
            categories.setdefault(f"mover/{name}", "car")
    for name, item in list(objects.items()):
        if _kind(item) == "mesh":
            del objects[name]
            shown = _expanded(item, name, folder, f"{where}: objects.{name}", materials, _distance(table))
            parts[name] = [*shown]
            owners |= {f"object/{key}": f"object/{name}" for key in shown}
            objects |= shown
    objects |= resting
    for name, material in list(materials.items()):
        if isinstance(material, Mapping) and "sha256" not in material:
            stated = cast("Table", material)
            materials[name] = {**stated, **_pictures(stated, folder, f"{where}: materials.{name}")}
    for name, mover in movers.items():
        if _kind(mover) == "keyframed" and isinstance(mover.get("objects"), list):
            listed = [part for key in mover["objects"] for part in parts.get(key, [key])]
            movers[name] = {**mover, "objects": listed}
    changed = {"objects": objects, "movers": movers, "materials": materials}
    changed |= {"owners": owners, "categories": categories}
    return {**table, **{key: value for key, value in changed.items() if value or key in table}}


def _categories(groups: Mapping[str, Table], where: str) -> Table:
    """Take the keys ``category`` out of objects and movers, by ``object/NAME`` and ``mover/NAME``."""
    found: Table = {}
    for group, items in groups.items():
        for name, item in items.items():
            if isinstance(item, Mapping) and "category" in item:
                stated = dict(cast("Table", item))
                items[name], found[f"{group}/{name}"] = stated, stated.pop("category")
                if not (isinstance(found[f"{group}/{name}"], str) and found[f"{group}/{name}"]):
                    got = found[f"{group}/{name}"]
                    raise ConfigError(f"{where}: {group}s.{name}.category: got {got!r}, expected a word")
    return found


def _pictures(material: Table, folder: Path, where: str) -> Table:
    """Paths of a material's pictures and maps, which are checked, and the hash of all."""
    listed = [key for key in ("picture", *MAPS) if key in material]
    files = {key: inside(folder, str(material[key]), f"{where}.{key}") for key in listed}
    for key, file in files.items():
        if key == "picture":
            read_picture(file)
        else:
            read_map(file, key)
    hashes = [f"{key} {content_hash(file)}" for key, file in files.items()]
    if not files:
        return {}
    whole = hashlib.sha256("".join(hashes).encode()).hexdigest()
    whole = content_hash(files["picture"]) if listed == ["picture"] else whole
    return {**{key: str(file) for key, file in files.items()}, "sha256": whole}


def _animated(
    own: Table, mover: Table, name: str, folder: Path, where: str, materials: Table, distance_m: float
) -> tuple[dict[str, Table], dict[str, Table]]:
    """Movers and still objects that an animated model becomes; its materials are added."""
    place = f"{where}: movers.{name}"
    if mover["animation"] != "play":
        raise ConfigError(
            f'{place}.animation: got {mover["animation"]!r}, expected "play"; cure: leave it out'
        )
    if extra := sorted({*mover} - {*own, "kind", "animation", "speed", "repeat"}):
        raise ConfigError(f"{place}.{extra[0]}: got it beside an animation, expected one of the two; drop it")
    parts = _expanded(own, name, folder, place, materials, distance_m)
    file = Path(next(iter(parts.values()))["file"])
    header = open_gltf(file).header if file.suffix.lower() in (".glb", ".gltf") else {}
    moving = moving_animations(header)
    if len(moving) > 1:
        raise ConfigError(
            f"{place}.animation: got {len(moving)} of them in {own['file']} ({', '.join(moving)}), "
            "expected one; cure: export the one to play"
        )
    if morphs(header):
        raise ConfigError(
            f"{place}.animation: {own['file']} moves morph targets, which are not read; cure: export the "
            "vertices and take a mover of kind vertices"
        )
    moved = read_model(file).moving_parts()
    if not moved:
        raise ConfigError(
            f'{place}.animation: got "play", but the nodes of {own["file"]} rest; cure: leave it out, or '
            "export the vertices and take a mover of kind vertices"
        )
    further = {each: mover[each] for each in ("speed", "repeat") if each in mover}
    movers, still = dict[str, Table](), dict[str, Table]()
    first: dict[tuple[str, int], str] = {}
    for key, part in parts.items():
        item = {**part, "kind": "mesh"}
        if part["part"] not in moved:
            still[f"{key}-still"] = item
            continue
        # Parts that move as one and look alike are one mover.
        name = first.setdefault((part["material"], moved[part["part"]]), key)
        movers.setdefault(name, {"kind": "animated", "items": [], **further})["items"].append(item)
    return movers, still


def _expanded(
    item: Mapping[str, Any], name: str, folder: Path, where: str, materials: Table, distance_m: float
) -> dict[str, Table]:
    """Objects that a model becomes; its materials are added."""
    stated = dict(item)
    file = inside(folder, str(stated.get("file", "")), f"{where}.file")
    check_files(file, folder, f"{where}.file", shown=stated.get("material") is None)
    model = read_model(file)
    up, unit = stated.get("up") or FORMATS[file.suffix.lower()], stated.get("unit")
    if up not in UPRIGHT:
        raise ConfigError(
            f"{where}.up: got {stated.get('up')!r}, expected x, y or z, as {file.suffix} files differ; "
            'cure: up = "z"'
        )
    if unit is None and stated.get("height_m") is None and FORMATS[file.suffix.lower()] is None:
        raise ConfigError(
            f"{where}.unit: got none, expected one of {', '.join(UNITS_M)}, as {file.suffix} files have no "
            'unit; cure: unit = "mm", or height_m = 0.3 to scale it to a height'
        )
    stated |= {"file": str(file), "sha256": model_hash(file), "up": up}
    low, high = upright(model, up)
    height_m, extent = stated.get("height_m"), high - low
    if not extent.max() > 0 or (height_m is not None and extent[2] < 1e-9 * extent.max()):
        raise ConfigError(f"{where}.file: got a model without a height; cure: another model, or another up")
    # Anything else is refused when the object is built.
    if unit in (None, *UNITS_M) and isinstance(height_m, int | float | type(None)):
        scale = UNITS_M[unit or "m"] if height_m is None else height_m / float(extent[2])
        size_m = float(extent.max()) * scale
        if not _SMALLEST * distance_m < size_m < _LARGEST * distance_m:
            raise ConfigError(
                f"{where}: got a model of {size_m:.3g} m, expected one that fits a scene seen from "
                f'{distance_m:.3g} m; is it in another unit? cure: unit = "mm", or height_m = 0.3'
            )
    found, lost = dict[str, Table](), [model.lost]
    for number, (surface, mesh) in enumerate(model.parts):
        key = name if len(model.parts) == 1 else f"{name}-{number}"
        if stated.get("material") is None:
            if surface.refused:
                raise ConfigError(
                    f"{where}.file: {file.name}: {surface.refused}; cure: export it again, or give the "
                    "object a material of the scene"
                )
            lost.append(surface.lost)
            material: Table = {
                "kind": "principled",
                "colour": np.clip(surface.colour, 0, 1).tolist(),
                "roughness": float(np.clip(surface.roughness, 0.01, 1)),
                "metallic": float(np.clip(surface.metallic, 0, 1)),
                "opacity": float(np.clip(surface.opacity, 0, 1)),
            }
            if mesh.colours is not None:
                material["vertex_colours"] = True
            shown = [key for key in MAPS if key in surface.maps]
            if surface.picture is not None or surface.cutout is not None:
                shown.append("picture")
            if shown:
                material |= dict.fromkeys(shown, str(file))
                first = next(k for k, (known, _) in enumerate(model.parts) if known is surface)
                material |= {"sha256": stated["sha256"], "part": first}
            # Parts that look alike have one material: what stands still is then one mesh, traced at once.
            own = next((name for name, known in materials.items() if known == material), key)
            materials[own] = material
        else:
            own = stated["material"]
        found[key] = {**stated, "material": own, "part": number}
    if said := listed(*lost):
        warnings.warn(f"{file.name}: left out: {said}", stacklevel=2)
    return found


def _hashed(folder: Path, where: str, mover: Mapping[str, Any]) -> Table:
    path = inside(folder, str(mover.get("file", "")), f"{where}.file", or_folder=True)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in FORMATS)
        digest = hashlib.sha256("".join(map(content_hash, files)).encode()).hexdigest()
    else:
        digest = content_hash(path)
    steps_of(path, digest)
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
    low, high = upright(model, up)
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
