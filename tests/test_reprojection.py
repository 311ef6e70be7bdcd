"""What movers carry between keys: look-ups by hand, and first surfaces against whole paths."""

import numpy as np
import pytest

from optsim.core.cache import Cache
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, moving, render_truth
from optsim.render.backend import activate, choose_backend
from optsim.render.reprojection import KeyPoseLight, between, filled, seen_at
from optsim.render.stage import PrimaryHits, RenderStage
from optsim.scene import load_scene
from optsim.scene.materials import Metal

VIEW = View(4, 6, 1, 0.3)

FACES = np.array([[0, 1, 2]], np.int32)
# A triangle over most of the picture, and the same one a sample further right: row, column, depth in m.
THEN = np.array([[0.0, 0.0, 2.0], [4.0, 0.0, 2.0], [0.0, 5.0, 2.0]])
HERE = THEN + np.array([0, 1, 0])
ONE = np.zeros(1, np.int64)


def activate_vectorised():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def looks(second: float, third: float, shape: int = 7) -> PrimaryHits:
    """One look at a point of the triangle."""
    weights = np.array([[second, third]], np.float32)
    return PrimaryHits(np.array([shape]), ONE, weights, np.ones(1, np.float32), np.zeros(0, np.float32))


def key(*paths: tuple[int, int, float, float, float]) -> KeyPoseLight:
    """Make a key of (sample, shape, depth, albedo, light)."""
    sample, shape, *values = np.array(sorted(paths)).T
    depth, albedo, light = (np.asarray(column, np.float32) for column in values)
    first = np.searchsorted(sample, np.arange(2 * VIEW.rows * VIEW.cols + 1))
    return KeyPoseLight((0, 0), (VIEW.rows, VIEW.cols), first, shape.astype(np.int64), depth, albedo, light)


def irradiance(of: KeyPoseLight, at: PrimaryHits, here=HERE, then=THEN, half=0) -> float:
    return float(of.irradiance(at, ONE, ONE + half, FACES, here, then, VIEW)[0])


# The point (row 1, column 1.25) of the triangle is seen in column 2.25 at the key: in sample 1 * 6 + 2.
POINT = looks(0.25, 0.25)


def test_a_point_takes_the_irradiance_of_the_sample_where_the_key_saw_it():
    assert irradiance(key((8, 7, 2.0, 0.5, 3.0), (8, 7, 2.0, 0.1, 0.3), (7, 7, 2.0, 0.5, 9.0)), POINT) == (
        pytest.approx((3.0 + 0.3) / (0.5 + 0.1))
    )


def test_a_sample_that_saw_something_else_counts_not_but_its_neighbours_do():
    other = (8, 3, 2.0, 0.5, 50.0)
    behind = (8, 7, 3.0, 0.5, 70.0)
    assert irradiance(key(other, behind, (9, 7, 2.0, 0.5, 1.0)), POINT) == pytest.approx(2.0)
    assert np.isnan(irradiance(key(other, behind, (10, 7, 2.0, 0.5, 1.0)), POINT))


def test_the_other_side_and_what_is_out_of_the_picture_is_unknown():
    known = key((8, 7, 2.0, 0.5, 3.0))
    mirrored = HERE * [1, -1, 1] + [0, 4.5, 0]
    assert np.isnan(irradiance(known, POINT, here=mirrored))
    assert irradiance(known, POINT, here=mirrored, then=mirrored) == pytest.approx(6.0)
    assert np.isnan(irradiance(known, POINT, here=HERE + np.array([0, 50, 0])))
    assert np.isnan(irradiance(known, POINT, here=HERE * [1, 1, np.nan]))


