"""Motion detection: false alarms at the stated rate, edges found, bounds treated as bounds."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ideal_camera import KERNEL, everywhere, expose, film, ideal_calibration, still_light

from optsim.calibration.demixed import demixed_frame, demixed_interval
from optsim.coding import HdrMosaic, NormalPhotography, RandomExposure
from optsim.core.quantities import CodedFrame
from optsim.optics.motion import _changed_together, _pair, changed, irradiance_interval
from optsim.optics.neighbourhoods import dilated, remove_specks

ROWS, COLS = 96, 128


def seen(calibration, frames, crosstalk="undone"):
    panel = None
    result = []
    for frame in frames:
        sample, panel = demixed_frame(calibration, frame, panel, crosstalk)
        result.append(demixed_interval(calibration, sample))
    return result


def certain(value, *, saturated=False, tainted=False, variance=0.0, attribution=0.0):
    image = np.array(value, np.float32, ndmin=2)
    flag = np.ones_like(image, np.bool_)
    return irradiance_interval(
        image,
        np.ones_like(image),
        np.broadcast_to(np.float32(variance), image.shape),
        np.broadcast_to(np.float32(attribution), image.shape),
        np.zeros_like(image),
        flag & saturated,
        flag & tainted,
        flag,
        gain_uncertainty=0.0,
        exposure_uncertainty=0.0,
        map_residual_px=0.0,
    )


@pytest.mark.parametrize("scheme", [HdrMosaic(), RandomExposure()])
@pytest.mark.parametrize("irradiance", [0.02, 0.3])
@pytest.mark.parametrize("kernel", [np.ones((1, 1), np.float32), KERNEL])
def test_false_alarms_come_at_the_stated_rate(scheme, irradiance, kernel):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, crosstalk=kernel)
    light = still_light(np.full((ROWS, COLS), irradiance))
    frames = seen(calibration, film(calibration, scheme, [light] * 4, np.random.default_rng(11)))
    alarms = [changed(a, b, 2.0, reaches_px=())[0].mean() for a, b in pairwise(frames)]
    stated = math.erfc(2.0 / math.sqrt(2))
    # 36 864 pixels at 4.55 %: binomial sigma 0.11 %; 5 of these leave one false alarm in a million for the
    # binomial part. A tenth more is allowed for: few electrons are not Gaussian, undone crosstalk correlates.
    tolerance = 5 * math.sqrt(stated / (ROWS * COLS * 3)) + 0.1 * stated
    assert np.mean(alarms) == pytest.approx(stated, abs=tolerance)


@pytest.mark.parametrize("scheme", [HdrMosaic(), RandomExposure()])
@pytest.mark.parametrize("irradiance", [0.001, 0.02, 0.3])
@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("kernel", [np.ones((1, 1), np.float32), KERNEL])
def test_false_alarms_of_squares_come_at_the_stated_rate(scheme, irradiance, textured, kernel):
    """In light and in the dark (0.3 electrons a slot), beside a lamp 3000 times as bright."""
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, crosstalk=kernel, read_noise_dn=1.0)
    light = np.full((ROWS, COLS), irradiance)
    if textured:
        light *= 10 ** np.random.default_rng(4).uniform(-0.5, 0.5, light.shape)
        light[40:44, 60:64] *= 3000
    frames = seen(calibration, film(calibration, scheme, [still_light(light)] * 8, np.random.default_rng(5)))
    stated = math.erfc(2.0 / math.sqrt(2))
    pairs = [_pair(a, b) for a, b in pairwise(frames)]
    for reach in (1, 2):
        rate = np.mean([_changed_together(pair, 2.0, 0.0, reach).mean() for pair in pairs])
        # Squares overlap: 86 016 of them are as good as 86 016 over their area. 5 sigma of the binomial.
        scatter = 5 * math.sqrt(stated / (7 * ROWS * COLS) * (2 * reach + 1) ** 2)
        assert rate < 1.1 * stated + scatter
        # What crosstalk's undoing adds to noise is taken for independent; rounding, and what textures and
        # lamps leave, for an error in common. All make it less.
        if kernel.size == 1 and not textured and irradiance > 0.1:
            assert rate > 0.9 * stated - scatter


@pytest.mark.parametrize("scheme", [HdrMosaic(), RandomExposure()])
def test_few_electrons_do_not_raise_the_alarm(scheme):
    calibration = ideal_calibration(ROWS, COLS, read_noise_dn=1.0)
    light = still_light(np.full((ROWS, COLS), 0.02))
    frames = seen(calibration, film(calibration, scheme, [light] * 8, np.random.default_rng(12)))
    alarms = np.mean([changed(a, b, 4.0)[0].mean() for a, b in pairwise(frames)])
    # Stated: 6.3e-5. Poisson tails at 5 electrons are longer than Gaussian ones, but with each sample's
    # own noise in place of the pooled one the rate would be a hundred times the stated one.
    assert alarms < 20 * math.erfc(4.0 / math.sqrt(2))


def test_static_edges_do_not_move_when_the_map_is_uncertain():
    image = np.full((ROWS, COLS), 0.1, np.float32)
    image[:, COLS // 2 :] = 1.0
    sharp = ideal_calibration(ROWS, COLS)
    # The panel is really shifted by a tenth of a pixel against what the calibration believes.
    shifted = np.array([[0, 0, 0], [0, 0.9, 0.1], [0, 0, 0]], np.float32)
    real = replace(sharp, crosstalk=everywhere(shifted, ROWS, COLS))
    shot = film(real, HdrMosaic(), [still_light(image)] * 2, np.random.default_rng(2))

    def alarms(calibration):
        first, second = seen(calibration, shot)
        return changed(first, second, 4.0)[0].mean()

    assert alarms(sharp) > 0.2
    assert alarms(replace(sharp, map_residual_px=0.1)) < 0.01


def test_a_moving_edge_is_found_and_nothing_else():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    before = np.full((ROWS, COLS), 0.1, np.float32)
    after = before.copy()
    after[20:40, 50:60] = 0.3
    shots = film(
        calibration, HdrMosaic(), [still_light(before), still_light(after)], np.random.default_rng(3)
    )
    moved, undecided = changed(*seen(calibration, shots), 4.0)
    assert not undecided.any()
    truth = before != after
    # At 1/36 exposure 0.1 gives 27 electrons and 0.3 gives 81: about 5 sigma apart, so most pixels are found.
    assert moved[truth].mean() > 0.85
    assert moved[~truth].mean() < 1e-3
    grown_mask = dilated(remove_specks(moved, 4), 1)
    assert grown_mask[truth].all()
    assert not grown_mask[:17].any()


def test_what_is_too_dark_for_a_pixel_is_found_in_its_surroundings():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, crosstalk=KERNEL)
    before = np.full((ROWS, COLS), 0.01)
    after = before.copy()
    after[30:42, 50:70] *= 0.4
    shots = film(
        calibration, HdrMosaic(), [still_light(before), still_light(after)], np.random.default_rng(3)
    )
    first, second = seen(calibration, shots)
    truth = before != after
    inside = np.zeros_like(truth)
    inside[32:40, 52:68] = True
    alone, _ = changed(first, second, 4.0, reaches_px=())
    together, _ = changed(first, second, 4.0)
    assert alone[inside].mean() < 0.3
    assert together[inside].mean() > 0.8
    assert together[~dilated(truth, 2)].mean() < 1e-3


def test_noise_averages_out_over_a_square_and_model_error_does_not():
    one, more = np.ones((9, 9)), np.full((9, 9), 1.03)

    def middle(**error):
        first, second = certain(one, **error), certain(more, **error)
        return changed(first, second, 4.0)[0][4, 4]

    # 3 % are 2.1 standard deviations of a difference; over 5 x 5 pixels, 10.6 of its noise.
    assert middle(variance=1e-4)
    assert not middle(variance=1e-4, attribution=1e-4)
    assert not changed(certain(one, variance=1e-4), certain(more, variance=1e-4), 4.0, least_change=0.1)[
        0
    ].any()


def test_model_error_is_a_part_of_the_variance_and_is_counted_once():
    both = certain(1.0, variance=2.0, attribution=0.5)
    assert (both.variance[0, 0], both.shared[0, 0]) == (2.0, 0.5)


def test_squares_reach_as_far_to_all_sides_and_find_nothing_twice():
    variance, light = np.full((9, 11), 1e8), np.ones((9, 11))
    variance[4, 4:6], light[4, 4:6] = 0.5, 4.5
    pair = certain(np.ones((9, 11)), variance=variance), certain(light, variance=variance)
    # 3.5 standard deviations each, 4.9 together: where a square has both.
    three, five = np.zeros((2, 9, 11), np.bool_)
    three[3:6, 4:6] = five[2:7, 3:7] = True
    np.testing.assert_array_equal(changed(*pair, 4.0)[0], three)
    np.testing.assert_array_equal(changed(*pair, 4.0, reaches_px=(2,))[0], five)


def test_stray_light_of_a_lamp_is_no_motion_and_hides_no_motion_elsewhere():
    """A lamp's light spreads over a dark field behind the panel, in one of two frames."""
    calibration = ideal_calibration(ROWS, COLS, leak=0.01)
    light = np.full((ROWS, COLS), 0.02)
    after = light.copy()
    after[70:80, 100:115] *= 2
    scheme = HdrMosaic()
    shots = film(calibration, scheme, [still_light(light), still_light(after)], np.random.default_rng(7))
    samples = [demixed_frame(calibration, frame, None, "undone")[0] for frame in shots]
    # As much as up to five slots of the field's own light, on the left, in the first frame alone.
    wing = np.broadcast_to(np.linspace(0.2, -0.1, COLS), (ROWS, COLS)).clip(0.1, None) - 0.1
    lit = replace(samples[0], signal=(samples[0].signal + wing).astype(np.float32))
    first, second = (demixed_interval(calibration, sample) for sample in (lit, samples[1]))
    blind = (replace(b, stray=np.zeros_like(b.stray)) for b in (first, second))
    assert _changed_together(_pair(*blind), 4.0, 0.0, 2)[:60, :20].mean() > 0.5
    moved = _changed_together(_pair(first, second), 4.0, 0.0, 2)
    assert moved[:60, :20].mean() < 0.01
    assert moved[70:80, 100:115].mean() > 0.8


