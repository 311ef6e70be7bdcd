"""What glTF files hold beyond triangles and pictures: read as it is meant, or refused in one line."""

import base64
import copy
import io
import json

import numpy as np
import pytest
from PIL import Image

from optsim.core.errors import OptsimError
from optsim.scene import load_scene
from optsim.scene.models import read_model

HEAD = """
name = "x"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -3, 0]
target_m = [0, 0, 0]
[materials.grey]
[lamps.a]
center_m = [0, -1, 3]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 8.0
"""
OBJECT = '[objects.it]\nkind = "mesh"\nfile = "it.gltf"\n'
PLAY = '[movers.it]\nkind = "mesh"\nfile = "it.gltf"\nanimation = "play"\n'
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
UV = np.array([[0, 1], [1, 1], [0, 0]], np.float32)
STEPS = np.array([[0, 0, 0], [0, 2, 0]], np.float32)


def embedded(content, kind="application/octet-stream"):
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def png(colour):
    stream = io.BytesIO()
    Image.new("RGB", (4, 4), colour).save(stream, "PNG")
    return stream.getvalue()


def triangle():
    """A textured triangle, and what an animation of its node needs."""
    arrays = [POINTS, UV, np.array([0, 1, 2], np.uint16), np.array([0, 1], np.float32), STEPS]
    kinds = ["VEC3", "VEC2", "SCALAR", "SCALAR", "VEC3"]
    starts = np.cumsum([0, *(array.nbytes + -array.nbytes % 4 for array in arrays)]).tolist()
    content = b"".join(array.tobytes() + bytes(-array.nbytes % 4) for array in arrays)
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "tip"}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0},
                ]
            }
        ],
        "materials": [
            {
                "name": "paint",
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0},
                "normalTexture": {"index": 1},
            }
        ],
        "textures": [{"source": 0}, {"source": 1}],
        "images": [
            {"uri": embedded(png((188, 188, 188)), "image/png")},
            {"uri": embedded(png((204, 128, 230)), "image/png")},
        ],
        "buffers": [{"byteLength": len(content), "uri": embedded(content)}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
            for start, array in zip(starts, arrays, strict=False)
        ],
        "accessors": [
            {
                "bufferView": number,
                "componentType": 5123 if array.dtype == np.uint16 else 5126,
                "count": len(array),
                "type": kind,
            }
            for number, (array, kind) in enumerate(zip(arrays, kinds, strict=True))
        ],
    }


def changed(path, value, content):
    """The file with one place of it set."""
    content = copy.deepcopy(content)
    at = content
    for key in path[:-1]:
        at = at.setdefault(key, {}) if isinstance(at, dict) else at[key]
    if isinstance(at, dict) and isinstance(at.get(path[-1]), dict):
        value = at[path[-1]] | value
    at[path[-1]] = value
    return content


def load(folder, content, text=OBJECT):
    (folder / "it.gltf").write_text(json.dumps(content))
    (folder / "scene.toml").write_text(HEAD + text)
    return load_scene(folder)


def animation(name, path="translation"):
    return {
        "name": name,
        "samplers": [{"input": 3, "output": 4}],
        "channels": [{"sampler": 0, "target": {"node": 0, "path": path}}],
    }


def test_the_plain_file_is_read(tmp_path):
    found = load(tmp_path, triangle())
    assert sorted(found.objects) == ["it"]
    ((surface, _),) = read_model(tmp_path / "it.gltf").parts
    assert surface.picture is not None
    assert sorted(surface.maps) == ["normal_map"]
    assert len(load(tmp_path, triangle() | {"animations": [animation("a")]}, PLAY).movers) == 1


