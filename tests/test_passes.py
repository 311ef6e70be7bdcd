"""Depth, ids, flow and poses agree with each other, with the renderer and with closed forms."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter

from optsim.core.quantities import View
from optsim.render import PassRenderer, choose_backend, render_passes
from optsim.render.backend import activate
from optsim.render.first_hit import first_hit
from optsim.render.flow import rigid_motion
from optsim.render.footprint import cover
from optsim.render.stage import RenderStage
from optsim.scene import Scene, list_scenes, load_scene

VIEW = View(72, 96, 3, 0.32)
TIME_S, STEP_S = 0.11, 1 / 180


@pytest.fixture(scope="module", params=list_scenes())
def frames(request):
    """A shipped scene with the passes of two successive instants."""
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    scene = load_scene(request.param).in_band()
    renderer = PassRenderer(scene, VIEW)
    return scene, renderer.at(TIME_S, STEP_S), renderer.at(TIME_S + STEP_S, STEP_S)


def centres(view=VIEW):
    """Rows and columns of the sample centres, (2, y, x)."""
    return np.indices((view.rows, view.cols)) + 0.5


def world_points(passes, pose=1):
    """Back-project depth by intrinsics and pose alone, (y, x, 3)."""
    row, col = centres(View(*passes.ids.shape, 1, 1.0))
    k = passes.intrinsics_px
    x, y = (col - k[0, 2]) / k[0, 0], (row - k[1, 2]) / k[1, 1]
    points = np.stack([x, y, np.ones_like(x)], -1) * passes.depth_m[..., None].astype(np.float64)
    matrix = passes.camera_to_world[pose]
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def place_px(points_m, matrix, intrinsics):
    """Project points: (row, column, depth), shape (..., 3)."""
    col, row, depth = np.moveaxis((points_m - matrix[:3, 3]) @ matrix[:3, :3] @ intrinsics.T, -1, 0)
    depth = np.where(depth > 0, depth, np.nan)
    return np.stack([row / depth, col / depth, depth], -1)


def of_one_object(ids):
    """Samples whose eight neighbours are all of their object."""
    inside = minimum_filter(ids, 3) == maximum_filter(ids, 3)
    inside[[0, -1]] = inside[:, [0, -1]] = False
    return inside


def carried_rigidly(passes, to):
    """Surface points at t- (0) or t+ (2) by object poses alone, and where these say anything."""
    points, known = world_points(passes), passes.ids > 0
    for number, name in passes.id_table.items():
        if name in passes.object_poses:
            mine, pose = passes.ids == number, passes.object_poses[name]
            if pose.matrices is None:
                known &= ~mine
            else:
                motion = pose.matrices[to] @ np.linalg.inv(pose.matrices[1])
                points[mine] = points[mine] @ motion[:3, :3].T + motion[:3, 3]
    return points, known


@pytest.mark.parametrize("way", ["forward", "backward"])
def test_flow_agrees_with_depth_and_poses(frames, way) -> None:
    """For still and rigid objects depth, intrinsics and poses say the flow by themselves."""
    _, passes, _ = frames
    to = {"forward": 2, "backward": 0}[way]
    flow = getattr(passes, f"flow_{way}_px")
    points, known = carried_rigidly(passes, to)
    place = place_px(points, passes.camera_to_world[to], passes.intrinsics_px)
    expected = place[..., :2] - np.moveaxis(centres(), 0, -1)
    assert known.mean() > 0.3
    np.testing.assert_allclose(flow[known], expected[known], atol=2e-3)


def test_warping_by_the_flow_gives_the_next_instant(frames) -> None:
    """Ids, albedo and depth of frame t + 1 at the flowed place are those of frame t, but at edges."""
    _, now, then = frames
    visible = ~now.occluded_forward
    assert visible[now.ids > 0].mean() > 0.95
    row, col = (np.floor(centres()[i] + now.flow_forward_px[..., i]).astype(int) for i in (0, 1))
    assert row[visible].min() >= 0
    assert row[visible].max() < VIEW.rows
    assert col[visible].min() >= 0
    assert col[visible].max() < VIEW.cols
    # The nearest sample may be half a pixel away: only where all samples around are of one object.
    inside = of_one_object(then.ids)
    at = (row[visible], col[visible])
    calm = inside[at]
    assert calm.mean() > 0.3
    same = then.ids[at] == now.ids[visible]
    assert same[calm].mean() > 0.998
    assert same.mean() > 0.985

    def between(before, after, slack):
        low, high = minimum_filter(after, 3)[at][calm], maximum_filter(after, 3)[at][calm]
        return (before[calm] >= low - slack) & (before[calm] <= high + slack)

    # Minimum and maximum of neighbours bound texture only where it is coarser than the grid.
    assert between(now.albedo[visible], then.albedo, 0.02).mean() > 0.95
    points, known = carried_rigidly(now, 2)
    depth = place_px(points, now.camera_to_world[2], now.intrinsics_px)[..., 2]
    bounded = between(depth[visible], then.depth_m, 1e-4 * depth[visible][calm])
    assert bounded[known[visible][calm]].mean() > 0.995


def test_forward_then_backward_returns(frames) -> None:
    """The next frame's backward flow, at the flowed place, leads back: for deforming objects too."""
    _, now, then = frames
    place = np.moveaxis(centres(), 0, -1) + now.flow_forward_px
    visible = ~now.occluded_forward & (now.ids > 0)
    nearest = [np.where(visible, np.floor(place[..., axis]), 0).astype(int) for axis in (0, 1)]
    use = visible & of_one_object(then.parts)[*nearest] & (then.parts[*nearest] == now.parts)
    # Across an edge of a box its flow has a kink.
    turns = maximum_filter(then.normal, (3, 3, 1)) - minimum_filter(then.normal, (3, 3, 1))
    use &= (turns.max(axis=-1) < 0.5)[*nearest]
    assert use.mean() > 0.3
    spots = place[use].T - 0.5
    back = np.stack([map_coordinates(then.flow_backward_px[..., i], spots, order=1) for i in (0, 1)], -1)
    error = np.hypot(*(now.flow_forward_px[use] + back).T)
    length = np.hypot(*now.flow_forward_px[use].T)
    # Between samples the flow of a rotation is linear; of parts that pass before each other it isn't.
    slack = 0.02 + 0.01 * length
    moving = now.moving[use]
    for who in (moving, ~moving):
        assert not who.any() or (error < slack)[who].mean() > 0.97
    assert then.occluded_backward[*nearest][use].mean() < 0.02


