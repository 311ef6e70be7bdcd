"""What a pixel can't measure by itself its neighbours tell; what it can it keeps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ideal_camera import film as filmed
from ideal_camera import ideal_calibration, still_light

from optsim.coding import HdrMosaic
from optsim.decoding import HdrMerge
from optsim.decoding.neighbour_pooling import pooled

ROWS, COLS = 40, 48
NOWHERE = np.zeros((ROWS, COLS), np.float32)
EVERYWHERE = np.ones((ROWS, COLS), np.bool_)


def decoded(light, scheme, seed=3, **options):
    """The last of four noisy frames."""
    calibration = ideal_calibration(*light.shape)
    frames = filmed(calibration, scheme, [still_light(light)] * 4, np.random.default_rng(seed))
    *_, layer = HdrMerge(**options).partials(frames, calibration)
    return layer


def stops(layer, light):
    return np.log2(layer.irradiance_w_m2[0] / light)


def rms(values):
    return np.sqrt(np.mean(np.square(values)))


def test_too_short_an_exposure_is_read_beside_it():
    """A dim slope in a mosaic that stands still: a few electrons in the shortest exposure."""
    slope = np.broadcast_to(np.geomspace(0.01, 0.04, COLS), (ROWS, COLS)).astype(np.float32)
    fixed = HdrMosaic(shifts=False)
    alone, together = decoded(slope, fixed, neighbours=False), decoded(slope, fixed)
    levels = np.add.reduce(fixed_levels(), axis=0)
    shortest = np.broadcast_to(levels == levels.min(), slope.shape)
    longest = levels == levels.max()
    assert rms(stops(together, slope)[shortest]) < rms(stops(alone, slope)[shortest]) / 4
    assert rms(stops(together, slope)[longest]) < 1.1 * rms(stops(alone, slope)[longest])
    np.testing.assert_array_equal(together.valid, alone.valid)
    off = (together.irradiance_w_m2[0] - slope) / together.uncertainty_w_m2[0]
    # Neighbours share what they hear of, and a Laplacian's tails are heavy.
    assert 0.6 < rms(off) < 1.4


def fixed_levels():
    calibration = ideal_calibration(ROWS, COLS)
    light = [still_light(np.full((ROWS, COLS), 0.1, np.float32))]
    return filmed(calibration, HdrMosaic(shifts=False), light, None)[0].code.levels


def test_what_is_measured_well_is_left_alone():
    """White noise of a factor of three from pixel to pixel, but thousands of electrons each."""
    texture = np.random.default_rng(1).uniform(0.5, 1.5, (ROWS, COLS)).astype(np.float32)
    alone, together = decoded(texture, HdrMosaic(), neighbours=False), decoded(texture, HdrMosaic())
    change = together.irradiance_w_m2 / alone.irradiance_w_m2 - 1
    assert 0 < rms(change) < 0.01
    assert np.abs(change).max() < 0.03


def test_noise_about_zero_averages_to_the_light_it_is_about():
    """Darkness of five times less than its noise: positive by itself it would be four times too bright."""
    rng = np.random.default_rng(2)
    light = np.full((ROWS, COLS), 0.2, np.float32)
    noisy = (light + rng.normal(size=light.shape)).astype(np.float32)
    found, variance = pooled(noisy, np.ones_like, EVERYWHERE, NOWHERE, 0.05)
    alone, _ = pooled(noisy, np.ones_like, ~EVERYWHERE, NOWHERE, 0.05)
    # Nobody measured, nobody tells.
    np.testing.assert_array_equal(alone, np.maximum(noisy, 0))
    # A pixel and three neighbours' worth of others: half the noise, of which the positive part is 0.5 or so.
    assert found.mean() < 0.6
    assert 1 / 4 < variance.mean() < 1 / 3


def test_bright_light_pools_without_bias_though_its_variance_follows_it():
    """By each pixel's own variance, the darker by noise would be the more certain: one part in 1 + 1/N."""
    rng = np.random.default_rng(4)
    counts = rng.poisson(25, (160, 160)).astype(np.float32)
    everywhere, nowhere = np.ones(counts.shape, np.bool_), np.zeros_like(counts)
    found, _ = pooled(counts, lambda light: light, everywhere, nowhere, 0.05)
    # Of the same counts, so no noise; 0.6 % too dark, for the pooled light still knows of the pixel's own.
    # By each pixel's own variance it would be 3 %.
    assert found.mean() / counts.mean() == pytest.approx(1, abs=0.01)
    assert found.std() < 0.7 * counts.std()


