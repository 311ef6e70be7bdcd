# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false
"""Make a world as people bring it: models with pictures, metal and roughness, under a sky that is a picture.

An engine has 100 parts and 12 materials, and its own animation turns ten of them. A textured crate crosses,
and another stands. The camera may walk.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from optsim.core.files import write_exr
from optsim.core.quantities import Doubles
from optsim.scene import Scene, load_scene

_SCENE = """name = "own_world"
description = "an engine and two crates on a yard under a pictured sky"
white_w_m2_sr = 2.0
max_depth = 5
[camera]
position_m = [0.0, -2.6, 1.4]
target_m = [0.0, 0.6, 0.5]
VELOCITY
[sky]
kind = "picture"
file = "sky.exr"
radiance_w_m2_sr = 1.0
[materials]
yard = { texture = "cobbles", tile_m = 0.7, reflectance = 0.8 }
[objects.yard]
kind = "quad"
material = "yard"
corner_m = [-12.0, -6.0, 0.0]
edge_u_m = [24.0, 0.0, 0.0]
edge_v_m = [0.0, 24.0, 0.0]
[objects.standing]
kind = "mesh"
file = "crate.glb"
height_m = 0.5
position_m = [0.9, 0.9, 0.0]
[movers.crossing]
kind = "mesh"
file = "crate.glb"
height_m = 0.35
times_s = [0.0, 1.0]
positions_m = [[-1.2, -0.2, 0.2], [1.2, -0.2, 0.2]]
spin_hz = 0.5
[movers.engine]
kind = "mesh"
file = "engine.glb"
position_m = [-0.4, 0.7, 0.0]
animation = "play"
"""
_PARTS, _MATERIALS = 100, 12


def make_own_world(folder: Path, *, walking: bool = False) -> Scene:
    """Write models, sky and scene into a folder, and read it."""
    rng = np.random.default_rng(1)
    _sky(folder / "sky.exr")
    trimesh.Scene([_crate(rng)]).export(folder / "crate.glb")
    _engine(folder / "engine.glb", rng)
    path = folder / "scene.toml"
    path.write_text(_SCENE.replace("VELOCITY", "velocity_m_s = [0.7, 0.3, 0.0]" if walking else ""))
    return load_scene(path)


def _sky(path: Path) -> None:
    """Write a blue gradient, brown below, and a sun of two degrees, 300 times as bright."""
    rows, cols = 256, 512
    up, around = np.meshgrid(np.linspace(1, -1, rows), np.linspace(-np.pi, np.pi, cols), indexing="ij")
    light = np.where(up > 0, 0.5 + 0.5 * (1 - up), 0.15)
    light[np.hypot(up - 0.5, (around - 1.0) / 2) < 0.015] = 300
    write_exr(path, {"Y": light.astype(np.float32)}, attributes={})


def _crate(rng: np.random.Generator) -> trimesh.Trimesh:
    """Make a box with a picture and maps of roughness and metal."""
    box = trimesh.creation.box((0.5, 0.5, 0.5))
    planks = np.repeat(rng.integers(60, 220, (16, 1, 3)), 16, axis=0).repeat(256, axis=1)
    planks = np.clip(planks + rng.normal(0, 12, planks.shape), 0, 255).astype(np.uint8)
    maps = np.zeros((256, 256, 3), np.uint8)
    maps[..., 1], maps[::64, :, 2] = rng.integers(90, 255, (256, 256)), 255
    material = PBRMaterial(
        name="planks",
        baseColorTexture=Image.fromarray(planks),
        metallicRoughnessTexture=Image.fromarray(maps),
        roughnessFactor=1.0,
        metallicFactor=1.0,
    )
    uv: Doubles = box.vertices[:, :2] + box.vertices[:, 2:] / 2 + 0.5
    box.visual = TextureVisuals(uv=uv, material=material)
    return box


def _engine(path: Path, rng: np.random.Generator) -> None:
    """Write 100 parts of 12 materials, a third of them metal; the file's animation turns each tenth."""
    materials = [
        PBRMaterial(
            name=f"m{k}",
            baseColorFactor=[*rng.uniform(0.1, 0.9, 3), 1.0],
            roughnessFactor=float(rng.uniform(0.2, 0.9)),
            metallicFactor=float(k % 3 == 0),
        )
        for k in range(_MATERIALS)
    ]
    scene = trimesh.Scene()
    for k in range(_PARTS):
        part = trimesh.creation.cylinder(0.04 + 0.03 * rng.random(), 0.1 + 0.1 * rng.random(), sections=24)
        part.visual = TextureVisuals(material=materials[k % _MATERIALS])
        place = np.eye(4)
        place[:3, 3] = rng.uniform((-0.35, 0.05, -0.25), (0.35, 0.7, 0.25))
        scene.add_geometry(part, node_name=f"part{k}", transform=place)
    path.write_bytes(_animated(cast("bytes", scene.export(file_type="glb"))))


def _animated(glb: bytes) -> bytes:
    """Add an animation to a GLB of trimesh: each tenth part turns about its own z, once a second."""
    length = struct.unpack("<I", glb[12:16])[0]
    header: dict[str, Any] = json.loads(glb[20 : 20 + length])
    rest = glb[20 + length :]
    binary = rest[8:]
    times = np.linspace(0, 1, 9, dtype=np.float32)
    half = np.pi * times
    turns = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1).astype(np.float32)
    for array, kind in ((times, "SCALAR"), (turns, "VEC4")):
        view = {"buffer": 0, "byteOffset": len(binary), "byteLength": array.nbytes}
        header["bufferViews"].append(view)
        about = {"bufferView": len(header["bufferViews"]) - 1, "componentType": 5126, "count": len(array)}
        limits = {"min": [0.0], "max": [1.0]} if kind == "SCALAR" else {}
        header["accessors"].append({**about, "type": kind, **limits})
        binary += array.tobytes()
    last = len(header["accessors"])
    parts = [k for k, node in enumerate(header["nodes"]) if str(node.get("name", "")).startswith("part")]
    for k in parts[::10]:
        # Animations move translation, rotation and scale, not a matrix.
        header["nodes"][k]["translation"] = header["nodes"][k].pop("matrix")[12:15]
    channels = [{"sampler": 0, "target": {"node": k, "path": "rotation"}} for k in parts[::10]]
    header["animations"] = [{"samplers": [{"input": last - 2, "output": last - 1}], "channels": channels}]
    header["buffers"][0]["byteLength"] = len(binary)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    chunks = (
        struct.pack("<II", len(text), 0x4E4F534A)
        + text
        + struct.pack("<II", len(binary), 0x004E4942)
        + binary
    )
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