def test_depth_back_projects_onto_the_renderers_hits(frames) -> None:
    """Mitsuba's own camera rays meet the surfaces where intrinsics, pose and depth say."""
    import mitsuba as mi

    scene, _, _ = frames
    # The sensor is loaded at time 0.
    passes = render_passes(scene, VIEW, 0.0, STEP_S)
    stage = RenderStage(scene, VIEW)
    row, col = (values.ravel().astype(np.float32) for values in centres())
    spot = mi.Point2f(mi.Float(col / VIEW.cols), mi.Float(row / VIEW.rows))
    ray, _ = stage.loaded.sensors()[0].sample_ray(0.0, 0.5, spot, mi.Point2f(0.5))
    hit = stage.loaded.ray_intersect(ray)
    expected = np.asarray(hit.p.numpy()).T.reshape(*passes.ids.shape, 3)
    valid = np.asarray(hit.is_valid().numpy()).reshape(passes.ids.shape)
    assert np.mean(valid == (passes.ids > 0)) > 0.999
    both = valid & (passes.ids > 0)
    error = np.linalg.norm(world_points(passes) - expected, axis=-1)[both] / passes.distance_m[both]
    assert np.quantile(error, 0.998) < 2e-5


def test_every_id_lies_within_its_object(frames) -> None:
    """Points of a part lie in the box of the part that the table names: also of merged meshes."""
    scene, passes, _ = frames
    points = world_points(passes)
    singles, still = scene.singles(), scene.still_objects()
    for number in np.unique(passes.parts[passes.parts > 0]).tolist():
        kind, name = passes.part_table[number][1].split("/", 1)
        if kind == "static":
            continue
        if kind == "mover":
            corners = singles[name].vertices(TIME_S)
        elif kind == "object":
            corners = still[name].mesh().vertices_m
        else:
            lamp = scene.lamps[name]
            u, v = np.asarray(lamp.edge_u_m) / 2, np.asarray(lamp.edge_v_m) / 2
            corners = np.asarray(lamp.center_m) + np.array([u + v, u - v, v - u, -u - v])
        mine = points[passes.parts == number]
        assert (passes.ids[passes.parts == number] == passes.part_table[number][0]).all()
        slack = 1e-5 * passes.distance_m.max()
        assert (mine >= corners.min(axis=0) - slack).all(), name
        assert (mine <= corners.max(axis=0) + slack).all(), name


