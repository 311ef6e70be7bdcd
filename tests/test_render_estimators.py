"""The cheaper ways to the same truth: allocation, paths that need no second look, lamps, moving cameras."""

import dataclasses

import numpy as np
import pytest

from optsim.core.cache import Cache
from optsim.core.errors import ConfigError
from optsim.core.progress import silent
from optsim.core.quantities import Timing, View
from optsim.experiment.experiment import load_experiment
from optsim.experiment.truth import camera_noise
from optsim.render import CameraNoise, RenderSettings, choose_backend, render_truth
from optsim.render.allocation import TILE_PX, Statistics, allocate, relative_deviation, tally
from optsim.render.backend import activate
from optsim.render.difference import Difference
from optsim.render.full import render_slot, slot_image
from optsim.render.nearby import boxes_around
from optsim.render.plan import RenderPlan
from optsim.render.stage import RenderStage
from optsim.render.still import halves_tally, static_light
from optsim.scene import load_scene

VIEW = View(36, 48, 3, 0.32)
PIXELS = np.arange(VIEW.rows * VIEW.cols)


@pytest.fixture(scope="module", autouse=True)
def _backend():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def plan_of(scene, folder, **settings):
    timing = Timing(1 / 180, 4, 2)
    return RenderPlan(
        scene, VIEW, timing, RenderSettings(**settings), None, Cache(folder), silent, scene.name
    )


@pytest.fixture(scope="module")
def difference(tmp_path_factory):
    plan = plan_of(load_scene("window_room"), tmp_path_factory.mktemp("cache"), static_error=0.3)
    return plan, Difference(plan, static_light(plan, RenderStage(plan.scene, VIEW, movers=False)))


# --- allocation --------------------------------------------------------------------------------------------


def test_neyman_spends_in_proportion_to_the_deviation():
    deviation = np.repeat(np.float32([1, 4, 16]), 100)
    counts = allocate(deviation, 0.8, least=1)
    np.testing.assert_array_equal(counts[200:], 4 * counts[100:200])
    np.testing.assert_array_equal(np.log2(counts) % 1, 0)
    reached = np.sqrt(np.mean(deviation**2 / (2 * counts)))
    assert 0.8 / 2 < reached <= 0.8  # powers of two: at worst a factor of two in samples
    even = np.mean(deviation**2) / (2 * reached**2)
    assert counts.mean() < 0.65 * even  # Neyman's gain here is (21/3)^2 / (273/3) = 0.54, before rounding


def test_dear_samples_are_taken_more_rarely():
    cost = np.repeat(np.float32([1, 1 / 16]), 50)
    counts = allocate(np.ones(100, np.float32), 0.2, least=1, cost=cost)
    np.testing.assert_array_equal(counts[50:], 4 * counts[:50])


def test_the_bounds_hold_even_where_the_target_cannot():
    counts = allocate(np.float32([1e-3, 1e3]), 1e-3, least=2, most=np.float32([8, 16]))
    np.testing.assert_array_equal(counts, [8, 16])
    assert allocate(np.float32([1e-6, 1]), 0.5, least=2)[0] == 2


