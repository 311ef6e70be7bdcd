"""HDR merging beside edges, saturation and stray light: wrong guesses of others' light blacken pixels."""

from dataclasses import replace

import numpy as np
import pytest
from ideal_camera import film, ideal_calibration, still_light
from scipy import stats

from optsim.calibration import Glare
from optsim.calibration.demixed import SaturationPrior, attribution_variance, demix, demixed_frame
from optsim.coding import HdrMosaic
from optsim.core.quantities import CodedFrame
from optsim.decoding import HdrMerge
from optsim.decoding.partial import positive_mean
from optsim.decoding.readout_window import missed

ROWS, COLS = 24, 32
KERNEL = np.array([[0, 0.03, 0], [0.03, 0.88, 0.03], [0, 0.03, 0]], np.float32)


def merged(frames, calibration, **options):
    *_, result = HdrMerge(**options).decode(frames, calibration)
    return result


def coded_crosstalk(calibration, image, rng):
    """Four mosaic frames in which neighbours' codes act on the own light: what fringing fields do."""
    frames = film(calibration, HdrMosaic(), [still_light(image)] * 4, None)
    shown = []
    for frame in frames:
        weights, _ = calibration.weights(frame.code, None)
        signal = calibration.spread(weights.sum(axis=0)[None])[0] * image * calibration.responsivity_dn
        dn = signal
        if rng is not None:
            dn = rng.poisson(signal) + rng.normal(0, calibration.read_noise_dn, signal.shape)
        counts = np.clip(np.rint(dn + calibration.black_dn), 0, 16_383).astype(np.uint16)
        shown.append(CodedFrame(frame.index, counts, frame.code))
    return shown