def test_masks_normals_and_both_depths(frames) -> None:
    scene, passes, _ = frames
    seen = passes.ids > 0
    movers = {number for number, (_, name) in passes.part_table.items() if name.startswith("mover/")}
    assert len(movers) == len(scene.singles())
    np.testing.assert_array_equal(passes.moving, np.isin(passes.parts, list(movers)))
    footprint = np.zeros(passes.ids.shape, bool)
    for single in scene.singles().values():
        cover(footprint, single.vertices(TIME_S), single.rest().faces, scene.camera.at(TIME_S), VIEW)
    assert not (passes.moving & ~footprint).any()
    row, col = centres()
    k = passes.intrinsics_px
    ways = np.stack([(col - k[0, 2]) / k[0, 0], (row - k[1, 2]) / k[1, 1], np.ones_like(row)], -1)
    length = np.linalg.norm(ways, axis=-1)
    np.testing.assert_allclose(passes.depth_m, passes.distance_m / length, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(passes.normal[seen], axis=-1), 1, atol=1e-6)
    directions = ways / length[..., None] @ passes.camera_to_world[1][:3, :3].T
    assert np.einsum("yxc,yxc->yx", passes.normal, directions)[seen].max() < 1e-6
    for name in ("depth_m", "distance_m", "normal", "albedo", "flow_forward_px", "flow_backward_px"):
        assert not getattr(passes, name)[~seen].any(), name
    assert passes.occluded_forward[~seen].all()
    assert passes.times_s == (TIME_S - STEP_S, TIME_S, TIME_S + STEP_S)


# -- closed forms ------------------------------------------------------------------------------------------

WALL_M, CARD_M, TAN = 4.0, 2.0, 0.5


def flat_scene(camera=None, card=None, scale=1.0, kind="card") -> Scene:
    """Make a wall at y = 4 m before a camera at the origin, perhaps a card; all lengths times a scale."""

    def times(table):
        return {key: (np.asarray(values) * scale).tolist() for key, values in table.items()}

    wall = {"corner_m": [-9, WALL_M, -9], "edge_u_m": [18, 0, 0], "edge_v_m": [0, 0, 18]}
    lamp = {"center_m": [0, -1, 0], "edge_u_m": [1, 0, 0], "edge_v_m": [0, 0, -1]}
    moves = {} if card is None else {"card": {"kind": kind, "material": "grey", **times(card)}}
    turning = {key: value for key, value in (camera or {}).items() if key.endswith("rad_s")}
    pose = {"position_m": [0, 0, 0], "target_m": [0, 1, 0], **(camera or {})}
    return Scene.model_validate(
        {
            "name": "flat",
            "white_w_m2_sr": 1.0,
            "camera": times(pose) | turning,
            "materials": {"grey": {"reflectance": 0.4}, "coat": {"kind": "plastic", "reflectance": 0.6}},
            "lamps": {"lamp": times(lamp) | {"radiance_w_m2_sr": 1.0}},
            "objects": {"wall": {"kind": "quad", "material": "coat"} | times(wall)},
            "movers": moves,
        }
    )


