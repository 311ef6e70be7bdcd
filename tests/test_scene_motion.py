"""Motion as pure functions of time: the camera's pose, keyframed objects, what a scene says that changes."""

import numpy as np
import pytest

from optsim.core.config import build
from optsim.core.errors import ConfigError
from optsim.scene.camera_pose import CameraPose
from optsim.scene.keyframed import Keyframed, rotation
from optsim.scene.lamps import Sine
from optsim.scene.scene import Scene

TABLE = {
    "name": "x",
    "white_w_m2_sr": 1.0,
    "camera": {"position_m": [0, 0, 1], "target_m": [0, 4, 1]},
    "materials": {"grey": {}, "red": {"reflectance": 0.2}},
    "lamps": {
        "a": {"center_m": [0, 0, 3], "edge_u_m": [1, 0, 0], "edge_v_m": [0, -1, 0], "radiance_w_m2_sr": 1}
    },
    "objects": {
        "door": {"kind": "box", "material": "grey", "center_m": [1.5, 4, 1], "size_m": [1, 0.1, 2]},
        "knob": {"kind": "globe", "material": "red", "center_m": [1.9, 3.9, 1], "radius_m": 0.05},
        "post": {"kind": "box", "material": "grey", "center_m": [0, 5, 1], "size_m": [0.1, 0.1, 2]},
    },
}
DOOR = {"kind": "keyframed", "objects": ["door", "knob"]}


def scene(**changes):
    return build(Scene, TABLE | changes, where="scene")


def with_mover(**keys):
    return scene(movers={"m": DOOR | keys})


def pose(**keys):
    return CameraPose(**({"position_m": (1.0, 2.0, 1.5), "target_m": (2.0, 6.0, 1.0)} | keys))


# --- camera ----------------------------------------------------------------------------------------------


def test_a_camera_that_stands_still_is_the_same_at_all_times():
    still = pose()
    assert not still.moves
    assert still.at(3.0) is still
    # A sway needs both numbers.
    assert not pose(sway_m=(0.1, 0, 0)).moves
    assert not pose(sway_hz=2.0).moves


@pytest.mark.parametrize(
    "motion",
    [
        {"velocity_m_s": (0.5, -1.0, 0.2)},
        {"sway_m": (0.1, 0.0, 0.05), "sway_hz": 2.0},
        {"pan_rad_s": 0.7},
        {"velocity_m_s": (0.5, 0, 0), "sway_m": (0, 0, 0.1), "sway_hz": 1.0, "pan_rad_s": -0.3},
    ],
)
def test_a_moving_camera_is_pure_continuous_and_keeps_its_distance(motion):
    camera = pose(**motion)
    assert camera.moves
    start = camera.at(0.0)
    assert (start.position_m, start.target_m) == (camera.position_m, camera.target_m)
    for time_s in (-0.4, 0.1, 1.3, 20.0):
        now = camera.at(time_s)
        assert not now.moves
        assert now == camera.at(time_s)
        assert now.distance_m == pytest.approx(camera.distance_m, rel=1e-12)
        soon = camera.at(time_s + 1e-5)
        for a, b in ((now.position_m, soon.position_m), (now.target_m, soon.target_m)):
            # 6 m/s is faster than any of these; at a standstill nothing would move at all.
            assert np.abs(np.subtract(a, b)).max() < 6e-5
        assert now != soon