@pytest.mark.parametrize("irradiance", [0.004, 0.3])
@pytest.mark.parametrize("textured", [False, True])
def test_stray_light_is_told_from_noise_and_texture(irradiance, textured):
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, read_noise_dn=1.0)
    light = np.full((ROWS, COLS), irradiance)
    if textured:
        light *= 10 ** np.random.default_rng(8).uniform(-0.3, 0.3, light.shape)

    def found(scheme, added):
        shot = film(calibration, scheme, [still_light(light)], np.random.default_rng(9))[0]
        sample = demixed_frame(calibration, shot, None, "undone")[0]
        sample = replace(sample, signal=sample.signal + np.float32(added))
        return np.sqrt(demixed_interval(calibration, sample).stray) * sample.exposure

    assert (found(HdrMosaic(), 0) > 0).mean() < 0.02
    # As much as eight slots of its own light: less what three standard deviations of noise may be.
    stray = found(HdrMosaic(), 8 * irradiance)
    assert np.median(stray) == pytest.approx(8 * irradiance, rel=0.25)
    # Where all pixels are open alike, nothing tells stray light from their own.
    assert not found(NormalPhotography(open_slots=36), 8 * irradiance).any()


def test_pixels_that_are_rounded_alike_are_no_motion():
    """8 bits without a black level: light of 0.7 counts a slot is 1 in nearly all pixels."""
    calibration = replace(ideal_calibration(ROWS, COLS), black_dn=np.zeros((ROWS, COLS), np.float32))
    calibration = replace(calibration, read_noise_dn=0.3, dn_per_e=1e-3)
    level = 0.7 / float(calibration.responsivity_dn[0, 0])
    exact = np.random.default_rng(14)

    def frame(index, open_slots):
        scheme = NormalPhotography(open_slots=open_slots)
        code, _ = scheme.next(index, [], scheme.init(calibration, exact))
        slots = (code.levels > 0).sum(axis=0)
        dn = np.rint(0.7 * slots + 0.08 * exact.standard_normal(slots.shape)).clip(0).astype(np.uint16)
        return CodedFrame(index, dn, code)

    first, second = seen(calibration, [frame(0, 1), frame(1, 36)])
    assert np.median(first.low) > 1.3 * level
    assert not changed(first, second, 4.0)[0].mean() > 0.001
    shared = np.zeros_like(first.shared)
    blind = (replace(b, shared=shared) for b in (first, second))
    assert changed(*blind, 4.0)[0].mean() > 0.5


