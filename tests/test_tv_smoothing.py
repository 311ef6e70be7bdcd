"""Lowering total variation: against scikit-image's, which shares no code with it."""

import numpy as np
import pytest
from skimage.restoration import denoise_tv_chambolle

from optsim.reconstruct.tv_smoothing import smoothed

SHAPES = [(24, 33, 8), (5, 7, 3), (1, 4, 2), (4, 1, 1), (9, 3, 36), (1, 1, 1)]


def reference(video, weight, steps, *, over_time):
    """Chambolle's steps of scikit-image: its first iteration only starts."""
    if over_time:
        return denoise_tv_chambolle(video, weight=weight, eps=0.0, max_num_iter=steps + 1)
    return denoise_tv_chambolle(video, weight=weight, eps=0.0, max_num_iter=steps + 1, channel_axis=2)


@pytest.mark.parametrize("over_time", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_steps_are_those_of_scikit_image(shape, over_time):
    video = np.random.default_rng(1).random(shape).astype(np.float32)
    before = video.copy()
    for steps in (1, 4, 20):
        found = smoothed(video, 0.2, steps, over_time=over_time)
        np.testing.assert_allclose(found, reference(video, 0.2, steps, over_time=over_time), atol=2e-6)
    np.testing.assert_array_equal(video, before)


def test_the_mean_of_each_slot_stays_where_time_does_not_count():
    video = np.random.default_rng(2).random((16, 20, 6)).astype(np.float32)
    still = smoothed(video, 0.3, 30, over_time=False)
    np.testing.assert_allclose(still.mean(axis=(0, 1)), video.mean(axis=(0, 1)), rtol=1e-5)
    mixed = smoothed(video, 0.3, 30, over_time=True)
    np.testing.assert_allclose(mixed.mean(), video.mean(), rtol=1e-5)
    assert np.ptp(mixed.mean(axis=(0, 1))) < 0.5 * np.ptp(video.mean(axis=(0, 1)))


def test_no_variation_no_change_and_all_of_it_leaves_the_mean():
    even = np.full((6, 8, 5), 0.7, np.float32)
    np.testing.assert_array_equal(smoothed(even, 0.5, 10, over_time=True), even)
    video = np.random.default_rng(3).random((8, 8, 4)).astype(np.float32)
    flat = smoothed(video, 1e3, 2000, over_time=True)
    np.testing.assert_allclose(flat, video.mean(), atol=2e-3)