def test_the_camera_goes_where_its_numbers_say():
    moved = pose(velocity_m_s=(0.5, -1.0, 0.25)).at(2.0)
    np.testing.assert_allclose(moved.position_m, (2.0, 0.0, 2.0))
    np.testing.assert_allclose(moved.target_m, (3.0, 4.0, 1.5))
    # A quarter of a period after a zero crossing, the sway is at its amplitude; then at minus it.
    swaying = pose(sway_m=(0.1, 0.0, 0.05), sway_hz=2.0)
    np.testing.assert_allclose(swaying.at(0.125).position_m, (1.1, 2.0, 1.55))
    np.testing.assert_allclose(swaying.at(0.375).target_m, (1.9, 6.0, 0.95))
    # A quarter turn, anticlockwise from above: +y becomes -x.
    panned = pose(position_m=(1, 2, 1), target_m=(1, 6, 2), pan_rad_s=np.pi / 2).at(1.0)
    np.testing.assert_allclose(panned.position_m, (1, 2, 1))
    np.testing.assert_allclose(panned.target_m, (-3, 2, 2), atol=1e-12)


@pytest.mark.parametrize("target", [(1.0, 2.0, 1.5), (1.0, 2.0, 9.0), (1.0, 2.0, -4.0)])
def test_a_camera_cannot_look_straight_up_or_at_itself(target):
    with pytest.raises(ConfigError, match="move the target sideways"):
        build(CameraPose, {"position_m": (1.0, 2.0, 1.5), "target_m": target}, where="camera")


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_the_camera_sees_from_a_thousandth_to_a_thousand_of_its_distance(scale):
    camera = pose(position_m=(0, 0, 0), target_m=(0, 5 * scale, 0))
    assert camera.near_m <= 1e-3 * camera.distance_m * (1 + 1e-12)
    assert camera.far_m >= 1e3 * camera.distance_m * (1 - 1e-12)


# --- keyframes -------------------------------------------------------------------------------------------


def motion(**keys):
    return build(Keyframed, DOOR | keys, where="mover")


POINTS = np.array([[2.0, 4.0, 1.0], [1.0, 4.0, 0.0], [1.5, 3.0, 2.0]])


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
def test_a_body_passes_through_its_keyframes_and_rests_before_and_after(interpolation):
    path = motion(
        times_s=[0.5, 1.0, 2.5],
        positions_m=[[0, 0, 0], [1, 0, 0.5], [1, -2, 0]],
        yaw_rad=[0, np.pi / 2, 0.3],
        pivot_m=[1, 4, 0],
        interpolation=interpolation,
    )
    np.testing.assert_allclose(path.placed(POINTS, 0.5), POINTS, atol=1e-12)
    # A quarter turn about x = 1, y = 4: east of the pivot goes north of it, south goes east.
    np.testing.assert_allclose(
        path.placed(POINTS, 1.0), [[2, 5, 1.5], [2, 4, 0.5], [3, 4.5, 2.5]], atol=1e-12
    )
    for outside, edge in ((-3.0, 0.5), (9.0, 2.5)):
        np.testing.assert_allclose(path.placed(POINTS, outside), path.placed(POINTS, edge), atol=1e-12)


def test_linear_is_straight_and_smooth_eases_without_overshoot():
    keys = {"times_s": [0.0, 1.0, 2.0], "positions_m": [[0, 0, 0], [1, 0, 0], [1, 0, 0]]}
    shift = {
        name: [motion(**keys, interpolation=name).placed(POINTS, t)[0, 0] - 2 for t in np.linspace(0, 2, 81)]
        for name in ("linear", "smooth")
    }
    np.testing.assert_allclose(shift["linear"], np.clip(np.linspace(0, 2, 81), 0, 1), atol=1e-12)
    smooth = np.array(shift["smooth"])
    assert smooth.max() <= 1 + 1e-12
    assert (np.diff(smooth) >= -1e-12).all()
    assert np.abs(smooth - shift["linear"]).max() > 0.05
    # It comes to rest without a jerk of its velocity.
    assert abs(smooth[40] - smooth[39]) / 0.025 < 0.1