def test_a_pixel_that_says_nothing_moves_with_its_surroundings():
    flag = np.zeros((9, 9), np.bool_)
    flag[4, 4] = True
    first, second = (certain(np.full((9, 9), value), saturated=flag, variance=1e-4) for value in (1.0, 1.04))
    moved, undecided = changed(first, second, 4.0)
    assert moved[4, 4]
    assert not undecided.any()
    still = changed(first, first, 4.0)
    assert not still[0].any()
    assert still[1][4, 4]


def test_lamps_of_any_brightness_raise_no_alarm():
    light = 10 ** np.random.default_rng(6).uniform(-6, 9, (40, 50))
    with np.errstate(all="raise", under="ignore"):
        first = certain(light, variance=1e-14)
        moved, _ = changed(first, first, 4.0)
    assert not moved.any()


def test_saturated_samples_are_bounds():
    def verdict(first, second):
        moved, undecided = changed(first, second, 3.0)
        return bool(moved[0, 0]), bool(undecided[0, 0])

    assert verdict(certain(1.0, saturated=True), certain(5.0)) == (False, False)
    assert verdict(certain(1.0, saturated=True), certain(0.5)) == (True, False)
    assert verdict(certain(1.0, saturated=True), certain(9.0, saturated=True)) == (False, True)
    assert verdict(certain(1.0, tainted=True), certain(0.5)) == (False, False)
    assert verdict(certain(1.0, tainted=True), certain(1.5)) == (True, False)
    assert verdict(certain(1.0, tainted=True), certain(5.0, saturated=True)) == (True, False)
    blind = certain(1.0)
    blind = replace(blind, valid=~blind.valid)
    assert verdict(blind, certain(9.0)) == (False, True)