def test_points_between_vertices_are_projected_in_perspective():
    # Vertices at depths 1, 1 and 4: the middle of the edge from the first to the third is at depth 2.5, and
    # seen at (1 * 0 + 4 * 5) / (1 + 4) = column 4 of a picture in which the ends are at columns 0 and 5.
    slanted = np.array([[0.5, 0.0, 1.0], [4.0, 0.0, 1.0], [0.5, 5.0, 4.0]])
    edge = looks(0.0, 0.5)
    # Halfway between rows 0.5 and 0.5, columns 0 and 5.
    np.testing.assert_allclose(seen_at(edge, ONE, FACES, slanted), [[0.5, 4.0, 2.5]])
    there = key((4, 7, 2.5, 0.5, 2.0), (2, 7, 2.5, 0.5, 9.0))
    assert irradiance(there, edge, here=slanted, then=slanted) == pytest.approx(4.0)


def test_halves_are_looked_up_apart():
    both = key((8, 7, 2.0, 0.5, 1.0), (24 + 8, 7, 2.0, 0.5, 2.0))
    assert irradiance(both, POINT, half=0) == pytest.approx(2.0)
    assert irradiance(both, POINT, half=1) == pytest.approx(4.0)
    np.testing.assert_allclose(both.beside([3])[:, 8], [1, 2])
    assert np.isnan(irradiance(key((8, 7, 2.0, 0.5, 1.0)), POINT, half=1))


def test_paths_that_went_past_show_what_is_beside():
    beside = key((8, 3, 2.0, 0.5, 5.0), (8, 2, 3.0, 0.0, 7.0), (8, 7, 2.0, 0.5, 99.0), (9, 7, 2.0, 0.5, 1.0))
    light = beside.beside([7])
    assert light[0, 8] == pytest.approx(6.0)
    assert np.isnan(np.delete(light, 8)).all()


def test_interpolation_takes_what_is_known():
    nan = np.float32(np.nan)
    before, after = np.array([1, nan, 3, nan], np.float32), np.array([5, 6, nan, nan], np.float32)
    np.testing.assert_allclose(between(before, after, 0.25), [2, 6, 3, nan])


def test_gaps_are_filled_in_time_first_and_then_in_proportion():
    nan, mask = np.nan, np.ones((1, 3), np.bool_)
    static = np.array([[1.0, 2.0, 4.0]] * 2, np.float32)
    # Sample 0 is known at keys 0 and 3, sample 1 never, sample 2 always.
    each = np.array([[1.0, nan, 8.0], [nan, nan, 9.0], [nan, nan, 10.0], [2.0, nan, 11.0]], np.float32)
    light = filled(np.stack([each, each], axis=1), static, mask, 0.0)
    np.testing.assert_allclose(light[:, 0, 0], [1, 1, 2, 2])
    np.testing.assert_allclose(light[:, 1, 2], [8, 9, 10, 11])
    nearest = light[:, 0, 0] * 2, light[:, 0, 2] / 2
    assert any(np.allclose(light[:, 0, 1], guess) for guess in nearest)
    # Noise may have made the light there negative: no proportion of that.
    noisy = filled(np.stack([each, each], axis=1), static * [-1e-9, 1, -1e-9], mask, 0.01)
    assert np.abs(noisy).max() < 300 * 11
    assert np.isnan(filled(np.full((2, 2, 3), nan, np.float32), static, mask, 0.0)).all()


def test_of_two_keys_as_near_the_earlier_one_fills_a_gap():
    light = np.full((5, 2, 1), np.nan, np.float32)
    light[[1, 3], :, 0] = [[1.0, 10.0], [2.0, 20.0]]
    whole = filled(light, np.ones((2, 1), np.float32), np.ones((1, 1), np.bool_), 0.0)
    np.testing.assert_array_equal(whole[:, 0, 0], [1, 1, 1, 2, 2])
    np.testing.assert_array_equal(whole[:, 1, 0], [10, 10, 10, 20, 20])
    for known in (0, 4):
        light = np.full((5, 2, 1), np.nan, np.float32)
        light[known] = 3
        one, mask = np.ones((2, 1), np.float32), np.ones((1, 1), np.bool_)
        np.testing.assert_array_equal(filled(light, one, mask, 0.0), np.full((5, 2, 1), 3))


