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
        (("nodes", 0, "extensions"), {"EXT_mesh_gpu_instancing": {}}, "got instances"),
        (("extensionsRequired",), ["EXT_meshopt_compression"], "got EXT_meshopt_compression"),
        (
            ("bufferViews", 1, "extensions"),
            {"KHR_meshopt_compression": {}},
            r"bufferViews\[1\]: got KHR_meshopt_compression",
        ),
        (("extensionsRequired",), ["KHR_texture_basisu"], "got KHR_texture_basisu"),
        ((*BASE, "texCoord"), 1, "pictures that lie differently"),
        (
            ("materials", 0, "normalTexture", "extensions"),
            {"KHR_texture_transform": {"scale": [2, 2]}},
            "pictures that lie differently",
        ),
        (
            ("textures", 0),
            {"extensions": {"KHR_texture_basisu": {"source": 0}}, "source": None},
            "got a picture KHR_texture_basisu, expected PNG",
        ),
        (("asset", "version"), "1.0", r"its version is '1\.0', expected 2\.0"),
        (("nodes", 0, "mesh"), -1, r"got meshes\[-1\], but it has 1 of them"),
        (("nodes", 0, "children"), [0], r"no triangles|nodes\[0\] is named twice"),
        (("scene",), 3, r"got scenes\[3\], but it has 1"),
        (("accessors", 2, "count"), 9, r"9 rows of bufferViews\[2\] end beyond it"),
        (("accessors", 1, "count"), 2, r"has 2 rows of TEXCOORD, expected 3"),
        (("accessors",), {"0": {}}, "accessors is no list of objects"),
        (("buffers", 0, "uri"), "gone.bin", r"names 'gone\.bin', but there is no such file"),
        (("images", 0), {"uri": "no.png"}, r"objects\.it\.file: it\.gltf names 'no\.png', but there is no"),
        (("images", 0), {"uri": "../out.png"}, r"names '\.\./out\.png', expected a file inside"),
        (
            ("images", 0),
            {"uri": embedded(b"no picture")},
            r"materials\[0\]\.baseColorTexture: got no PNG, JPEG",
        ),
        (
            ("images", 1),
            {"uri": embedded(png((90, 90, 90)))},
            "normalTexture: the normal map: got vectors of length",
        ),
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


def part(folder, content):
    (folder / "it.gltf").write_text(json.dumps(content))
    (found,) = read_model(folder / "it.gltf").parts
    return found


def with_array(content, array, kind, component=5126, **more):
    """The file with one more accessor, its last."""
    content = copy.deepcopy(content)
    content["buffers"].append({"byteLength": array.nbytes, "uri": embedded(array.tobytes())})
    content["bufferViews"].append(
        {"buffer": len(content["buffers"]) - 1, "byteLength": array.nbytes, **more.pop("view", {})}
    )
    view = {"bufferView": len(content["bufferViews"]) - 1}
    content["accessors"].append(view | {"componentType": component, "type": kind, "count": 3} | more)
    return content


def bare():
    """A triangle without a material."""
    content = triangle()
    del content["materials"], content["meshes"][0]["primitives"][0]["material"]
    return content


def attribute(content, name, value=5):
    return changed((*PRIMITIVE, "attributes", name), value, content)


def test_numbers_of_every_layout_are_the_same_triangle(tmp_path):
    quantised = attribute(
        with_array(bare(), np.uint16([0, 65535, 65535, 65535, 0, 0]), "VEC2", 5123, normalized=True),
        "TEXCOORD_0",
    )
    np.testing.assert_allclose(part(tmp_path, quantised)[1].uv, [[0, 0], [1, 0], [0, 1]], atol=1e-6)
    short = with_array(
        bare(), np.int16([0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0]), "VEC3", 5122, view={"byteStride": 8}
    )
    short["extensionsRequired"] = ["KHR_mesh_quantization"]
    np.testing.assert_array_equal(part(tmp_path, attribute(short, "POSITION"))[1].vertices_m, POINTS)
    sparse = with_array(with_array(bare(), np.uint8([1]), "SCALAR", 5121), np.float32([7, 8, 9]), "VEC3")
    sparse["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": 5, "componentType": 5121},
        "values": {"bufferView": 6},
    }
    points = part(tmp_path, sparse)[1].vertices_m
    np.testing.assert_array_equal(points, [POINTS[0], [7, 8, 9], POINTS[2]])


def test_an_accessor_without_a_view_is_zeros(tmp_path):
    content = bare()
    del content["accessors"][1]["bufferView"]
    np.testing.assert_array_equal(part(tmp_path, content)[1].uv, [[0, 1]] * 3)


