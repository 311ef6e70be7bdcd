"""Regions that saturate in every frame: their glare tells how bright they are."""

from types import SimpleNamespace

import numpy as np
import pytest
from ideal_camera import BLACK_DN, film, ideal_calibration, still_light

from optsim.calibration import Glare
from optsim.coding import HdrMosaic
from optsim.core.quantities import CodedFrame
from optsim.decoding import HdrMerge
from optsim.decoding.hidden_light import _darkest, _regions

ROWS, COLS = 60, 80
KERNEL = np.array([[0.012, 0.03, 0.012], [0.03, 0.832, 0.03], [0.012, 0.03, 0.012]], np.float32)
GLARE = Glare(0.0025, 0.002, 18.0, (0.0054, 0.0054, 0.0054, 0.0027))
# As a bench found them of a camera that has these, tests/test_laboratory.py.
MEASURED = Glare(0.0026, 0.0019, 17.0, (0.0056, 0.0052, 0.0056, 0.0020))


def room(rng, *windows):
    """A dim room of uneven light, and windows: (rows, columns, brightness)."""
    image = 0.01 * rng.lognormal(0, 0.7, (ROWS, COLS))
    for rows, cols, light in windows:
        image[rows, cols] = light
    return image.astype(np.float32)


def merged(images, true, known, seed=1, kernel=KERNEL):
    """Last of four frames of the mosaic, merged with what is known of the glare that they have.

    Of one image, or of four; by a camera whose kernel may have changed since. Each pixel by itself: the
    room is white noise, which no neighbour knows.
    """
    images = images if isinstance(images, list) else [images] * 4
    rng = np.random.default_rng(seed)
    camera, calibration = (
        ideal_calibration(ROWS, COLS, crosstalk=k, glare=g) for k, g in ((kernel, true), (KERNEL, known))
    )
    frames = film(camera, HdrMosaic(), [still_light(image) for image in images], None)
    for index, (frame, image) in enumerate(zip(list(frames), images, strict=True)):
        weights, _ = camera.weights(frame.code, None)
        # 270 DN of as many electrons a slot and W m^-2; the converter ends at 16 383.
        electrons = 270.0 * camera.mix((weights * image).sum(axis=0))
        dn = rng.poisson(np.minimum(electrons, 1e6)) + rng.normal(0, 3, image.shape) + BLACK_DN
        counts = np.rint(dn.clip(0, 16_383)).astype(np.uint16)
        frames[index] = CodedFrame(index, counts, frame.code)
    *_, layer = HdrMerge(neighbours=False).partials(frames, calibration)
    return layer


def stops(found, true):
    return np.log2(np.maximum(found, 1e-6) / true)


@pytest.mark.parametrize("known", [GLARE, MEASURED], ids=["glare known", "glare measured"])
@pytest.mark.parametrize("light", [20.0, 32.0, 60.0, 200.0])
def test_a_window_that_saturates_in_every_frame_is_as_bright_as_its_glare_says(light, known):
    """From just past what fills a slot to ten times that, and so is the room: within its uncertainty."""
    window = np.s_[12:33], np.s_[14:35]
    image = room(np.random.default_rng(2), (*window, light))
    layer = merged(image, GLARE, known)
    found, inside = layer.irradiance_w_m2[0], np.s_[15:30, 17:32]
    assert layer.interpolated[inside].all() or light < 60
    # 25 % too little of the brightest: its rim, which saturates by its light, is taken to be as bright.
    assert stops(found[inside].mean(), light) == pytest.approx(0, abs=0.15 if light < 100 else 0.45)
    far = np.ones(image.shape, bool)
    far[8:37, 10:39] = False
    deviation = (found - image)[far] / layer.uncertainty_w_m2[0][far]
    assert np.sqrt(np.mean(deviation**2)) < 1.4
    assert np.median(stops(found, image)[far]) == pytest.approx(0, abs=0.15 if light < 100 else 0.6)


def test_two_windows_are_told_apart():
    """The first is three times as bright as the second."""
    windows = (np.s_[8:26], np.s_[8:26], 90.0), (np.s_[34:52], np.s_[52:70], 30.0)
    image = room(np.random.default_rng(3), *windows)
    found = merged(image, GLARE, GLARE).irradiance_w_m2[0]
    first, second = found[12:22, 12:22].mean(), found[38:48, 56:66].mean()
    assert stops(first, 90.0) == pytest.approx(0, abs=0.2)
    assert stops(second, 30.0) == pytest.approx(0, abs=0.3)


