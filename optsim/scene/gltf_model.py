"""Triangles and surfaces of a glTF 2.0 file: a piece for each primitive of each node."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from optsim.core.errors import OptsimError
from optsim.core.quantities import Doubles, Ints
from optsim.scene import model_surface as shared
from optsim.scene.gltf import READ, Gltf, Header, check_readable, open_gltf
from optsim.scene.model_surface import Placement, Surface, SurfacePiece, listed
from optsim.scene.node_animation import NodeTree, read_nodes
from optsim.scene.polygons import check_indices

_PBR = "pbrMetallicRoughness"
_OLD = "KHR_materials_pbrSpecularGlossiness"
_KINDS = {0: "points", 1: "lines", 2: "lines", 3: "lines"}
_STRIP, _FAN, _TRIANGLES = 5, 6, 4
_WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
_NEAREST = 9728
# What each texture gives a surface.
_MAPS = {
    "baseColorTexture": ("picture", "alpha"),
    "metallicRoughnessTexture": ("roughness_map", "metallic_map"),
    "normalTexture": ("normal_map",),
}
_Found = tuple[Surface, tuple[Placement, ...]]


def read_gltf(path: Path) -> tuple[list[SurfacePiece], str, NodeTree]:
    """Read the pieces of the visible nodes, what is left out of the file as a whole, and its nodes."""
    gltf = open_gltf(path)
    check_readable(gltf)
    nodes, header = read_nodes(gltf), gltf.header
    pieces: list[SurfacePiece] = []
    surfaces: dict[tuple[object, float], _Found] = {}
    unread = [name for name in header.get("extensionsUsed", []) if name not in READ]
    lost = [name for name in unread if not name.startswith("KHR_materials_")]
    lost += ["cameras"] if header.get("cameras") else []
    lost += ["scenes but the first shown"] if len(header.get("scenes", [])) > 1 else []
    for number in sorted(nodes.matrices()):
        if "mesh" not in nodes.nodes[number]:
            continue
        mesh = nodes.nodes[number]["mesh"]
        for index, primitive in enumerate(gltf.entry("meshes", mesh)["primitives"]):
            where = f"meshes[{mesh}].primitives[{index}]"
            if primitive.get("mode", _TRIANGLES) in _KINDS:
                lost.append(_KINDS[primitive["mode"]])
            elif "POSITION" in primitive["attributes"]:
                pieces.append(replace(_piece(gltf, primitive, where, surfaces), node=number))
            else:
                lost.append(f"{where} without POSITION")
    lost += [] if pieces or lost else ["its scene shows no mesh"]
    return pieces, listed(*lost), nodes


def textures_of(material: Header) -> dict[str, Header]:
    """Textures of a material that are read, by key."""
    found = {**material, **_base(material)}
    return {key: found[key] for key in _MAPS if key in found}


def _base(material: Header) -> Header:
    """Colour, roughness and metal; of the older extension its diffuse part, if there is no other."""
    old = material.get("extensions", {}).get(_OLD)
    if old is None or _PBR in material:
        return material.get(_PBR, {})
    found = {"baseColorFactor": old.get("diffuseFactor", [1.0] * 4), "metallicFactor": 0.0}
    found["roughnessFactor"] = 1 - old.get("glossinessFactor", 1.0)
    return found | ({"baseColorTexture": old["diffuseTexture"]} if "diffuseTexture" in old else {})


def _piece(
    gltf: Gltf, primitive: Header, where: str, surfaces: dict[tuple[object, float], _Found]
) -> SurfacePiece:
    attributes = primitive["attributes"]
    points = gltf.numbers(attributes["POSITION"])
    index = np.arange(len(points))
    if "indices" in primitive:
        index = gltf.numbers(primitive["indices"])[:, 0].astype(np.int64)
    check_indices(gltf.path, index, len(points))
    faces = _faces(index, primitive.get("mode", _TRIANGLES))
    colours = gltf.numbers(attributes["COLOR_0"]) if "COLOR_0" in attributes else None
    alpha, lost = 1.0, ""
    number = primitive.get("material")
    material = {} if number is None else gltf.entry("materials", number)
    if colours is not None and colours.shape[1] == 4 and material.get("alphaMode", "OPAQUE") != "OPAQUE":
        alpha = float(colours[:, 3].mean()) if len(colours) else 1.0
        lost = "opacity at vertices (its mean counts)" if np.ptp(colours[:, 3]) > 1e-6 else ""
    if (number, alpha) not in surfaces:
        surfaces[number, alpha] = _surface(gltf, material, f"materials[{number}]", alpha)
    surface, places = surfaces[number, alpha]
    surface = replace(surface, lost=listed(surface.lost, lost))
    uv = None
    key = f"TEXCOORD_{places[0].coordinates if places else 0}"
    if key in attributes:
        uv = gltf.numbers(attributes[key]) * (1, -1) + (0, 1)
    surface, uv = shared.laid(surface, uv, places)
    surface, tints = shared.tinted(surface, None if colours is None else colours[:, :3], plain=number is None)
    for name, array in (("TEXCOORD", uv), ("COLOR_0", tints)):
        if array is not None and len(array) != len(points):
            raise ValueError(f"{where} has {len(array)} rows of {name}, expected {len(points)}")
    if "NORMAL" not in attributes:
        # Then faces are flat (glTF 2.0, section 3.7.2.1).
        flat = faces.ravel()
        points, uv = points[flat], None if uv is None else uv[flat]
        tints = None if tints is None else tints[flat]
        faces = np.arange(len(flat)).reshape(-1, 3)
    return SurfacePiece(where, surface, points, faces, uv, tints)


def _faces(index: Ints, mode: int) -> Ints:
    """Triangles of a list, a strip or a fan."""
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    first = np.arange(max(len(index) - 2, 0))
    if mode == _STRIP:
        return index[np.stack([first, first + 1 + first % 2, first + 2 - first % 2], axis=1)]
    if mode == _FAN:
        return index[np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1)]
    raise ValueError(f"a primitive has mode {mode}, expected 0 to 6")


def _surface(gltf: Gltf, material: Header, where: str, alpha: float) -> _Found:
    """Surface of a material without colours at vertices but their opacity, and how its pictures lie."""
    if not material:
        return Surface(), ()
    base, textures, extensions = _base(material), textures_of(material), material.get("extensions", {})
    factor = np.asarray(base.get("baseColorFactor", (1, 1, 1, 1)), np.float64)
    # glTF 2.0: both factors are 1 by default.
    roughness, metallic = (float(base.get(key, 1.0)) for key in ("roughnessFactor", "metallicFactor"))
    lost, refused, places = [*extensions], "", list[Placement]()
    lost += ["emission"] if any(material.get("emissiveFactor", [])) else []
    surface = Surface(str(material.get("name", "")), factor[:3], None, None, 1.0, roughness, metallic)
    mode, opacity = material.get("alphaMode", "OPAQUE"), float(factor[3]) * alpha
    lost += [f"alphaMode {mode}"] if mode not in ("OPAQUE", "MASK", "BLEND") else []
    for key, texture in textures.items():
        sampler = gltf.entry("textures", texture["index"]).get("sampler")
        if sampler is not None and gltf.entry("samplers", sampler).get("magFilter") == _NEAREST:
            lost.append("unfiltered pictures (magFilter NEAREST)")
        try:
            content = gltf.picture(texture["index"])
            places.append(_placement(gltf, texture))
            for each in _MAPS[key]:
                surface = shared.with_picture(surface, each, content, float(texture.get("scale", 1.0)))
        except (ValueError, OptsimError) as error:
            refused = listed(refused, f"{where}.{key}: {shared.fault(error)}")
    cutout = surface.cutout if mode != "OPAQUE" else None
    if mode == "MASK":
        least = float(material.get("alphaCutoff", 0.5))
        cutout = None if cutout is None else np.float32(opacity * cutout >= least)
        opacity = 1.0 if cutout is not None else float(opacity >= least)
    surface = replace(
        surface,
        cutout=cutout if cutout is not None and (cutout < 1).any() else None,
        opacity=1.0 if mode == "OPAQUE" else opacity,
        lost=listed(*lost, surface.lost),
        refused=refused,
    )
    return surface, tuple(places)


def _placement(gltf: Gltf, texture: Header) -> Placement:
    """How a texture lies: set of coordinates, transform and wrap modes."""
    moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
    sampler = gltf.entry("textures", texture["index"]).get("sampler")
    about = {} if sampler is None else gltf.entry("samplers", sampler)
    wraps = [about.get(key, 10497) for key in ("wrapS", "wrapT")]
    if unknown := {*wraps} - {*_WRAPS}:
        raise ValueError(f"its sampler has the wrap mode {unknown.pop()}")
    cos, sin = np.cos(moved.get("rotation", 0.0)), np.sin(moved.get("rotation", 0.0))
    (wide, high), (right, down) = moved.get("scale", (1, 1)), moved.get("offset", (0, 0))
    # Of coordinates with v down.
    matrix = np.array([[cos * wide, sin * high, right], [-sin * wide, cos * high, down], [0, 0, 1]])
    over: Doubles = np.array([[1.0, 0, 0], [0, -1, 1], [0, 0, 1]])
    return Placement(
        moved.get("texCoord", texture.get("texCoord", 0)),
        tuple((over @ matrix @ over)[:2].ravel().tolist()),
        (_WRAPS[wraps[0]], _WRAPS[wraps[1]]),
    )
