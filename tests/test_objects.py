"""One object has one id, whatever its parts; boxes and visibility are those that other code finds."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from optsim.core.errors import ConfigError
from optsim.core.quantities import View
from optsim.render import choose_backend, render_passes
from optsim.scene import load_scene
from optsim.scene.bodies import bodies

VIEW = View(90, 120, 1, 0.45)
HEAD = """
name = "things"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -3, 0.6]
target_m = [0, 0, 0.4]
[materials]
grey = { reflectance = 0.4 }
[lamps.a]
center_m = [0, 0, 4]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 5.0
"""
FLOOR = """
[objects.floor]
kind = "quad"
material = "grey"
corner_m = [-20, -20, 0]
edge_u_m = [40, 0, 0]
edge_v_m = [0, 40, 0]
category = "ground"
"""
ENGINE = """
[movers.engine]
kind = "mesh"
file = "three.glb"
height_m = 0.8
rotation_rad = [0, 0, 0.5]
times_s = [0, 1]
positions_m = [[0, 0, 0], [1, 0, 0]]
spin_hz = 0.5
"""


@pytest.fixture
def made(tmp_path):
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    whole = trimesh.Scene()
    for k, color in enumerate(([255, 0, 0], [0, 255, 0], [0, 0, 255])):
        part = trimesh.creation.box((0.4, 0.3, 0.2))
        part.apply_translation((0, 0.3 * k, 0.1 * k))
        material = trimesh.visual.material.PBRMaterial(name=f"m{k}", baseColorFactor=[*color, 255])
        part.visual = trimesh.visual.TextureVisuals(material=material)
        whole.add_geometry(part)
    whole.export(tmp_path / "three.glb")

    def scene(text):
        (tmp_path / "scene.toml").write_text(HEAD + text)
        return load_scene(tmp_path)

    return scene


def named(passes):
    return {name: number for number, name in passes.id_table.items()}


def test_a_model_has_one_id_whether_it_moves_or_not(made):
    for text in (ENGINE, '[objects.engine]\nkind = "mesh"\nfile = "three.glb"\nheight_m = 0.8\n'):
        passes = render_passes(made(text + FLOOR), VIEW, 0.1, 0.01)
        group = "mover" if "movers" in text else "object"
        assert set(named(passes)) == {f"{group}/engine", "lamp/a", "object/floor"}
        number = named(passes)[f"{group}/engine"]
        mine = passes.ids == number
        assert mine.sum() > 500
        parts = {part for part, (owner, _) in passes.part_table.items() if owner == number}
        assert len(parts) == 3
        assert set(np.unique(passes.parts[mine]).tolist()) == parts
        assert passes.moving[mine].all() == (group == "mover")
        assert passes.extents[number].category == "three"
        assert passes.extents[named(passes)["object/floor"]].category == "ground"
    assert set(passes.object_poses) == set()


def test_a_box_in_space_lies_along_the_objects_own_axes(made):
    passes = render_passes(made(ENGINE), VIEW, 0.1, 0.01)
    box = passes.extents[named(passes)["mover/engine"]]
    np.testing.assert_allclose(box.size_m, np.array([0.4, 0.4, 0.9]) * 0.8 / 0.9, rtol=1e-6)
    angle = 0.5 + 2 * np.pi * 0.5 * 0.1
    np.testing.assert_allclose(box.axes[:, 0], [np.cos(angle), np.sin(angle), 0], atol=1e-6)
    np.testing.assert_allclose(box.center_m[2], 0.4, atol=1e-6)


def test_names_with_numbers_stay_apart_and_a_car_is_one(made):
    text = "".join(
        f'[objects.vase-{k}]\nkind = "mesh"\nfile = "three.glb"\nmaterial = "grey"\nheight_m = 0.3\n'
        f"position_m = [{k}, 0, 0]\n"
        for k in (0, 1)
    )
    text += '[movers.taxi]\nkind = "car"\nmaterial = "grey"\nwheel_material = "grey"\nground_m = [0, 9, 0]\n'
    found = bodies(made(text))
    assert {name: body.category for name, body in found.items()} == {
        "object/vase-0": "three",
        "object/vase-1": "three",
        "mover/taxi": "car",
    }
    assert len(found["mover/taxi"].parts) == 5
    passes = render_passes(made(text), VIEW, 0.1, 0.01)
    taxi = passes.object_poses["mover/taxi"]
    assert taxi.matrices is None
    # Its wheels roll; each is rigid by itself.
    assert all(passes.object_poses[part].matrices is not None for part in found["mover/taxi"].parts)


def project(points, passes, view):
    """Project to columns and rows by the stated camera alone."""
    inverse = np.linalg.inv(passes.camera_to_world[1])
    seen = points @ inverse[:3, :3].T + inverse[:3, 3]
    plane = seen[:, :2] / seen[:, 2:]
    plane = plane * (1 + passes.radial_k1 * (plane**2).sum(axis=1, keepdims=True))
    return plane @ passes.intrinsics_px[:2, :2].T + passes.intrinsics_px[:2, 2], seen[:, 2]


@pytest.mark.parametrize("distortion", [0.0, -0.03])
@pytest.mark.parametrize("name", ["flying_solids", "engine", "moving_camera"])
def test_boxes_and_visibility_are_those_that_other_code_finds(made, name, distortion):
    """Projected vertices, masks, and a picture of each object alone."""
    view = replace(VIEW, distortion=distortion)
    ball = '[objects.b]\nkind = "globe"\nmaterial = "grey"\ncenter_m = [0.3, -0.9, 0.4]\nradius_m = 0.15\n'
    scene = (
        made(ENGINE + FLOOR + ball)
        if name == "engine"
        else load_scene(name, "3" * (name[0] == "f") or "main")
    )
    scene = scene.in_band()
    passes = render_passes(scene, view, 0.1, 0.01)
    found, hidden = bodies(scene), 0
    assert {passes.id_table[number] for number in passes.extents} == set(found)
    for number, each in passes.extents.items():
        body, mine = found[passes.id_table[number]], passes.ids == number
        rows, cols = np.nonzero(mine)
        if rows.size:
            assert each.visible_box_px == (cols.min(), rows.min(), cols.max() + 1, rows.max() + 1)
        assert each.visible == mine.sum()
        points = np.concatenate(
            [p.vertices(0.1) if hasattr(p, "vertices") else p.mesh().vertices_m for p in body.parts.values()]
        )
        places, depth = project(points, passes, view)
        near = scene.camera.near_m
        if (depth > near).all() and not distortion:
            ends = np.array([view.cols, view.rows])
            box = [*np.clip(places.min(axis=0), 0, ends), *np.clip(places.max(axis=0), 0, ends)]
            if box[0] < box[2] and box[1] < box[3]:
                np.testing.assert_allclose(each.box_px, box, atol=1e-6)
            else:
                assert each.box_px is None
        # In its own frame the box holds every vertex, and touches them on all six sides.
        local = (points - each.center_m) @ each.axes
        np.testing.assert_allclose(local.max(axis=0), each.size_m / 2, atol=1e-6)
        np.testing.assert_allclose(local.min(axis=0), -each.size_m / 2, atol=1e-6)
        np.testing.assert_allclose(each.axes.T @ each.axes, np.eye(3), atol=1e-9)
        hidden += 0 < each.visibility < 0.9
    assert hidden >= 1
    for number, each in list(passes.extents.items())[:8]:
        key = passes.id_table[number]
        kind, own = key.split("/", 1)
        movers = {
            k: v
            for k, v in scene.movers.items()
            if kind == "mover" and scene.owners.get(f"mover/{k}", f"mover/{k}") == key
        }
        inside = {part.removeprefix("object/") for part in found[key].parts}
        inside |= {item for mover in movers.values() for item in getattr(mover, "objects", ())}
        alone = scene.model_copy(
            update={
                "objects": {k: v for k, v in scene.objects.items() if k in inside},
                "movers": movers,
                "lamps": {
                    k: v.model_copy(update={"center_m": (0, -400, 500)}) for k, v in scene.lamps.items()
                },
                "static": None,
            }
        )
        picture = render_passes(alone, view, 0.1, 0.01)
        covered = int((picture.ids == named(picture)[key]).sum())
        slack = (0.005 if distortion else 0.002) * covered
        assert abs(each.covered - covered) <= max(2, slack), own
        if covered > 50 and each.box_px is not None:
            rows, cols = np.nonzero(picture.ids == named(picture)[key])
            box = (cols.min(), rows.min(), cols.max() + 1, rows.max() + 1)
            # Of few samples the edges lie up to a sample inside of the true ones.
            np.testing.assert_allclose(each.box_px, box, atol=2.5)


def test_a_category_must_be_a_word(made):
    with pytest.raises(ConfigError, match=r"objects\.floor\.category: got 3, expected a word"):
        made(FLOOR.replace('"ground"', "3"))
    with pytest.raises(ConfigError, match=r"owners: unknown key"):
        made("[owners]\na = 1\n" + FLOOR)
