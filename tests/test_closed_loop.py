"""Closed loops: exposures follow what arrived frames read, and the codes that these were taken with."""

import numpy as np
import pytest
from ideal_camera import BLACK_DN, SLOTS, film, ideal_calibration, still_light
from pydantic import ValidationError

from optsim.calibration import Glare
from optsim.coding import ClosedLoopDensity, ClosedLoopRate, MotionAdaptive, RandomExposure
from optsim.core.quantities import CodedFrame
from optsim.decoding import HdrMerge, Union

ROWS, COLS = 12, 16
# A reading of 60 % of the well, W m^-2 slots: 270 DN each, saturation at 15 000 DN.
TARGET = 0.6 * (15_000 - BLACK_DN) / 270


def opened(frames):
    """Open slots of each frame's pixels: (frame, v, u)."""
    return np.stack([np.count_nonzero(frame.code.levels, axis=0) for frame in frames])


def lengths_under(level, latency=1, n=9, coded_slots=SLOTS):
    """Open slots frame by frame in even constant light, without noise."""
    light = np.zeros((SLOTS, ROWS, COLS), np.float32)
    light[:coded_slots] = level
    calibration = ideal_calibration(ROWS, COLS, coded_slots=coded_slots)
    found = opened(film(calibration, ClosedLoopDensity(), [light] * n, None, latency))
    assert (found == found[:, :1, :1]).all()
    return found[:, 0, 0].tolist()


