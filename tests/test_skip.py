"""The skip table: what it leaves out fits the tolerance, follows scene and camera, and is what a run uses."""

import numpy as np
import pytest
from small_experiment import SMALL

from optsim.camera.effects import changed
from optsim.camera.hardware import demo, prototype
from optsim.camera.parts.objective import MOVING_TAIL_SHARE
from optsim.camera.probe import Illumination
from optsim.camera.skip import ALL, Given, leave_out, straight_lines
from optsim.experiment.check_skips import check_skips
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import plan_record
from optsim.experiment.loop import planned
from optsim.experiment.truth import given, illumination
from optsim.scene import BrightLight, bright_lights, load_scene


def before(*lights, camera=None):
    return Given(camera or demo(), Illumination(0.1, 90.0, 0.8, lights))


ROOM, WINDOW = before(), before(BrightLight(25.0, 0.07))
LAMP = before(BrightLight(1000.0, 5e-4))


def skipped(skipping):
    return {choice.skip for choice in skipping.choices if choice.skipped}


@pytest.mark.parametrize("facts", [ROOM, WINDOW, LAMP])
def test_what_is_left_out_fits_the_tolerance_and_a_larger_one_leaves_out_more(facts):
    found = [leave_out(facts, tolerance) for tolerance in (0.0, 0.01, 0.1, 100.0)]
    for each in found:
        assert 0 <= each.bound <= each.tolerance
        assert [choice.skip for choice in each.choices] == [row.name for row in ALL]
    taken = [skipped(each) for each in found]
    assert taken[0] <= taken[1] <= taken[2] <= taken[3]
    assert "moving_tails" in taken[3] - taken[0]


def test_without_a_tolerance_nothing_is_left_out_that_is_there():
    found = leave_out(WINDOW, 0.0)
    assert found.bound == 0
    assert found.camera.objective.moving_tail_share == 0
    # Wings need not reach beyond the panel, here 480 cells wide, and back.
    for lens in (found.camera.objective, found.camera.relay):
        assert lens.tail_share == 3e-4 or lens.tail_share == pytest.approx(1e-4, rel=2)
        assert lens.field_error == 5e-3


@pytest.mark.parametrize("f_number", [0.7, 16.0])
def test_slow_and_fast_lenses_have_an_image(f_number):
    camera = demo()
    lens = camera.objective.model_copy(update={"f_number": f_number})
    slow = camera.model_copy(update={"objective": lens})
    for tolerance in (0.0, 0.1):
        found = leave_out(before(*WINDOW.light.lights, camera=slow), tolerance)
        assert found.camera.relay_operator().blur.shape == (360, 480)


def test_far_light_follows_lines_unless_a_lamp_may_be_hidden():
    """Of the lamps in the picture all count; one that brings next to nothing changes nothing."""
    for facts, lines in ((ROOM, True), (WINDOW, True), (LAMP, False)):
        found = leave_out(facts, 0.1)
        assert ("moving_tails" in skipped(found)) == lines
        assert found.camera.objective.moving_tail_share == (MOVING_TAIL_SHARE if lines else 0)
    for over_white, lines in ((5000.0, False), (10.0, True)):
        found = leave_out(before(*WINDOW.light.lights, BrightLight(over_white, 3e-4)), 0.1)
        assert ("moving_tails" in skipped(found)) == lines


def test_the_bound_of_lines_is_in_units_of_noise():
    """A lamp of L times a picture in white brings 2 L of a frame's electrons."""
    camera = demo()
    frame_e = 0.8 * camera.sensor.most_e / 2
    noise_e = np.sqrt(frame_e + camera.sensor.read_noise_e**2)
    brought_e = MOVING_TAIL_SHARE * 0.5 * 2 * frame_e
    lamp = before(BrightLight(1000.0, 5e-4))
    lamp = Given(camera, Illumination(1e6, 90.0, 0.8, lamp.light.lights))
    assert straight_lines(lamp) - straight_lines(WINDOW) == pytest.approx(7 * brought_e / noise_e)
    # In a dark scene, below the light rule, there are fewer electrons.
    dim = Given(camera, Illumination(1e-6, 90.0, 0.8, lamp.light.lights))
    assert straight_lines(dim) < 0.01 * straight_lines(lamp) + straight_lines(WINDOW)


