"""Moving light's PSF cut in two: what panel pixels collect, and how far it is from the whole PSF."""

import numpy as np
import pytest

from optsim.camera.hardware import prototype
from optsim.camera.parts.objective import MOVING_TAIL_SHARE
from optsim.core.quantities import Block
from optsim.optics import moving_blur
from optsim.optics.aberrations import Wavefront, field_psf
from optsim.optics.field_blur import FieldPsf, uniform
from optsim.optics.fringing import fine_image
from optsim.optics.moving_psf import divided
from optsim.optics.pixel_splines import draw, splines, spread
from optsim.optics.psf import psf_kernel
from optsim.optics.psf_tails import cut_softly
from optsim.optics.tap_blur import Grid, Patch

RNG = np.random.default_rng(88)
FIELD, PITCH = (180, 210), 3
PLACES = [(0, 0), (61, 70), (110, 127)]


def wings(cell_m=6.67e-6, reach=17):
    """PSF about as the prototype's, up to the reach that moving light gets in each instant."""
    kernel = psf_kernel(6.0, 3e-6, cell_m, 550e-9, 5e-3)
    return uniform(kernel).middle(reach)


def varying():
    kernel = psf_kernel(6.0, 3e-6, 6.67e-6, 550e-9, 5e-3)
    bent = Wavefront(spherical_waves=0.07, coma_waves=0.12, astigmatism_waves=0.15, curvature_waves=0.14)
    lens = {"f_number": 6.0, "sigma_m": 3e-6, "cell_m": 6.67e-6, "wavelength_m": 550e-9}
    return field_psf(bent, kernel, sides=FIELD, field_error=0.02, **lens).middle(17)


def blurred(psf, place, excess, pitch=PITCH):
    block = moving_blur.blur_moving((Block(*place, excess),), psf, pitch, np.ones(FIELD, np.float32))[0]
    whole = np.zeros((len(excess), *FIELD))
    _, height, width = block.excess.shape
    whole[:, block.row : block.row + height, block.col : block.col + width] = block.excess
    return whole


def both(monkeypatch, psf, place, excess, pitch=PITCH):
    """With the PSF divided, and with all of it in every instant."""
    monkeypatch.setattr(moving_blur, "FEW", 0)
    assert divided(psf, pitch).rest is not None
    cut = blurred(psf, place, excess, pitch)
    monkeypatch.setattr(moving_blur, "FEW", 10**9)
    return cut, blurred(psf, place, excess, pitch)


