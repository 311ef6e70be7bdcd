"""Rigid bodies fall by gravity, bounce and come to rest; their poses are data, the same each time."""

import json
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from optsim.core.errors import ConfigError
from optsim.scene import load_scene
from optsim.scene.keyframed import Keyframed

SCENE = """
name = "dropped"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -3, 1]
target_m = [0, 0, 0.4]
[materials]
a = { reflectance = 0.5 }
[lamps.a]
center_m = [0, 0, 4]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 5.0
[objects.floor]
kind = "quad"
material = "a"
corner_m = [-9, -9, 0]
edge_u_m = [18, 0, 0]
edge_v_m = [0, 18, 0]
[populate.thing]
count = [4, 4]
region_m = [[-0.8, -0.6, 0.5], [0.8, 0.6, 1.2]]
size_m = [0.15, 0.3]
materials = ["a"]
speed_m_s = [0.2, 1.0]
spin_hz = [0.2, 1.0]
moving_share = 0.5
physics = true
"""


@pytest.fixture
def dropped(tmp_path):
    pytest.importorskip("mujoco")
    from optsim.core.files import write_json
    from optsim.scene.physics import drop

    def made(text=SCENE, variation="1", duration_s=1.5, rate_hz=200.0):
        (tmp_path / "scene.toml").write_text(text)
        record = drop(tmp_path, variation, duration_s, rate_hz)
        write_json(tmp_path / "physics" / f"{variation}.json", record)
        return record, load_scene(tmp_path, variation)

    made.folder = tmp_path
    return made


def lowest(scene, key, time_s):
    return min(scene.singles()[f"{key}_a"].vertices(time_s)[:, 2])


def test_bodies_fall_as_galileo_says_and_come_to_rest_on_the_floor(dropped):
    text = SCENE.replace("[0.2, 1.0]\nmoving", "[0.0, 0.0]\nmoving").replace("speed_m_s = [0.2, 1.0]", "")
    record, scene = dropped(text, duration_s=3.0)
    assert set(record["movers"]) == {f"thing_{k}" for k in range(4)}
    for key, mover in record["movers"].items():
        fall = np.array(mover["positions_m"])[:, 2]
        times = np.array(mover["times_s"])
        # A body with its bounding sphere above the floor has met nothing, unless another one is below.
        free = times < 0.6 * np.sqrt(2 * lowest(scene, key, 0.0) / 9.81)
        assert free.sum() > 20
        np.testing.assert_allclose(
            fall[free], -9.81 / 2 * times[free] ** 2, atol=9.81 * times[free].max() * 1e-4
        )
        assert min(lowest(scene, key, t) for t in np.arange(0, 3, 0.03)) > -2e-3
        if scene.objects[key].shape in ("box", "slab", "column"):
            assert abs(lowest(scene, key, 3.0)) < 2e-4
            np.testing.assert_allclose(
                scene.movers[key].positions_m[-40], mover["positions_m"][-1], atol=1e-3
            )


@pytest.mark.parametrize("share", [0.05, 0.3, 0.7, 0.9])
def test_a_ball_bounces_with_the_stated_share_of_its_speed(dropped, share):
    text = SCENE.replace("count = [4, 4]", f'count = [1, 1]\nshapes = ["ball"]\nrestitution = {share}')
    text = text.replace("speed_m_s = [0.2, 1.0]", "").replace("spin_hz = [0.2, 1.0]", "")
    record, _ = dropped(text, duration_s=0.8, rate_hz=2000.0)
    speed = np.diff(np.array(record["movers"]["thing_0"]["positions_m"])[:, 2]) * 2000
    impact = int(np.argmin(speed))
    assert -speed[impact:].max() / speed[impact] == pytest.approx(share, abs=0.01)


def test_the_same_number_falls_the_same_way_and_another_otherwise(dropped):
    first, _ = dropped()
    again, scene = dropped()
    assert json.dumps(first) == json.dumps(again)
    assert dropped(variation="2")[0]["movers"] != first["movers"]
    # Some stand still before they fall, others are thrown.
    speeds = [
        np.linalg.norm(np.diff(mover["positions_m"][:2], axis=0)[0, :2]) * 200
        for mover in first["movers"].values()
    ]
    assert min(speeds) < 1e-6
    assert max(speeds) > 0.15
    rest = scene.objects["thing_0"].mesh().vertices_m
    moved = scene.movers["thing_0"].placed(rest, 0.3123)
    np.testing.assert_allclose(
        np.linalg.norm(moved[1:] - moved[0], axis=1), np.linalg.norm(rest[1:] - rest[0], axis=1), atol=1e-9
    )


def test_a_set_needs_no_engine_and_poses_belong_to_their_objects(dropped, monkeypatch):
    dropped()
    folder = dropped.folder
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert load_scene(folder, "1").movers["thing_1"].rotations_wxyz
    with pytest.raises(ConfigError, match=r"got no poses in .*cure: optsim scene drop .* --variation 2"):
        load_scene(folder, "2")
    (folder / "scene.toml").write_text(SCENE.replace("[0.15, 0.3]", "[0.15, 0.31]"))
    with pytest.raises(ConfigError, match="got poses of other objects in"):
        load_scene(folder, "1")
    from optsim.scene.physics import drop

    with pytest.raises(ConfigError, match=r"got no MuJoCo; cure: pip install 'optsim\[physics\]'"):
        drop(folder, "1", 1.0, 100.0)


def test_without_such_a_population_nothing_falls(dropped):
    with pytest.raises(ConfigError, match="got none with physics = true"):
        dropped(SCENE.replace("physics = true", ""))


def test_motion_that_the_engine_cannot_follow_is_refused_and_leaves_no_log(dropped, monkeypatch):
    monkeypatch.chdir(dropped.folder)
    with pytest.raises(ConfigError, match="motion that MuJoCo can't follow from 0 s on"):
        dropped(SCENE.replace("spin_hz = [0.2, 1.0]", "spin_hz = [1e6, 2e6]"), duration_s=0.1)
    assert not list(dropped.folder.glob("*.TXT"))


def test_turns_go_the_short_way_at_a_steady_rate():
    ends = Rotation.from_rotvec([[0, 0, 0], [0, 0, 1.2]]).as_quat()[:, [3, 0, 1, 2]]
    motion = Keyframed(
        objects=("a",),
        times_s=(0.0, 2.0),
        rotations_wxyz=(tuple(ends[0]), tuple(-ends[1])),
        pivot_m=(1, 0, 0),
    )
    for time_s, angle in ((-1, 0), (0.5, 0.3), (2, 1.2), (9, 1.2)):
        (place,) = motion.placed(np.array([[2.0, 0, 0]]), time_s)
        np.testing.assert_allclose(place, [1 + np.cos(angle), np.sin(angle), 0], atol=1e-12)
    for bad, message in (((2.0, 0, 0, 0), "not of length 1"), ((1.0, 0, 0, 0), "got 1 values for 2")):
        with pytest.raises(ValueError, match=message):
            Keyframed(objects=("a",), times_s=(0.0, 2.0), rotations_wxyz=(bad,) * (2 if bad[0] == 2 else 1))


@pytest.mark.parametrize("variation", ["5:3", "a:4", "4:"])
def test_a_bad_range_is_said(tmp_path, variation):
    from optsim.app.scene import drop

    with pytest.raises(ConfigError, match=r"--variation: got .*, expected FIRST:LAST"):
        drop(tmp_path, variation)
