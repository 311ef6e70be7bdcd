"""Moving light's PSF cut in two: what panel pixels collect, and how far it is from the whole PSF."""

import numpy as np
import pytest

from optsim.forward import moving_blur
from optsim.forward.aberrations import Wavefront, field_psf
from optsim.forward.field_blur import FieldPsf, uniform
from optsim.forward.moving_psf import MovingPsf, divided
from optsim.forward.pixel_splines import draw, splines, spread
from optsim.forward.psf import psf_kernel
from optsim.forward.tap_blur import Grid, Patch
from optsim.hardware import prototype
from optsim.optics.objective import CORE_SHARE
from optsim.quantities import Block

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


def blurred(psf, place, excess):
    block = moving_blur.blur_moving((Block(*place, excess),), psf, np.ones(FIELD, np.float32))[0]
    whole = np.zeros((len(excess), *FIELD))
    _, height, width = block.excess.shape
    whole[:, block.row : block.row + height, block.col : block.col + width] = block.excess
    return whole


def light(kind):
    """Light of height 1: an even patch, or noise; in the middle instant none."""
    excess = np.ones((3, 70, 83), np.float32)
    if kind == "noise":
        excess = RNG.random(excess.shape, np.float32)
    excess[1] = 0
    return excess


@pytest.fixture(params=[False, True], ids=["arrays", "loops"], autouse=True)
def _loops(request, monkeypatch):
    monkeypatch.setattr(moving_blur, "FEW", 0 if request.param else 10**9)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("make", "error"), [(wings, 7e-5), (varying, 1.3e-4)])
def test_edges_are_off_by_about_a_ten_thousandth_of_their_height(make, error, place):
    whole, cut = make(), divided(make(), PITCH)
    assert cut.rest is not None
    assert cut.near.half < whole.half / 2
    excess = light("patch")
    left = blurred(cut, place, excess) - blurred(MovingPsf(whole), place, excess)
    # It is not exact: else this would measure nothing.
    assert 1e-6 < np.abs(left).max() < error
    assert not left[1].any()
    # Panel pixels see less of it.
    pixels = left[0].reshape(FIELD[0] // PITCH, PITCH, FIELD[1] // PITCH, PITCH).mean(axis=(1, 3))
    assert np.abs(pixels).max() < error / 1.8


def test_of_noise_still_less_is_left():
    excess = light("noise")
    for make in (wings, varying):
        found = [blurred(psf, PLACES[1], excess) for psf in (divided(make(), PITCH), MovingPsf(make()))]
        assert np.std(found[0] - found[1]) < 3e-5 * np.std(found[1][0, 80:120, 90:140])


@pytest.mark.parametrize("pitch", [2, 3, 5])
def test_a_flat_stays_flat_and_no_light_is_lost(pitch):
    psf = divided(wings(), pitch)
    total = wings().kernel.sum()
    assert psf.rest is not None
    assert psf.near.kernel.sum() + pitch**2 * psf.rest.kernel.sum() == pytest.approx(total, rel=1e-12)
    everywhere = np.ones((1, *FIELD), np.float32)
    np.testing.assert_allclose(blurred(psf, (0, 0), everywhere), total, rtol=2e-6)
    # A point's light, from each place in a panel pixel.
    for row, col in ((90, 90), (91, 92), (94, 91)):
        point = np.full((1, 1, 1), 1000.0, np.float32)
        found = blurred(psf, (row, col), point)
        assert found.sum() == pytest.approx(1000 * total, rel=2e-5)
        exact = blurred(MovingPsf(wings()), (row, col), point)
        assert np.abs(found - exact).max() < 1000 * 1e-4


def test_what_is_small_or_far_too_wide_stays_whole():
    for psf in (wings(reach=4), uniform(np.ones((1, 1))), wings(cell_m=0.4e-6, reach=90)):
        assert divided(psf, PITCH).rest is None
    # A large PSF of which all is in its middle.
    point = np.zeros((35, 35))
    point[17, 17] = 1
    found = divided(uniform(point), PITCH)
    assert found.near.half == 2 * PITCH
    np.testing.assert_allclose(found.rest.kernel, 0, atol=1e-15)


def test_the_prototypes_psf_is_divided_as_is_said():
    camera = prototype()
    shape, cell_m = (camera.panel_rows * 3, camera.panel_cols * 3), camera.modulator.pitch_m / 3
    lens = camera.objective
    reach = lens.half_width(lens.working_f_number, cell_m, CORE_SHARE, camera.wavelength_m)
    psf = lens.psf(lens.working_f_number, cell_m, shape, 0.0, camera.wavelength_m).middle(reach)
    assert divided(psf, 3).near.half == 7
    whole = psf.whole
    inner = slice(psf.half - 7, psf.half + 8)
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
    found = {many: spread(Patch(excess, *place), PITCH, pixels, many) for many in (False, True)}
    np.testing.assert_allclose(found[False].excess, found[True].excess, atol=3e-6)
    other = RNG.normal(0, 1, found[True].excess.shape).astype(np.float32)
    fine = {many: np.empty((3, *size), np.float32) for many in (False, True)}
    for many, drawn in fine.items():
        corner = found[many].row - pixels.margin, found[many].col - pixels.margin
        draw(Patch(other, *corner), PITCH, *place, drawn, many)
    np.testing.assert_allclose(fine[False], fine[True], atol=2e-6)
    inside = place[0] > 0 and place[0] + size[0] < 60 and place[1] > 0 and place[1] + size[1] < 72
    forth, back = (found[True].excess * other).sum(dtype=float), (fine[True] * excess).sum(dtype=float)
    assert (abs(forth - back) < 1e-4) == inside


def test_uniform_psfs_and_ones_that_only_could_vary_are_the_same():
    kernel = wings().kernel
    nodes = np.broadcast_to(kernel, (3, 3, *kernel.shape)).copy()
    excess = light("noise")
    one, many = (
        blurred(divided(psf, PITCH), PLACES[2], excess) for psf in (uniform(kernel), FieldPsf(kernel, nodes))
    )
    np.testing.assert_allclose(one, many, atol=3e-6)
