"""Variations by number: the same number is the same scene, ranges hold, bad ranges are explained."""

import numpy as np
import pytest

from optsim.core.errors import ConfigError
from optsim.scene import list_scenes, load_scene
from optsim.scene.variation import Range

BASE = """
name = "varied"
white_w_m2_sr = 1.0
[camera]
position_m = [0, 0, 1]
target_m = [0, 4, 1]
[materials.grey]
[materials.wall]
texture = "brick"
[lamps.a]
center_m = [0, 0, 3]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 2.0
[objects.wall]
kind = "quad"
material = "wall"
corner_m = [-2, 5, 0]
edge_u_m = [4, 0, 0]
edge_v_m = [0, 0, 3]
[movers.fan]
kind = "fan"
material = "grey"
center_m = [0, 3, 1]
radius_m = 0.3
[variations.fast.movers.fan]
turns_hz = 9.0
"""
RANGES = """
[ranges]
"lamps.a.radiance_w_m2_sr" = [1.0, 8.0]
"movers.fan.center_m.0" = [-0.5, 0.5]
[ranges.movers.fan]
turns_hz = [1.0, 5.0]
n_blades = [3, 6]
[ranges.materials.wall]
texture = { choices = ["brick", "gravel", "checker"] }
"""


@pytest.fixture
def folder(tmp_path):
    def write(text=BASE + RANGES):
        (tmp_path / "scene.toml").write_text(text)
        return tmp_path

    return write


def numbers(scene):
    fan = scene.movers["fan"]
    return (scene.lamps["a"].radiance_w_m2_sr, fan.center_m[0], fan.turns_hz, fan.n_blades)


def test_the_same_number_is_the_same_scene(folder):
    assert load_scene(folder(), "7") == load_scene(folder(), "7")
    assert load_scene(folder(), "7").variation == "7"
    dumps = [load_scene(folder(), str(n)).model_dump_json(exclude={"variation"}) for n in range(20)]
    assert len(set(dumps)) == 20


def test_a_number_depends_on_the_scene_and_not_on_the_order_of_the_file(folder):
    here = load_scene(folder(), "7")
    head, *lines = RANGES.strip().split("\n")
    turned = "\n".join([*lines[2:], head, *lines[:2]])
    assert load_scene(folder(BASE + turned), "7") == here
    other = load_scene(folder((BASE + RANGES).replace('"varied"', '"other"')), "7")
    assert numbers(other) != numbers(here)


def test_ranges_are_respected_and_filled(folder):
    drawn = [load_scene(folder(), str(n)) for n in range(300)]
    for index, (low, high) in enumerate([(1, 8), (-0.5, 0.5), (1, 5)]):
        values = np.array([numbers(scene)[index] for scene in drawn])
        assert low <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high
        # Mean of 300 uniform numbers: sd 0.0167 of the width; 5 sd, false alarm 6e-7 each.
        assert abs(values.mean() - (low + high) / 2) < 5 * 0.0167 * (high - low)
    blades = [scene.movers["fan"].n_blades for scene in drawn]
    assert set(blades) == {3, 4, 5, 6}
    assert all(isinstance(count, int) for count in blades)
    assert {scene.materials["wall"].texture for scene in drawn} == {"brick", "gravel", "checker"}
    # Numbers side by side are independent: the correlation of 300 pairs has sd 0.058.
    assert abs(np.corrcoef(*np.array([numbers(s)[:2] for s in drawn]).T)[0, 1]) < 0.3
    # What has no range is as written.
    assert {scene.movers["fan"].center_m[1:] for scene in drawn} == {(3.0, 1.0)}


def test_a_range_more_leaves_all_others_bitwise_as_they_were(folder):
    text = (BASE + RANGES).replace("[ranges]\n", '[ranges]\n"lamps.a.center_m.0" = [0.0, 0.5]\n')
    assert numbers(load_scene(folder(text), "7")) == numbers(load_scene(folder(), "7"))


