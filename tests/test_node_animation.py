"""glTF's own animation: each kind of keyframes by its formula, down the tree of nodes, as movers."""

import base64
import json
from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from benchmarks.own_world import make_own_world
from optsim.core.errors import ConfigError, OptsimError
from optsim.core.quantities import View
from optsim.render import render_passes
from optsim.render.backend import choose_backend
from optsim.scene import load_scene
from optsim.scene.models import read_model

SCENE = """
name = "animated"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -8, 0.5]
target_m = [0, 0, 0.5]
[materials.grey]
[lamps.a]
center_m = [0, -1, 3]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 8.0
[movers.arm]
kind = "mesh"
file = "arm.gltf"
animation = "play"
anchor = "origin"
"""
TURNING = [f"mover/engine-{part}" for part in range(0, 100, 10)]
POINTS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
LIFT = np.array([0, 0, 5])
HALF = np.sqrt(0.5)


def gltf(path, channels):
    """A triangle in a node "tip" below a node "arm" that is shifted by LIFT; keyframes at 0, 1 and 3 s."""
    blobs, accessors = [], []

    def accessor(array, kind, component=5126):
        blobs.append(np.ascontiguousarray(array).tobytes())
        accessors.append(
            {"bufferView": len(accessors), "componentType": component, "count": len(array), "type": kind}
        )
        return len(accessors) - 1

    points = accessor(POINTS, "VEC3")
    faces = accessor(np.array([0, 1, 2], np.uint16), "SCALAR", 5123)
    times = accessor(np.array([0, 1, 3], np.float32), "SCALAR")
    samplers, targets = [], []
    for node, name, kind, values in channels:
        width = "VEC4" if name == "rotation" else "VEC3"
        values = np.asarray(values, np.float32)
        samplers.append({"input": times, "output": accessor(values, width), "interpolation": kind})
        targets.append({"sampler": len(samplers) - 1, "target": {"node": node, "path": name}})
    starts = np.cumsum([0, *map(len, blobs)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(blob)}
        for start, blob in zip(starts, blobs, strict=False)
    ]
    uri = "data:application/octet-stream;base64," + base64.b64encode(b"".join(blobs)).decode()
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"name": "arm", "children": [1], "translation": [0, 0, 5]},
            {"name": "tip", "mesh": 0},
            {"matrix": [1.0, 0, 0, 0] * 4},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": points}, "indices": faces}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"uri": uri, "byteLength": starts[-1]}],
    }
    if channels:
        header["animations"] = [{"samplers": samplers, "channels": targets}]
    path.write_text(json.dumps(header))
    return path


TURN = (0, "rotation", "LINEAR", [[0, 0, 0, 1], [0, 0, HALF, HALF], [0, 0, HALF, HALF]])
SHIFT = (1, "translation", "STEP", [[0, 0, 0], [2, 0, 0], [4, 0, 0]])
GROW = (
    1,
    "scale",
    "CUBICSPLINE",
    [[0] * 3, [1] * 3, [0] * 3, [0] * 3, [3] * 3, [0] * 3, [0] * 3, [3] * 3, [0] * 3],
)


def z_turned(points, angle):
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


def test_without_time_it_stands_as_trimesh_puts_it(tmp_path):
    model = read_model(gltf(tmp_path / "arm.gltf", [TURN]))
    np.testing.assert_allclose(model.vertices(0, 0.0), model.parts[0][1].vertices_m, atol=1e-6)


@pytest.mark.parametrize("time", [0.0, 0.25, 0.5, 1.0, 2.0, 9.0])
def test_a_rotation_goes_along_the_great_circle(tmp_path, time):
    model = read_model(gltf(tmp_path / "arm.gltf", [TURN]))
    angle = np.pi / 2 * min(time, 1)
    np.testing.assert_allclose(model.vertices(0, time), z_turned(POINTS, angle) + LIFT, atol=1e-6)


@pytest.mark.parametrize(("time", "shift"), [(0.0, 0), (0.99, 0), (1.0, 2), (2.5, 2), (3.0, 4)])
def test_steps_stay_until_the_next_keyframe(tmp_path, time, shift):
    model = read_model(gltf(tmp_path / "arm.gltf", [SHIFT]))
    np.testing.assert_allclose(model.vertices(0, time), POINTS + LIFT + np.array([shift, 0, 0]), atol=1e-6)


def test_a_spline_with_flat_tangents_is_hermites(tmp_path):
    model = read_model(gltf(tmp_path / "arm.gltf", [GROW]))
    for time in (0.25, 0.5, 0.75):
        size = 1 + 2 * (3 * time**2 - 2 * time**3)
        np.testing.assert_allclose(model.vertices(0, time), size * POINTS + LIFT, atol=1e-6)


def test_a_spline_with_tangents_is_scipys(tmp_path):
    """Tangents are per second (glTF 2.0, appendix C): the second interval is two seconds long."""
    into, keys, out = np.random.default_rng(3).uniform(-2, 2, (3, 3, 3))
    spline = (1, "translation", "CUBICSPLINE", np.stack([into, keys, out], axis=1).reshape(9, 3))
    model = read_model(gltf(tmp_path / "arm.gltf", [spline]))
    for first, (start, stop) in enumerate(((0.0, 1.0), (1.0, 3.0))):
        pair = slice(first, first + 2)
        theirs = CubicHermiteSpline([start, stop], keys[pair], [out[first], into[first + 1]])
        for time in np.linspace(start, stop, 7)[:-1]:
            np.testing.assert_allclose(model.vertices(0, time), POINTS + LIFT + theirs(time), atol=1e-5)