def light(kind):
    """Light of height 1: an even patch, or noise; in the middle instant none."""
    excess = np.ones((3, 70, 83), np.float32)
    if kind == "noise":
        excess = RNG.random(excess.shape, np.float32)
    excess[1] = 0
    return excess


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("make", "error"), [(wings, 7e-5), (varying, 1.3e-4)])
def test_edges_are_off_by_about_a_ten_thousandth_of_their_height(monkeypatch, make, error, place):
    cut, whole = both(monkeypatch, make(), place, light("patch"))
    left = cut - whole
    # It is not exact: else this would measure nothing.
    assert 1e-6 < np.abs(left).max() < error
    assert not left[1].any()
    # Panel pixels see less of it.
    pixels = left[0].reshape(FIELD[0] // PITCH, PITCH, FIELD[1] // PITCH, PITCH).mean(axis=(1, 3))
    assert np.abs(pixels).max() < error / 1.8


@pytest.mark.parametrize("make", [wings, varying])
def test_of_noise_still_less_is_left(monkeypatch, make):
    cut, whole = both(monkeypatch, make(), PLACES[1], light("noise"))
    assert np.std(cut - whole) < 6e-5 * np.std(whole[0, 80:120, 90:140])


@pytest.mark.parametrize("pitch", [2, 3, 5])
def test_a_flat_stays_flat_and_no_light_is_lost(monkeypatch, pitch):
    psf = wings()
    cut, total = divided(psf, pitch), psf.kernel.sum()
    assert cut.near.kernel.sum() + pitch**2 * cut.rest.kernel.sum() == pytest.approx(total, rel=1e-12)
    everywhere = np.ones((1, *FIELD), np.float32)
    for flat in both(monkeypatch, psf, (0, 0), everywhere, pitch):
        np.testing.assert_allclose(flat, total, rtol=2e-6)
    # A point's light, from each place in a panel pixel.
    for place in ((90, 90), (91, 92), (94, 91)):
        found, exact = both(monkeypatch, psf, place, np.full((1, 1, 1), 1000.0, np.float32), pitch)
        assert found.sum() == pytest.approx(1000 * total, rel=2e-5)
        assert np.abs(found - exact).max() < 1000 * 1e-4


def test_a_flat_stays_flat_between_nodes_and_at_the_border_of_any_field(monkeypatch):
    """Both parts are interpolated by themselves, on grids of their own."""
    bent = Wavefront(coma_waves=0.2)
    lens = {"f_number": 6.0, "sigma_m": 3e-6, "cell_m": 6.67e-6, "wavelength_m": 550e-9}
    kernel = psf_kernel(6.0, 3e-6, 6.67e-6, 550e-9, 5e-3)
    psf = field_psf(bent, kernel, sides=FIELD, field_error=0.02, **lens).middle(17)
    sums = divided(psf, PITCH).rest.whole.sum(axis=(2, 3))
    assert np.ptp(sums) < 1e-12
    for flat in both(monkeypatch, psf, (0, 0), np.ones((1, *FIELD), np.float32)):
        np.testing.assert_allclose(flat, psf.whole[0, 0].sum(), rtol=2e-6)


def test_blocks_are_blurred_each_by_itself_and_wherever_they_end(monkeypatch):
    """Two that overlap; and light in a block, or in a larger one that is dark around it."""
    monkeypatch.setattr(moving_blur, "FEW", 0)
    psf, ones = varying(), np.ones(FIELD, np.float32)
    patches = [(Block(50, 61, light("noise"))), Block(83, 40, light("patch"))]
    together = moving_blur.blur_moving(tuple(patches), psf, PITCH, ones)
    for block, found in zip(patches, together, strict=True):
        alone = blurred(psf, (block.row, block.col), block.excess)
        _, height, width = found.excess.shape
        inside = alone[:, found.row : found.row + height, found.col : found.col + width]
        np.testing.assert_array_equal(found.excess, inside)
        whole = np.zeros((3, *FIELD), np.float32)
        whole[:, block.row : block.row + 70, block.col : block.col + 83] = block.excess
        np.testing.assert_allclose(blurred(psf, (0, 0), whole), alone, atol=2e-6)


def test_a_lone_sample_is_found_wherever_rows_and_columns_that_are_in_work_end(monkeypatch):
    monkeypatch.setattr(moving_blur, "FEW", 0)
    psf, lone = varying(), np.ones((1, 1, 1), np.float32)
    for at in range(-8, 9):
        place = moving_blur._ROWS + at, FIELD[1] // 2 + at
        whole = np.zeros((1, *FIELD), np.float32)
        whole[(0, *place)] = 1
        np.testing.assert_allclose(blurred(psf, (0, 0), whole), blurred(psf, place, lone), atol=1e-7)


def test_what_is_small_or_far_too_wide_stays_whole():
    for psf in (wings(reach=4), uniform(np.ones((1, 1))), wings(cell_m=0.4e-6, reach=90), wings(cell_m=1e-6)):
        assert divided(psf, PITCH).rest is None
    # Nor one on which there is nothing to gain, or that is not smooth.
    assert divided(wings(reach=12), 1).rest is None
    spike = np.zeros((31, 31))
    spike[15, 15], spike[0, 0] = 0.991, 0.009
    assert divided(uniform(spike), PITCH).rest is None
    # Nor one that varies beyond what is worked through tap by tap.
    nodes = np.broadcast_to(wings().kernel[4:-4, 4:-4], (3, 3, 27, 27)).copy()
    assert divided(FieldPsf(wings().kernel, nodes), PITCH).rest is None
    # A large PSF of which all is in its middle.
    point = np.zeros((35, 35))
    point[17, 17] = 1
    found = divided(uniform(point), PITCH)
    assert found.near.half == 3 * PITCH
    np.testing.assert_allclose(found.rest.kernel, 0, atol=1e-15)


def test_the_prototypes_psf_is_divided_as_is_said():
    camera = prototype()
    shape, cell_m = (camera.panel_rows * 3, camera.panel_cols * 3), camera.modulator.pitch_m / 3
    lens = camera.objective
    reach = lens.half_width(lens.working_f_number, cell_m, MOVING_TAIL_SHARE, camera.wavelength_m)
    psf, _ = cut_softly(lens.psf(lens.working_f_number, cell_m, shape, 0.0, camera.wavelength_m), reach)
    assert divided(psf, 3).near.half == psf.core_half == 10
    whole = psf.whole
    inner = slice(psf.half - 10, psf.half + 11)
    assert 1 - (whole[:, :, inner, inner].sum(axis=(2, 3)) / whole.sum(axis=(2, 3))).min() < 1e-2


@pytest.mark.parametrize("pitch", [1, 2, 3, 7])
def test_splines_are_the_quadratic_ones_and_share_all_light(pitch):
    shares = splines(pitch)
    np.testing.assert_allclose(shares.sum(axis=1), 1, atol=1e-15)
    assert shares.min() >= 0
    # They pass straight lines on: the mean place of a sample's light is its own.
    place = (np.arange(pitch) + 0.5) / pitch - 0.5
    np.testing.assert_allclose(shares @ [-1, 0, 1], place, atol=1e-15)


@pytest.mark.parametrize(("place", "size"), [((0, 0), (13, 9)), ((7, 11), (20, 35)), ((40, 40), (20, 32))])
def test_to_draw_is_the_transpose_of_to_spread(place, size):
    """Within the field; where light touches the border it goes on, so there what is spread is more."""
    pixels = Grid(60 // PITCH + 8, 72 // PITCH + 8, 4)
    excess = RNG.normal(0, 1, (3, *size)).astype(np.float32)
    found = spread(Patch(excess, *place), PITCH, pixels)
    corner = found.row - pixels.margin, found.col - pixels.margin
    other = RNG.normal(0, 1, found.excess.shape).astype(np.float32)
    fine = np.empty((3, *size), np.float32)
    draw(Patch(other, *corner), PITCH, *place, fine)
    shares = splines(PITCH)
    for pixel_light, drawn in zip(other, fine, strict=True):
        all_drawn = fine_image(pixel_light.astype(float), shares)
        top, left = place[0] - corner[0] * PITCH, place[1] - corner[1] * PITCH
        np.testing.assert_allclose(drawn, all_drawn[top : top + size[0], left : left + size[1]], atol=2e-6)
    inside = place[0] > 0 and place[0] + size[0] < 60 and place[1] > 0 and place[1] + size[1] < 72
    forth, back = (found.excess * other).sum(dtype=float), (fine * excess).sum(dtype=float)
    assert (abs(forth - back) < 1e-4) == inside


def test_uniform_psfs_and_ones_that_only_could_vary_are_the_same(monkeypatch):
    kernel = wings().kernel
    nodes = np.broadcast_to(kernel[7:-7, 7:-7], (3, 3, 21, 21)).copy()
    excess = light("noise")
    found = [
        both(monkeypatch, psf, PLACES[2], excess)[0] for psf in (uniform(kernel), FieldPsf(kernel, nodes))
    ]
    np.testing.assert_allclose(*found, atol=3e-6)
