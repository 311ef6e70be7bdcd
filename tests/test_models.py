"""Models from files: size, place and material as stated, motion in all passes, bad files said in a line."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from optsim.app.cli import app
from optsim.core.errors import ConfigError, OptsimError
from optsim.core.quantities import View
from optsim.render import choose_backend, render_passes
from optsim.scene import load_scene
from optsim.scene.models import read_model
from optsim.scene.pictures import read_picture

SCENE = """
name = "models"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -3, 0.5]
target_m = [0, 0, 0.5]
[materials.grey]
[lamps.a]
center_m = [0, -1, 3]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 8.0
"""


def model(path: Path) -> Path:
    """A box of 1 x 2 x 3 (y up) with a picture, beside a plain ball; two materials."""
    box = trimesh.creation.box((1, 2, 3))
    picture = Image.fromarray(np.full((4, 4, 3), 188, np.uint8))
    material = trimesh.visual.material.PBRMaterial(
        name="check", baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=0.3
    )
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)), material=material)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.2)
    ball.apply_translation((0, 2, 0))
    trimesh.Scene([box, ball]).export(path)
    return path


@pytest.fixture
def folder(tmp_path):
    model(tmp_path / "two.glb")
    trimesh.creation.box((10, 20, 30)).export(tmp_path / "box.stl")
    return tmp_path


def scene(folder, text, variation="main"):
    (folder / "scene.toml").write_text(SCENE + text)
    return load_scene(folder, variation)


def extents(meshes):
    points = np.concatenate([mesh.vertices_m for mesh in meshes])
    return points.min(axis=0), points.max(axis=0)


def test_a_model_stands_where_and_as_large_as_stated(folder):
    text = '[objects.thing]\nkind = "mesh"\nfile = "two.glb"\nheight_m = 0.32\nposition_m = [1, 2, 3]\n'
    found = scene(folder, text)
    assert sorted(found.objects) == ["thing-0", "thing-1"]
    low, high = extents([item.mesh() for item in found.objects.values()])
    # Upright: 3.2 units high (y), so 0.1 m a unit; the base's middle is at the position.
    np.testing.assert_allclose(low, [0.95, 1.85, 3.0], atol=1e-6)
    np.testing.assert_allclose(high, [1.05, 2.15, 3.32], atol=1e-6)


@pytest.mark.parametrize(("unit", "metres"), [("cm", 0.01), ("in", 0.0254), ("mm", 0.001)])
def test_units_axes_and_rotation(folder, unit, metres):
    text = (
        f'[objects.box]\nkind = "mesh"\nfile = "box.stl"\nmaterial = "grey"\nunit = "{unit}"\nup = "x"\n'
        'anchor = "origin"\nrotation_rad = [0, 0, 1.5707963]\n'
    )
    low, high = extents([scene(folder, text).objects["box"].mesh()])
    # x of the file is up, y stays y, z becomes -x; then a quarter turn about the vertical.
    np.testing.assert_allclose(high - low, np.array([20, 30, 10]) * metres, rtol=1e-6)


def test_materials_come_from_the_file(folder):
    found = scene(folder, '[objects.thing]\nkind = "mesh"\nfile = "two.glb"\nheight_m = 0.3\n')
    kinds = {found.objects[name].part: found.materials[name] for name in ("thing-0", "thing-1")}
    parts = read_model(folder / "two.glb").parts
    textured = next(n for n, (surface, _) in enumerate(parts) if surface.picture is not None)
    assert (kinds[textured].roughness, kinds[textured].metallic) == (pytest.approx(0.3), 0)
    # sRGB 188 is half of white in linear light (IEC 61966-2-1).
    np.testing.assert_allclose(parts[textured][0].picture, 0.5028865, atol=1e-5)


def test_parts_that_look_alike_have_one_material_and_are_one_mesh(tmp_path):
    looks = [
        {"baseColorFactor": [200, 20, 20, 255], "roughnessFactor": 0.4},
        {"baseColorFactor": [9, 9, 9, 255]},
    ]
    boxes = []
    for k in range(6):
        box = trimesh.creation.box((1, 1, 1))
        box.apply_translation((2 * k, 0, 0))
        material = trimesh.visual.material.PBRMaterial(name=f"m{k}", metallicFactor=0.0, **looks[k % 2])
        box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
        boxes.append(box)
    trimesh.Scene(boxes).export(tmp_path / "six.glb")
    found = scene(tmp_path, '[objects.six]\nkind = "mesh"\nfile = "six.glb"\nheight_m = 0.1\n')
    assert len(found.objects) == 6
    used = {item.material for item in found.objects.values()}
    assert len(used) == len(found.materials.keys() - {"grey"}) == len(found.still_meshes()) == 2
    # Each keeps its own colour: materials alternate as the boxes do.
    for item in found.objects.values():
        surface = read_model(tmp_path / "six.glb").parts[item.part][0]
        luminance = np.dot(surface.colour[:3], (0.2126, 0.7152, 0.0722))
        assert found.materials[item.material].reflectance == pytest.approx(luminance, rel=1e-3)


def test_pictures_are_linear_reflectance_with_row_0_below(tmp_path):
    grey = np.array([[0, 188], [255, 10]], np.uint8)
    Image.fromarray(grey).save(tmp_path / "a.png")
    np.testing.assert_allclose(
        read_picture(tmp_path / "a.png"), [[1, 10 / 255 / 12.92], [0, 0.5028865]], atol=1e-5
    )


def test_a_copied_scene_is_the_same_scene_and_a_changed_file_another(folder, tmp_path_factory):
    text = '[objects.thing]\nkind = "mesh"\nfile = "two.glb"\nheight_m = 0.3\n'
    here = scene(folder, text).model_dump_json()
    other = tmp_path_factory.mktemp("other")
    (other / "two.glb").write_bytes((folder / "two.glb").read_bytes())
    assert scene(other, text).model_dump_json() == here
    trimesh.creation.box((1, 2, 3)).export(other / "two.glb")
    assert scene(other, text).model_dump_json() != here


def test_moving_models_have_flow_depth_and_ids_of_their_vertices(folder):
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    square = np.array([[-0.3, 0, -0.3], [0.3, 0, -0.3], [0.3, 0, 0.3], [-0.3, 0, 0.3]])
    steps = np.stack([square + np.array([0.02 * k, 0, 0]) for k in range(5)])
    np.savez(folder / "cloth.npz", vertices=steps, faces=[[0, 1, 2], [0, 2, 3]])
    text = (
        '[movers.cloth]\nkind = "vertices"\nfile = "cloth.npz"\nmaterial = "grey"\nrate_hz = 100\n'
        "position_m = [-0.5, 0, 0.5]\n"
        '[movers.box]\nkind = "mesh"\nfile = "box.stl"\nmaterial = "grey"\nunit = "mm"\nup = "z"\n'
        "height_m = 0.4\nposition_m = [0.6, 0, 0.3]\ntimes_s = [0, 1]\n"
        "positions_m = [[0, 0, 0], [0, 0, 1.0]]\ninterpolation = 'linear'\n"
    )
    view = View(60, 80, 1, 0.5)
    passes = render_passes(scene(folder, text), view, 0.02, 0.01)
    names = {name: number for number, name in passes.id_table.items()}
    focal = 40 / 0.5
    cloth, box = (passes.ids == names[name] for name in ("mover/cloth", "mover/box"))
    assert cloth.sum() > 100
    assert box.sum() > 50
    # Seen from 3 m: 0.02 m a slot to the right; the box rises 0.01 m a slot, its face 3 m - 0.067 m away.
    np.testing.assert_allclose(
        passes.flow_forward_px[cloth], [[0, 0.02 * focal / 3]] * cloth.sum(), atol=2e-3
    )
    np.testing.assert_allclose(passes.depth_m[cloth], 3, atol=1e-4)
    front = box & (passes.normal[..., 1] < -0.9)
    depth = passes.depth_m[front]
    np.testing.assert_allclose(passes.flow_forward_px[front][:, 0], -0.01 * focal / depth, atol=2e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('file = "no.glb"', r"objects\.thing\.file: got 'no\.glb', but there is no such file"),
        ('file = "../two.glb"', "expected a path inside"),
        ('file = "box.stl"\nmaterial = "grey"\nunit = "mm"', r"objects\.thing\.up: got None"),
        ('file = "box.stl"\nmaterial = "grey"\nup = "z"', r"objects\.thing\.unit: got none"),
        (
            'file = "box.stl"\nmaterial = "grey"\nup = "z"\nunit = "ft"\nheight_m = 5000.0',
            "is it in another unit",
        ),
        (
            'file = "broken.obj"\nmaterial = "grey"\nup = "z"\nunit = "m"',
            "got a face with vertex 9|broken.obj",
        ),
        ('file = "nan.ply"\nmaterial = "grey"\nup = "z"\nunit = "m"', "not finite"),
        ('file = "empty.stl"\nmaterial = "grey"\nup = "z"\nunit = "m"', "empty.stl"),
        ('file = "cut.glb"', r"cut\.glb"),
        ('file = "scene.toml"', r"expected one of: \.glb"),
        ('file = "two.glb"\nheigth_m = 1.0', "height_m"),
    ],
)
def test_bad_models_are_said_in_a_line_before_rendering(folder, text, message):
    (folder / "broken.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 10\n")
    (folder / "nan.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 nan\n0 1 0\n3 0 1 2\n"
    )
    (folder / "empty.stl").write_bytes(b"")
    (folder / "cut.glb").write_bytes((folder / "two.glb").read_bytes()[:400])
    with pytest.raises(OptsimError, match=message):
        scene(folder, f'[objects.thing]\nkind = "mesh"\n{text}\n')


def test_degenerate_triangles_are_dropped_and_counted(tmp_path):
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "v 2 0 0", "f 1 2 3", "f 1 2 4", "f 1 1 2"]
    (tmp_path / "a.obj").write_text("\n".join(lines) + "\n")
    found = read_model(tmp_path / "a.obj")
    assert (found.dropped, len(found.parts[0][1].faces)) == (2, 1)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"vertices": np.zeros((2, 3, 2)), "faces": np.zeros((1, 3), int)}, r"expected vertices \(t, n, 3\)"),
        ({"faces": np.zeros((1, 3), int)}, r"expected vertices \(t, n, 3\)"),
        ({"vertices": np.zeros((2, 3, 3)), "faces": np.full((1, 3), 7)}, "indices of 0 to 2"),
        ({"vertices": np.full((2, 3, 3), np.nan), "faces": np.zeros((1, 3), int)}, "not finite"),
    ],
)
def test_bad_vertex_sequences_are_said(folder, arrays, message):
    np.savez(folder / "bad.npz", **arrays)
    with pytest.raises(ConfigError, match=message):
        scene(
            folder,
            '[movers.m]\nkind = "vertices"\nfile = "bad.npz"\nmaterial = "grey"\nrate_hz = 10\n',
        )


def test_a_scene_with_models_says_so_in_json(folder):
    found = scene(folder, '[objects.thing]\nkind = "mesh"\nfile = "two.glb"\nheight_m = 0.3\n')
    dumped = json.loads(found.model_dump_json())["objects"]["thing-0"]
    assert len(dumped["sha256"]) == 64
    assert "file" not in dumped


@pytest.mark.parametrize("name", ["two.glb", "box.stl", "scene"])
def test_show_draws_a_preview_with_sizes(folder, capsys, name):
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    scene(folder, '[objects.thing]\nkind = "mesh"\nfile = "two.glb"\nheight_m = 0.3\n')
    target = f"{folder}/" if name == "scene" else str(folder / name)
    with pytest.raises(SystemExit) as ended:
        app(["scene", "show", target, "--out", str(folder / "x.png"), "--samples", "4"])
    assert ended.value.code == 0
    said = {"two.glb": ": 1 x 3 x 2 units", "box.stl": ": 10 x 20 x 30 units", "scene": "object thing-0: "}
    assert said[name] in capsys.readouterr().out
    with Image.open(folder / "x.png") as picture:
        assert picture.size == (480, 360)
        assert np.asarray(picture).std() > 10
