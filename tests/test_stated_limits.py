"""Thresholds, reaches and errors are as large as stated: frames without noise, limits by hand."""

from dataclasses import replace

import numpy as np
import pytest
from ideal_camera import SLOTS, film, ideal_calibration, still_light

from optsim.calibration.demixed import demixed_frame, demixed_interval
from optsim.coding import HdrMosaic, MotionAdaptive, NormalPhotography
from optsim.core.quantities import ExposureCode
from optsim.decoding import HdrMerge

ROWS, COLS = 40, 48
ELECTRONS_A_SLOT, READ_E = 270.0, 3.0
LIGHT = 0.5
NORMAL = NormalPhotography()


def stepped(step: float, *pixels: tuple[int, int]) -> list[np.ndarray]:
    """Two frames of even light; in the second some pixels are brighter by so much."""
    after = np.full((ROWS, COLS), LIGHT)
    for v, u in pixels:
        after[v, u] += step
    return [still_light(np.full((ROWS, COLS), LIGHT)), still_light(after)]


def step_of(sigmas: float, read_e: float, gain: float) -> float:
    """Step of so many standard deviations: twice the noise of the mean of both, in the all-open frames.

    And each frame's own error of the gain.
    """
    step = 0.0
    for _ in range(20):
        noise = 2 * (36 * ELECTRONS_A_SLOT * (LIGHT + step / 2) + read_e**2) / (36 * ELECTRONS_A_SLOT) ** 2
        step = sigmas * np.sqrt(noise + (gain * LIGHT) ** 2 + (gain * (LIGHT + step)) ** 2)
    return step


def mask_after(scheme: MotionAdaptive, lights: list[np.ndarray], **camera: float) -> ExposureCode:
    """Code of the frame after all of these, seen by a panel that is always open."""
    calibration = ideal_calibration(ROWS, COLS, **camera)
    frames = film(calibration, NORMAL, lights, None)
    return scheme.next(len(frames), frames, scheme.init(calibration, np.random.default_rng(0)))[0]


@pytest.mark.parametrize(
    ("sigma", "read_e", "gain"),
    [(3.0, READ_E, 0.0), (4.0, READ_E, 0.0), (4.0, 90.0, 0.0), (4.0, READ_E, 0.02)],
)
@pytest.mark.parametrize(("share", "moves"), [(0.985, False), (1.015, True)])
def test_a_pixel_moves_beyond_so_many_standard_deviations(
    sigma: float, read_e: float, gain: float, share: float, moves: bool
) -> None:
    """For the scheme, and for the merge, which then keeps the newest frame alone."""
    lights = stepped(share * step_of(sigma, read_e, gain), (20, 24))
    camera = {"read_noise_dn": read_e, "gain_uncertainty": gain}
    # No speck is too small, nothing is dilated, and squares don't count.
    alone = {"speck_px": 1, "dilation_px": 0, "least_change": 1e3}
    found = mask_after(MotionAdaptive(threshold_sigma=sigma, **alone), lights, **camera).moving
    assert found[20, 24] == moves
    assert found.sum() == int(moves)
    calibration = ideal_calibration(ROWS, COLS, **camera)
    merge = HdrMerge(threshold_sigma=sigma, speck_px=1, neighbours=False)
    *_, layer = merge.partials(film(calibration, NORMAL, lights, None), calibration)
    expected = lights[1][0, 20, 24] if moves else (lights[0] + lights[1])[0, 20, 24] / 2
    # A count is 1e-4; the mean and the newest differ by 2 % and more.
    assert layer.irradiance_w_m2[0, 20, 24] == pytest.approx(expected, rel=2e-3)
    assert layer.moving.sum() == int(moves)


@pytest.mark.parametrize(
    ("least", "step", "moves"), [(0.2, 0.15, False), (0.2, 0.25, True), (0.1, 0.15, True)]
)
def test_of_what_is_too_noisy_for_a_pixel_a_square_moves_beyond_the_least_change(
    least: float, step: float, moves: bool
) -> None:
    square = [(v, u) for v in range(16, 25) for u in range(20, 29)]
    scheme = MotionAdaptive(least_change=least, dilation_px=0)
    found = mask_after(scheme, stepped(step * LIGHT, *square), read_noise_dn=400.0).moving
    # Four sigma are half of the light for a pixel, a tenth for 25.
    assert found[20, 24] == moves
    assert found.any() == moves


def test_all_exposures_of_a_mosaic_see_the_same_mean_time() -> None:
    """Within half a slot: so that what moves is in one place for all four."""
    tiles = HdrMosaic().tiles(SLOTS, SLOTS, np.random.default_rng(0))
    opened = np.moveaxis(tiles == 255, 1, -1).reshape(-1, SLOTS)
    middle = (opened * (np.arange(SLOTS) + 0.5)).sum(axis=1) / opened.sum(axis=1)
    np.testing.assert_allclose(middle, SLOTS / 2, atol=0.5)


def test_the_mask_reaches_as_far_as_stated_and_the_code_a_patch_further() -> None:
    """A square of 3 x 3 that steps, a pair that is too small, and one that is just large enough."""
    square = [(v, u) for v in (19, 20, 21) for u in (23, 24, 25)]
    lights = stepped(0.5, *square, (4, 6), (4, 7), (5, 6), (35, 40), (36, 41), (35, 41), (36, 40))
    scheme = MotionAdaptive(speck_px=4, dilation_px=2, patch_px=3, psf_px=1, least_change=1e3)
    code = mask_after(scheme, lights)
    expected = np.zeros((ROWS, COLS), np.bool_)
    expected[17:24, 21:28] = expected[33:39, 38:44] = True
    np.testing.assert_array_equal(code.moving, expected)
    wider = np.zeros((ROWS, COLS), np.bool_)
    wider[14:27, 18:31] = wider[30:42, 35:47] = True
    # Of the static code, some pixel has another number of open slots than the moving code's three.
    mosaic, _ = HdrMosaic().next(
        2, [], HdrMosaic().init(ideal_calibration(ROWS, COLS), np.random.default_rng())
    )
    told = np.count_nonzero(mosaic.levels, axis=0) != 3
    np.testing.assert_array_equal((np.count_nonzero(code.levels, axis=0) == 3)[told], wider[told])


def test_errors_of_the_calibration_count_as_large_as_stated() -> None:
    """Of even light E through n slots and a leak: gain g E, leak (share x leak x closed and open) E / n."""
    calibration = ideal_calibration(ROWS, COLS, leak=0.01, gain_uncertainty=0.004, leak_uncertainty=0.2)
    (frame,) = film(calibration, NormalPhotography(open_slots=3), stepped(0)[:1], None)
    sample, _ = demixed_frame(calibration, frame, calibration.panel_at_rest(), "undone")
    opened = 3 + 33 * 0.01
    rounding = 1 / 12 / (ELECTRONS_A_SLOT * opened) ** 2
    model = (0.004 * LIGHT) ** 2 + (0.2 * 0.01 * 36 * LIGHT / opened) ** 2
    found = demixed_interval(calibration, sample)
    np.testing.assert_allclose(found.shared, model + rounding, rtol=0.01)
    electrons = ELECTRONS_A_SLOT * LIGHT * opened
    noise = (electrons + READ_E**2) / (ELECTRONS_A_SLOT * opened) ** 2
    np.testing.assert_allclose(found.variance, model + noise, rtol=0.01)
    certain = demixed_interval(replace(calibration, gain_uncertainty=0, leak_uncertainty=0), sample)
    np.testing.assert_allclose(certain.variance, noise, rtol=0.01)