@pytest.mark.parametrize("level", [0.01, 0.95, 1.2, 1.5, 3.0, 5.0])
@pytest.mark.parametrize("coded_slots", [SLOTS, 28])
def test_even_light_is_exposed_to_the_target_within_two_arrived_frames(level, coded_slots):
    """By the first frame where it didn't saturate, else by the second, at a quarter."""
    goal = np.clip(np.rint(TARGET / level), 1, coded_slots)
    found = lengths_under(level, coded_slots=coded_slots)
    assert found[0] == coded_slots
    assert found[1] == (goal if coded_slots * level * 270 < 15_000 - BLACK_DN else coded_slots // 4)
    assert found[2:] == [goal] * 7


@pytest.mark.parametrize("level", [40.0, 1e4])
def test_a_saturated_pixel_falls_by_quarters_to_one_slot_and_stays(level):
    one_slot = np.rint(TARGET / level) if level * 270 < 15_000 - BLACK_DN else 1
    assert lengths_under(level) == [36, 9, 2, *[max(one_slot, 1)] * 6]


@pytest.mark.parametrize("latency", [1, 2, 3])
def test_each_reading_counts_with_the_code_of_its_own_frame(latency):
    """From the newest code instead, quarters would multiply for as long as the latency lasts."""
    found = lengths_under(3.0, latency, n=3 * latency + 2)
    assert found == [36] * latency + [9] * latency + [11] * (latency + 2)


def test_each_pixel_goes_its_own_way_in_the_middle_of_the_coded_slots():
    image = np.geomspace(0.3, 100, ROWS * COLS).reshape(ROWS, COLS)
    calibration = ideal_calibration(ROWS, COLS)
    last = film(calibration, ClosedLoopDensity(target_share=0.3), [still_light(image)] * 5, None)[-1]
    (lengths,) = opened([last])
    np.testing.assert_array_equal(lengths, np.clip(np.rint(TARGET / 2 / image), 1, SLOTS))
    assert set(lengths.ravel()) >= {1, 2, 3, 35, 36}
    is_open = last.code.levels == 255
    np.testing.assert_array_equal(is_open.argmax(axis=0), (SLOTS - lengths) // 2)
    assert (np.diff(is_open.astype(int), axis=0, prepend=0) == 1).sum(axis=0).max() == 1
    assert not last.code.moving.any()


def test_a_pixel_without_a_measurement_opens_like_the_nearest_that_has_one():
    valid = np.ones((ROWS, COLS), np.bool_)
    valid[3, 4] = False
    calibration = ideal_calibration(ROWS, COLS, valid=valid)
    for dead in (0.0, 40.0):
        image = np.where(valid, 3.0, dead)
        (lengths,) = opened(film(calibration, ClosedLoopDensity(), [still_light(image)] * 4, None)[-1:])
        assert (lengths == 11).all()
    blind = ideal_calibration(ROWS, COLS, valid=np.zeros_like(valid))
    assert opened(film(blind, ClosedLoopDensity(), [still_light(image)] * 3, None)).all()


def test_a_bright_window_is_measured_that_an_open_shutter_would_clip():
    image = np.full((ROWS, COLS), 0.3, np.float32)
    image[:, 8:] = 20.0
    calibration = ideal_calibration(ROWS, COLS)
    frames = film(calibration, ClosedLoopDensity(), [still_light(image)] * 6, np.random.default_rng(2))
    found = list(HdrMerge().decode(frames, calibration))[-1]
    assert found.valid.all()
    assert not found.interpolated.any()
    np.testing.assert_allclose(found.irradiance_w_m2[0], image, rtol=0.05)


def test_still_pixels_of_the_adaptive_scheme_follow_their_brightness():
    """Half a panel of movers and half of still light: random bumps there, exposures to the target here."""
    rows, cols = 24, 64
    still = np.geomspace(0.3, 100, rows * cols // 2).reshape(rows, cols // 2)
    dark, bright = (still_light(np.hstack([np.full_like(still, level), still])) for level in (0.5, 2.0))
    scheme = MotionAdaptive(static=ClosedLoopDensity(), dilation_px=1)
    frames = film(ideal_calibration(rows, cols), scheme, [dark, bright] * 4, np.random.default_rng(0))
    lengths = opened(frames)[-1]
    assert frames[-1].code.moving[:, : cols // 2].all()
    assert not frames[-1].code.moving[:, cols // 2 + 2 :].any()
    assert (lengths[:, : cols // 2] == RandomExposure().bump_slots).all()
    far = slice(cols // 2 + 10, None)
    wanted = np.clip(np.rint(TARGET / still), 1, SLOTS)
    np.testing.assert_allclose(lengths[:, far], wanted[:, 10:], atol=1)  # of noise
    assert MotionAdaptive.model_validate(scheme.model_dump()) == scheme


def test_a_lamp_s_glare_is_no_motion_when_codes_are_first_chosen():
    """It always saturates. Its glare counts less where the dark is open for 36 slots, not 3 as the lamp."""
    calibration = ideal_calibration(32, 48, glare=Glare(veil=0.02))
    scheme, light, rng = (
        MotionAdaptive(static=ClosedLoopDensity()),
        np.full((32, 48), 0.05),
        np.random.default_rng(3),
    )
    light[12:16, 20:24] = 400
    state, panel, frames = scheme.init(calibration, rng), None, []
    for index in range(8):
        code, state = scheme.next(index, frames, state)
        weights, panel = calibration.weights(code, panel)
        dn = rng.poisson(calibration.mix((weights.sum(axis=0) * light).astype(np.float32)) * 270) + BLACK_DN
        frames.append(CodedFrame(index, dn.clip(0, 16_383).astype(np.uint16), code))
    assert calibration.observe(frames[-1]).saturated[12:16, 20:24].all()
    assert [frame.code.moving.any() for frame in frames] == [True] * 2 + [False] * 6
    assert (opened(frames[-1:])[0][:, :16] == SLOTS).all()


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_target_outside_the_well_is_refused(share):
    with pytest.raises(ValidationError, match="target_share"):
        ClosedLoopDensity(target_share=share)


def test_still_pixels_open_as_by_density_at_scattered_times():
    image = np.geomspace(0.3, 100, ROWS * COLS).reshape(ROWS, COLS)
    calibration, lights = ideal_calibration(ROWS, COLS), [still_light(image)] * 6
    *_, density = film(calibration, ClosedLoopDensity(), lights, None)
    *_, last = film(calibration, ClosedLoopRate(), lights, None)
    (lengths,) = opened([last])
    np.testing.assert_array_equal(lengths, opened([density])[0])
    assert not last.code.moving.any()
    starts = (last.code.levels == 255).argmax(axis=0)
    assert (starts <= SLOTS - lengths).all()
    short = starts[lengths == 1]
    assert np.ptp(short) > 20
    assert len(np.unique(short)) > 15


def walk(step, n=6, brightest=0.6):
    """A textured box that jumps ``step`` pixels to the right in each frame, before a dim wall."""
    rng = np.random.default_rng(3)
    box = rng.uniform(0.15, brightest, (10, 12)).astype(np.float32)
    frames = []
    for index in range(n):
        image = np.full((32, 96), 0.05, np.float32)
        image[12:22, 10 + step * index :][:, :12] = box
        frames.append(still_light(image))
    return frames


# 36 slots a frame: n slots fit where n * step / 36 is at most half a pixel.
@pytest.mark.parametrize(("step", "length"), [(1, 12), (2, 6), (3, 6), (5, 3), (7, 3)])
@pytest.mark.parametrize("latency", [1, 3])
def test_a_moving_region_opens_for_half_a_pixel_of_its_motion(step, length, latency):
    calibration, n = ideal_calibration(32, 96), 6 + latency
    frames = film(calibration, ClosedLoopRate(), walk(step, n), np.random.default_rng(1), latency)
    code, (lengths,) = frames[-1].code, opened(frames[-1:])
    first = 10 + step * (n - 1 - latency)
    assert code.moving[12:22, first : first + 12].mean() > 0.9, "where it was in the newest frame"
    rows, cols = (np.flatnonzero(each) for each in (code.moving.any(axis=1), code.moving.any(axis=0)))
    around = np.s_[rows[0] - 8 : rows[-1] + 9, max(cols[0] - 8, 0) : cols[-1] + 9]
    assert (lengths[around] == length).all(), "patches that touch the region have its code alone"
    assert (lengths < SLOTS).sum() == lengths[around].size


def test_the_shortest_bumps_are_those_of_random_exposure():
    calibration = ideal_calibration(32, 96)
    frames = film(calibration, ClosedLoopRate(), walk(5), np.random.default_rng(1))
    random, _ = RandomExposure().next(0, [], RandomExposure().init(calibration, np.random.default_rng(5)))
    short = opened(frames[-1:])[0] == 3
    assert short.sum() > 500
    np.testing.assert_array_equal(frames[-1].code.levels[:, short], random.levels[:, short])


def test_bright_pixels_of_a_mover_open_as_their_brightness_asks():
    calibration, lights = ideal_calibration(32, 96), walk(1, brightest=20.0)
    frames = film(calibration, ClosedLoopRate(), lights, None)
    (lengths,) = opened(frames[-1:])
    by_light = np.clip(np.rint(TARGET / lights[-2][0]), 1, SLOTS)
    there = frames[-1].code.moving
    bright = there & (by_light < 12)
    assert bright.sum() > 80
    # Saturated pixels fall by quarters, so they may be a slot or two from the target yet.
    assert np.abs(lengths - np.minimum(by_light, 12))[there].max() <= 8
    assert (lengths[bright] == by_light[bright]).mean() > 0.6
    assert lengths[there].max() == 12


def test_a_mover_is_decoded_sharper_than_an_open_shutter_blurs_it():
    light = np.full((7 * SLOTS, 32, 80), 0.1, np.float32)
    for slot, image in enumerate(light):
        image[10:22] += np.clip(1 - np.abs(np.arange(80) - 16 - 0.15 * slot) / 3, 0, 1).astype(np.float32)
    lights = list(light.reshape(7, SLOTS, 32, 80))
    calibration = ideal_calibration(32, 80)
    frames = film(calibration, ClosedLoopRate(), lights, np.random.default_rng(1))
    found = list(Union().decode(frames, calibration))[-1]
    blur = np.square(lights[-1].mean(axis=0) - lights[-1])
    assert np.square(found.irradiance_w_m2 - lights[-1]).mean() < 0.5 * blur.mean()


@pytest.mark.parametrize("lengths", [(), (0, 3), (3, 3), (6, 3)])
def test_lengths_that_do_not_ascend_are_refused(lengths):
    with pytest.raises(ValidationError, match="ascending numbers of open slots"):
        ClosedLoopRate(bump_slots=lengths)
