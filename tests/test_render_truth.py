"""The truth estimator: exact bookkeeping, and unbiased by statistics."""

import numpy as np
import pytest

from optsim.core.cache import Cache
from optsim.core.errors import ConfigError
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, choose_backend, render_footage, render_truth
from optsim.render.backend import activate
from optsim.render.footprint import cover, path_px, project
from optsim.render.full import slot_image
from optsim.render.pose_sampling import hat_means
from optsim.render.stage import RenderStage, outside_mask
from optsim.scene import load_scene

VIEW = View(48, 63, 3, 0.32)
TIMING = Timing(1 / 180, 4, 2)
SETTINGS = RenderSettings(static_error=0.2, change_error=0.2, moving_error=0.2, slots_per_segment=4)
PIXELS = np.arange(VIEW.rows * VIEW.cols)


@pytest.fixture(scope="module")
def scene():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()
    return load_scene("window_room")


@pytest.fixture(scope="module")
def truth(scene, tmp_path_factory):
    cache = Cache(tmp_path_factory.mktemp("truth"))
    return cache, render_truth(scene, VIEW, TIMING, SETTINGS, cache=cache)


def assert_same(image, other):
    """Equal but for rays along an edge: Embree's parallel build may order equal triangles differently."""
    assert np.mean(np.abs(image - other) > 1e-5 * np.abs(other)) < 0.002


def test_a_subset_of_pixels_is_bitwise_the_whole(scene):
    stage = RenderStage(scene, VIEW)
    some = PIXELS[5::7]
    whole = stage.radiance(PIXELS, 4, (1, 2))
    np.testing.assert_array_equal(stage.radiance(some, 4, (1, 2)), whole[:, some])
    assert not np.array_equal(whole[0], whole[1])
    # Pixels with different numbers of samples in one launch, and a pass that continues another.
    counts = np.where(some % 2, 4, 2)
    mixed = stage.radiance(some, counts, (1, 2))
    np.testing.assert_array_equal(mixed[:, some % 2 == 1], whole[:, some[some % 2 == 1]])
    both = (stage.radiance(some, 2, (1,)) + stage.radiance(some, 2, (1,), 2)) / 2
    np.testing.assert_allclose(both[0], whole[0, some], rtol=1e-12)


def test_moving_the_vertices_equals_loading_afresh(scene):
    moved = RenderStage(scene, VIEW)
    moved.pose(0.7)
    moved.pose(0.05)
    fresh = RenderStage(scene, VIEW)
    fresh.pose(0.05)
    rest = RenderStage(scene, VIEW).radiance(PIXELS, 2, (3,))
    image = moved.radiance(PIXELS, 2, (3,))
    assert_same(image, fresh.radiance(PIXELS, 2, (3,)))
    with pytest.raises(AssertionError):
        assert_same(image, rest)


def test_the_projection_agrees_with_the_renderer(scene):
    """Samples where a mover changes the first hit lie inside its footprint, and fill most of it."""
    alone = {"movers": {"walker": scene.movers["walker"]}, "max_depth": 2}
    one = scene.model_copy(update=alone)
    walker = one.singles()["walker"]
    mask = np.zeros((VIEW.rows, VIEW.cols), bool)
    cover(mask, walker.vertices(0.0), walker.rest().faces, one.camera, VIEW)
    with_him = RenderStage(one, VIEW).radiance(PIXELS, 8, (5,))
    without = RenderStage(one, VIEW, movers=False).radiance(PIXELS, 8, (5,))
    # The same random numbers: where the first hit is the same, only his shadow differs, and it darkens.
    brighter = (with_him > (1 + 1e-5) * without)[0].reshape(mask.shape)
    # A ray along an edge may take either side, so a few samples in a thousand are spared.
    assert (brighter & ~mask).mean() < 0.002
    changed = (with_him != without)[0].reshape(mask.shape)
    # The footprint is generous by 0.75 samples all round; on this coarse grid that is a third of it.
    assert (changed & mask).sum() > 0.6 * mask.sum()


def test_a_point_on_the_optical_axis_projects_to_the_middle(scene):
    middle = project(np.array([scene.camera.target_m]), scene.camera, VIEW)[0]
    np.testing.assert_allclose(middle[:2], (VIEW.rows / 2, VIEW.cols / 2), atol=1e-9)
    fan = scene.singles()["fan"]
    ways = [path_px(fan.vertices, np.linspace(0, s, 9), scene.camera, VIEW) for s in (0.005, 0.01)]
    assert ways[1] == pytest.approx(2 * ways[0], rel=0.05)  # steady rotation; 5 % of foreshortening


@pytest.mark.parametrize(("n_steps", "n_instants"), [(1, 4), (4, 4), (8, 4), (16, 9), (2, 9)])
def test_hat_means_integrate_linear_interpolation(n_steps, n_instants):
    share = hat_means(n_steps, n_instants)
    np.testing.assert_allclose(share.sum(axis=1), 1)
    nodes, fine = np.linspace(0, 1, n_steps + 1), (np.arange(7200) + 0.5) / 7200
    values = np.sin(5 * nodes)
    dense = np.interp(fine, nodes, values).reshape(n_instants, -1).mean(axis=1)
    # The midpoint sum of a piecewise linear function misses by its kinks only.
    np.testing.assert_allclose(share @ values, dense, atol=1e-5)