@pytest.mark.parametrize(
    ("scene", "leaves"),
    [
        ("window_room", {"still_light", "lamp_groups", "polarisation"}),
        ("chart", {"still_light", "lamp_groups", "polarisation"}),
        ("flicker_lamp", {"still_light", "polarisation"}),
        ("moving_camera", {"lamp_groups", "polarisation"}),
        ("glossy_floor", {"still_light", "lamp_groups"}),
    ],
)
def test_what_is_not_in_the_scene_is_left_out(scene, leaves):
    exact = {"time", "still_light", "lamp_groups", "polarisation"}
    facts = given(load_experiment("demo", [f"scene.name={scene}"]))
    assert skipped(leave_out(facts, 0.0)) & exact == leaves


def test_numbers_set_by_hand_stay():
    by_hand = {"relay": {"tail_share": 0.02}, "objective": {"field_error": 0.5, "moving_tail_share": 0.01}}
    found = leave_out(before(*LAMP.light.lights, camera=changed(demo(), by_hand)), 0.1)
    assert found.camera.relay.tail_share == 0.02
    assert found.camera.objective.field_error == 0.5
    assert found.camera.objective.moving_tail_share == 0.01
    assert "moving_tails" not in {choice.skip for choice in found.choices}


def test_wings_have_room_on_every_panel():
    for camera in (demo(), prototype()):
        found = leave_out(before(camera=camera), 0.1).camera
        assert 1e-4 <= found.objective.tail_share < camera.objective.tail_share


def test_a_run_models_what_the_table_says():
    experiment = load_experiment("demo", ["tolerance=0.3"])
    modelled, skipping = planned(experiment)
    assert modelled.camera == skipping.camera
    assert skipping.tolerance == 0.3
    record = plan_record(skipping)
    assert record["bound"] == pytest.approx(sum(row["bound"] for row in record["choices"]))
    assert modelled.camera.view == experiment.camera.view


@pytest.mark.slow
def test_a_frame_is_taken_both_ways():
    """In an even room lines in time cost next to nothing; a tolerance of 0 leaves nothing out."""
    experiment = load_experiment("demo", [*SMALL, "calibration=ideal"])
    found = check_skips(experiment)
    assert [each["method"] for each in found] == [method.name for method in experiment.methods]
    assert all("moving_tails" in each["left_out"] for each in found)
    assert all(0 < each["error"] < 0.1 for each in found)
    assert all(each["loss_db"] == pytest.approx(4.343 * each["error"] ** 2, rel=0.02) for each in found)
    nothing = check_skips(experiment.model_copy(update={"tolerance": 0.0}))
    assert all(each["error"] == 0 for each in nothing)


def test_lamps_in_the_picture_are_found_from_the_scene_alone():
    view = demo().view
    shape = (view.tan_half_width, view.rows / view.cols)
    window = bright_lights(load_scene("window_room").in_band(), *shape)[0]
    assert window.over_white == pytest.approx(11.2 / 0.4)
    assert 0.05 < window.share < 0.1
    assert not bright_lights(load_scene("wheel").in_band(), *shape)
    lamp = bright_lights(load_scene("night_street").in_band(), *shape)[0]
    assert lamp.over_white == pytest.approx(500 / 0.02)
    assert lamp.share < 1e-3
    assert illumination(load_experiment("demo")).bright == window


def test_a_lamp_that_faces_away_or_is_off_is_not_seen():
    scene = load_scene("window_room").in_band()
    shape = (demo().view.tan_half_width, 0.75)
    window = scene.lamps["window"]
    for update in ({"edge_u_m": (-1.2, 0.0, 0.0)}, {"lit": False}, {"center_m": (30.0, 7.66, 1.7)}):
        lamps = {"window": window.model_copy(update=update)}
        assert not bright_lights(scene.model_copy(update={"lamps": lamps}), *shape)