PRIMITIVE = ("meshes", 0, "primitives", 0)
BASE = ("materials", 0, "pbrMetallicRoughness", "baseColorTexture")


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("nodes", 0, "skin"), 0, r"nodes\[0\]: got a skin, which is not read; cure: apply the armature"),
        (("meshes", 0, "weights"), [0.5], r"meshes\[0\]: got morph targets"),
        (("nodes", 0, "weights"), [0, 1], r"nodes\[0\]: got morph targets"),
        (
            (*PRIMITIVE, "extensions"),
            {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}},
            r"meshes\[0\]: got Draco compression",
        ),
        ((*PRIMITIVE, "mode"), 6, "got a triangle fan"),
        (("nodes", 0, "extensions"), {"EXT_mesh_gpu_instancing": {}}, "got instances"),
        (("extensionsRequired",), ["EXT_meshopt_compression"], "got EXT_meshopt_compression"),
        (("extensionsRequired",), ["KHR_texture_basisu"], "got KHR_texture_basisu"),
        (("accessors", 1, "normalized"), True, r"meshes\[0\]\.TEXCOORD_0: got normalized numbers"),
        (("accessors", 0, "sparse"), {"count": 1}, r"meshes\[0\]\.POSITION: got sparse numbers"),
        ((*BASE, "texCoord"), 1, r"materials\[0\]\.baseColorTexture: got a second set"),
        (
            ("materials", 0, "normalTexture", "extensions"),
            {"KHR_texture_transform": {"scale": [2, 2]}},
            r"materials\[0\]\.normalTexture: got a moved texture",
        ),
        (("images", 0), {"uri": "no.png"}, r"objects\.it\.file: it\.gltf names 'no\.png', but there is no"),
        (("images", 0), {"uri": "../out.png"}, r"names '\.\./out\.png', expected a file inside"),
        (
            ("images", 0),
            {"uri": embedded(b"no picture")},
            r"baseColorTexture \(the picture\) cannot be read, expected PNG or JPEG",
        ),
        (("images", 1), {"uri": embedded(png((90, 90, 90)))}, "normalTexture: got vectors of length"),
    ],
)
def test_what_would_look_wrong_is_refused(tmp_path, place, value, message):
    with pytest.raises(OptsimError, match=message) as caught:
        load(tmp_path, changed(place, value, triangle()))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("meshes", 0, "weights"), [0.0]),
        (("extensionsRequired",), ["KHR_materials_unlit"]),
        (("skins",), [{"joints": [0]}]),
        (("materials", 0, "occlusionTexture"), {"index": 0, "texCoord": 1}),
        ((*BASE, "texCoord"), 0),
    ],
)
def test_what_changes_nothing_is_no_obstacle(tmp_path, place, value):
    assert sorted(load(tmp_path, changed(place, value, triangle())).objects) == ["it"]


@pytest.mark.parametrize(
    ("animations", "message"),
    [
        ([animation("walk"), animation("run")], r"got 2 of them in it\.gltf \(walk, run\), expected one"),
        ([animation("walk"), animation("smile", "weights")], r"got 2 of them"),
        ([animation("smile", "weights")], r"movers\.it\.animation: it\.gltf moves morph targets"),
    ],
)
def test_an_animation_that_would_play_in_part_is_refused(tmp_path, animations, message):
    content = triangle() | {"animations": animations}
    with pytest.raises(OptsimError, match=message) as caught:
        load(tmp_path, content, PLAY)
    assert "\n" not in str(caught.value)
    # At rest it looks the same whatever moves it.
    assert sorted(load(tmp_path, content).objects) == ["it"]


def test_the_scale_of_a_normal_map_scales_its_slopes(tmp_path):
    slopes = []
    for scale in (1.0, 0.5):
        load(tmp_path, changed(("materials", 0, "normalTexture"), {"scale": scale}, triangle()))
        ((surface, _),) = read_model(tmp_path / "it.gltf").parts
        x, _, z = 2 * surface.maps["normal_map"][0, 0] - 1
        slopes.append(x / z)
    assert slopes[1] / slopes[0] == pytest.approx(0.5, rel=1e-4)
    other = {"name": "paint", "normalTexture": {"index": 1, "scale": 2.0}}
    content = triangle()
    with pytest.raises(OptsimError, match=r"'paint' twice, with normal maps scaled by 1 and 2"):
        load(tmp_path, content | {"materials": [*content["materials"], other]})


def test_a_picture_beside_the_file_is_part_of_the_scene(tmp_path):
    content = changed(("images", 0), {"uri": "skin.png"}, triangle())
    seen = []
    for colour in ((188, 188, 188), (10, 10, 10)):
        (tmp_path / "skin.png").write_bytes(png(colour))
        seen.append(load(tmp_path, content).model_dump_json())
        ((surface, _),) = read_model(tmp_path / "it.gltf").parts
        assert surface.picture.max() == pytest.approx((0.5028865, 0.0030353)[len(seen) - 1], rel=1e-4)
    assert seen[0] != seen[1]


def test_a_material_of_the_scene_needs_no_picture_of_the_file(tmp_path):
    for image in ({"uri": "no.png"}, {"uri": embedded(b"no picture")}):
        content = changed(("images", 0), image, triangle())
        assert load(tmp_path, content, OBJECT + 'material = "grey"\n').objects["it"].material == "grey"


def test_an_obj_without_its_material_file_is_refused_unless_it_has_another(tmp_path):
    (tmp_path / "it.obj").write_text("mtllib no.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    text = '[objects.it]\nkind = "mesh"\nfile = "it.obj"\nup = "z"\nunit = "m"\n'
    (tmp_path / "scene.toml").write_text(HEAD + text)
    with pytest.raises(OptsimError, match=r"it\.obj names 'no\.mtl', but there is no such file"):
        load_scene(tmp_path)
    (tmp_path / "scene.toml").write_text(HEAD + text + 'material = "grey"\n')
    assert load_scene(tmp_path).objects["it"].material == "grey"
