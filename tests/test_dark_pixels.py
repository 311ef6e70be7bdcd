"""Dark pixels of decoded videos: noise must neither blacken them nor lift them."""

import numpy as np
import pytest
from ideal_camera import film, ideal_calibration, still_light

from optsim.coding import RandomExposure
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.decoding import SparseCoding
from optsim.decoding.coded_images import CodedImage, covered
from optsim.decoding.partial import positive_mean

ROWS, COLS, SLOTS = 96, 96, 36


def coded_image(variance=0.0, exposure=3.0):
    shape = (ROWS, COLS)
    return CodedImage(
        np.zeros(shape, np.float32),
        np.full(shape, exposure, np.float32),
        np.full(shape, variance, np.float32),
        np.full((*shape, SLOTS), exposure / SLOTS, np.float32),
        np.ones(shape, np.bool_),
        np.zeros(shape, np.bool_),
    )


def layer_of(video, image, count=None):
    """Hand over a video of shape (v, u, slot) as if a decoder had painted it."""
    code = ExposureCode(np.zeros((SLOTS, ROWS, COLS), np.uint8), np.ones((ROWS, COLS), np.bool_))
    frame = CodedFrame(0, np.zeros((ROWS, COLS), np.uint16), code)
    ones = np.ones((ROWS, COLS), np.float32)
    count = ones if count is None else count
    return covered(frame, image, video * count[:, :, None], count, ones)


def errors(rng, sigma):
    return rng.normal(0, sigma, (ROWS, COLS, SLOTS)).astype(np.float32)


@pytest.mark.parametrize("sigma", [0.01, 3.0])
def test_negative_light_says_how_wrong_the_dark_is(sigma):
    rng = np.random.default_rng(1)
    video = errors(rng, sigma)
    found = layer_of(video.copy(), coded_image()).irradiance_w_m2
    known = positive_mean(np.moveaxis(video, -1, 0), np.full((ROWS, COLS), sigma**2, np.float32))
    # The variance comes from 64 pixels of 36 slots, of which half are negative: 5 % at three deviations
    # (a mean of 2304 values of the kurtosis of a half Gaussian; 1 in 300 pixels may lie beyond).
    near = np.abs(found - known) < 0.05 * sigma
    assert near.mean() > 0.98
    assert (found > 0).all()


def test_light_far_above_its_error_stays_as_it_was():
    rng = np.random.default_rng(2)
    video = 1 + errors(rng, 0.05)
    found = layer_of(video.copy(), coded_image(variance=(3 * 0.05) ** 2)).irradiance_w_m2
    np.testing.assert_array_equal(found, np.moveaxis(video, -1, 0))


def test_slots_with_the_shutter_closed_show_no_errors():
    open_slots = coded_image()
    open_slots.weights[:, :, 28:] = 0
    video = errors(np.random.default_rng(5), 0.1)
    expected = layer_of(video.copy(), open_slots).irradiance_w_m2[:28]
    known = positive_mean(np.moveaxis(video, -1, 0)[:28], np.full((ROWS, COLS), 0.01, np.float32))
    # As above, from 28 slots.
    assert (np.abs(expected - known) < 0.05 * 0.1 * np.sqrt(36 / 28)).mean() > 0.98
    video[:, :, 28:] = -100
    np.testing.assert_array_equal(layer_of(video, open_slots).irradiance_w_m2[:28], expected)


def test_a_video_without_light_has_the_noise_of_what_its_neighbourhood_gathered():
    """A dictionary picks nothing below the noise: that is no proof of blackness."""
    dark = layer_of(np.zeros((ROWS, COLS, SLOTS), np.float32), coded_image(variance=0.09, exposure=3))
    # 0.3 of noise by an exposure of 3 and by 8, the root of 64 pixels; times the mean of half a Gaussian.
    np.testing.assert_allclose(dark.irradiance_w_m2, 0.3 / 3 / 8 * np.sqrt(2 / np.pi), rtol=1e-5)
    unknown = layer_of(np.zeros((ROWS, COLS, SLOTS), np.float32), coded_image(exposure=0))
    np.testing.assert_allclose(unknown.irradiance_w_m2, 0, atol=1e-12)


def test_pixels_without_a_patch_stay_empty_and_count_for_nothing():
    count = np.ones((ROWS, COLS), np.float32)
    count[:, COLS // 2 :] = 0
    video = errors(np.random.default_rng(3), 1.0)
    some = layer_of(video.copy(), coded_image(), count).irradiance_w_m2
    assert not some[:, :, COLS // 2 :].any()
    all_of_it = layer_of(video.copy(), coded_image()).irradiance_w_m2
    # Beside the empty half the variance comes from fewer pixels, not from a mean with nothing in it.
    edge = some[:, :, COLS // 2 - 4 : COLS // 2].mean() / all_of_it[:, :, COLS // 2 - 4 : COLS // 2].mean()
    assert abs(edge - 1) < 0.03


def test_a_dim_room_beside_a_window_is_not_black():
    """A passage beside a window: its samples are noise, and patches are full of bright pixels."""
    calibration = ideal_calibration(32, 48)
    image = np.full((32, 48), 0.003, np.float32)
    image[:, 24:] = 0.3
    frames = film(calibration, RandomExposure(), [still_light(image)], np.random.default_rng(4))
    (found,) = SparseCoding().decode(frames, calibration)
    dark = found.irradiance_w_m2[:, :, :20]
    stops = np.log2(dark / 0.003)
    assert np.isfinite(stops).all()
    assert np.sqrt(np.square(stops).mean()) < 1.5
    np.testing.assert_allclose(found.irradiance_w_m2[:, :, 32:].mean(), 0.3, rtol=0.02)