def test_crosstalk_of_codes_blackens_no_pixel_beside_an_edge():
    """On flats it is the same as crosstalk of light, so a calibration takes it for that."""
    calibration = ideal_calibration(ROWS, COLS, crosstalk=KERNEL)
    image = np.full((ROWS, COLS), 0.05, np.float32)
    image[:, COLS // 2 :] = 0.3
    found = merged(coded_crosstalk(calibration, image, np.random.default_rng(1)), calibration)
    dark = found.irradiance_w_m2[0][:, COLS // 2 - 1]
    # Taken for light, 3 % of a neighbour six times as bright and open 36 times as long is up to six times
    # what a pixel open for a slot has itself.
    assert found.valid.all()
    np.testing.assert_allclose(dark, 0.05, rtol=0.25)
    # Without noise: long exposures count most, short ones would make it a tenth too dark.
    exact = merged(coded_crosstalk(calibration, image, None), calibration).irradiance_w_m2[0]
    np.testing.assert_allclose(exact[:, COLS // 2 - 1], 0.05, rtol=0.05)
    away = np.r_[0 : COLS // 2 - 2, COLS // 2 + 2 : COLS]
    np.testing.assert_allclose(found.irradiance_w_m2[0][:, away], image[:, away], rtol=0.15)


def test_attribution_is_no_question_in_a_flat_and_known_at_an_edge():
    calibration = ideal_calibration(ROWS, COLS, crosstalk=KERNEL)
    exposure = np.random.default_rng(0).integers(1, 37, (ROWS, COLS)).astype(np.float32)
    flat = attribution_variance(calibration, exposure, np.full((ROWS, COLS), 0.2, np.float32))
    np.testing.assert_allclose(flat, 0, atol=1e-9)
    image = np.full((ROWS, COLS), 0.1, np.float32)
    image[:, 16:] = 0.5
    found = attribution_variance(calibration, exposure, image)
    # Column 15 takes 3 % of column 16: its light, or the own in its place.
    expected = (0.03 / 0.88 * exposure[:, 16] * 0.4) ** 2 / 3
    np.testing.assert_allclose(found[:, 15], expected, rtol=1e-3)
    np.testing.assert_allclose(found[:, :14], 0, atol=1e-9)


def test_noise_alone_makes_no_question_of_attribution():
    calibration = ideal_calibration(64, 64, crosstalk=KERNEL)
    frame = film(calibration, HdrMosaic(), [still_light(np.full((64, 64), 0.1))], np.random.default_rng(2))[0]
    sample, _ = demixed_frame(calibration, frame, None, "undone")
    noise = sample.variance
    true = 0.1 * sample.exposure
    shortest = np.isclose(sample.exposure, 1)
    # 1024 pixels, so 4.4 % and five of these: at most half as much again as the noise found is predicted.
    ratio = noise[shortest].mean() / ((sample.signal - true)[shortest] ** 2).mean()
    assert 0.78 < ratio < 1.5


def test_what_saturates_in_all_frames_is_at_least_what_the_shortest_says():
    calibration = ideal_calibration(ROWS, COLS)
    image = np.full((ROWS, COLS), 0.2, np.float32)
    image[8:16, 8:20] = 400.0
    frames = film(calibration, HdrMosaic(), [still_light(image)] * 4, np.random.default_rng(3))
    found = merged(frames, calibration)
    # 15 000 DN less black, 270 DN per slot and W m^-2; the clip of 16 383 DN is the most it can say.
    low, high = (15_000 - 64) / 270, (16_383 - 64) / 270
    inside = found.irradiance_w_m2[0][8:16, 8:20]
    assert low <= inside.min()
    assert inside.max() <= high * 1.01
    assert found.interpolated[8:16, 8:20].all()


@pytest.mark.parametrize(("light", "beside", "real_share"), [(4.0, 40.0, 1.0), (8.0, 50.0, 0.5)])
def test_a_pixel_that_saturates_in_long_exposures_is_not_called_dark_by_a_short_one(
    light, beside, real_share
):
    """More than a short exposure holds may be taken off for neighbours open 36 times as long."""
    image = np.full((ROWS, COLS), light, np.float32)
    image[:, ::4] = beside
    real = KERNEL * real_share
    real[1, 1] += 1 - real.sum()
    frames = film(ideal_calibration(ROWS, COLS, crosstalk=real), HdrMosaic(), [still_light(image)] * 4, None)
    found = merged(frames, ideal_calibration(ROWS, COLS, crosstalk=KERNEL)).irradiance_w_m2[0]
    # Its saturated samples say that there is a third of it at least; the short one alone says a thousandth.
    assert (found / image)[2:-2, 4:-4].min() > 0.3


def spread_over_nine(own):
    """A kernel that leaves a pixel a share of its light."""
    corner, side = 0.075 * (1 - own), 0.175 * (1 - own)
    return np.array([[corner, side, corner], [side, own, side], [corner, side, corner]], np.float32)


@pytest.mark.parametrize("own", [1.0, 0.9, 0.8, 0.7])
def test_a_window_that_neighbours_saturate_is_as_bright_as_its_short_exposures_say(own):
    """Open for a slot beside one open for 36, a pixel gathers several times what it lets through."""
    calibration = ideal_calibration(ROWS, COLS, crosstalk=spread_over_nine(own))
    # Of 60 W m^-2 slots that saturate it.
    for light in {1.0: (20.0, 50.0), 0.9: (8.0, 18.0), 0.8: (6.0, 9.0, 12.0), 0.7: (4.0, 7.0, 9.0)}[own]:
        image = np.full((ROWS, COLS), 0.2, np.float32)
        image[6:18, 8:24] = light
        frames = film(calibration, HdrMosaic(), [still_light(image)] * 4, None)
        inside = merged(frames, calibration).irradiance_w_m2[0][8:16, 10:22]
        assert np.median(inside) == pytest.approx(light, rel=0.02)


@pytest.mark.parametrize("own", [0.8, 0.65])
def test_a_dead_pixel_darkens_no_neighbour(own):
    """It is taken to look like the nearest live one, of which only its own light counts."""
    calibration = ideal_calibration(ROWS, COLS, crosstalk=spread_over_nine(own))
    alive = np.ones((ROWS, COLS), np.bool_)
    alive[8, 8] = alive[15, 15] = alive[20, 21] = False
    calibration = replace(calibration, valid=alive)
    frames = film(calibration, HdrMosaic(), [still_light(np.full((ROWS, COLS), 0.2))] * 4, None)
    frames = [replace(frame, dn=np.where(alive, frame.dn, 0).astype(np.uint16)) for frame in frames]
    found = merged(frames, calibration).irradiance_w_m2[0]
    np.testing.assert_allclose(found[alive], 0.2, rtol=0.01)


def test_what_saturates_everywhere_is_bright_whatever_is_done_about_crosstalk():
    calibration = ideal_calibration(8, 9, crosstalk=KERNEL)
    frames = film(calibration, HdrMosaic(), [still_light(np.full((8, 9), 400.0))] * 4, None)
    for crosstalk in ("undone", "row_summed"):
        assert merged(frames, calibration, crosstalk=crosstalk).irradiance_w_m2.min() > 1


def test_a_bound_that_a_real_sample_replaced_judges_no_older_frame():
    """Bright, then dark: saturated samples of the dark frames are bounds, which bright ones would satisfy."""
    calibration = ideal_calibration(ROWS, COLS)
    lights = [still_light(np.full((ROWS, COLS), light)) for light in (40.0, 40.0, 2.0, 2.0)]
    found = merged(film(calibration, HdrMosaic(), lights, None), calibration).irradiance_w_m2[0]
    assert (np.abs(found / 2.0 - 1) > 0.2).mean() < 0.02


def test_light_hidden_by_saturation_is_known_where_another_frame_says():
    """A window that saturates in long exposures hides nothing from its surroundings: short ones know it."""
    calibration = ideal_calibration(ROWS, COLS, crosstalk=spread_over_nine(0.8))
    image = np.full((ROWS, COLS), 0.2, np.float32)
    image[6:18, 8:24] = 3.0
    frames = film(calibration, HdrMosaic(), [still_light(image)] * 4, None)
    assert merged(frames, calibration).valid.mean() > 0.99


def test_what_a_light_was_at_least_is_forgotten_when_it_gets_darker():
    calibration = ideal_calibration(ROWS, COLS, crosstalk=KERNEL)
    before, after = (np.full((ROWS, COLS), 0.2, np.float32) for _ in range(2))
    before[8:16, 8:20], after[8:16, 8:20] = 400.0, 2.0
    # 2 W m^-2 still saturates in 36 slots: how much of it gets beside is known from shorter exposures since.
    lights = [still_light(before)] * 4 + [still_light(after)] * 3
    found = merged(film(calibration, HdrMosaic(), lights, None), calibration)
    # Where it saturated once more, the share of a frame that isn't known is of the new light, not of the old.
    beside = found.irradiance_w_m2[0][7, 8:20]
    assert np.median(beside) == pytest.approx(0.2, rel=0.7)
    assert beside.max() < 0.5


def test_stray_light_of_what_saturates_is_taken_out():
    """A long exposure of the sun says little of its light; the shortest one says most."""
    veiled = ideal_calibration(ROWS, COLS, glare=Glare(veil=0.02))
    image = np.full((ROWS, COLS), 0.02, np.float32)
    image[4:12, 4:12] = 50.0  # just below saturation in one slot
    frames = film(ideal_calibration(ROWS, COLS), HdrMosaic(), [still_light(image)] * 8, None)
    shown = []
    for frame in frames:
        weights, _ = veiled.weights(frame.code, None)
        signal = veiled.mix((weights * image).sum(axis=0)) * veiled.responsivity_dn
        counts = np.clip(np.rint(signal + veiled.black_dn), 0, 16_383).astype(np.uint16)
        shown.append(CodedFrame(frame.index, counts, frame.code))
    found = merged(shown, veiled).irradiance_w_m2[0]
    # The veil is 2 % of 7 slots and 4 W m^-2 on average: thirty times the dark pixels' own light.
    np.testing.assert_allclose(found[16:, 16:], 0.02, rtol=0.2)


def test_bounds_are_kept_until_a_pixel_is_measured_again():
    calibration = ideal_calibration(4, 4)
    bright, dark = still_light(np.full((4, 4), 400.0)), still_light(np.full((4, 4), 0.2))
    frames = film(calibration, HdrMosaic(), [bright] * 4 + [dark], None)
    seen, panel, most = SaturationPrior.unknown((4, 4)), None, np.zeros((4, 4), np.float32)
    for frame in frames[:4]:
        sample, panel = demixed_frame(calibration, frame, panel, "undone")
        seen = seen.after(sample)
        most = np.maximum(most, sample.floor)
    assert np.isnan(seen.irradiance).all()
    np.testing.assert_array_equal(seen.floor, most)
    assert seen.floor.min() > 50
    separated = demix(calibration, sample, seen)
    np.testing.assert_allclose(separated.signal, most * sample.exposure, rtol=1e-5)
    sample, panel = demixed_frame(calibration, frames[4], panel, "undone")
    seen = seen.after(sample)
    assert not seen.floor.any()
    np.testing.assert_allclose(seen.irradiance, 0.2, rtol=0.05)


@pytest.mark.parametrize("ratio", [-40.0, -3.0, 0.0, 0.5, 6.0, 100.0])
def test_dark_pixels_are_the_mean_of_what_they_may_be(ratio):
    sigma = 0.02
    found = positive_mean(np.array([ratio * sigma], np.float32), np.array([sigma**2], np.float32))[0]
    oracle = stats.truncnorm.mean(-ratio, np.inf, loc=ratio * sigma, scale=sigma)
    assert found == pytest.approx(oracle, rel=1e-4)


def test_without_noise_nothing_is_added():
    measured = np.array([-1.0, 0.0, 0.3], np.float32)
    np.testing.assert_allclose(positive_mean(measured, np.zeros(3, np.float32)), [0, 0, 0.3], atol=1e-12)


@pytest.mark.parametrize("ratio", [1.0, 2.0, 2.88])
def test_what_a_narrow_pick_misses_where_light_bends(ratio):
    """Along a line it curves by 0.8 a pixel squared; by hand: the mean of a x^2 over w is a w^2 / 12."""
    light = 0.4 * np.abs(np.mgrid[:12, :14][1] - 7).astype(np.float32)
    found = missed(light, np.zeros_like(light), ratio)
    np.testing.assert_allclose(found[2:-2, 7], 0.4 * (1 - ratio**-2) / 12, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(np.delete(found, 7, axis=1)[:, 1:-1], 0, atol=1e-7)


@pytest.mark.parametrize("ratio", [1, 3, 5])
def test_what_a_narrow_pick_misses_of_rough_light(ratio):
    """Power falls with the square of the frequency; 15 samples a pixel, picked and averaged."""
    rng = np.random.default_rng(3)
    samples, pixels = 15, 60
    frequency = np.fft.fftfreq(samples * pixels)
    square = frequency**2 + frequency[:, None] ** 2
    square[0, 0] = np.inf
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal(square.shape)) / np.sqrt(square)).real
    cells = field.reshape(pixels, samples, pixels, samples)
    middle = slice((samples - samples // ratio) // 2, (samples + samples // ratio) // 2)
    ccd_pixels = cells[:, middle, :, middle].mean(axis=(1, 3)).astype(np.float32)
    error = (ccd_pixels - cells.mean(axis=(1, 3)))[1:-1, 1:-1]
    stated = missed(ccd_pixels, np.zeros_like(ccd_pixels), ratio)[1:-1, 1:-1]
    # A curvature above the median counts as well: it makes a tenth.
    assert np.sqrt(np.mean(error**2)) == pytest.approx(np.sqrt(np.mean(stated**2)), rel=0.15, abs=1e-6)


def test_noise_is_not_taken_for_roughness():
    noise = np.random.default_rng(4).standard_normal((80, 80)).astype(np.float32)
    stated = np.sqrt(1 + missed(noise, np.ones_like(noise), 3.0) ** 2)
    assert 1 < np.sqrt(np.mean(stated**2)) < 1.1


def test_the_ratio_of_a_camera_is_that_of_its_picks():
    calibration = ideal_calibration(ROWS, COLS)
    assert calibration.ratio == 1
    row, col = (np.floor(2.88 * (pick + 0.5)).astype(np.int64) for pick in np.mgrid[:ROWS, :COLS])
    size = (3 * ROWS, 3 * COLS)
    wide = replace(calibration, centre_row=row, centre_col=col, ccd_shape=size)
    assert wide.ratio == pytest.approx(2.88, rel=0.01)


def test_the_stated_uncertainty_holds_what_a_narrow_pick_misses():
    """The same frames on a CCD of three pixels to a panel pixel: uncertain where light curves."""
    image = np.full((ROWS, COLS), 0.1, np.float32)
    image[:, COLS // 2 :] = 0.8
    calibration = ideal_calibration(ROWS, COLS)
    frames = film(calibration, HdrMosaic(), [still_light(image)] * 4, None)
    row, col = (3 * pick + 1 for pick in (calibration.centre_row, calibration.centre_col))
    wide = [CodedFrame(f.index, f.dn.repeat(3, axis=0).repeat(3, axis=1), f.code) for f in frames]
    *_, plain = HdrMerge().partials(frames, calibration)
    size = (3 * ROWS, 3 * COLS)
    *_, narrow = HdrMerge().partials(
        wide, replace(calibration, centre_row=row, centre_col=col, ccd_shape=size)
    )
    np.testing.assert_array_equal(plain.irradiance_w_m2, narrow.irradiance_w_m2)
    off = missed(plain.irradiance_w_m2[0], plain.uncertainty_w_m2[0] ** 2, 3.0)
    np.testing.assert_allclose(narrow.uncertainty_w_m2, np.hypot(plain.uncertainty_w_m2, off), rtol=1e-4)
    assert off[:, COLS // 2].min() > 0.02