@pytest.fixture
def flat_view():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()
    return View(60, 80, 1, TAN)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_card_that_drifts_before_a_wall(flat_view, scale) -> None:
    """Flow is the projected translation; it hides a strip of the wall ahead, and shows one behind.

    In tiny and huge scenes alike.
    """
    velocity, step = (8.0, 0.0, 4.0), 0.02
    card = {"center_m": [0, CARD_M, 0], "size_m": [0.8, 0.8], "velocity_m_s": velocity}
    passes = render_passes(flat_scene(card=card, scale=scale), flat_view, 0.0, step)
    focal = 80 / 2 / TAN
    # 8 m/s to the right and 4 m/s up, at 2 m.
    shift = np.array([-4.0, 8.0]) * step * focal / CARD_M
    assert passes.moving.sum() == 32**2
    np.testing.assert_allclose(passes.flow_forward_px[passes.moving], np.tile(shift, (32**2, 1)), atol=1e-4)
    np.testing.assert_allclose(passes.flow_backward_px[passes.moving], np.tile(-shift, (32**2, 1)), atol=1e-4)
    assert not passes.flow_forward_px[~passes.moving].any()
    np.testing.assert_allclose(passes.depth_m, scale * np.where(passes.moving, CARD_M, WALL_M), rtol=1e-6)
    np.testing.assert_allclose(passes.normal, np.broadcast_to([0, -1, 0], (60, 80, 3)), atol=1e-6)
    np.testing.assert_allclose(passes.albedo, np.where(passes.moving, 0.4, 0.6), atol=1e-6)
    # The wall's samples under the card of the next and of the last instant, which are those of a card
    # moved by the shift: occlusion in closed form, but for samples within a rounding of its edge.
    row, col = centres(flat_view)
    for sign, mask in ((1, passes.occluded_forward), (-1, passes.occluded_backward)):
        margin = 16 - np.maximum(abs(row - 30 - sign * shift[0]), abs(col - 40 - sign * shift[1]))
        sure = abs(margin) > 1e-3
        np.testing.assert_array_equal(mask[sure], ((margin > 0) & ~passes.moving)[sure])
    moved = passes.object_poses["mover/card"].matrices
    assert moved is not None
    np.testing.assert_allclose(moved[2][:3, 3], scale * np.array(velocity) * step, atol=1e-12 * scale)
    np.testing.assert_allclose(moved[2][:3, :3], np.eye(3), atol=1e-12)


def test_a_camera_that_drifts_before_a_wall(flat_view) -> None:
    """Sideways: one flow everywhere. Toward the wall: flow grows from the centre."""
    focal, step = 80 / 2 / TAN, 0.02
    aside = render_passes(flat_scene({"velocity_m_s": [3.0, 0, 0]}), flat_view, 0.5, step)
    expected = np.broadcast_to([0, -3.0 * step * focal / WALL_M], (60, 80, 2))
    np.testing.assert_allclose(aside.flow_forward_px, expected, atol=1e-4)
    np.testing.assert_allclose(aside.flow_backward_px, -expected, atol=1e-4)
    # What leaves the picture is not seen: the columns that flow beyond its border.
    col = centres(flat_view)[1]
    np.testing.assert_array_equal(aside.occluded_forward, col + expected[..., 1] < 0)
    ahead = render_passes(flat_scene({"velocity_m_s": [0, 10.0, 0]}), flat_view, 0.0, step)
    dilated = np.moveaxis(centres(flat_view), 0, -1) - (30, 40)
    np.testing.assert_allclose(ahead.flow_forward_px, dilated * (WALL_M / (WALL_M - 0.2) - 1), atol=1e-4)


def test_a_camera_that_pans(flat_view) -> None:
    """Pure rotation: flow depends on no depth; the centre moves by f tan(angle), to the right."""
    angle = 0.01
    passes = render_passes(flat_scene({"pan_rad_s": 1.0}), flat_view, 0.0, angle)
    across = (centres(flat_view)[1] - 40) / 80
    # Anticlockwise seen from above: the camera turns left, so the picture moves right.
    expected = 80 * (np.tan(np.arctan(across) + angle) - across)
    np.testing.assert_allclose(passes.flow_forward_px[..., 1], expected, atol=1e-4)
    assert (passes.flow_forward_px[..., 1] > 0).all()


def test_a_ball_hides_its_own_far_side(flat_view) -> None:
    """A spinning ball: what turns away from the camera is hidden, although its object is still seen there."""
    ball = {"floor_m": [0, CARD_M, -1.0], "radius_m": 0.5, "height_m": 0.5, "spin_hz": 20.0}
    passes = render_passes(flat_scene(card=ball, kind="bouncing_ball"), flat_view, 0.3, 0.0125)
    # A quarter turn by 2 pi 20 Hz 0.0125 s.
    motion = passes.object_poses["mover/card"].matrices[2]
    turn = motion[:3, :3] @ passes.object_poses["mover/card"].matrices[1][:3, :3].T
    np.testing.assert_allclose(turn, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-6)
    points, _ = carried_rigidly(passes, 2)
    centre = passes.object_poses["mover/card"].center_m[2]
    outward = (points - centre) / 0.5
    facing = -np.einsum("yxc,yxc->yx", outward, points / np.linalg.norm(points, axis=-1, keepdims=True))
    # The ball is a polyhedron of 32 x 16 facets: its limb is a facet wide.
    sure = passes.moving & (abs(facing) > 0.2)
    assert (facing[sure] < 0).mean() > 0.25
    assert (facing[sure] > 0).mean() > 0.25
    np.testing.assert_array_equal(passes.occluded_forward[sure], facing[sure] < 0)