@pytest.mark.parametrize(
    ("mode", "faces"), [(4, [[0, 1, 2]]), (5, [[0, 1, 2], [1, 3, 2]]), (6, [[1, 2, 0], [2, 3, 0]])]
)
def test_strips_and_fans_are_triangles_of_one_winding(tmp_path, mode, faces):
    square = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])[
        [0, 1, 2, 3] if mode == 5 else [0, 1, 3, 2]
    ]
    content = attribute(with_array(bare(), square, "VEC3", count=4), "POSITION")
    del (
        content["meshes"][0]["primitives"][0]["indices"],
        content["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"],
    )
    mesh = part(tmp_path, changed((*PRIMITIVE, "mode"), mode, content))[1]
    np.testing.assert_array_equal(mesh.vertices_m[mesh.faces], square[faces])
    corners = mesh.vertices_m[mesh.faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0).all()


def test_without_normals_faces_are_flat_and_with_them_vertices_stay_shared(tmp_path):
    shared = with_array(bare(), np.uint16([0, 1, 2, 2, 1, 0]), "SCALAR", 5123, count=6)
    shared = changed((*PRIMITIVE, "indices"), 5, shared)
    assert len(part(tmp_path, shared)[1].vertices_m) == 6
    assert len(part(tmp_path, attribute(shared, "NORMAL", 0))[1].vertices_m) == 3


def test_texture_coordinates_are_those_that_the_texture_names_and_moved_as_it_says(tmp_path):
    content = triangle()
    del content["materials"][0]["normalTexture"]
    other = np.float32([[0.25, 0.25], [0.75, 0.25], [0.25, 0.5]])
    content = attribute(with_array(content, other, "VEC2"), "TEXCOORD_1")
    flip = np.array([1, -1])
    second = changed((*BASE, "texCoord"), 1, content)
    np.testing.assert_allclose(part(tmp_path, second)[1].uv, other * flip + (0, 1))
    move = {"KHR_texture_transform": {"offset": [0.5, 0.125], "rotation": 0.5, "scale": [2, 3]}}
    # By the formula of the extension's own text, with v down.
    cos, sin = np.cos(0.5), np.sin(0.5)
    expected = np.array([(0.5 + cos * 2 * u + sin * 3 * v, 0.125 - sin * 2 * u + cos * 3 * v) for u, v in UV])
    moved = part(tmp_path, changed((*BASE, "extensions"), move, content))[1].uv
    np.testing.assert_allclose(moved, expected * flip + (0, 1), atol=1e-6)
    move["KHR_texture_transform"]["texCoord"] = 1
    assert (part(tmp_path, changed((*BASE, "extensions"), move, content))[1].uv != moved).any()


@pytest.mark.parametrize(("wrap", "named"), [(10497, "repeat"), (33071, "clamp"), (33648, "mirror")])
def test_wrap_modes_are_followed(tmp_path, wrap, named):
    content = with_sampler(triangle(), wrapS=wrap, wrapT=wrap)
    assert part(tmp_path, content)[0].wrap == named
    # Coordinates stay within the picture along v: its mode doesn't count there.
    wide = attribute(with_array(content, np.float32([[0, 0], [3, 0], [0, 1]]), "VEC2"), "TEXCOORD_0")
    assert part(tmp_path, with_sampler(wide, wrapS=wrap, wrapT=33071))[0].wrap == named
    tall = attribute(with_array(content, np.float32([[0, 0], [3, 0], [0, 2]]), "VEC2"), "TEXCOORD_0")
    if wrap != 33071:
        with pytest.raises(OptsimError, match=rf"wrap modes {named} and clamp along u and v"):
            load(tmp_path, with_sampler(tall, wrapS=wrap, wrapT=33071))
    with pytest.raises(OptsimError, match=r"baseColorTexture: its sampler has the wrap mode 10496"):
        load(tmp_path, with_sampler(content, wrapS=10496))


def with_sampler(content, **keys):
    textures = [{**each, "sampler": 0} for each in content["textures"]]
    return content | {"samplers": [keys], "textures": textures}


@pytest.mark.parametrize("value", [0.0019, 0.005, 0.04])
def test_dark_factors_are_the_files_own(tmp_path, value):
    content = triangle()
    content["materials"] = [{"pbrMetallicRoughness": {"baseColorFactor": [value, value, value, 1]}}]
    np.testing.assert_allclose(part(tmp_path, content)[0].colour, value, rtol=1e-7)