@pytest.mark.parametrize("interpolation", ["linear", "smooth"])
def test_a_repeating_body_is_periodic_without_a_jump(interpolation):
    path = motion(
        times_s=[1.0, 1.5, 2.5, 3.0],
        positions_m=[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]],
        yaw_rad=[0, 2, 4, 2 * np.pi],
        interpolation=interpolation,
        repeat=True,
    )
    for time_s in (-7.3, 1.2, 2.99, 3.4):
        here = path.placed(POINTS, time_s)
        np.testing.assert_allclose(path.placed(POINTS, time_s + 2.0), here, atol=1e-9)
        soon = path.placed(POINTS, time_s + 1e-6)
        # Points at up to 4.6 m turn with up to some 6 rad/s.
        assert 0 < np.abs(soon - here).max() < 60e-6
    # No jump, and for the smooth one no kink either, where a lap ends.
    step = 1e-5
    before, at, after = (path.placed(POINTS, 3.0 + k * step) for k in (-1, 0, 1))
    kink = np.abs((after - at) - (at - before)).max() / step
    assert np.abs(after - before).max() < 1e-3
    assert kink < 0.02 if interpolation == "smooth" else kink > 0.5


def test_a_wheel_spins_about_its_axis_right_handed_and_comes_round():
    wheel = motion(objects=["post"], spin_axis=[0, 2, 0], pivot_m=[0, 5, 1], spin_hz=4.0)
    rim = np.array([[0.0, 5.0, 1.5], [0.3, 5.0, 1.0], [0.0, 6.0, 1.0]])
    # About +y, a quarter turn takes +z to +x and +x to -z; the axis stays.
    np.testing.assert_allclose(wheel.placed(rim, 1 / 16), [[0.5, 5, 1], [0, 5, 0.7], [0, 6, 1]], atol=1e-12)
    np.testing.assert_allclose(wheel.placed(rim, 0.25), rim, atol=1e-12)


def test_a_wheel_of_a_turning_car_spins_in_its_own_place():
    """Spin about the hub while the whole turns about the car's middle: the hub goes as the car says."""
    car = {
        "times_s": [0, 1],
        "positions_m": [[0, 0, 0], [3, 0, 0]],
        "yaw_rad": [0, 1.0],
        "pivot_m": [0, 0, 0],
    }
    hub, rim = np.array([[1.0, 0.5, 0.3]]), np.array([[1.0, 0.5, 0.6]])
    body = motion(**car)
    wheel = motion(**car, spin_axis=[0, 1, 0], spin_center_m=[1.0, 0.5, 0.3], spin_rad=[0, 10.0])
    for time_s in (0.0, 0.37, 1.0):
        np.testing.assert_allclose(wheel.placed(hub, time_s), body.placed(hub, time_s), atol=1e-12)
        assert np.linalg.norm(wheel.placed(rim, time_s) - wheel.placed(hub, time_s)) == pytest.approx(0.3)
    assert np.abs(wheel.placed(rim, 0.37) - body.placed(rim, 0.37)).max() > 0.05