def test_a_lamp_that_two_frames_saw_waits_for_the_others():
    """On since the frame before: bounds still follow the codes, and no factor makes that light."""
    dark, lit = (
        room(np.random.default_rng(7), (np.s_[20:36], np.s_[20:36], light)) for light in (0.01, 60.0)
    )
    late, blind = (merged([dark, dark, lit, lit], g, g) for g in (GLARE, Glare()))
    lamp = late.interpolated & blind.interpolated
    assert lamp.sum() > 40
    found, expected = (each.irradiance_w_m2[0][lamp] for each in (late, blind))
    # Means over 9 x 9 pixels see glare as a change: then a pixel's bound is that of one frame.
    assert np.isclose(found, expected, rtol=0.1).mean() > 0.95
    assert found.max() < 2 * 60


def test_a_camera_that_drifted_does_not_pass_crosstalk_off_as_glare():
    """Each pixel gets 5 % more of its left neighbour than was calibrated: an offset too, but in the dark."""
    shifted = KERNEL.copy()
    shifted[1, 0] += 0.05
    shifted[1, 1] -= 0.05
    image = room(np.random.default_rng(8))
    image[:, 4:] *= 100
    image[12:33, 14:35] = 60
    inside = merged(image, GLARE, GLARE, kernel=shifted).irradiance_w_m2[0][15:30, 17:32]
    assert stops(inside.mean(), 60.0) == pytest.approx(0, abs=0.15)


@pytest.mark.parametrize("more", [0.05, 0.1])
def test_bars_that_moved_in_one_place_are_no_glare(more):
    """A corner window with little glare: residuals of the bars resemble it, but only where they stand."""
    shifted = KERNEL.copy()
    shifted[1, 0] += more
    shifted[1, 1] -= more
    image = room(np.random.default_rng(8))
    for left in range(2, 20, 4):
        image[20:56, left : left + 2] = 3
    image[:6, -8:] = 60
    weak = Glare(GLARE.veil / 5, GLARE.ghost / 5, 18.0, tuple(each / 5 for each in GLARE.wings))
    inside = merged(image, weak, weak, kernel=shifted).irradiance_w_m2[0][1:5, -7:-1]
    assert stops(inside.mean(), 60.0) == pytest.approx(0, abs=0.1)


def test_without_glare_nobody_knows_better():
    """What saturated alone stays as it was: bright as if through its own code alone, here a third of it."""
    image = room(np.random.default_rng(4), (np.s_[12:33], np.s_[14:35], 180.0))
    blind = merged(image, Glare(), Glare())
    inside = np.s_[15:30, 17:32]
    bound = blind.irradiance_w_m2[0][inside]
    assert stops(bound.mean(), 180.0) < -1.3
    knowing = merged(image, GLARE, GLARE).irradiance_w_m2[0][inside]
    assert abs(stops(knowing.mean(), 180.0)) < 0.45


def test_few_pixels_come_out_no_worse_than_their_bound():
    """Three pixels just past saturation: their glare nearly drowns in noise."""
    image = room(np.random.default_rng(5), (np.s_[30:31], np.s_[40:43], 30.0))
    with_glare, without = (merged(image, g, g).irradiance_w_m2[0] for g in (GLARE, Glare()))
    off, bound_off = (np.abs(stops(each[30, 40:43], 30.0)).mean() for each in (with_glare, without))
    assert off < bound_off + 0.05


def test_glare_that_drowns_in_noise_is_not_believed():
    """A millionth of the light: the estimate stays the bound, where a fit of noise would move it."""
    image = room(np.random.default_rng(6), (np.s_[12:33], np.s_[14:35], 60.0))
    faint, blind = (merged(image, g, g).irradiance_w_m2[0][15:30, 17:32] for g in (Glare(1e-6), Glare()))
    np.testing.assert_allclose(faint, blind, rtol=0.01)


def test_nothing_gets_darker_than_what_just_saturates():
    """Two frames: the second says 4, a third of what is assumed, and nothing where it shows another light."""
    shape = (2, 3)
    first, second = (
        SimpleNamespace(uniform=np.full(shape, 8.0) / g, saturated=np.ones(shape, bool)) for g in (4.0, 2.0)
    )
    alive = [np.ones(shape, bool), np.array([[True, True, False]] * 2)]
    factor = _darkest([first, second], alive, np.array([[12.0, 2.0, 12.0]] * 2))
    np.testing.assert_allclose(factor, [[4 / 12, 1, 2 / 12]] * 2)


def test_regions_are_connected_large_enough_and_the_brightest_come_first():
    light = np.zeros((40, 40), np.float32)
    light[2:8, 2:8] = 1
    light[20:26, 20:26] = 5
    light[30:33, 5:8] = 100  # nine pixels
    first, second = _regions(light)
    assert first[22, 22]
    assert first.sum() == 36
    assert second[4, 4]
    assert second.sum() == 36