def test_the_mean_of_many_differences_is_the_mean_of_renders(scene):
    """z-test over 200 independent seeds of sums over regions, false alarm rate below 1e-4 in all."""
    view = View(18, 24, 3, 0.32)
    pixels = np.arange(view.rows * view.cols)
    moving, still = RenderStage(scene, view), RenderStage(scene, view, movers=False)
    moving.pose(0.1)
    seeds = tuple(range(1, 201))
    change = moving.radiance(pixels, 2, seeds) - still.radiance(pixels, 2, seeds)
    seeds = tuple(range(1001, 1201))
    direct = moving.radiance(pixels, 2, seeds)
    base = still.radiance(pixels, 2, tuple(range(2001, 2201)))
    regions = (pixels // view.cols // 6) * 4 + pixels % view.cols // 6
    for region in range(12):
        here = regions == region
        a = (change[:, here]).mean(1)
        b = (direct[:, here]).mean(1) - base[:, here].mean(1)
        z = (a.mean() - b.mean()) / np.sqrt((a.var(ddof=1) + b.var(ddof=1)) / 200)
        assert abs(z) < 4.8  # 12 regions, two-sided: 2e-5
    assert change.std() < 0.7 * (direct - base).std()  # and it is worth it


@pytest.mark.slow
def test_an_instant_agrees_with_a_direct_render_within_its_noise(scene, truth):
    """The video's slots against the plain loop with its own noise; the statistic is a mean of squares."""
    video = truth[1]
    stage = RenderStage(scene, VIEW)
    inside = ~video.outside
    for index, instant in ((0, 0), (1, 2)):
        slot = index * 4 + instant
        seeds = tuple(range(50 * slot + 7, 50 * slot + 15))
        direct = slot_image(stage, slot / 180, 1 / 180, 16, 2, seeds)
        mean, error = direct.mean(0), direct.std(0, ddof=1) / np.sqrt(8)
        ours = video.load(index).instant(instant)
        noise = video.half_difference.load(index).instant(instant)
        # Regions of 8 x 9 samples: sums are near normal, errors from both sides' own scatter.
        blocks = [
            np.where(inside, a, 0).astype(float).reshape(6, 8, 7, 9).sum((1, 3))
            for a in (ours - mean, error**2, noise.astype(float) ** 2)
        ]
        z = blocks[0] / np.sqrt(blocks[1] + blocks[2] + 1e-12)
        # 42 regions, |z| rarely above 4; variances from few numbers have wide tails, hence 7.
        assert np.abs(z).max() < 7
        assert abs(z.mean()) < 1.0  # a bias of the whole picture would show: sd of the mean about 0.15..0.3


def test_slots_that_no_mover_touches_stand_still(truth):
    segment = truth[1].load(0)
    touched = np.zeros(segment.start.shape, bool)
    for block in segment.blocks:
        _, height, width = block.excess.shape
        touched[block.row : block.row + height, block.col : block.col + width] |= (block.excess != 0).any(0)
    first, last = segment.instant(0), segment.instant(3)
    assert 0.02 < touched.mean() < 0.5
    # Outside the blocks only the linear base changes.
    np.testing.assert_allclose(
        (last - first)[~touched], (0.75 * (segment.stop - segment.start))[~touched], atol=1e-4
    )


def test_resuming_and_longer_runs_find_the_cached_poses_bitwise(scene, truth):
    cache, video = truth
    entries = cache.show()["entries"]
    again = render_truth(scene, VIEW, TIMING, SETTINGS, cache=cache)
    assert cache.show()["entries"] == entries
    np.testing.assert_array_equal(again.load(1).instant(1), video.load(1).instant(1))
    longer = render_truth(scene, VIEW, Timing(1 / 180, 4, 3), SETTINGS, cache=cache)
    assert (
        cache.show()["entries"] == entries + 3
    )  # a key instant, a segment, and where movers go in a longer time
    np.testing.assert_array_equal(longer.load(0).instant(3), video.load(0).instant(3))


def test_work_on_light_that_stands_still_is_told_piece_by_piece(scene, truth, tmp_path, monkeypatch):
    monkeypatch.setattr("optsim.render.rays._MAX_LANES", 20_000)
    told = {"pilot": [], "static light": []}

    def progress(stage, done, total):
        told.get(stage, []).append(done / total)

    render_truth(scene, VIEW, TIMING, SETTINGS, cache=Cache(tmp_path), progress=progress)
    for each in told.values():
        assert each[0] == 0
        assert each[-1] == 1
        assert each == sorted(each)
        assert len(set(each)) > 3


def test_a_fresh_cache_gives_the_same_light(scene, truth, tmp_path):
    fresh = render_truth(scene, VIEW, Timing(1 / 180, 4, 1), SETTINGS, cache=Cache(tmp_path))
    assert_same(fresh.load(0).instant(1), truth[1].load(0).instant(1))


def test_the_window_is_outside_and_bright(scene, truth):
    video = truth[1]
    image = video.load(0).instant(0)
    assert 0.05 < video.outside.mean() < 0.1
    np.testing.assert_array_equal(video.outside, outside_mask(scene, VIEW))
    assert np.percentile(image[video.outside], 95) / np.percentile(image[~video.outside], 5) > 2e4


def test_segments_must_divide_the_coded_frame(scene, tmp_path):
    with pytest.raises(ConfigError, match="slots_per_segment"):
        render_truth(scene, VIEW, Timing(1 / 180, 10, 1), SETTINGS, cache=Cache(tmp_path))


def test_footage_is_a_video_at_panel_resolution():
    crowd = load_scene("training_mix", "c")
    frames = render_footage(crowd, VIEW, Timing(1 / 180, 2, 2), samples=4)
    assert frames.shape == (4, 16, 21)
    assert np.isfinite(frames).all()
    assert np.abs(frames[3] - frames[0]).max() > 0
