"""Closed loops: exposures follow what arrived frames read, and the codes that these were taken with."""

import numpy as np
import pytest
from ideal_camera import BLACK_DN, SLOTS, film, ideal_calibration, still_light
from pydantic import ValidationError

from optsim.coding import ClosedLoopDensity
from optsim.decoding import HdrMerge

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


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_target_outside_the_well_is_refused(share):
    with pytest.raises(ValidationError, match="target_share"):
        ClosedLoopDensity(target_share=share)
