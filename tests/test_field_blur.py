"""Blur that varies over the field: each point its own PSF, energy kept, exact adjoint, stated aberrations."""

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from optsim.camera.parts import Objective, Relay, form_image
from optsim.core.quantities import Block, RadianceVideo, Segment
from optsim.optics import moving_blur
from optsim.optics.aberrations import Wavefront, field_psf
from optsim.optics.field_blur import FieldBlur, FieldPsf, hats, make_field_blur, uniform
from optsim.optics.moving_psf import MovingPsf
from optsim.optics.psf import Blur, extend, psf_kernel
from optsim.optics.tap_blur import LARGEST_TAPS

WAVELENGTH_M = 550e-9
LENS = {"f_number": 3.9, "sigma_m": 2e-6, "cell_m": 4.36e-6, "wavelength_m": WAVELENGTH_M}
ACHROMAT = Wavefront(spherical_waves=0.07, coma_waves=0.12, astigmatism_waves=0.15, curvature_waves=0.14)


def psf(wavefront=ACHROMAT, field_error=0.02, sides=(50, 60), **changes):
    lens = LENS | changes
    disc_m = abs(lens.get("defocus_m", 0.0)) / lens["f_number"]
    kernel = psf_kernel(lens["f_number"], lens["sigma_m"], lens["cell_m"], WAVELENGTH_M, 5e-3, disc_m=disc_m)
    return field_psf(wavefront, kernel, sides=sides, field_error=field_error, **lens)


def test_every_point_spreads_with_its_own_psf_and_the_adjoint_is_exact():
    rng = np.random.default_rng(4)
    found = psf()
    shape = (50, 60)
    blur = make_field_blur(found, shape)
    assert isinstance(blur, FieldBlur)
    points = np.zeros(shape)
    places = [(0, 0), (3, 55), (25, 30), (44, 11), (49, 59)]
    expected = np.zeros((50 + 2 * found.half, 60 + 2 * found.half))
    for k, (row, col) in enumerate(places):
        points[row, col] = k + 1
        own = found.at((row + 0.5) / 25 - 1, (col + 0.5) / 30 - 1)
        expected[row : row + len(own), col : col + len(own)] += (k + 1) * own
    inside = expected[found.half : found.half + 50, found.half : found.half + 60]
    np.testing.assert_allclose(blur.apply(points), inside, atol=1e-12)
    image, other = rng.random((2, *shape))
    forth, back = (blur.apply(image) * other).sum(), (blur.adjoint(other) * image).sum()
    assert forth == pytest.approx(back, rel=1e-11)
    np.testing.assert_array_equal(blur.apply(image), blur.apply(image))