def test_an_edge_of_four_decades_stays_where_it_is():
    light = np.where(np.arange(COLS) < COLS // 2, 1e-3, 10.0) * np.ones((ROWS, 1))
    sigma = np.where(np.arange(ROWS) % 2, 0.002, 0.3)[:, None]
    noisy = light * (1 + sigma * np.random.default_rng(1).normal(size=light.shape).clip(-2, 2))
    found, _ = pooled(
        noisy.astype(np.float32),
        lambda irradiance: ((sigma * irradiance) ** 2).astype(np.float32),
        EVERYWHERE,
        NOWHERE,
        0.05,
    )
    wrong = np.log2(found / light)
    assert np.abs(wrong[1::2]).max() < 0.02
    dark, bright = wrong[::2, : COLS // 2], wrong[::2, COLS // 2 :]
    unpooled = np.log2(noisy / light)[::2]
    assert rms(dark[:, :-1]) < rms(unpooled) / 3
    assert rms(bright[:, 1:]) < rms(unpooled) / 3
    # Beside the edge, too.
    assert rms(dark[:, -1]) < 0.5
    assert rms(bright[:, 0]) < 0.5


def test_nothing_falls_below_what_saturation_says():
    dark, measured = np.full((5, 5), 0.1, np.float32), np.ones((5, 5), np.bool_)
    own = np.full((5, 5), 1e-6, np.float32)
    dark[2, 2], own[2, 2] = 1.5, 9.0
    floor = np.zeros((5, 5), np.float32)
    free, _ = pooled(dark, lambda _: own, measured, floor, 0.05)
    assert free[2, 2] == pytest.approx(0.1, rel=0.02)
    floor[2, 2] = 1.2
    light, variance = pooled(dark, lambda _: own, measured, floor, 0.05)
    assert light[2, 2] == np.float32(1.2)
    assert variance[2, 2] == np.float32(1.2) ** 2  # as uncertain as bright
    # Whether it was measured or guessed; and guesses tell others nothing.
    measured[2, 2] = False
    light, _ = pooled(dark, lambda _: own, measured, floor, 0.05)
    assert light[2, 2] == np.float32(1.2)
    np.testing.assert_allclose(np.delete(light.ravel(), 12), 0.1, rtol=1e-6)
    floor[2, 2] = 0
    assert pooled(dark, lambda _: own, measured, floor, 0.05)[0][2, 2] == pytest.approx(0.1, rel=0.02)


def test_neighbours_that_contradict_make_no_pixel_surer():
    """Every other pixel twice as bright, each as uncertain as half of that."""
    board = 1.0 + np.indices((ROWS, COLS)).sum(axis=0) % 2
    own = np.full((ROWS, COLS), 0.2, np.float32)
    _, variance = pooled(board.astype(np.float32), lambda _: own, EVERYWHERE, NOWHERE, 0.05)
    _, agreed = pooled(np.full_like(own, 1.5), lambda _: own, EVERYWHERE, NOWHERE, 0.05)
    inner = np.s_[1:-1, 1:-1]
    assert (variance[inner] > 1.2 * agreed[inner]).all()
    assert (variance <= own).all()


def test_what_saturates_alone_is_as_bright_as_its_neighbours_on_both_sides():
    """A slope in a mosaic that stands still; its longest exposure saturates at 1.5, the next at 4."""
    light = np.broadcast_to(np.geomspace(1.8, 3.6, 24), (ROWS, 24)).astype(np.float32)
    alone = decoded(light, HdrMosaic(shifts=False), neighbours=False)
    together = decoded(light, HdrMosaic(shifts=False))
    hidden = alone.interpolated.copy()
    assert 0.2 < hidden.mean() < 0.3
    np.testing.assert_array_equal(together.interpolated, hidden)
    hidden[:, [0, -1]] = False  # these have neighbours on one side only
    # By the nearest it is off by the slope, 3 % a pixel.
    assert rms(stops(together, light)[hidden]) < 0.4 * rms(stops(alone, light)[hidden])


def test_darkness_is_averaged_before_it_is_made_positive():
    """Four electrons in all frames together, six of noise: alone, pixels are 1.5 times too bright."""
    light = np.full((80, 80), 4 / (270 * 51), np.float32)
    found = decoded(light, HdrMosaic(), threshold_sigma=6.0).irradiance_w_m2
    assert found.mean() / light[0, 0] == pytest.approx(1, abs=0.12)


def test_the_paper_averages_no_neighbours():
    light = np.random.default_rng(5).uniform(0.01, 0.03, (ROWS, COLS)).astype(np.float32)
    alone, together = (decoded(light, HdrMosaic(), paper_literal=True, neighbours=n) for n in (False, True))
    np.testing.assert_array_equal(alone.irradiance_w_m2, together.irradiance_w_m2)


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 2**32 - 1))
def test_any_light_and_any_noise_give_light(seed):
    """Finite and none negative, of 24 decades of irradiance either side of zero and of 48 of variance."""
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 9, 2))
    mean = 10.0 ** rng.uniform(-12, 12, shape) * rng.choice([1, -1, 0], shape)
    own = (10.0 ** rng.uniform(-24, 24, shape) * rng.choice([1, 0], shape)).astype(np.float32)
    measured = rng.random(shape) < 0.7
    mean = np.where(measured, mean, np.abs(mean)).astype(np.float32)
    floor = np.where(rng.random(shape) < 0.2, np.abs(mean), 0).astype(np.float32)
    light, variance = pooled(mean, lambda x: own + np.float32(1e-3) * x, measured, floor, 0.05)
    for each in (light, variance):
        assert each.dtype == np.float32
        assert np.isfinite(each).all()
        assert (each >= 0).all()
    assert (light >= floor).all()


