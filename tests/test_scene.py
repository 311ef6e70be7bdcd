"""Scenes: movers are pure, continuous functions of time with a fixed topology; bad input is named."""

from itertools import pairwise

import numpy as np
import pytest

from optsim.core.config import read_toml
from optsim.core.errors import ConfigError
from optsim.scene import list_scenes, load_scene
from optsim.scene.geometry import ball, box, limb, wall
from optsim.scene.scene import scenes_folder

SCENES = [(name, variation) for name, variations in list_scenes().items() for variation in variations]
LAMP = """
[lamps.a]
center_m = [0, 0, 2]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 1.0
"""
HEAD = """
name = "x"
white_w_m2_sr = 1.0
[camera]
position_m = [0, 0, 0]
target_m = [0, 1, 0]
[materials.grey]
"""
MOVER = """
[movers.m]
kind = "fan"
material = "grey"
center_m = [0, 3, 0]
radius_m = 0.3
"""


def written(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(("name", "variation"), SCENES)
def test_shipped_scenes_load_and_carry_a_readme(name, variation):
    scene = load_scene(name, variation)
    assert scene.variation == variation
    assert scene.still_meshes()
    assert scene.light_groups()
    assert bool(scene.singles()) or scene.kind_of_change() in ("static", "lamps", "camera")
    assert (scenes_folder() / name / "README.md").is_file()


@pytest.mark.parametrize(("name", "variation"), SCENES)
def test_movers_are_pure_continuous_and_keep_their_topology(name, variation):
    for key, mover in load_scene(name, variation).singles().items():
        rest = mover.rest()
        assert rest.faces.min() == 0, key
        assert rest.faces.max() == len(rest.vertices_m) - 1, key
        assert len(rest.uv) == len(rest.vertices_m), key
        np.testing.assert_array_equal(mover.vertices(0.0), rest.vertices_m)
        for time_s in (0.0, 0.11, 0.5, 1.7):
            now, soon = mover.vertices(time_s), mover.vertices(time_s + 1e-5)
            assert now.shape == rest.vertices_m.shape
            # 60 m/s is faster than any point of these movers; a facet that pops moves a centimetre at once.
            assert np.abs(soon - now).max() < 60 * 1e-5, key
            np.testing.assert_array_equal(now, mover.vertices(time_s))


@pytest.mark.parametrize("name", list_scenes())
def test_numbers_vary_every_scene_that_has_ranges(name):
    if "ranges" not in read_toml(scenes_folder() / name / "scene.toml"):
        with pytest.raises(ConfigError, match="it has none"):
            load_scene(name, "1")
        return
    drawn = [load_scene(name, str(number)) for number in (1, 1, 2, 3)]
    assert drawn[0] == drawn[1]
    assert len({scene.model_dump_json(exclude={"variation"}) for scene in drawn}) == 3
    main = load_scene(name)
    assert [scene.kind_of_change() for scene in drawn] == [main.kind_of_change()] * 4
    assert {scene.reserved for scene in drawn} == {main.reserved}


def test_walker_limbs_keep_their_lengths_while_they_swing():
    walker = load_scene("window_room").singles()["walker"]
    shapes = [walker.vertices(t) for t in np.linspace(0, 1.2, 13)]
    edges = walker.rest().faces[:, :2]
    lengths = np.array([np.linalg.norm(v[edges[:, 0]] - v[edges[:, 1]], axis=1) for v in shapes])
    # Every limb is rigid; joints lie between limbs, so no edge crosses one.
    assert np.ptp(lengths, axis=0).max() < 1e-9
    assert np.ptp(np.array(shapes), axis=0).max() > 0.2


def test_fan_comes_round_again():
    fan = load_scene("window_room").singles()["fan"]
    turn_s = 1 / fan.turns_hz
    np.testing.assert_allclose(fan.vertices(turn_s), fan.vertices(0.0), atol=1e-12)
    assert np.abs(fan.vertices(turn_s / 8) - fan.vertices(0.0)).max() > 0.05


def test_torso_stays_within_15_panel_pixels_a_coded_frame():
    from optsim.core.quantities import View
    from optsim.render.footprint import project

    scene, view = load_scene("window_room"), View(500, 600, 1, 0.32)
    walker = scene.singles()["walker"]
    trunk = slice(0, 2 * len(limb((0, 0, 0), (0, 0, 1), 0.1, 0.1).vertices_m))  # pelvis and chest
    places = [project(walker.vertices(0.2 * f)[trunk], scene.camera, view)[:, :2] for f in range(12)]
    moved = [np.hypot(*(b - a).T).max() for a, b in pairwise(places)]
    assert 0.5 < max(moved) < 15


def _volume(mesh):
    a, b, c = (mesh.vertices_m[mesh.faces[:, i]] for i in range(3))
    return np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6


def test_closed_meshes_face_outward_and_have_the_right_volume():
    assert _volume(box((1, 2, 3), (2, 3, 4), 0.7)) == pytest.approx(24)
    # Polyhedra inscribed in round bodies: a few per cent too small with these many facets, never too large.
    assert 0.9 < _volume(ball((5, 0, 0), 1.0)) / (4 * np.pi / 3) < 1
    capsule = np.pi * 0.1**2 * 1.0 + 4 * np.pi / 3 * 0.1**3
    assert 0.9 < _volume(limb((0, 0, 0), (0, 0, 1), 0.1, 0.1)) / capsule < 1


def test_a_wall_has_its_holes():
    mesh = wall((0, 0, 0), (4, 0, 0), (0, 0, 3), [(1, 1, 2, 2)], 0.1)
    a, b, c = (mesh.vertices_m[mesh.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a) / 2
    front = np.abs(normal[:, 1]) > 1e-9
    assert np.abs(normal[front]).sum() == pytest.approx(4 * 3 - 1)
    assert np.abs(normal[~front]).sum() == pytest.approx(4 * 0.1)  # the reveals


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (HEAD + MOVER, "lamps"),
        (HEAD + "[lamps]\n" + MOVER, "lamps"),
        (HEAD + LAMP + MOVER.replace("fan", "fam"), "fan"),
        (HEAD + LAMP + MOVER.replace("grey", "gray"), "grey"),
        (HEAD + 'texture = "brik"\n' + LAMP, "brick"),
        (HEAD + LAMP + MOVER.replace("0.3", "nan"), "radius_m"),
        (HEAD + LAMP + MOVER.replace("radius_m", "radius"), "radius_m"),
        (HEAD + LAMP.replace("[1, 0, 0]", "[0, -1, 0]"), "orthogonal"),
    ],
)
def test_bad_scenes_are_explained(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(written(tmp_path, text))


def test_unknown_names_get_the_nearest_one():
    with pytest.raises(ConfigError, match="did you mean 'window_room'"):
        load_scene("window_rom")
    with pytest.raises(ConfigError, match="did you mean 'crossing'"):
        load_scene("window_room", "crosing")


def test_a_variation_changes_only_what_it_names(tmp_path):
    text = HEAD + LAMP + MOVER + "[variations.fast.movers.m]\nturns_hz = 9.0\n"
    main, fast = (load_scene(written(tmp_path, text), name) for name in ("main", "fast"))
    assert (main.singles()["m"].turns_hz, fast.singles()["m"].turns_hz) == (3.0, 9.0)
    assert fast.lamps == main.lamps


def test_two_scenes_are_kept_for_testing():
    assert {name for name in list_scenes() if load_scene(name).reserved} == {"chart", "night_street"}