def test_a_child_moves_in_its_parents_frame(tmp_path):
    model = read_model(gltf(tmp_path / "arm.gltf", [TURN, SHIFT]))
    expected = z_turned(POINTS + np.array([2, 0, 0]), np.pi / 2) + LIFT
    np.testing.assert_allclose(model.vertices(0, 1.0), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "time", "place"), [("", 3.5, 0.5), ("speed = 2", 0.25, 0.5), ("repeat = false", 9, 3)]
)
def test_a_mover_plays_it_in_the_scenes_frame(tmp_path, keys, time, place):
    gltf(tmp_path / "arm.gltf", [TURN])
    (tmp_path / "scene.toml").write_text(f"{SCENE}{keys}\n")
    (mover,) = load_scene(tmp_path).singles().values()
    x, y, z = (z_turned(POINTS, np.pi / 2 * min(place, 1)) + LIFT).T
    # y is up in the file, z in the scene.
    np.testing.assert_allclose(mover.vertices(time), np.stack([x, -z, y], axis=1), atol=1e-6)
    np.testing.assert_array_equal(mover.rest().vertices_m, mover.vertices(0.0))


def test_what_an_animation_leaves_alone_stands_still(tmp_path):
    """Each tenth of 100 parts turns about its own axis; 90 stand still."""
    scene = make_own_world(tmp_path)
    movers = {name: mover for name, mover in scene.singles().items() if name.startswith("engine")}
    turning = sorted(item.part for mover in movers.values() for item in mover.items)
    assert len(turning) == 10
    assert len(movers) == 10
    still = [item.part for name, item in scene.objects.items() if name.startswith("engine")]
    assert sorted([*turning, *still]) == list(range(100))
    assert {owner for part, owner in scene.owners.items() if "/engine" in part} == {"mover/engine"}
    for mover in movers.values():
        rests = [item.mesh().vertices_m for item in mover.items]
        np.testing.assert_allclose(mover.rest().vertices_m, np.concatenate(rests), atol=1e-6)
        for first, last in pairwise(np.cumsum([0, *map(len, rests)])):
            before, after = (mover.vertices(time)[first:last] for time in (0.0, 0.25))
            assert np.abs(before - after).max() > 0.01
            np.testing.assert_allclose(before.mean(axis=0), after.mean(axis=0), atol=1e-6)


def test_passes_of_a_model_that_moves_in_part(tmp_path):
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    scene = make_own_world(tmp_path)
    passes = render_passes(scene, View(rows=60, cols=80, samples_per_pitch=1, tan_half_width=0.3), 0.1, 0.01)
    numbers = {part: number for number, (_, part) in passes.part_table.items()}
    (engine,) = (number for number, name in passes.id_table.items() if name == "mover/engine")
    shown, turning = passes.ids == engine, np.isin(passes.parts, [numbers[name] for name in TURNING])
    assert shown.sum() > 300
    assert 20 < turning.sum() < shown.sum() / 3
    np.testing.assert_array_equal(passes.moving & shown, turning)
    assert not passes.flow_forward_px[shown & ~turning].any()
    # As a whole it isn't rigid; each turning part is.
    assert passes.object_poses["mover/engine"].matrices is None
    assert all(passes.object_poses[name].matrices is not None for name in TURNING)


def test_a_part_that_is_played_away_from_its_rest_is_a_mover(tmp_path):
    """Its keyframes are all alike, but not where the file puts it."""
    model = read_model(gltf(tmp_path / "arm.gltf", [(1, "translation", "LINEAR", [[2, 0, 0]] * 3)]))
    assert [*model.moving_parts()] == [0]
    model = read_model(gltf(tmp_path / "arm.gltf", [(0, "translation", "LINEAR", [[0, 0, 5]] * 3)]))
    assert [*model.moving_parts()] == []
    flat = [[0, 0, 0], [0, 0, 5], [0, 0, 0]] * 3
    bent = [[0, 0, 0], [0, 0, 5], [0, 0, 1], *flat[3:]]
    for values, moving in ((flat, []), (bent, [0])):
        channel = (0, "translation", "CUBICSPLINE", values)
        assert [*read_model(gltf(tmp_path / "arm.gltf", [channel])).moving_parts()] == moving


@pytest.mark.parametrize(
    ("channels", "keys", "message"),
    [
        ([], "", "the nodes of arm.gltf rest"),
        ([(0, "rotation", "LINEAR", [[0, 0, 0, 1]] * 3)], "", "the nodes of arm.gltf rest"),
        ([TURN], "spin_hz = 2.0", r"movers\.arm\.spin_hz: got it beside an animation"),
        ([(0, "rotation", "LINEAR", [[0, 0, 0, np.nan]] * 3)], "", "arm.gltf cannot be read"),
        ([(0, "rotation", "LINEAR", [[0, 0, 0, 1]] * 2)], "", "arm.gltf cannot be read"),
        ([(0, "rotation", "LINEAR", [[0, 0, 0, 1], [0] * 4, [0, 0, 0, 1]])], "", "a rotation is 0"),
        ([(1, "scale", "BEZIER", [[1, 1, 1]] * 3)], "", "its interpolation is 'BEZIER'"),
        ([(2, "rotation", "LINEAR", [[0, 0, 0, 1]] * 3)], "", r"nodes\[2\] has a matrix, which anim"),
    ],
)
def test_what_does_not_play_is_said(tmp_path, channels, keys, message):
    gltf(tmp_path / "arm.gltf", channels)
    (tmp_path / "scene.toml").write_text(f"{SCENE}{keys}\n")
    with pytest.raises(OptsimError, match=message):
        load_scene(tmp_path)


def test_only_play_is_known(tmp_path):
    gltf(tmp_path / "arm.gltf", [TURN])
    (tmp_path / "scene.toml").write_text(SCENE.replace('"play"', '"first"'))
    with pytest.raises(ConfigError, match="got 'first', expected \"play\""):
        load_scene(tmp_path)
