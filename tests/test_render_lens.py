"""The lens in the renderer: the same light, spread and bent as closed forms say; movers out of focus."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from scipy import stats

from optsim.core.cache import Cache
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, choose_backend, render_passes, render_truth
from optsim.render.backend import activate
from optsim.render.footprint import path_px, project
from optsim.render.gbuffer import sample_rays
from optsim.render.lens import distorted, ideal, margin_px, touched, undistorted
from optsim.render.plan import RenderPlan, seed_of
from optsim.render.reprojection import KeyPoseLight
from optsim.render.stage import RenderStage
from optsim.scene import Scene

VIEW = View(18, 24, 3, 0.3)
# Focused at half the distance of what it looks at, which is spread over 6 samples.
DEFOCUSED = replace(VIEW, aperture_m=0.6, focus_m=2.0)
BENT = replace(VIEW, distortion=-0.08)
BOTH = replace(DEFOCUSED, distortion=-0.08)
PIXELS = np.arange(VIEW.rows * VIEW.cols)


@pytest.fixture(autouse=True)
def vectorised():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def room(**more: object) -> Scene:
    """A matt striped ball swings between us and a striped wall, lit from beside us."""
    stripes = {"reflectance": 0.8, "texture": "checker", "tile_m": 2.0}
    table: dict[str, object] = {
        "name": "room",
        "white_w_m2_sr": 1.0,
        "max_depth": 3,
        "camera": {"position_m": (0.0, 0.0, 1.0), "target_m": (0.0, 4.0, 1.0)},
        "materials": {"matt": stripes},
        "lamps": {
            "lamp": {
                "center_m": (1.5, -1.0, 3.0),
                "edge_u_m": (1.0, 0.0, 0.0),
                "edge_v_m": (0.0, -0.7, -0.7),
                "radiance_w_m2_sr": 20.0,
            }
        },
        "objects": {
            "wall": {
                "kind": "quad",
                "material": "matt",
                "corner_m": (-4.0, 5.5, -3.0),
                "edge_u_m": (8.0, 0.0, 0.0),
                "edge_v_m": (0.0, 0.0, 8.0),
            }
        },
        "movers": {
            "ball": {
                "kind": "pendulum",
                "pivot_m": (0.0, 4.0, 2.2),
                "length_m": 1.2,
                "bob_radius_m": 0.45,
                "swing_rad": 0.5,
                "material": "matt",
            }
        },
    }
    return Scene.model_validate(table | more)


def test_a_pinhole_neither_focuses_nor_takes_random_numbers():
    scene = room()
    plain = RenderStage(scene, VIEW).radiance(PIXELS, 4, (1,))
    focused = RenderStage(scene, replace(VIEW, focus_m=1.0, defocus_per_m=1.0)).radiance(PIXELS, 4, (1,))
    np.testing.assert_allclose(focused, plain, rtol=1e-6)
    tiny = RenderStage(scene, replace(VIEW, aperture_m=1e-6)).radiance(PIXELS, 4, (1,))
    changed = np.mean(np.abs(tiny - plain) > 1e-3 * plain)
    assert changed > 0.1, "a lens takes two more of a path's random numbers"


def test_constant_radiance_stays_what_it_is():
    """Every path ends in a lamp as wide as the field, wherever on the lens it began."""
    lamp = {
        "center_m": (0.0, 3.0, 1.0),
        "edge_u_m": (40.0, 0.0, 0.0),
        "edge_v_m": (0.0, 0.0, 40.0),
        "radiance_w_m2_sr": 3.0,
    }
    scene = room(lamps={"lamp": lamp}, objects={}, movers={})
    for view in (DEFOCUSED, BENT, BOTH, replace(BOTH, distortion=0.1)):
        np.testing.assert_allclose(RenderStage(scene, view).radiance(PIXELS, 8, (1,)), 3.0, rtol=1e-6)


@pytest.mark.parametrize("k", [-0.1, -0.01, 0.1])
def test_the_ideal_grid_holds_the_picture_and_goes_there_and_back(k):
    view = replace(VIEW, distortion=k)
    row, col = np.indices((view.rows + 1, view.cols + 1)).reshape(2, -1).astype(float)
    there = undistorted(row, col, view)
    np.testing.assert_allclose(distorted(*there, view), (row, col), atol=1e-6)
    grid, margin = ideal(view), margin_px(view)
    for place, n in zip(there, (grid.rows, grid.cols), strict=True):
        assert place.min() + margin >= 0
        assert place.max() + margin <= n
    # The corner of the ideal image lands k of half the diagonal away from the grid's.
    end = distorted(np.array(float(view.rows)), np.array(float(view.cols)), view)
    shift = np.hypot(end[0] - view.rows, end[1] - view.cols) * np.sign(end[0] - view.rows)
    assert shift == pytest.approx(k * np.hypot(view.rows, view.cols) / 2)


@pytest.mark.parametrize("view", [DEFOCUSED, BENT, BOTH, replace(DEFOCUSED, distortion=0.1)])
def test_a_footprint_holds_all_that_is_seen_of_a_mover(view, tmp_path):
    """First surfaces through the whole lens: none on the ball outside its footprint."""
    scene, view = room(), replace(view, rows=3 * view.rows, cols=3 * view.cols)
    pixels = np.arange(view.rows * view.cols)
    plan = RenderPlan(
        scene, view, Timing(1 / 180, 4, 1), RenderSettings(), None, Cache(tmp_path), _silent, "test"
    )
    stage, n = RenderStage(scene, view), np.full(len(pixels), 256)
    for time_s in (0.0, 0.4):
        stage.pose(time_s)
        looks = stage.hits(pixels, n, np.full(len(pixels), 3), light=False)
        seen = (looks.shape == stage.shape_of("ball")).reshape(len(pixels), -1).any(axis=1)
        own = plan.own(time_s).ravel()
        assert seen.any()
        assert not (seen & ~own).any()
        sharp = replace(plan, view=replace(view, aperture_m=0.0)).own(time_s).ravel()
        assert not (sharp & ~own).any()
        assert own.mean() < 0.75


def _silent(*_: object) -> None: ...


def test_samples_touched_are_those_around_the_nearest():
    view = replace(View(60, 80, 1, 0.3), distortion=-0.1)
    grid = ideal(view)
    mask = np.zeros((grid.rows, grid.cols), bool)
    mask[10, 12] = True
    row, col = np.nonzero(touched(mask, view))
    back = distorted(np.array(10.5 - margin_px(view)), np.array(12.5 - margin_px(view)), view)
    assert np.abs(row + 0.5 - back[0]).max() < 2.5
    assert np.abs(col + 0.5 - back[1]).max() < 2.5
    assert touched(mask, VIEW) is mask


def test_paths_of_a_key_are_sorted_by_place():
    """Two samples, two halves; paths seen in samples (5, 7), (5, 8) and nowhere."""
    numbers = np.arange(6)
    values = numbers.astype(np.float32)
    key = KeyPoseLight((0, 0), (1, 2), np.array([0, 2, 3, 4, 6]), numbers, values, values + 1, values + 2)
    row = np.array([0.5, 0.2, np.nan, 0.9, -1.5, 9e9])
    col = np.array([2.5, -1.2, np.nan, 2.1, 2.0, 0.0])
    found = key.by_place(row, col)
    assert (found.corner, found.size) == ((-2, -2), (3, 5))
    samples = np.repeat(np.arange(30), np.diff(found.first))
    # Half A: paths 0 and 1; half B: 3 and 4.
    expected = {0: 2 * 5 + 4, 1: 2 * 5 + 0, 3: 15 + 2 * 5 + 4, 4: 15 + 0 * 5 + 4}
    assert dict(zip(found.shape.tolist(), samples.tolist(), strict=True)) == expected
    assert found.light.tolist() == (found.shape + 2).tolist()
    nothing = key.by_place(np.full(6, np.nan), np.full(6, np.nan))
    assert len(nothing.shape) == 0
    assert nothing.first.tolist() == [0]


def test_what_defocus_brings_into_the_picture_has_a_way():
    """A point 2 samples beside the picture moves; through a lens that spreads it over 6 it is seen."""
    camera = room().camera
    places = {0.0: np.array([[1.4, 4.0, 1.0]]), 1.0: np.array([[1.4, 4.0, 1.2]])}
    assert 1.5 < project(places[0.0], camera, VIEW)[0, 1] - VIEW.cols < 2.5
    assert path_px(places.__getitem__, (0.0, 1.0), camera, VIEW) == 0
    assert path_px(places.__getitem__, (0.0, 1.0), camera, DEFOCUSED) == pytest.approx(2.0, rel=1e-6)


def test_chief_rays_and_passes_agree_with_the_sensor():
    """Points of the passes, put back by depth, k1, intrinsics and pose, are where distorted rays end."""
    scene, view = room(), BENT
    passes = render_passes(scene, view, 0.1, 1 / 180)
    k = passes.intrinsics_px
    row, col = (axis.ravel() for axis in np.indices((view.rows, view.cols)) + 0.5)
    y, x = (row - k[1, 2]) / k[1, 1], (col - k[0, 2]) / k[0, 0]
    # OpenCV's way back: r = q (1 + k1 q^2) by fixed-point iteration.
    u, v = x, y
    for _ in range(200):
        scale = 1 + passes.radial_k1 * (u**2 + v**2)
        u, v = x / scale, y / scale
    directions = sample_rays(view)
    np.testing.assert_allclose(directions[:, 0] / directions[:, 2], u, atol=1e-6)
    np.testing.assert_allclose(directions[:, 1] / directions[:, 2], v, atol=1e-6)
    points = np.stack([u, v, np.ones_like(u)], -1) * passes.depth_m.ravel()[:, None].astype(np.float64)
    world = points @ passes.camera_to_world[1, :3, :3].T + passes.camera_to_world[1, :3, 3]
    on_wall = passes.ids.ravel() == next(n for n, name in passes.id_table.items() if name == "object/wall")
    assert on_wall.sum() > 100
    np.testing.assert_allclose(world[on_wall, 1], 5.5, rtol=1e-5)
    # What rests has no flow, distorted or not; what moves has, and is found again.
    assert np.abs(passes.flow_forward_px.reshape(-1, 2)[on_wall]).max() < 1e-4
    # The ball's points, carried by its own pose and projected by intrinsics and k1, are where its flow says.
    on_ball = passes.ids.ravel() == next(n for n, name in passes.id_table.items() if name == "mover/ball")
    poses = passes.object_poses["mover/ball"].matrices
    assert poses is not None
    way = poses[2] @ np.linalg.inv(poses[1])
    carried = world[on_ball] @ way[:3, :3].T + way[:3, 3]
    there = (carried - passes.camera_to_world[2, :3, 3]) @ passes.camera_to_world[2, :3, :3]
    u, v = there[:, 0] / there[:, 2], there[:, 1] / there[:, 2]
    scale = 1 + passes.radial_k1 * (u**2 + v**2)
    place = np.stack([k[1, 1] * v * scale + k[1, 2], k[0, 0] * u * scale + k[0, 2]], axis=-1)
    flow = passes.flow_forward_px.reshape(-1, 2)[on_ball]
    np.testing.assert_allclose(flow, place - np.stack([row, col], axis=-1)[on_ball], atol=2e-4)
    assert np.abs(flow).max() > 0.05
    # Defocus is not in them.
    sharp = render_passes(scene, BOTH, 0.1, 1 / 180)
    np.testing.assert_array_equal(sharp.depth_m, passes.depth_m)


def test_whole_samples_of_a_picture_are_bent_like_its_rays():
    """Mitsuba's own loop, resampled, against rays: at edges they differ by half a sample, not by several."""
    scene = room(movers={})
    view = replace(View(90, 120, 1, 0.3), distortion=-0.08)
    pixels = np.arange(view.rows * view.cols)
    rays = RenderStage(scene, view).radiance(pixels, 64, (1,))[0].reshape(view.rows, view.cols)
    loop = RenderStage(scene, view).picture(64, 1)
    straight = RenderStage(scene, replace(view, distortion=0.0)).picture(64, 1)
    assert np.std(rays - loop) < 0.5 * np.std(rays - straight)


