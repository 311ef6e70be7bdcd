"""Lowering total variation: against scikit-image's, which shares no code with it."""

import numpy as np
import pytest
from skimage.restoration import denoise_tv_chambolle

from optsim.decoding.tv_smoothing import smoothed

SHAPES = [(24, 33, 8), (5, 7, 3), (1, 4, 2), (4, 1, 1), (9, 3, 36), (1, 1, 1)]


def reference(video, weight, steps, time_weight):
    """Chambolle's steps of scikit-image: its first iteration only starts."""
    axis = None if time_weight else 2
    return denoise_tv_chambolle(video, weight=weight, eps=0.0, max_num_iter=steps + 1, channel_axis=axis)


@pytest.mark.parametrize("time_weight", [0, 1])
@pytest.mark.parametrize("shape", SHAPES)
def test_steps_are_those_of_scikit_image(shape, time_weight):
    video = np.random.default_rng(1).random(shape).astype(np.float32)
    before = video.copy()
    for steps in (1, 4, 20):
        found = smoothed(video, 0.2, steps, time_weight=time_weight)
        np.testing.assert_allclose(found, reference(video, 0.2, steps, time_weight), atol=2e-6)
    np.testing.assert_array_equal(video, before)


@pytest.mark.parametrize("time_weight", [0.3, 2.0])
def test_differences_in_time_count_as_they_are_told_to(time_weight):
    """The least sum of squared change and weighted total variation, found by hand for one step in time."""
    video = np.zeros((3, 4, 2), np.float32)
    video[:, :, 1] = 1
    few = smoothed(video, 0.1, 2, time_weight=time_weight)
    np.testing.assert_allclose(np.ptp(few, axis=(0, 1)), 0, atol=1e-6, err_msg="no pixel is special")
    # Each side of the step moves by what the variation's slope takes: weight times time_weight.
    found = smoothed(video, 0.1, 3000, time_weight=time_weight)
    np.testing.assert_allclose(found[:, :, 0], 0.1 * time_weight, atol=1e-4)
    np.testing.assert_allclose(found[:, :, 1], 1 - 0.1 * time_weight, atol=1e-4)


def test_the_mean_of_each_slot_stays_where_time_does_not_count():
    video = np.random.default_rng(2).random((16, 20, 6)).astype(np.float32)
    still = smoothed(video, 0.3, 30, time_weight=0)
    np.testing.assert_allclose(still.mean(axis=(0, 1)), video.mean(axis=(0, 1)), rtol=1e-5)
    mixed = smoothed(video, 0.3, 30, time_weight=1)
    np.testing.assert_allclose(mixed.mean(), video.mean(), rtol=1e-5)
    assert np.ptp(mixed.mean(axis=(0, 1))) < 0.5 * np.ptp(video.mean(axis=(0, 1)))


def test_no_variation_no_change_and_all_of_it_leaves_the_mean():
    even = np.full((6, 8, 5), 0.7, np.float32)
    np.testing.assert_array_equal(smoothed(even, 0.5, 10, time_weight=1), even)
    video = np.random.default_rng(3).random((8, 8, 4)).astype(np.float32)
    flat = smoothed(video, 1e3, 2000, time_weight=1)
    np.testing.assert_allclose(flat, video.mean(), atol=2e-3)
