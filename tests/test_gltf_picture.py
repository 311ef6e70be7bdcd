"""A picture on a glTF model as a camera sees it: glTF has v = 0 at the picture's upper edge."""

import base64
import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optsim.core.quantities import View
from optsim.render import choose_backend
from optsim.render.backend import activate
from optsim.render.stage import RenderStage
from optsim.scene import load_scene

SCENE = """
name = "picture"
white_w_m2_sr = 1.0
max_depth = 2
[camera]
position_m = [0, -3, 0.5]
target_m = [0, 0, 0.5]
[lamps.far]
center_m = [0, -2000, 0.5]
edge_u_m = [0, 0, 40]
edge_v_m = [40, 0, 0]
radiance_w_m2_sr = 1e4
[objects.it]
kind = "mesh"
file = "it.gltf"
"""
# Reflectance: upper left and right, lower left and right.
QUARTERS = np.array([[0.8, 0.4], [0.2, 0.1]])
# A square of a metre in the file's x and y (up), with the texture's coordinates as glTF has them.
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
VIEW = View(12, 12, 1, 0.5 / 3)


def embedded(content: bytes) -> str:
    return f"data:application/octet-stream;base64,{base64.b64encode(content).decode()}"


def png(bits: int) -> bytes:
    coded = np.where(QUARTERS > 0.0031308, 1.055 * QUARTERS ** (1 / 2.4) - 0.055, 12.92 * QUARTERS)
    whole = np.kron(np.rint(coded * (2**bits - 1)), np.ones((8, 8)))
    stream = io.BytesIO()
    Image.fromarray(whole.astype(f"uint{bits}")).save(stream, "PNG")
    return stream.getvalue()


@pytest.mark.parametrize("bits", [8, 16])
def test_a_base_colour_is_seen_upright(tmp_path: Path, bits: int) -> None:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()
    arrays = {"VEC3": CORNERS, "VEC2": UV, "SCALAR": FACES}
    starts = np.cumsum([0, *(array.nbytes for array in arrays.values())]).tolist()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0}}],
        "textures": [{"source": 0}],
        "images": [{"uri": embedded(png(bits)).replace("application/octet-stream", "image/png")}],
        "buffers": [
            {
                "byteLength": starts[-1],
                "uri": embedded(b"".join(array.tobytes() for array in arrays.values())),
            }
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
            for start, array in zip(starts, arrays.values(), strict=False)
        ],
        "accessors": [
            {
                "bufferView": number,
                "componentType": 5123 if kind == "SCALAR" else 5126,
                "count": len(array),
                "type": kind,
            }
            for number, (kind, array) in enumerate(arrays.items())
        ],
    }
    (tmp_path / "it.gltf").write_text(json.dumps(content))
    (tmp_path / "scene.toml").write_text(SCENE)
    pixels = np.arange(VIEW.rows * VIEW.cols)
    light = RenderStage(load_scene(tmp_path), VIEW).radiance(pixels, 64, (1,))[0].reshape(2, 6, 2, 6)
    # Without the samples at the edges of a quarter; row 0 is the camera's upper one.
    seen = light[:, 1:-1, :, 1:-1].mean(axis=(1, 3))
    np.testing.assert_allclose(seen / seen.sum(), QUARTERS / QUARTERS.sum(), atol=0.01)