@pytest.mark.parametrize(("view", "sorts"), [(VIEW, False), (DEFOCUSED, True), (BENT, True)])
def test_what_movers_carry_is_sorted_by_place_only_behind_a_lens(view, sorts, tmp_path):
    """A pinhole's paths belong to the sample in which the point that they meet is seen."""
    coarse = RenderSettings(static_error=0.5, change_error=0.5, moving_error=0.5, slots_per_segment=2)
    with mock.patch.object(
        KeyPoseLight, "by_place", autospec=True, side_effect=KeyPoseLight.by_place
    ) as by_place:
        render_truth(room(), view, Timing(1 / 180, 2, 1), coarse, cache=Cache(tmp_path))
    assert (by_place.call_count > 0) == sorts


# Right code fails once in 10 000 versions of its random numbers.
FALSE_ALARM = 1e-4


@pytest.mark.parametrize("view", [DEFOCUSED, BOTH])
def test_truth_by_differences_is_what_a_plain_path_tracer_sees_of_a_mover_out_of_focus(view, tmp_path):
    """Mean over 12 slots in regions, against plain paths at 48 poses: no differences, no carried light."""
    scene, timing = room(), Timing(1 / 60, 12, 1)
    settings = RenderSettings(
        static_error=0.03, change_error=0.1, moving_error=0.1, interpolation_error=0.02, slots_per_segment=2
    )
    video = render_truth(scene, view, timing, settings, cache=Cache(tmp_path))
    noise = video.half_difference
    assert noise is not None
    light, half_difference = (
        np.mean([each.instant(i).ravel() for _, s in film.segments(0, 12) for each, i in _all(s)], axis=0)
        for film in (video, noise)
    )
    plain, poses, samples = RenderStage(scene, view), 48, 64
    images = np.empty((2, poses, len(PIXELS)))
    for pose in range(poses):
        plain.pose((pose + 0.5) / poses * timing.n_slots * timing.slot_s)
        images[:, pose] = plain.radiance(PIXELS, samples, (seed_of("A", pose), seed_of("B", pose)))
    about = images.mean(axis=(0, 1))
    variance = ((images[0] - images[1]) ** 2).sum(axis=0) / (2 * poses) ** 2 + half_difference**2
    y, x = np.indices((view.rows, view.cols)) // 6
    regions = [((y == i) & (x == j)).ravel() for i in range(3) for j in range(4)]
    limit = stats.t.isf((1 - (1 - FALSE_ALARM) ** (1 / len(regions))) / 2, 20)
    for region in regions:
        # 0.3 % for interpolation between poses and keys, which the settings allow 2 % in each sample.
        slack = 3e-3 * about[region].sum()
        error = (light - about)[region].sum() / np.sqrt(variance[region].sum() + slack**2)
        assert abs(error) < limit


def _all(segment):
    return [(segment, index) for index in range(segment.n_instants)]