def test_a_look_is_the_beginning_of_the_path_with_the_same_number():
    activate_vectorised()
    scene = load_scene("window_room")
    stage = RenderStage(scene, View(24, 32, 1, 0.32))
    stage.pose(0.03)
    pixels, samples, seeds = np.arange(0, 768, 3), np.full(256, 4), np.full(256, 5)
    whole = stage.hits(pixels, samples, seeds, light=True)
    np.testing.assert_allclose(
        whole.light.reshape(-1, 4).mean(axis=1), stage.paths(pixels, samples, seeds), rtol=1e-5, atol=1e-7
    )
    alone = stage.hits(pixels, samples, seeds, light=False)
    # A ray along an edge may take either side, so a few in a thousand are spared.
    same = (whole.shape == alone.shape) & (whole.face == alone.face)
    assert same.mean() > 0.995
    np.testing.assert_allclose(whole.weights[same], alone.weights[same], atol=1e-4)
    np.testing.assert_allclose(whole.albedo[same], alone.albedo[same], atol=1e-4)
    assert not len(alone.light)
    assert (alone.shape == stage.shape_of("fan")).any()
    assert alone.albedo.min() >= 0
    assert 0.1 < np.median(alone.albedo) < 0.95


def test_looks_go_on_where_earlier_ones_stopped():
    activate_vectorised()
    stage = RenderStage(load_scene("window_room"), View(24, 32, 1, 0.32))
    pixels, seeds = np.arange(0, 768, 3), np.full(256, 5)
    all_of_them = stage.hits(pixels, np.full(256, 8), seeds, light=False)
    later = stage.hits(pixels, np.full(256, 4), seeds, np.full(256, 4), light=False)
    # A ray along an edge may take either side.
    assert (all_of_them.face.reshape(-1, 8)[:, 4:] == later.face.reshape(-1, 4)).mean() > 0.995
    assert (all_of_them.weights.reshape(-1, 8, 2)[:, :4] != later.weights.reshape(-1, 4, 2)).mean() > 0.9


def test_a_slots_looks_are_shared_out_over_its_poses():
    poses_a_slot = np.array([1e-3, 0.25, 0.5, 1, 2, 4, 1e3])
    looks = moving._hits_a_pose(poses_a_slot)
    assert np.array_equal(looks, [64, 32, 16, 8, 4, 2, 2])


def test_what_is_not_matt_is_rendered_at_every_pose(tmp_path, monkeypatch):
    """A glossy mover is never looked up: every sample that shows it is traced as a whole."""
    activate_vectorised()
    scene = load_scene("window_room")
    fan = scene.singles()["fan"].material
    shiny = {name for name, mover in scene.singles().items() if mover.material == fan}
    scene = scene.model_copy(update={"materials": scene.materials | {fan: Metal(kind="metal", metal="Al")}})
    seen: list[np.ndarray] = []
    rendered: list[np.ndarray] = []
    asked: list[str] = []
    honest = RenderStage.hits, moving._whole, moving._reprojected

    def spied(stage, pixels, samples, seeds, *first, light):
        found = honest[0](stage, pixels, samples, seeds, *first, light=light)
        hit = found.shape == stage.shape_of("fan")
        seen.append(np.repeat(pixels, samples)[hit & (not light)])
        return found

    monkeypatch.setattr(RenderStage, "hits", spied)
    monkeypatch.setattr(moving, "_whole", lambda *a: rendered.append(a[2]) or honest[1](*a))
    monkeypatch.setattr(moving, "_reprojected", lambda *a: asked.append(a[3].name) or honest[2](*a))
    settings = RenderSettings(static_error=0.5, change_error=0.5, moving_error=1, slots_per_segment=2)
    video = render_truth(scene, View(30, 40, 1, 0.32), Timing(1 / 180, 2, 1), settings, cache=Cache(tmp_path))
    assert np.isfinite(video.load(0).instant(1)).all()
    every = set(np.concatenate(seen))
    assert every
    assert every <= set(np.concatenate(rendered))
    assert set(asked)
    assert not shiny & set(asked)