@pytest.mark.parametrize(
    ("factor", "colour", "cutoff", "shown"),
    [(1.0, 255, None, 1), (0.4, 255, None, 0), (0.6, 255, 0.55, 1), (0.6, 200, 0.5, 0), (0.4, 255, 0.0, 1)],
)
def test_a_mask_is_the_product_of_factor_picture_and_vertices(tmp_path, factor, colour, cutoff, shown):
    stream = io.BytesIO()
    Image.new("RGBA", (2, 2), (255, 255, 255, colour)).save(stream, "PNG")
    pbr = {"baseColorFactor": [1, 1, 1, factor]}
    for texture in ({}, {"baseColorTexture": {"index": 0}}):
        content = triangle()
        content["images"] = [{"uri": embedded(stream.getvalue(), "image/jpeg")}] * 2
        content["materials"] = [{"alphaMode": "MASK", "pbrMetallicRoughness": pbr | texture}]
        content["materials"][0] |= {} if cutoff is None else {"alphaCutoff": cutoff}
        surface = part(tmp_path, content)[0]
        seen = surface.opacity * (1 if surface.cutout is None else surface.cutout.min())
        assert seen == (shown if texture else (factor >= (0.5 if cutoff is None else cutoff)))
    vertices = with_array(triangle(), np.float32([[1, 1, 1, 0.5]] * 3), "VEC4")
    vertices["materials"] = [{"alphaMode": "BLEND", "pbrMetallicRoughness": pbr}]
    assert part(tmp_path, attribute(vertices, "COLOR_0"))[0].opacity == pytest.approx(0.5 * factor)


def test_hidden_nodes_do_not_show_and_files_without_a_scene_show_all_roots(tmp_path):
    content = bare()
    hidden = {"KHR_node_visibility": {"visible": False}}
    content["nodes"] = [{"mesh": 0}, {"children": [2], "extensions": hidden}, {"mesh": 0}]
    content["scenes"] = [{"nodes": [0, 1]}]
    part(tmp_path, content)
    del content["scenes"], content["scene"]
    content["nodes"][1] = {"children": [2]}
    (tmp_path / "it.gltf").write_text(json.dumps(content))
    assert len(read_model(tmp_path / "it.gltf").parts) == 2


@pytest.mark.parametrize(
    "name", ["my%20tri.bin", "sub\\tri.bin", "sub%5Ctri.bin", "a%b.bin", "C:\\Users\\me\\my%20tri.bin"]
)
def test_names_are_decoded(tmp_path, name):
    content = bare()
    data = base64.b64decode(content["buffers"][0]["uri"].partition(",")[2])
    (tmp_path / "sub").mkdir()
    for file in ("my tri.bin", "sub/tri.bin", "a%b.bin"):
        (tmp_path / file).write_bytes(data)
    content["buffers"][0]["uri"] = name
    (tmp_path / "bom.gltf").write_bytes(b"\xef\xbb\xbf" + json.dumps(content).encode())
    np.testing.assert_array_equal(read_model(tmp_path / "bom.gltf").parts[0][1].vertices_m, POINTS)


def test_a_node_of_scale_0_at_rest_grows_in_the_scene(tmp_path):
    grows = animation("grow", "scale")
    content = with_array(triangle(), np.float32([[0, 0, 0], [2, 2, 2]]), "VEC3", count=2)
    grows["samplers"][0]["output"] = 5
    content["nodes"] = [{"mesh": 0, "scale": [0, 0, 0]}, {"mesh": 0, "translation": [5, 0, 0]}]
    content["scenes"] = [{"nodes": [0, 1]}]
    found = load(tmp_path, content | {"animations": [grows]}, PLAY)
    (mover,), (still,) = found.singles().values(), found.objects.values()
    sizes = [np.ptp(mover.vertices(time), axis=0).max() for time in (0.0, 0.5)]
    np.testing.assert_allclose(sizes, [0, 1], atol=1e-6)
    np.testing.assert_allclose(np.ptp(still.mesh().vertices_m, axis=0).max(), 1, atol=1e-6)
    content["scenes"] = [{"nodes": [0]}]
    (mover,) = load(tmp_path, content | {"animations": [grows]}, PLAY + "height_m = 0.5\n").singles().values()
    sizes = [np.ptp(mover.vertices(time), axis=0)[2] for time in (0.0, 0.5, 0.99999)]
    np.testing.assert_allclose(sizes, [0, 0.25, 0.5], atol=1e-5)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("materials", 0, "emissiveFactor"), [1, 0, 0], "emission"),
        (("materials", 0, "extensions"), {"KHR_materials_clearcoat": {}}, "KHR_materials_clearcoat"),
        (("extensionsUsed",), ["KHR_lights_punctual"], "KHR_lights_punctual"),
        (("cameras",), [{}], "cameras"),
        (("materials", 0, "alphaMode"), "HASHED", "alphaMode HASHED"),
        (("scenes",), [{"nodes": [0]}, {"nodes": []}], "scenes but the first shown"),
        (("meshes", 0, "primitives"), "lines", "lines"),
        ((*BASE, "texCoord"), 0, None),
    ],
)
def test_what_is_left_out_is_said(tmp_path, place, value, said):
    if value == "lines":
        first = triangle()["meshes"][0]["primitives"][0]
        value = [first, first | {"mode": 1}]
    content = changed(place, value, triangle())
    if said is None:
        load(tmp_path, content)
    else:
        with pytest.warns(UserWarning, match=rf"it\.gltf: left out: {said}"):
            load(tmp_path, content)


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