def test_an_aspect_may_follow_another_number_and_leaves_the_others_alone(folder):
    three, seven = (numbers(load_scene(folder(), number)) for number in "37")
    assert numbers(load_scene(folder(), "3,light=7")) == (seven[0], *three[1:])
    assert numbers(load_scene(folder(), "3,motion=7")) == (three[0], *seven[1:])
    with pytest.raises(ConfigError, match="unknown variation"):
        load_scene(folder(), "3,lights=7")


@pytest.mark.parametrize("name", sorted(list_scenes()))
def test_every_shipped_scene_has_numbered_variations(name):
    assert load_scene(name, "1") != load_scene(name, "2")


def test_whole_ends_draw_whole_numbers_and_others_do_not():
    rng = np.random.default_rng(0)
    whole = [Range("k", low=1, high=3).drawn(rng) for _ in range(50)]
    assert set(whole) == {1, 2, 3}
    assert {type(value) for value in whole} == {int}
    assert len({Range("k", low=1.0, high=3.0).drawn(rng) for _ in range(50)}) == 50


def test_main_and_named_variations_are_as_written(folder):
    plain = load_scene(folder(BASE))
    assert load_scene(folder()).model_dump() == plain.model_dump()
    assert numbers(load_scene(folder(), "fast")) == (2.0, 0.0, 9.0, 4)


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ('"movers.fan.turns_hz" = [5.0, 1.0]', "movers.fan.turns_hz.*low first"),
        ('"movers.fan.turns_hz" = [1.0]', "expected \\[low, high\\]"),
        ('"movers.fan.turns_hz" = [1.0, nan]', "finite"),
        ('"movers.fan.turns_hz" = [true, false]', "expected \\[low, high\\]"),
        ('"movers.fan.turns_hz" = 3.0', "expected \\[low, high\\]"),
        ('"movers.fan.turns_hz" = { choices = [] }', "one, or more"),
        ('"movers.fam.turns_hz" = [1.0, 2.0]', "did you mean 'fan'"),
        ('"movers.fan.turn_hz" = [1.0, 2.0]', "unknown key"),
        ('"movers.fan.center_m.3" = [1.0, 2.0]', "0 .. 2"),
        ('"name.x" = [1.0, 2.0]', "plain value"),
        ('"lamps.a.radiance_w_m2_sr" = [-1.0, 2.0]', "at an end of its ranges"),
        ('"movers.fan.n_blades" = [3, 9]', "at an end of its ranges"),
        ('"movers.fan.n_blades" = [2.5, 3.5]', "n_blades"),
        ('"materials.wall.texture" = { choices = ["brick", "gravel", "brik"] }', "brick"),
    ],
)
def test_bad_ranges_are_explained_even_when_main_is_asked_for(folder, ranges, message):
    with pytest.raises(ConfigError, match=message):
        load_scene(folder(f"{BASE}[ranges]\n{ranges}\n"))


@pytest.mark.parametrize("variation", ["-1", "1.5", "007", "²", ""])
def test_what_is_no_number_is_an_unknown_name(folder, variation):
    with pytest.raises(ConfigError, match="unknown variation"):
        load_scene(folder(), variation)


def test_a_number_needs_ranges_and_names_are_not_numbers(folder):
    with pytest.raises(ConfigError, match=r"add a table \[ranges\]"):
        load_scene(folder(BASE), "7")
    with pytest.raises(ConfigError, match=r"variations\.7"):
        load_scene(folder(BASE.replace("variations.fast", "variations.7")), "7")


def test_training_refuses_a_reserved_scene(monkeypatch, folder):
    from optsim.experiment import train

    path = folder("reserved = true\n" + BASE)
    assert load_scene(path).reserved
    assert not load_scene("training_mix").reserved
    reserved = load_scene(path)
    monkeypatch.setattr("optsim.scene.load_scene", lambda name, variation: reserved)
    monkeypatch.setattr("optsim.render.render_footage", lambda *a, **k: pytest.fail("it rendered"))
    with pytest.raises(ConfigError, match="reserved for testing"):
        train.training_clips(seed=0, backend=None, progress=lambda *a: None)
