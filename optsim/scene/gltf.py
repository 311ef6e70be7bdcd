"""A glTF 2.0 file by its own JSON: entries, numbers and named files; and a line for what isn't read."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ConfigError
from optsim.core.foreign import check_memory
from optsim.core.quantities import Doubles
from optsim.scene.model_surface import content_beside

Header = dict[str, Any]

# Extensions that a file may require: they change how a surface looks at most, or are read.
_LOOKS = ("KHR_materials_", "KHR_lights_")
READ = (
    "EXT_texture_webp",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
    "KHR_xmp_json_ld",
)
"""Extensions that are read, or say nothing of light."""
_COMPRESSED = ("EXT_meshopt_compression", "KHR_meshopt_compression")
_LISTS = "accessors animations bufferViews buffers images materials meshes nodes samplers scenes textures"
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
# Component type -> its kind, and the largest value of what is normalised (glTF 2.0, section 3.11).
_NUMBERS = {
    5126: ("<f4", 1),
    5125: ("<u4", 2**32 - 1),
    5120: ("i1", 127),
    5121: ("u1", 255),
    5122: ("<i2", 32767),
    5123: ("<u2", 65535),
}


@dataclass(frozen=True, eq=False)
class Gltf:
    """A file's JSON, its binary chunk, which plain glTF hasn't, and buffers as they are read."""

    path: Path
    header: Header
    binary: bytes
    loaded: dict[int, bytes] = field(default_factory=dict[int, bytes])

    def entry(self, kind: str, number: object) -> Header:
        """Entry of a list of the file."""
        listed = self.header.get(kind, [])
        if type(number) is not int or not 0 <= number < len(listed):
            raise ConfigError(
                f"{self.path}: got {kind}[{number}], but it has {len(listed)} of them; cure: export it again"
            )
        return listed[number]

    def numbers(self, number: object) -> Doubles:
        """Rows of an accessor, (n, width); normalised and sparse numbers as they are meant."""
        accessor = self.entry("accessors", number)
        kind, largest = _NUMBERS[accessor["componentType"]]
        width, count = _WIDTHS[accessor["type"]], int(accessor["count"])
        check_memory(self.path, 8.0 * width * count, "a glTF 2.0 file")
        rows = np.zeros((count, width))
        if "bufferView" in accessor:
            rows[:] = self._rows(accessor, kind, width, count)
        if sparse := accessor.get("sparse"):
            where, n = sparse["indices"], int(sparse["count"])
            places = self._rows(where, _NUMBERS[where["componentType"]][0], 1, n)[:, 0]
            rows[places] = self._rows(sparse["values"], kind, width, n)
        return np.maximum(rows / largest, -1) if accessor.get("normalized") else rows

    def _rows(self, place: Header, kind: str, width: int, count: int) -> NDArray[Any]:
        view = self.entry("bufferViews", place["bufferView"])
        content, first = self.buffer(view["buffer"]), view.get("byteOffset", 0)
        offset, size = place.get("byteOffset", 0), np.dtype(kind).itemsize
        step = view.get("byteStride", size * width)
        end = offset + (count - 1) * step + size * width if count else 0
        if min(count, offset, first) < 0 or end > min(view["byteLength"], len(content) - first):
            raise ValueError(f"{count} rows of bufferViews[{place['bufferView']}] end beyond it")
        return np.ndarray((count, width), kind, content, first + offset, (step, size))

    def buffer(self, number: int) -> bytes:
        """Content of a buffer."""
        if number not in self.loaded:
            about = self.entry("buffers", number)
            content = self.named(about["uri"]) if "uri" in about else self.binary
            if len(content) < about["byteLength"]:
                raise ValueError(
                    f"buffers[{number}] holds {len(content)} bytes, expected {about['byteLength']}"
                )
            self.loaded[number] = content
        return self.loaded[number]

    def named(self, uri: str) -> bytes:
        """Content that a URI names or holds."""
        if not uri.startswith("data:"):
            return content_beside(self.path, uri)
        kind, _, text = uri.partition(",")
        return base64.b64decode(text) if kind.lower().endswith(";base64") else unquote_to_bytes(text)

    def picture(self, texture: object) -> bytes:
        """Content of a texture's picture."""
        about = self.entry("textures", texture)
        if source(about) is None:
            kinds = ", ".join(about.get("extensions", {}))
            raise ValueError(f"got a picture {kinds or 'without a source'}, expected PNG, JPEG or WebP")
        image = self.entry("images", source(about))
        if "uri" in image:
            return self.named(image["uri"])
        view = self.entry("bufferViews", image["bufferView"])
        first = view.get("byteOffset", 0)
        return self.buffer(view["buffer"])[first : first + view["byteLength"]]


def source(texture: Header) -> object:
    """Get the number of a texture's picture: WebP, if it has one, else PNG or JPEG."""
    webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
    return webp.get("source", texture.get("source"))


def open_gltf(path: Path) -> Gltf:
    """Read JSON and binary chunk, and check that what it lists are lists of entries."""
    content, binary = path.read_bytes(), b""
    if content[:4] == b"glTF":
        version, length = struct.unpack_from("<II", content, 4)
        if version != 2 or length > len(content):
            raise ValueError(f"GLB version {version}, {len(content)} of {length} bytes; expected 2, and all")
        chunks: dict[bytes, bytes] = {}
        at = 12
        while at + 8 <= length:
            size, kind = struct.unpack_from("<I4s", content, at)
            chunks.setdefault(kind, content[at + 8 : at + 8 + size])
            at += 8 + size
        content, binary = chunks[b"JSON"], chunks.get(b"BIN\0", b"")
    header = cast("Header", json.loads(content))
    version = header["asset"]["version"]
    if not str(version).startswith("2."):
        raise ValueError(f"its version is {version!r}, expected 2.0")
    for key in _LISTS.split():
        listed: Any = header.get(key, [])
        if not isinstance(listed, list) or any(
            type(each) is not dict for each in cast("list[object]", listed)
        ):
            raise ValueError(f"{key} is no list of objects")
    return Gltf(path, header, binary)


def check_readable(gltf: Gltf) -> None:
    """Refuse a file whose triangles or surfaces would be read wrongly."""
    for where, got, cure in _unread(gltf.header):
        raise ConfigError(f"{gltf.path}: {where}: got {got}, which is not read; cure: {cure}")


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
    for number, view in enumerate(header.get("bufferViews", [])):
        for name in set(_COMPRESSED) & {*view.get("extensions", {})}:
            yield f"bufferViews[{number}]", name, plainly
    for name in header.get("extensionsRequired", []):
        if not name.startswith(_LOOKS) and name not in READ:
            yield "extensionsRequired", name, plainly


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