@pytest.mark.parametrize("noise", [0.05, 0.15, 0.3])
def test_texture_above_its_noise_is_not_averaged_away(noise):
    """White texture of a third of its light, dark beside nothing: neighbours know nothing of it."""
    rng = np.random.default_rng(6)
    light = rng.uniform(0.4, 1.6, (80, 80)).astype(np.float32)
    noisy = (light + noise * rng.normal(size=light.shape)).astype(np.float32)
    everywhere, nowhere = np.ones(light.shape, np.bool_), np.zeros_like(light)
    found, _ = pooled(noisy, lambda x: np.full_like(x, noise**2), everywhere, nowhere, 0.05)
    assert rms(found - light) < 1.005 * rms(noisy - light)


def test_noise_on_even_light_is_averaged():
    """Of nine pixels with the weights of the neighbours at most 1 / 4 of the variance is left."""
    rng = np.random.default_rng(7)
    noisy = (1 + 0.1 * rng.normal(size=(80, 80))).astype(np.float32)
    everywhere, nowhere = np.ones(noisy.shape, np.bool_), np.zeros_like(noisy)
    found, variance = pooled(noisy, lambda x: np.full_like(x, 0.01), everywhere, nowhere, 0.05)
    assert rms(found - 1) < 0.65 * 0.1
    assert variance.mean() < 0.5 * 0.01