@pytest.mark.slow
@pytest.mark.parametrize(("loops", "even_rim"), [(False, 0), (False, 7), (True, 0)])
@pytest.mark.parametrize("field_error", [0.005, 0.03, 1.0])
@pytest.mark.parametrize("place", [(0, 0), (35, 61), (70, 110)])
def test_moving_light_gets_the_psf_of_each_point(monkeypatch, place, field_error, loops, even_rim):
    """Every point of the field: what it collects of a block, and what its own PSF would; cut at no seam."""
    monkeypatch.setattr(moving_blur, "FEW", 0 if loops else 10**9)
    found, field = psf(field_error=field_error, sides=(120, 150)), (120, 150)
    middle = found.middle(found.middle(0).half + even_rim)
    factor = np.linspace(0.5, 1, 120 * 150, dtype=np.float32).reshape(field)
    excess = np.random.default_rng(7).normal(0, 1, (3, 50, 40)).astype(np.float32)
    excess[1] = 0  # an instant without any
    whole = np.zeros((3, *field))
    whole[:, place[0] : place[0] + 50, place[1] : place[1] + 40] = excess
    reach = middle.half
    wide = np.pad(whole, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    windows = sliding_window_view(wide, (2 * reach + 1, 2 * reach + 1), axis=(1, 2))
    if found.cores.size:
        hats_y, hats_x = (hats((np.arange(n) + 0.5) / n * 2 - 1, len(found.cores)) for n in field)
        own = np.einsum("iy,jx,ijkl->yxkl", hats_y, hats_x, middle.cores, optimize=True)
        cores = slice(even_rim, 2 * reach + 1 - even_rim)
        exact = np.einsum("tyxkl,yxkl->tyx", windows[..., cores, cores], own, optimize=True)
        exact = (exact + np.einsum("tyxkl,kl->tyx", windows, middle.common, optimize=True)) * factor
    else:
        exact = np.einsum("tyxkl,kl->tyx", windows, middle.kernel, optimize=True) * factor
    assert not loops or middle.half <= LARGEST_TAPS
    monkeypatch.setattr(moving_blur, "divided", lambda psf, _: MovingPsf(psf))
    block = moving_blur.blur_moving((Block(*place, excess),), middle, 3, factor)[0]
    _, height, width = block.excess.shape
    ours = np.zeros((3, *field))
    ours[:, block.row : block.row + height, block.col : block.col + width] = block.excess
    # The block's light is between -5 and 5, in float32.
    np.testing.assert_allclose(ours, exact, atol=5e-6)
    assert not block.excess[1].any()


def test_psfs_are_positive_and_keep_the_energy_at_and_between_the_nodes():
    found = psf()
    for y, x in np.random.default_rng(5).uniform(-1, 1, (30, 2)):
        own = found.at(y, x)
        assert own.min() >= 0
        assert own.sum() == pytest.approx(1, abs=1e-12)
    assert 0.04 < np.abs(found.at(0, 0) - found.at(1, 1)).sum() / 2 < 0.5


@pytest.mark.parametrize("field_error", [0.1, 0.02, 0.008])
def test_interpolation_misplaces_what_was_allowed_and_not_far_less(field_error):
    found, exact = psf(field_error=field_error), psf(field_error=1e-3)
    worst = 0.0
    for y, x in np.random.default_rng(6).uniform(-1, 1, (200, 2)):
        worst = max(worst, np.abs(found.at(y, x) - exact.at(y, x)).sum() / 2)
    assert field_error / 8 < worst < field_error * 1.1


def test_without_variation_there_is_one_kernel():
    flat = psf(Wavefront(spherical_waves=0.1))
    assert not flat.cores.size
    assert isinstance(make_field_blur(flat, (50, 60)), Blur)
    assert flat.kernel.max() < psf(Wavefront()).kernel.max() * 0.95
    mean = psf(field_error=1.0)
    np.testing.assert_allclose(mean.kernel, mean.kernel[::-1, ::-1], atol=1e-9)
    varying, places = psf(), np.linspace(-1, 1, 9)
    everywhere = np.mean([varying.at(y, x) for y in places for x in places], axis=0)
    assert np.abs(mean.kernel - everywhere).sum() / 2 < 0.01


def spread(own):
    """Centroid and variances within 25 cells, cells."""
    middle = len(own) // 2
    reach = min(25, middle)
    part = own[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1] / own.sum()
    place = np.arange(-reach, reach + 1)
    y, x = (part.sum(axis=1) * place).sum(), (part.sum(axis=0) * place).sum()
    return y, x, (part.sum(axis=1) * (place - y) ** 2).sum(), (part.sum(axis=0) * (place - x) ** 2).sum()


def test_coma_has_its_tail_outwards_and_moves_no_centroid():
    found = psf(Wavefront(coma_waves=0.2), sides=(60, 60), cell_m=2e-6, field_error=2e-3)
    for y, x in ((1, 1), (0, 1), (-1, 0), (0.5, 0.5)):
        cy, cx, _, _ = spread(found.at(y, x))
        np.testing.assert_allclose([cy, cx], 0, atol=0.1)
        own, middle = found.at(y, x), found.half
        peak = np.array(np.unravel_index(own.argmax(), own.shape)) - middle
        # The peak lies inwards of the centroid, and a third moment along the radius points outwards.
        assert peak @ np.array([y, x]) < (1e-9 if abs(y) == 0.5 else 0)
        dy, dx = np.mgrid[-middle : middle + 1, -middle : middle + 1]
        along = (dy * y + dx * x) / np.hypot(y, x)
        near = np.hypot(dy, dx) < 20
        assert (own * along**3)[near].sum() > 5 * np.hypot(y, x)


def test_astigmatism_grows_with_the_square_and_curvature_blurs_alike_in_both_directions():
    """Rays of a W20 of c 2 sqrt(3) waves fill an even disc: variance (2 lambda N W20)^2 along each axis."""
    bent = psf(Wavefront(curvature_waves=0.5), sides=(60, 60), cell_m=2e-6, field_error=2e-3, sigma_m=0.0)
    disc = (2 * WAVELENGTH_M * LENS["f_number"] * 2 * np.sqrt(3) * 0.5 / 2e-6) ** 2
    (_, _, base, _), (_, _, y, x) = spread(bent.at(0, 0)), spread(bent.at(1, 1))
    np.testing.assert_allclose([y - base, x - base], disc, rtol=0.12)
    assert spread(bent.at(0.5, 0.5))[2] - base == pytest.approx(disc / 16, rel=0.2)
    oval = psf(Wavefront(astigmatism_waves=0.3, curvature_waves=0.15), sides=(60, 60), field_error=2e-3)
    _, _, y, x = spread(oval.at(0, 1))
    assert x > 1.1 * y
    _, _, y, x = spread(oval.at(1, 0))
    assert y > 1.1 * x


@pytest.mark.parametrize("wavefront", [Wavefront(), Wavefront(coma_waves=1e-6)])
def test_a_plane_out_of_focus_has_the_interference_of_waves_in_its_middle(wavefront):
    """On the axis W waves at the rim leave sinc^2(W) of the peak: nothing for one (Born and Wolf, 8.8)."""
    f_number, cell_m = LENS["f_number"], 0.5e-6
    depth_m = 8 * f_number**2 * WAVELENGTH_M
    peaks = []
    for waves in (0.0, 0.5, 1.0, 1.5):
        lens = {"sigma_m": 0.0, "cell_m": cell_m, "defocus_m": waves * depth_m}
        own = psf(wavefront, **lens).at(0, 0)
        peaks.append(own.max() if waves == 0 else own[len(own) // 2, len(own) // 2])
    np.testing.assert_allclose(np.array(peaks[1:]) / peaks[0], np.sinc([0.5, 1.0, 1.5]) ** 2, atol=0.012)


def test_a_large_cell_gets_the_light_of_the_small_ones_in_it():
    small, large = (psf(sigma_m=0.0, cell_m=c, field_error=2e-3).at(1, 1) for c in (2e-6, 6e-6))
    rows = np.arange(-10, 11)[:, None] * 3 + np.arange(-1, 2) + len(small) // 2
    summed = small[np.ix_(rows.ravel(), rows.ravel())].reshape(21, 3, 21, 3).sum(axis=(1, 3))
    middle = slice(len(large) // 2 - 10, len(large) // 2 + 11)
    assert np.abs(large[middle, middle] - summed).sum() / 2 < 2e-3


def test_hats_add_up_to_one_and_hold_beyond_the_field():
    places = np.linspace(-1.5, 1.5, 31)
    np.testing.assert_allclose(hats(places, 4).sum(axis=0), 1)
    np.testing.assert_array_equal(hats(np.array([-1.2, 1.3]), 3), [[1, 0], [0, 0], [0, 1]])


@pytest.fixture(params=["whole", "divided"])
def is_divided(request, monkeypatch):
    """Moving light with the whole PSF, and with one that works further off on panel pixels."""
    if request.param == "divided":
        monkeypatch.setattr(moving_blur, "FEW", 0)
    return request.param == "divided"


def test_moving_light_is_blurred_as_light_that_stands_still(is_divided):
    """A lamp in the corner, as base or as a block that doesn't move, through a lens that varies."""
    lens = Objective(glare_share=0.0, wavefront=ACHROMAT, field_error=1e-3)
    base = np.full((90, 120), 0.1, np.float32)
    lamp = np.zeros((2, 12, 18), np.float32)
    lamp[:, 3:9, 3:15] = 10.0
    lit = base.copy()
    lit[70:82, 95:113] += lamp[0]

    def imaged(image, blocks):
        video = RadianceVideo(
            rows=90, cols=120, samples_per_pitch=3, slot_s=1.0, instants_per_slot=1, slots_per_segment=2,
            n_slots=2, load=lambda _: Segment(image, image, blocks, 2), white_w_m2_sr=1.0,
        )  # fmt: skip
        return form_image(lens, video, 20e-6, 1).load(0).instant(0)

    still, moving = imaged(lit, ()), imaged(base, (Block(70, 95, lamp),))
    np.testing.assert_allclose(moving, still, rtol=3e-3, atol=5e-5 * still.max() if is_divided else 0)
    same = imaged(lit[::-1, ::-1].copy(), ())[::-1, ::-1]
    np.testing.assert_allclose(same, still, rtol=1e-5)


def test_what_is_covered_before_a_bright_window_is_blurred_exactly(is_divided):
    """The same instant as a still picture and as a block that takes light away, with few modes allowed."""
    lens = Objective(glare_share=0.0, wavefront=ACHROMAT, field_error=0.1)
    window = np.full((90, 120), 0.1, np.float32)
    window[20:60, 70:110] = 1000.0
    covered = window.copy()
    covered[40:55, 75:85] = 0.3
    excess = np.zeros((2, 30, 30), np.float32)
    excess[:, 10:25, 5:15] = 0.3 - 1000.0
    video = [
        RadianceVideo(
            rows=90, cols=120, samples_per_pitch=3, slot_s=1.0, instants_per_slot=1, slots_per_segment=2,
            n_slots=2, load=lambda _, i=image, b=blocks: Segment(i, i, b, 2), white_w_m2_sr=1.0,
        )
        for image, blocks in ((covered, ()), (window, (Block(30, 70, excess),)))
    ]  # fmt: skip
    still, moving = (form_image(lens, each, 20e-6, 1).load(0).instant(0) for each in video)
    # What is left comes from the far wings of moving light and the rest of a divided PSF: on panel pixels.
    assert np.abs(moving - still).max() < (1.5e-4 if is_divided else 5e-5) * still.max()


def test_lenses_with_odd_numbers_still_give_a_psf():
    """Aberrations of several waves, tiny fields, strong defocus: finite, positive, energy kept."""
    for wavefront, defocus in ((Wavefront(coma_waves=-1.0), 0.0), (ACHROMAT, 5e-4), (ACHROMAT, -5e-4)):
        relay = Relay(magnification=0.65, f_number=3.9, transmission=0.9, aberration_m=0.0, glare_share=0.0,
                      wavefront=wavefront, tail_share=5e-3)  # fmt: skip
        own = relay.psf(3.9, 4.36e-6, (1, 1), defocus).at(1, 1)
        assert own.min() >= 0
        assert own.sum() == pytest.approx(1, abs=1e-9)
    nothing = uniform(np.ones((1, 1)))
    same = make_field_blur(nothing, (2, 3)).apply(np.eye(2, 3))
    np.testing.assert_allclose(same, np.eye(2, 3), atol=1e-15)
    assert FieldPsf(np.ones((1, 1)), np.zeros((0, 0, 1, 1))).middle(5).half == 0
    assert extend(np.ones((1, 1)), 2).shape == (5, 5)


def test_without_aberrations_worth_the_name_the_psf_is_that_of_the_closed_form():
    """The cell's own variance is taken out of the Gaussian in both; sampling the pupil misplaces 3e-3."""
    numbers = {"f_number": 6.0, "sigma_m": 3e-6, "cell_m": 6.667e-6, "wavelength_m": WAVELENGTH_M}
    kernel = psf_kernel(6.0, 3e-6, 6.667e-6, WAVELENGTH_M, 1e-3)
    found = field_psf(Wavefront(spherical_waves=1e-6), kernel, sides=(9, 12), field_error=1.0, **numbers)
    assert 1e-3 < np.abs(found.kernel - kernel).sum() / 2 < 5e-3