def test_a_keyframed_body_is_rigid_pure_and_splits_by_material():
    moving = with_mover(times_s=[0, 1], yaw_rad=[0, 1.2], pivot_m=[1, 4, 0], spin_hz=0.5)
    parts = moving.singles()
    assert {name: part.material for name, part in parts.items()} == {"m_grey": "grey", "m_red": "red"}
    apart = {}
    for time_s in (0.0, 0.3, 2.0):
        vertices = np.concatenate([parts["m_grey"].vertices(time_s), parts["m_red"].vertices(time_s)])
        np.testing.assert_array_equal(
            parts["m_red"].vertices(time_s), moving.singles()["m_red"].vertices(time_s)
        )
        apart[time_s] = np.linalg.norm(vertices[:, None] - vertices[None, ::50], axis=-1)
        np.testing.assert_allclose(apart[time_s], apart[0.0], atol=1e-9)
    np.testing.assert_array_equal(parts["m_grey"].vertices(0.0), parts["m_grey"].rest().vertices_m)
    # What is carried doesn't stand still as well; the post does.
    assert set(moving.still_objects()) == {"post"}
    assert set(moving.still_meshes()) == {"grey"}
    assert len(moving.still_meshes()["grey"].faces) == 12
    assert len(scene().still_meshes()["grey"].faces) == 24


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"objects": ["dor"]}, "movers.m.objects.*did you mean 'door'"),
        ({"objects": ["door", "door"]}, "named twice"),
        ({"objects": []}, "objects"),
        ({"times_s": [0, 2, 1], "yaw_rad": [0, 1, 2]}, "times_s must increase; got 1.0 after 2.0"),
        ({"times_s": [0, 1, 1], "yaw_rad": [0, 1, 2]}, "times_s must increase"),
        ({"times_s": [0, float("nan")], "yaw_rad": [0, 1]}, "times_s.1.*finite"),
        ({"times_s": [0, 1], "positions_m": [[0, 0, 0], [0, float("inf"), 0]]}, "positions_m.1.1.*finite"),
        ({"times_s": [0, 1], "yaw_rad": [0, 1, 2]}, "yaw_rad: got 3 values for 2"),
        ({"spin_axis": [0, 0, 0], "spin_hz": 1}, "spin_axis.*direction"),
        ({"times_s": [0, 1], "positions_m": [[0, 0, 0], [1, 0, 0]], "repeat": True}, "leads back"),
        ({"times_s": [0, 1], "yaw_rad": [0, 3], "repeat": True}, "whole number"),
        ({"repeat": True}, "at least two"),
        ({"interpolation": "cubic"}, "interpolation"),
        ({"spin": 3}, r"movers\.m\.spin: unknown key; did you mean 'spin_hz'\?"),
        ({"turn": 3}, r"movers\.m\.turn: unknown key; keys here are: kind, .*times_s"),
    ],
)
def test_bad_keyframes_are_explained(keys, message):
    with pytest.raises(ConfigError, match=message):
        with_mover(**keys)


def test_two_movers_must_not_carry_one_object_nor_share_a_name():
    with pytest.raises(ConfigError, match="'door' is named twice, by 'm' and 'n'"):
        scene(movers={"m": DOOR, "n": DOOR})
    fan = {"kind": "fan", "material": "grey", "center_m": [0, 3, 1], "radius_m": 0.2}
    with pytest.raises(ConfigError, match="name of another mover"):
        scene(movers={"m": DOOR, "m_grey": fan})


def test_rotation_is_a_rotation():
    turn = rotation((1.0, -2.0, 0.5), 1.1)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    assert np.trace(turn) == pytest.approx(1 + 2 * np.cos(1.1))


# --- what changes ----------------------------------------------------------------------------------------


def test_a_scene_says_what_changes():
    flickering = TABLE["lamps"]["a"] | {"flicker": Sine(frequency_hz=100)}
    mover = {"movers": {"m": DOOR}}
    moving = {"camera": TABLE["camera"] | {"pan_rad_s": 0.1}}
    steady = {"b": TABLE["lamps"]["a"], "a": flickering | {"lit": False}}
    assert scene().kind_of_change() == "static"
    assert scene(lamps={"a": flickering}).kind_of_change() == "lamps"
    assert scene(lamps=steady).kind_of_change() == "static"
    assert scene(lamps={"a": flickering}, **mover).kind_of_change() == "movers"
    assert scene(**mover, **moving).kind_of_change() == "camera"


def test_a_mover_may_leave_the_frame_and_pass_the_camera():
    """Through the camera's plane and far behind it: positions stay finite and on their line."""
    passing = with_mover(times_s=[0, 1], positions_m=[[0, 0, 0], [-1.5, -2000, 0]], interpolation="linear")
    places = np.array([passing.singles()["m_grey"].vertices(t).mean(axis=0) for t in np.linspace(0, 1, 11)])
    np.testing.assert_allclose(places[:, 1], 4 - 200 * np.arange(11), atol=1e-9)
