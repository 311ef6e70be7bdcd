"""Header of a glTF 2.0 file: its chunks, facts that trimesh drops, and a line for what isn't read."""

from __future__ import annotations

import json
import struct
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optsim.core.errors import ConfigError

Header = dict[str, Any]

TEXTURES = ("baseColorTexture", "metallicRoughnessTexture", "normalTexture")
"""Textures of a material that are read."""
# Extensions that a file may require: they change how a surface looks at most.
_LOOKS = ("KHR_materials_", "KHR_lights_")
_REQUIRED = ("EXT_texture_webp", "KHR_mesh_quantization", "KHR_texture_transform", "KHR_xmp_json_ld")
_TRIANGLE_FAN = 6


@dataclass(frozen=True)
class StatedMaterial:
    """What a file's header says of a material beyond what trimesh keeps.

    Parameters
    ----------
    textures : dict
        Those of :data:`TEXTURES` that it has -> where its picture is, for messages.
    normal_scale : float
        Factor of the normal map's slopes.
    """

    textures: Mapping[str, str]
    normal_scale: float


def gltf_parts(path: Path) -> tuple[Header, bytes]:
    """JSON and binary chunk of a file; plain glTF has no chunk."""
    content = path.read_bytes()
    if content[:4] != b"glTF":
        return json.loads(content), b""
    chunks: dict[bytes, bytes] = {}
    at = 12
    while at + 8 <= len(content):
        length, kind = struct.unpack_from("<I4s", content, at)
        chunks.setdefault(kind, content[at + 8 : at + 8 + length])
        at += 8 + length
    return json.loads(chunks[b"JSON"]), chunks.get(b"BIN\0", b"")


def check_readable(path: Path, header: Header) -> None:
    """Refuse a file whose triangles or surfaces would be read wrongly.

    Raises
    ------
    ConfigError
        With the place in the file, and the cure.
    """
    for where, got, cure in _unread(header):
        raise ConfigError(f"{path}: {where}: got {got}, which is not read; cure: {cure}")


def _unread(header: Header) -> Generator[tuple[str, str, str]]:
    """Find what isn't read: where it stands, its name, and the cure."""
    plainly = "export the model without it"
    for number, node in enumerate(header.get("nodes", [])):
        where = f"nodes[{number}]"
        if "mesh" in node and "skin" in node:
            yield where, "a skin", "apply the armature, or export vertices for a mover of kind vertices"
        if any(node.get("weights", [])):
            yield where, "morph targets", "apply the shape keys"
        if "EXT_mesh_gpu_instancing" in node.get("extensions", {}):
            yield where, "instances (EXT_mesh_gpu_instancing)", plainly
    for number, mesh in enumerate(header.get("meshes", [])):
        where = f"meshes[{number}]"
        if any(mesh.get("weights", [])):
            yield where, "morph targets", "apply the shape keys"
        for primitive in mesh["primitives"]:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                yield where, "Draco compression", plainly
            if primitive.get("mode") == _TRIANGLE_FAN:
                yield where, "a triangle fan", "triangulate it"
            yield from _unread_numbers(header, primitive, where)
    for name in header.get("extensionsRequired", []):
        if not name.startswith(_LOOKS) and name not in _REQUIRED:
            yield "extensionsRequired", name, plainly
    for number, material in enumerate(header.get("materials", [])):
        for key, texture in _textures(material).items():
            where = f"materials[{number}].{key}"
            moved = texture.get("extensions", {}).get("KHR_texture_transform")
            if moved:
                yield where, "a moved texture (KHR_texture_transform)", "apply it to the coordinates"
            if texture.get("texCoord", 0):
                yield where, "a second set of texture coordinates", "export with one set"


def _unread_numbers(header: Header, primitive: Header, where: str) -> Generator[tuple[str, str, str]]:
    """Find positions, texture coordinates and indices whose numbers trimesh would take as they are."""
    used = {key: primitive["attributes"].get(key) for key in ("POSITION", "TEXCOORD_0")}
    used["indices"] = primitive.get("indices")
    for key, index in used.items():
        accessor: Header = {} if index is None else header["accessors"][index]
        for trait in ("normalized", "sparse"):
            if accessor.get(trait):
                yield f"{where}.{key}", f"{trait} numbers", "export it as plain floats"


def _textures(material: Header) -> dict[str, Header]:
    """Textures of a material that are read, by key."""
    found = material | material.get("pbrMetallicRoughness", {})
    return {key: found[key] for key in TEXTURES if key in found}


def stated_materials(path: Path, header: Header) -> dict[str, StatedMaterial]:
    """Facts of the materials by name, empty for those without.

    Raises
    ------
    ConfigError
        For materials of one name whose normal maps are scaled differently.
    """
    found: dict[str, StatedMaterial] = {}
    for material in header.get("materials", []):
        name, textures = str(material.get("name") or ""), _textures(material)
        scale = float(textures.get("normalTexture", {}).get("scale", 1.0))
        here = StatedMaterial({key: _picture(header, each) for key, each in textures.items()}, scale)
        other = found.get(name, here)
        if other.normal_scale != scale:
            raise ConfigError(
                f"{path}: materials: got {name!r} twice, with normal maps scaled by {other.normal_scale:g} "
                f"and {scale:g}, expected names that differ; cure: rename one"
            )
        shared = {key: where for key, where in other.textures.items() if key in here.textures}
        found[name] = StatedMaterial(shared, scale)
    return found


def _picture(header: Header, texture: Header) -> str:
    """Say where a texture's picture is."""
    source = header["textures"][texture["index"]].get("source")
    image: Header = {} if source is None else header["images"][source]
    uri = str(image.get("uri", ""))
    return uri if uri and not uri.startswith("data:") else str(image.get("mimeType", "the picture"))


def moving_animations(header: Header) -> list[str]:
    """Names of the animations that move anything, or their numbers."""
    return [
        str(animation.get("name", number))
        for number, animation in enumerate(header.get("animations", []))
        if any("node" in channel["target"] for channel in animation["channels"])
    ]


def morphs(header: Header) -> bool:
    """Whether an animation moves morph targets."""
    channels = (each for animation in header.get("animations", []) for each in animation["channels"])
    return any(channel["target"].get("path") == "weights" for channel in channels)
