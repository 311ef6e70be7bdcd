"""Random objects: drawn by the number, inside their region, apart from each other, aspect by aspect."""

import numpy as np
import pytest
import trimesh

from optsim.core.errors import ConfigError
from optsim.scene import load_scene
from optsim.scene.geometry import Mesh
from optsim.scene.solids import SHAPES, Solid

BASE = """
name = "crowded"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -3, 1]
target_m = [0, 0, 1]
[materials]
a = { reflectance = 0.2 }
b = { reflectance = 0.7 }
[lamps.a]
center_m = [0, 0, 3]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 2.0
[populate.thing]
count = [5, 9]
region_m = [[-1, -1, 0.5], [1, 1, 1.5]]
size_m = [0.1, 0.3]
materials = ["a", "b"]
speed_m_s = [0.5, 2.0]
spin_hz = [0.5, 1.0]
moving_share = 0.5
falling = true
"""


@pytest.fixture
def scene(tmp_path):
    def load(variation="1", text=BASE):
        (tmp_path / "scene.toml").write_text(text)
        return load_scene(tmp_path, variation)

    load.folder = tmp_path
    return load


def volume(mesh: Mesh) -> float:
    return trimesh.Trimesh(mesh.vertices_m, mesh.faces).volume


@pytest.mark.parametrize("shape", SHAPES)
def test_solids_are_as_high_as_stated_face_outward_and_stand_where_they_are_put(shape):
    solid = Solid(shape=shape, material="a", height_m=0.4, position_m=(1, 2, 3))
    points = solid.mesh().vertices_m
    assert np.ptp(points[:, 2]) == pytest.approx(0.4)
    np.testing.assert_allclose((points.min(axis=0) + points.max(axis=0)) / 2, (1, 2, 3.2), atol=1e-9)
    # The volume is positive only if triangles face outward.
    assert volume(solid.mesh()) > 0.2**3 / 8
    turned = Solid(shape=shape, material="a", height_m=0.4, rotation_rad=(np.pi / 2, 0, 0), anchor="middle")
    assert np.ptp(turned.mesh().vertices_m[:, 1]) == pytest.approx(0.4)


def test_a_ball_and_a_box_have_their_volumes():
    ball = Solid(shape="ball", material="a", height_m=2.0).mesh()
    assert volume(ball) == pytest.approx(4 / 3 * np.pi, rel=0.02)
    assert volume(Solid(shape="box", material="a", height_m=2.0).mesh()) == pytest.approx(8)


def test_numbers_draw_inside_the_region_and_as_many_as_stated(scene):
    counts = []
    for number in range(40):
        found = scene(str(number))
        counts.append(len(found.objects))
        for item in found.objects.values():
            assert all(-1 <= x <= 1 for x in item.position_m[:2])
            assert 0.5 <= item.position_m[2] <= 1.5
            sides = np.ptp(
                Solid(shape=item.shape, material="a", height_m=item.height_m).mesh().vertices_m, axis=0
            )
            assert 0.1 <= sides.max() <= 0.3 + 1e-9
    assert set(counts) == {5, 6, 7, 8, 9}


def test_nothing_overlaps_at_any_instant_of_the_first_half_second(scene):
    for number in range(20):
        found = scene(str(number))
        for time_s in np.linspace(0, 0.5, 11):
            balls = []
            for name, item in found.objects.items():
                motion = found.movers.get(name)
                points = item.mesh().vertices_m
                middle = (points.min(axis=0) + points.max(axis=0)) / 2
                radius = np.linalg.norm(points - middle, axis=1).max()
                if motion is not None:
                    points = motion.placed(points, time_s)
                    middle = (points.min(axis=0) + points.max(axis=0)) / 2
                balls.append((middle, radius))
            for i, (a, r) in enumerate(balls):
                for b, q in balls[:i]:
                    # Bounding boxes of turned solids are off their middles by a little.
                    assert np.linalg.norm(a - b) > 0.8 * (r + q)


def test_an_aspect_changes_nothing_else(scene):
    def parts(variation):
        found = scene(variation)
        shapes = {name: item.model_dump(exclude={"material"}) for name, item in found.objects.items()}
        materials = {name: item.material for name, item in found.objects.items()}
        motions = {name: mover.model_dump() for name, mover in found.movers.items()}
        return shapes, materials, motions

    three, seven = parts("3"), parts("7")
    shapes, materials, motions = parts("3,textures=7")
    assert (shapes, motions) == (three[0], three[2])
    assert materials != three[1]
    shapes, materials, motions = parts("3,light=7")
    assert (shapes, materials, motions) == three
    assert three != seven


def test_a_thrown_body_falls_by_gravity(scene):
    found = scene("3")
    name, motion = next(iter(found.movers.items()))
    points = found.objects[name].mesh().vertices_m.mean(axis=0, keepdims=True)
    still = motion.model_copy(update={"spin_hz": 0.0})
    path = np.concatenate([still.placed(points, t) for t in (0.0, 0.1, 0.2)])
    np.testing.assert_allclose(np.diff(path, 2, axis=0)[0] / 0.1**2, (0, 0, -9.81), atol=1e-9)


def test_models_of_a_folder_are_drawn_too(scene):
    (scene.folder / "models").mkdir()
    for name in ("one", "two"):
        trimesh.creation.box((1, 1, 1)).export(scene.folder / "models" / f"{name}.glb")
    text = BASE.replace('materials = ["a", "b"]', 'materials = ["a"]\nmodels = ["models"]')
    found = scene("1", text)
    assert {item.kind for item in found.objects.values()} == {"mesh"}
    assert len({item.sha256 for item in found.objects.values()}) >= 1


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl"])
def test_models_of_formats_without_an_axis_are_drawn_upright(scene, suffix):
    # 3 long in the file, along the axis that points up.
    trimesh.creation.box((1, 3, 2)).export(scene.folder / f"one.{suffix}")
    models = f'models = ["one.{suffix}"]\nup = "y"'
    found = scene("1", BASE.replace("falling = true", f"resting = true\n{models}"))
    assert {item.kind for item in found.objects.values()} == {"mesh"}
    for item in found.objects.values():
        points = item.mesh().vertices_m
        assert 0.1 <= np.ptp(points[:, 2]) <= 0.3
        assert points[:, 2].min() == pytest.approx(0.5)
    with pytest.raises(ConfigError, match=r'populate\.thing\.up: got none, .* cure: up = "z"'):
        scene("1", BASE.replace("falling = true", models.partition("\n")[0]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("count = [5, 9]", "count = [400, 900]", "got no free place for object"),
        ("count = [5, 9]", "count = [9, 5]", "low end first"),
        ("size_m = [0.1, 0.3]", "size_m = [0.3, 0.1]", "low end first"),
        ('materials = ["a", "b"]', "", "materials: got none"),
        ('materials = ["a", "b"]', 'materials = ["c"]', "unknown material 'c'"),
        (
            'materials = ["a", "b"]',
            'materials = ["a"]\nmodels = ["none"]',
            r"no such|unknown|expected one of",
        ),
        ("falling = true", "faling = true", "falling"),
        ("region_m = [[-1", "region_m = [[2", "lowest corner first"),
    ],
)
def test_bad_populations_are_said(scene, old, new, message):
    text = BASE.replace(old, new)

    def load():
        # A model is drawn by some numbers only.
        return [scene(str(number), text) for number in range(8)]

    with pytest.raises(ConfigError, match=message):
        load()
