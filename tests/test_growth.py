"""The adaptive mask's options: growth to where things will be, and hysteresis."""

import numpy as np
import pytest
from ideal_camera import film, ideal_calibration, still_light
from pydantic import ValidationError

from optsim.coding import MotionAdaptive, NormalPhotography
from optsim.coding.growth import region_displacements, swept_ahead

ROWS, COLS = 40, 120


def boxes(*corners, side=6, shape=(ROWS, COLS)):
    """A mask of squares by their first row and column."""
    mask = np.zeros(shape, np.bool_)
    for v, u in corners:
        mask[max(v, 0) : v + side, max(u, 0) : u + side] = True
    return mask


@pytest.mark.parametrize("frames_ahead", [1, 2, 3])
def test_a_region_covers_the_last_half_of_its_way(frames_ahead):
    swept = swept_ahead(boxes((8, 20)), boxes((6, 15)), frames_ahead)
    steps = 5 * frames_ahead
    way = [(8 + round(2 * k / 5), 20 + k) for k in range(steps // 2, steps + 1)]
    assert swept[boxes((8, 20), way[-1])].all()
    assert not swept[~boxes((8, 20), *way)].any(), "nothing but the mask and the half of the way"
    assert swept.any(axis=0)[20 + -(-steps // 2) : 26 + steps].all(), "without gaps"


def test_the_fragments_of_a_mover_move_as_one():
    """Of half of a mover's pixels four in five changed, others each time."""
    rng = np.random.default_rng(3)
    texture = rng.random((12, 24)) < 0.5

    def seen(*cols):
        mask = np.zeros((ROWS, COLS), np.bool_)
        for col in cols:
            mask[10:22, col : col + 24] |= texture & (rng.random(texture.shape) < 0.8)
        return mask

    places, displacements = region_displacements(seen(37, 54), seen(20, 37))
    assert len(places) == 1
    np.testing.assert_allclose(displacements, [(0, 17)], atol=1)


def test_each_region_goes_its_own_way_and_a_new_one_nowhere():
    mask = boxes((4, 20), (30, 60), (20, 100))
    before = boxes((4, 18), (27, 60))
    places, displacements = region_displacements(mask, before)
    assert [int(v.min()) for v, _ in places] == [4, 20, 30]
    # The new one is 43 pixels from the nearest, more than three times its 6.
    np.testing.assert_allclose(displacements, [(0, 2), (np.nan, np.nan), (3, 0)])
    ahead = (4, 20), *((4, 20 + k) for k in (2, 3, 4)), (30, 60), *((30 + k, 60) for k in (3, 4, 5, 6))
    expected = boxes((20, 100), *ahead)
    np.testing.assert_array_equal(swept_ahead(mask, before, 2), expected)
    np.testing.assert_array_equal(swept_ahead(mask, np.zeros_like(mask), 2), mask)
    assert not swept_ahead(np.zeros_like(mask), before, 2).any()


def test_what_is_faster_than_it_is_long_came_from_the_nearest_region():
    # Frames at columns 20, 45, 70: masks of two in a row; the middle one is in both.
    mask, before = boxes((10, 45), (10, 70), side=10), boxes((10, 20), (10, 45), side=10)
    _, displacements = region_displacements(mask, before)
    np.testing.assert_allclose(displacements, [(0, 25)], err_msg="near enough to be one region")
    mask, before = boxes((10, 50), (10, 80), side=10), boxes((10, 20), (10, 50), side=10)
    _, displacements = region_displacements(mask, before)
    np.testing.assert_allclose(displacements, [(0, 0), (0, 30)])
    _, beyond = region_displacements(boxes((10, 51), side=10), boxes((10, 20), side=10))
    assert np.isnan(beyond).all()
    # The longer side is what counts: 5 x 10 pixels.
    flat, came = boxes((10, 50), side=10), boxes((10, 20), side=10)
    flat[15:], came[15:] = False, False
    np.testing.assert_allclose(region_displacements(flat, came)[1], [(0, 30)])
    np.testing.assert_allclose(region_displacements(flat.T, came.T)[1], [(30, 0)])


def test_what_is_swept_stays_on_the_panel():
    swept = swept_ahead(boxes((-2, 110)), boxes((1, 102)), 1)
    assert swept.shape == (ROWS, COLS)
    assert swept[0, 115:].all()
    assert not swept[:, :100].any(), "nothing comes back on the other side"
    assert not swept[ROWS // 2 :].any()


def crossing(n, step_px, width_px=10):
    """A bar that goes on by a step a frame, and stands still within each."""
    frames = []
    for index in range(n):
        light = np.full((ROWS, COLS), 0.1, np.float32)
        first = 6 + step_px * index
        light[12:24, first : first + width_px] = 0.6
        frames.append(still_light(light))
    return frames


@pytest.mark.parametrize("latency", [1, 2, 3])
def test_the_mask_grows_to_where_the_bar_is(latency):
    calibration = ideal_calibration(ROWS, COLS)
    n, step = 2 * latency + 4, 8
    lights = crossing(n, step)

    def last_mask(scheme):
        taken = film(calibration, scheme, lights, np.random.default_rng(2), latency)
        return taken[-1].code.moving

    there = lights[-1][0] > 0.3
    late = last_mask(MotionAdaptive())
    grown_mask = last_mask(MotionAdaptive(growth="displacement"))
    # Late masks reach to the end of the newest bar that has arrived, and the dilation of 3.
    assert np.flatnonzero(late.any(axis=0)).max() == 6 + step * (n - 1 - latency) + 10 - 1 + 3
    assert late[there].mean() < 0.55
    assert grown_mask[there].all()
    assert grown_mask[late].all()
    # A pixel for the centroid of a mask with a ragged end, at every frame ahead.
    end = np.flatnonzero(there.any(axis=0)).max()
    assert abs(np.flatnonzero(grown_mask.any(axis=0)).max() - (end + 3)) <= latency
    assert not grown_mask[:8].any()
    assert not grown_mask[28:].any()


@pytest.mark.parametrize("latency", [1, 3])
def test_a_static_scene_stays_static_with_every_option(latency):
    calibration = ideal_calibration(ROWS, COLS)
    scheme = MotionAdaptive(growth="displacement", release_sigma=1.0, first_frames="static")
    image = np.random.default_rng(3).uniform(0.05, 0.3, (ROWS, COLS))
    taken = film(calibration, scheme, [still_light(image)] * 8, np.random.default_rng(4), latency)
    # Four neighbours at 4 sigma: never in 8 frames of 4800 pixels. A sixth of them is beyond the release.
    assert not any(frame.code.moving.any() for frame in taken)


def labels(release_sigma, levels):
    """Whether a square counts as moving after each frame, by its levels; without noise."""
    calibration = ideal_calibration(24, 24)
    scheme = MotionAdaptive(
        static=NormalPhotography(open_slots=36),
        moving=NormalPhotography(open_slots=36),
        dilation_px=0,
        release_sigma=release_sigma,
        least_change=10.0,  # single pixels alone
    )
    lights = []
    for level in levels:
        image = np.full((24, 24), 0.1, np.float32)
        image[8:16, 8:16] = level
        lights.append(still_light(image))
    frames = film(calibration, scheme, lights, None)
    state, found = scheme.init(calibration, np.random.default_rng(0)), []
    for n in range(2, len(frames) + 1):
        code, state = scheme.next(n, frames[:n], state)
        assert not code.moving[:8].any()
        square = code.moving[8:16, 8:16]
        assert square.all() == square.any()
        found.append(bool(square.any()))
    return found


def test_hysteresis_keeps_a_label_until_the_change_is_below_the_release():
    # At 0.5 W m^-2 and 36 slots there are 4860 electrons: 1 sigma of a difference is 0.0102 W m^-2.
    sigma = np.sqrt(2 * (4860 + 9)) / 9720
    steps = np.array([20, 3, 3, 1, 3])
    levels = [0.5 - 20 * sigma, *(0.5 + sigma * np.cumsum([0, *steps[1:]]))]
    assert labels(None, levels) == [True, False, False, False, False]
    assert labels(2.0, levels) == [True, True, True, False, False]
    assert labels(3.5, levels) == [True, False, False, False, False]


def test_hysteresis_keeps_false_alarms_as_often_as_noise_says():
    """Two changes share the frame between them, so those of noise are correlated by -1/2."""
    calibration = ideal_calibration(96, 96)
    every = NormalPhotography(open_slots=36)
    light = [still_light(np.full((96, 96), 0.5))] * 3
    noise = np.random.default_rng(5).standard_normal((3, 1_000_000))
    first, second = np.abs(np.diff(noise, axis=0)) / np.sqrt(2)
    for release, expected in ((None, second > 2), (1.0, (second > 2) | ((first > 2) & (second > 1)))):
        scheme = MotionAdaptive(
            static=every, moving=every, threshold_sigma=2, release_sigma=release, speck_px=1, dilation_px=0
        )
        frames = film(calibration, scheme, light, np.random.default_rng(6))
        code, _ = scheme.next(3, frames, scheme.init(calibration, np.random.default_rng(0)))
        share = expected.mean()
        # 5 standard errors: a false alarm in 1.7 million; the two shares are 8 standard errors apart.
        assert abs(code.moving.mean() - share) < 5 * np.sqrt(share / code.moving.size)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (
            {"release_sigma": 4.0},
            "release_sigma: got 4, expected less than threshold_sigma, which is 4; lower",
        ),
        ({"release_sigma": 3.0, "threshold_sigma": 2.0}, "expected less than threshold_sigma, which is 2"),
        ({"release_sigma": 0.0}, "greater than 0"),
        ({"growth": "latency"}, "'none' or 'displacement'"),
    ],
)
def test_options_that_cannot_be_are_refused(table, words):
    with pytest.raises(ValidationError, match=words):
        MotionAdaptive(**table)