def test_a_sample_takes_the_place_of_a_bound_with_all_that_is_known_of_it():
    bound = certain([[1.0, 3.0]], saturated=np.array([[True, False]]), variance=1.0)
    sample = certain([[2.0, 5.0]], variance=0.5, attribution=0.25)
    np.testing.assert_array_equal(bound.measured, [[False, True]])
    found = bound.replaced(~bound.measured, sample)
    np.testing.assert_array_equal(found.low, [[2.0, 3.0]])
    np.testing.assert_array_equal(found.high, [[2.0, 3.0]])
    np.testing.assert_array_equal(found.variance, [[0.5, 1.0]])
    np.testing.assert_array_equal(found.shared, [[0.25, 0.0]])
    assert found.measured.all()


positive = st.floats(1e-3, 1e3)


@given(positive, positive, positive, st.floats(0.5, 8), st.booleans(), st.booleans())
def test_comparison_is_symmetric_and_scale_free(a, b, noise, threshold, a_bound, b_bound):
    def pair(scale):
        first = certain(a * scale, saturated=a_bound, variance=(noise * scale) ** 2)
        second = certain(b * scale, saturated=b_bound, variance=(noise * scale) ** 2)
        return first, second

    first, second = pair(1.0)
    moved = changed(first, second, threshold)
    for other in (changed(second, first, threshold), changed(*pair(4.0), threshold)):
        np.testing.assert_array_equal(moved, other)


@given(st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_growth_is_the_square_neighbourhood(reach, seed):
    mask = np.random.default_rng(seed).random((13, 17)) < 0.05
    rows, cols = np.nonzero(mask)
    v, u = np.mgrid[:13, :17]
    near = np.zeros_like(mask)
    for row, col in zip(rows, cols, strict=True):
        near |= (np.abs(v - row) <= reach) & (np.abs(u - col) <= reach)
    np.testing.assert_array_equal(dilated(mask, reach), near)


def test_specks_go_and_regions_stay():
    mask = np.zeros((10, 10), np.bool_)
    mask[1, 1] = mask[2, 2] = mask[3, 3] = True
    mask[7:9, 7:9] = True
    kept = remove_specks(mask, 4)
    assert kept.sum() == 4
    assert kept[7:9, 7:9].all()
    np.testing.assert_array_equal(remove_specks(mask, 3), mask)


def test_panel_history_is_part_of_the_comparison():
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, tau_s=2e-3)
    light = still_light(np.full((ROWS, COLS), 1.0))
    scheme = HdrMosaic()
    state = scheme.init(calibration, np.random.default_rng(0))
    panel = calibration.panel_at_rest()
    rest = panel
    shots = []
    for index in range(2):
        code, state = scheme.next(index, [], state)
        frame, panel = expose(calibration, light, index, code, panel, None)
        shots.append(frame)
    right = seen(calibration, shots)
    assert not changed(*right, 3.0)[0].any()
    forgetful = [
        demixed_interval(calibration, demixed_frame(calibration, s, rest, "undone")[0]) for s in shots
    ]
    # A slow panel still shows the frame before; in a flat it looks like stray light, which is no motion.
    assert np.abs(right[1].low - 1).max() < 0.01
    assert np.abs(forgetful[1].low - 1).max() > 0.1