def test_nothing_in_view_and_behind_the_camera(flat_view) -> None:
    away = flat_scene({"target_m": [0, -1, 0.5]}).model_copy(update={"lamps": flat_scene().lamps})
    passes = render_passes(away, flat_view, 0.0, 0.01)
    assert (passes.ids == 0).mean() > 0.3
    assert passes.occluded_forward[passes.ids == 0].all()
    # Nothing at all: the wall is 18 m wide and 4 m behind; the lamp is 1 m wide, and below.
    void = render_passes(flat_scene({"target_m": [0, -1, 2.0]}), flat_view, 0.0, 0.01)
    assert not void.ids.any()
    assert void.occluded_backward.all()
    # A card that jumps behind the camera has no place in the picture there.
    card = {"center_m": [0, CARD_M, 0], "size_m": [0.8, 0.8], "velocity_m_s": [0, -100.0, 0]}
    gone = render_passes(flat_scene(card=card), flat_view, 0.0, 0.05)
    assert gone.occluded_forward[gone.moving].all()
    assert not gone.flow_forward_px[gone.moving].any()


def test_what_missed_rays_leave_in_memory_does_no_harm(flat_view, monkeypatch) -> None:
    """Renderers don't write a missed ray's columns: here they hold signalling NaN, which numpy warns of."""
    scene = flat_scene({"target_m": [0, -1, 0.5]})
    expected = render_passes(scene, flat_view, 0.0, 0.01)

    def found(*arguments, **options):
        hit = first_hit(*arguments, **options)
        weights = hit.weights.numpy()
        weights.view(np.uint32)[:, np.isinf(hit.distance.numpy())] = 0x7FA00000
        return replace(hit, weights=type(hit.weights)(weights))

    monkeypatch.setattr("optsim.render.gbuffer.first_hit", found)
    passes = render_passes(scene, flat_view, 0.0, 0.01)
    assert (passes.ids == 0).any()
    np.testing.assert_array_equal(passes.ids, expected.ids)
    np.testing.assert_array_equal(passes.depth_m, expected.depth_m)


def test_rigid_motion_is_found_and_bending_is_not() -> None:
    rng = np.random.default_rng(3)
    axis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn, shift = axis * np.linalg.det(axis), rng.normal(size=3)
    for points in (rng.normal(size=(40, 3)), rng.normal(size=(40, 3)) * (1, 1, 0)):
        matrix, deviation = rigid_motion(points, points @ turn.T + shift)
        np.testing.assert_allclose(matrix[:3], np.column_stack([turn, shift]), atol=1e-12)
        assert deviation < 1e-12
    assert rigid_motion(points, points * (1, 1.1, 1))[1] > 0.01


SCALAR = """
import numpy as np
from optsim.core.quantities import View
from optsim.render import render_passes
from optsim.scene import load_scene
scene, view = load_scene("window_room"), View(18, 24, 3, 0.32)
passes = render_passes(scene, view, 0.11, 1 / 180, backend="{backend}")
np.savez("{path}", depth=passes.depth_m, ids=passes.ids, flow=passes.flow_forward_px, normal=passes.normal,
         albedo=passes.albedo, occluded=passes.occluded_forward)
"""


@pytest.mark.slow
def test_the_scalar_fallback_agrees(tmp_path) -> None:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    found = []
    for backend in ("scalar_rgb", choose_backend().variant):
        path = tmp_path / f"{backend}.npz"
        code = SCALAR.format(backend=backend, path=path)
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        found.append(np.load(path))
    for name in found[0].files:
        share = np.mean(np.abs(found[0][name].astype(float) - found[1][name]) < 1e-3)
        assert share > 0.995, name