def test_tiles_pool_their_neighbourhood_and_forget_slowly():
    shape, pixels = (16, 24), np.arange(16 * 24)
    variance = np.where(pixels % 24 < 12, 4.0, 16.0)
    tiles = tally(shape, pixels, variance, np.ones(len(pixels)))
    assert float(tiles.count.sum()) == len(pixels)
    deviation = relative_deviation(tiles, shape, 1.0)
    # Deep inside each half: sqrt(variance) / (1 + 1), with a tenth of the picture's mean of 2.5 mixed in.
    assert deviation[8, 0] == pytest.approx(np.sqrt(0.9 * 1 + 0.1 * 2.5), rel=1e-5)
    assert deviation[8, 23] == pytest.approx(np.sqrt(0.9 * 4 + 0.1 * 2.5), rel=1e-5)
    later = tiles.and_then(tally(shape, pixels, 9 * variance, np.ones(len(pixels))))
    assert float((later.variance / later.count)[0, 0]) == pytest.approx(4 * (0.8 + 9) / 1.8, rel=1e-5)
    nothing = Statistics(*(np.zeros((4, 6), np.float32),) * 3)
    assert (relative_deviation(nothing, shape, 1.0) == 1).all()
    assert tiles.count.shape == (16 // TILE_PX, 24 // TILE_PX)


# --- paths that come near no mover -------------------------------------------------------------------------


def test_skipping_far_paths_changes_nothing(difference, monkeypatch):
    """The same paths with all of them traced again: equal but for rays along an edge of two triangles."""
    _, ours = difference
    counts = np.full(len(PIXELS), 4, np.float32)
    skipped, _ = ours.change(0.011, PIXELS, counts, 0)
    monkeypatch.setattr(type(ours._boxes), "hold", lambda *_: False)
    everything, _ = ours.change(0.011, PIXELS, counts, 0)
    assert (everything != 0).mean() > 0.1
    assert (skipped == 0).mean() > 0.1
    # 8 samples of one half each: a bit of rounding in the sum is 1e-6 of the brightest sample.
    wrong = np.abs(skipped - everything) > 1e-5
    assert wrong.mean() < 0.001


def test_a_share_of_the_paths_is_worth_skipping(difference):
    assert 0.03 < difference[1]._cost.mean() < 0.6


def test_movers_stay_in_their_boxes_and_are_missed_outside(difference):
    plan, ours = difference
    scene = plan.scene
    assert all(ours._boxes.hold(scene, t) for t in np.linspace(0, plan.time_s(8), 50))
    few = boxes_around(scene, np.array([0.0, 0.001]))
    assert not few.hold(scene, 0.3)
    corners = few.mesh().vertices_m
    assert (corners.max(0) - corners.min(0) < (4.4, 8.6, 2.9)).all()


def test_a_camera_inside_a_box_skips_nothing():
    scene = load_scene("window_room")
    walker = scene.movers["walker"].model_copy(update={"feet_m": (0.0, 0.0, 0.0)})
    assert boxes_around(scene.model_copy(update={"movers": {"walker": walker}}), np.array([0.0, 0.1])) is None


@pytest.mark.slow
def test_differences_average_to_the_difference_of_renders(difference):
    """z-test of 16 regions against independent plain renders; false alarm below 1e-4 in all (Sidak)."""
    plan, ours = difference
    counts, time_s = np.full(len(PIXELS), 2, np.float32), 0.02
    found = np.concatenate([ours.change(time_s, PIXELS, counts, turn)[0] for turn in range(40)])
    moving, still = RenderStage(plan.scene, VIEW), RenderStage(plan.scene, VIEW, movers=False)
    moving.pose(time_s)
    plain = moving.radiance(PIXELS, 8, tuple(range(5000, 5040)))
    plain -= still.radiance(PIXELS, 8, tuple(range(6000, 6040)))
    region = PIXELS // VIEW.cols // 9 * 4 + PIXELS % VIEW.cols // 12
    for r in range(16):
        a, b = found[:, region == r].mean(1), plain[:, region == r].mean(1)
        z = (a.mean() - b.mean()) / np.sqrt(a.var(ddof=1) / len(a) + b.var(ddof=1) / len(b))
        assert abs(z) < 4.6


# --- what changes decides ----------------------------------------------------------------------------------


def loaded(scene, folder, slots=8, **settings):
    timing = Timing(1 / 180, 4, slots // 4)
    coarse = {"static_error": 0.2, "change_error": 0.2, "moving_error": 0.25} | settings
    return render_truth(scene, VIEW, timing, RenderSettings(**coarse), cache=Cache(folder))


def regions(image):
    return image.reshape(4, 9, 4, 12).astype(float).sum(axis=(1, 3))


def within_noise(video, slot, direct, instants=1):
    """Compare a slot with independent plain renders (seed, y, x), by regions, both sides' noise known."""
    segment, where = video.load(slot // video.slots_per_segment), slot % video.slots_per_segment * instants
    half = video.half_difference.load(slot // video.slots_per_segment)
    ours = np.mean([segment.instant(where + i) for i in range(instants)], axis=0)
    noise = np.mean([half.instant(where + i) for i in range(instants)], axis=0)
    mean, error = direct.mean(0), direct.std(0, ddof=1) / np.sqrt(len(direct))
    z = regions(ours - mean) / np.sqrt(regions(error**2) + regions(noise**2) + 1e-12)
    # 16 regions; variances from few numbers have wide tails, hence 7.
    assert np.abs(z).max() < 7
    assert abs(z.mean()) < 1.3


@pytest.mark.slow
def test_a_flickering_lamp_is_a_sum_of_pictures(tmp_path):
    scene = load_scene("flicker_lamp")
    video = loaded(scene, tmp_path, instants_per_slot=2)
    assert (video.slots_per_segment, video.instants_per_slot) == (1, 2)
    levels = []
    for slot in (0, 5):
        start_s, stop_s = slot / 180, (slot + 1) / 180
        dimmed = {
            name: lamp.model_copy(
                update={
                    "radiance_w_m2_sr": lamp.radiance_w_m2_sr * lamp.gain(start_s, stop_s),
                    "flicker": None,
                }
            )
            for name, lamp in scene.lamps.items()
        }
        steady = RenderStage(scene.model_copy(update={"lamps": dimmed}), VIEW)
        direct = slot_image(steady, start_s, 1 / 180, 24, 2, tuple(range(900 + 10 * slot, 908 + 10 * slot)))
        within_noise(video, slot, direct, instants=2)
        levels.append(direct.mean())
    assert abs(levels[1] / levels[0] - 1) > 0.02  # or the test would not see the flicker


def test_a_single_lamp_may_flicker_and_the_camera_move_under_it(tmp_path):
    """The light of slots is in proportion to the closed form of the lamp, whatever else happens."""
    scene = load_scene("window_room")
    pulsed = load_scene("flicker_lamp").lamps
    flicker = next(lamp.flicker for lamp in pulsed.values() if lamp.flicker)
    lamp = scene.lamps["ceiling"].model_copy(update={"flicker": flicker})
    only = scene.model_copy(update={"lamps": {"ceiling": lamp}, "movers": {}})
    moving = only.model_copy(
        update={"camera": scene.camera.model_copy(update={"velocity_m_s": (1e-9, 0.0, 0.0)})}
    )
    for name, one in (("still", only), ("camera", moving)):
        video = loaded(one, tmp_path / name, slots=8, moving_error=0.1, static_error=0.1)
        assert video.slots_per_segment == 1
        light = np.array([video.load(slot).instant(0).mean() for slot in range(8)])
        gain = np.array([lamp.gain(slot / 180, (slot + 1) / 180) for slot in range(8)])
        assert np.ptp(gain) > 0.05
        np.testing.assert_allclose(light / gain, np.mean(light / gain), rtol=0.02)


def test_a_moving_camera_sees_every_slot_anew(tmp_path):
    scene = load_scene("moving_camera")
    video = loaded(scene, tmp_path, moving_error=0.3)
    assert video.slots_per_segment == 1
    stage = RenderStage(scene, VIEW)
    for slot in (0, 7):
        direct = slot_image(stage, slot / 180, 1 / 180, 16, 2, tuple(range(70 + 10 * slot, 78 + 10 * slot)))
        within_noise(video, slot, direct)
    assert np.abs(regions(video.load(7).start - video.load(0).start)).max() > 0


@pytest.mark.parametrize("target", [1.0, 0.08])
def test_samples_of_many_poses_are_as_good_as_of_one(tmp_path, target):
    """Light and noise of a slot in 8 poses, with fewer samples than these and with more, against one pose."""
    scene = load_scene("moving_camera")
    plan = plan_of(scene, tmp_path, moving_error=target)
    stage = RenderStage(scene, VIEW)
    light = stage.radiance(PIXELS, 16, (1, 2))
    tiles = halves_tally(plan, PIXELS, light, 16.0)
    one, many = (render_slot(plan, stage, 3, poses, tiles)["light"].astype(float) for poses in (1, 8))
    assert many.mean() == pytest.approx(one.mean(), rel=0.03)
    noise = [np.median(np.abs(halves[0] - halves[1])) for halves in (one, many)]
    assert 0.75 < noise[1] / noise[0] < 1.33


def test_the_targets_are_about_met(tmp_path):
    """Measured by the halves: the prediction may err, by tiles and powers of two, within a factor of 1.6."""
    scene = load_scene("moving_camera")
    for target in (0.6, 0.15):
        video = loaded(scene, tmp_path, slots=4, moving_error=target)
        image = np.mean([video.load(i).start for i in range(4)], axis=0)
        scale = np.maximum(image, 0) + 0.01 * scene.white_w_m2_sr
        found = [np.sqrt(np.mean((video.half_difference.load(i).start / scale) ** 2)) for i in (2, 3)]
        assert 1 / 1.6 < np.mean(found) / target < 1.6


def test_a_camera_that_could_not_tell_ends_the_sampling(tmp_path):
    """Dark places of a noisy camera get fewer samples; bright ones as many as before."""
    scene = load_scene("window_room")
    plan = plan_of(scene, tmp_path)
    tiles = tally(plan.shape, PIXELS, np.full(len(PIXELS), 0.01), np.full(len(PIXELS), 0.1))
    light = np.where(PIXELS % 2 == 0, 1e-3, 10).astype(np.float32)
    plain = plan.counts(tiles, PIXELS, light, 0.02, least=0.125)
    settings = plan.settings.model_copy(update={"noise_share": 0.2})
    noise = CameraNoise(electrons=500.0, read_noise_e=20.0)
    stopped = dataclasses.replace(plan, settings=settings, noise=noise).counts(
        tiles, PIXELS, light, 0.02, least=0.125
    )
    # One sample's deviation is about 1.06 (radiance + floor); the camera's noise is (20^2 + 500 L)^0.5 / 500.
    for where, level in ((0, 1e-3), (1, 10.0)):
        one = 0.01**0.5 / 0.104 * (level + 0.004)
        hidden = 0.2 * np.hypot(20, np.sqrt(500 * level)) / 500
        needed = (one / hidden) ** 2 / 2
        assert (
            needed <= max(stopped[where], 0.125) <= max(2 * needed, 0.125) or stopped[where] == plain[where]
        )
    assert stopped[0] < plain[0]
    with pytest.raises(ConfigError, match="noise_share"):
        render_truth(scene, VIEW, plan.timing, settings, cache=Cache(tmp_path))


def test_the_noise_of_the_camera_is_that_of_its_ledger():
    """0.1 W m^-2 sr^-1 at f/4: a hand calculation of the electrons of a slot, in a ninth of a panel pixel."""
    experiment = load_experiment("demo", ["render.noise_share=0.3"])
    camera = experiment.camera
    noise = camera_noise(experiment)
    row = next(r for r in camera.ledger(0.1) if r.stage == "electrons a slot")
    share = (camera.ratio / 3) ** 2
    expected = row.value * share / camera.objective.nd_transmission
    assert noise.electrons * 0.1 == pytest.approx(expected, rel=1e-9)
    assert noise.read_noise_e == pytest.approx(camera.sensor.read_noise_e * share**0.5, rel=1e-9)
    assert camera_noise(load_experiment("demo")) is None


def test_movers_carried_by_keyframes_are_rendered(tmp_path):
    """They can't be looked up by their contents, unlike the others."""
    scene = load_scene("chart")
    video = loaded(scene, tmp_path, slots=4)
    assert video.load(0).blocks
