"""PSF, relay operator, crosstalk, Mueller algebra and radiometry: array functions against closed forms."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from optsim.core.quantities import Block
from optsim.optics.crosstalk import crosstalk_kernels, true_dots
from optsim.optics.field_blur import uniform
from optsim.optics.fringing import border_shares
from optsim.optics.moving_blur import blur_moving
from optsim.optics.mueller import UNPOLARISED, depolariser, mirror, polariser, retarder_45
from optsim.optics.psf import extend, make_blur, psf_kernel
from optsim.optics.radiometry import cos4, irradiance_factor, photons_per_joule
from optsim.optics.relay import Ghost, RelayGeometry, RelayOperator, overlap_operator

WAVELENGTH_M = 550e-9


def operator(geometry, *, transmission=0.9, glare=0.005, sigma_m=3e-6):
    cell_m = geometry.cell_px * 4.54e-6
    kernel = psf_kernel(4.0, sigma_m, cell_m, WAVELENGTH_M, 5e-3)
    return RelayOperator(
        make_blur(kernel, (geometry.rows, geometry.cols)),
        overlap_operator(geometry, transmission),
        glare,
        (geometry.ccd_rows, geometry.ccd_cols),
    )


def test_the_encircled_energy_of_a_fine_kernel_is_that_of_an_airy_pattern():
    from scipy.special import j0, j1

    f_number, cell_m = 6.0, 0.25e-6
    kernel = psf_kernel(f_number, 0.0, cell_m, WAVELENGTH_M, 1e-3)
    half = kernel.shape[0] // 2
    radius_m = np.hypot(*np.mgrid[-half : half + 1, -half : half + 1]) * cell_m
    for r_m in (2e-6, 4.026e-6, 10e-6, 40e-6, 150e-6):  # the second is the first dark ring, 1.22 lambda N
        v = np.pi * r_m / (WAVELENGTH_M * f_number)
        outside = j0(v) ** 2 + j1(v) ** 2
        # Cells on the circle count whole, and 0.1 % of wings are put back.
        assert 1 - kernel[radius_m <= r_m].sum() == pytest.approx(outside - 1e-3, rel=0.05, abs=1e-4)
    assert kernel.min() >= 0
    assert kernel.sum() == pytest.approx(1, abs=1e-12)


def test_the_wings_near_the_point_hold_no_folded_light():
    """Light of the ring from 16 to 24 cells; that the wings' mean leaves out oscillates by a percent."""
    from scipy.special import j0, j1

    cell_m = 20e-6 / 3
    kernel = psf_kernel(6.0, 2e-6, cell_m, WAVELENGTH_M, 1e-3)
    place = np.arange(-(len(kernel) // 2), len(kernel) // 2 + 1)
    radius = np.hypot(place[:, None], place)
    inner, outer = ((kernel * np.clip(edge - radius + 0.5, 0, 1)).sum() for edge in (16, 24))
    v = np.pi * np.array([16, 24]) * cell_m / (WAVELENGTH_M * 6.0)
    assert outer - inner == pytest.approx(np.diff(-(j0(v) ** 2) - j1(v) ** 2)[0], rel=0.02)


@pytest.mark.parametrize("spread", [0.02, 0.0624, 0.0626, 0.15])
def test_a_pattern_far_smaller_than_a_cell_throws_on_its_neighbours_what_finer_cells_add_up_to(spread):
    parts = 9
    kernel = psf_kernel(spread, 0.1, 1.0, 1.0, 1e-3)
    fine = psf_kernel(spread, 0.0, 1 / parts, 1.0, spread * 2 / np.pi**2 / 4.5)
    middle = len(fine) // 2
    window = fine[middle - 31 : middle + 32, middle - 31 : middle + 32]
    cells = window.reshape(7, parts, 7, parts).sum(axis=(1, 3))
    half = len(kernel) // 2
    ours = kernel[half - 3 : half + 4, half - 3 : half + 4]
    np.testing.assert_allclose(ours, cells, rtol=0.02)
    assert kernel.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(kernel, kernel.T, rtol=1e-9)


def test_slow_patterns_are_damped_as_if_there_were_no_cells():
    # Integration over cells adds h^2/12 of variance and the Gaussian gives it up: what is left differs from
    # diffraction x Gaussian in the fourth order of the frequency, and by the aliases of diffraction.
    f_number, sigma_m, cell_m = 6.0, 3e-6, 5e-6
    kernel = psf_kernel(f_number, sigma_m, cell_m, WAVELENGTH_M, 5e-4)
    size = kernel.shape[0]
    k = np.arange(4, size // 8)  # slower ones feel the edge of the window
    seen = np.abs(np.fft.fft2(kernel)[0, k])
    frequency = k / (size * cell_m)
    rho = frequency * WAVELENGTH_M * f_number
    diffraction = 2 / np.pi * (np.arccos(rho) - rho * np.sqrt(1 - rho**2))
    np.testing.assert_allclose(
        seen, diffraction * np.exp(-2 * np.pi**2 * sigma_m**2 * frequency**2), rtol=1.5e-3
    )


def test_a_blur_is_a_convolution_and_its_own_adjoint():
    rng = np.random.default_rng(1)
    kernel = psf_kernel(4.0, 3e-6, 4.4e-6, WAVELENGTH_M, 0.01)
    blur = make_blur(kernel, (40, 50))
    image, other = rng.random((40, 50)), rng.random((40, 50))
    np.testing.assert_allclose(blur.apply(image), fftconvolve(image, kernel, mode="same"), atol=1e-12)
    assert (blur.apply(image) * other).sum() == pytest.approx((blur.apply(other) * image).sum(), rel=1e-12)


@pytest.mark.parametrize(("row", "col"), [(12, 20), (0, 20), (25, 44), (0, 0)])
def test_a_block_blurs_like_the_whole_image(row, col):
    rng = np.random.default_rng(2)
    kernel = psf_kernel(6.0, 3e-6, 6.67e-6, WAVELENGTH_M, 0.03)
    half = kernel.shape[0] // 2
    excess = rng.normal(0, 1, (2, 7, 6)).astype(np.float32)
    whole = np.zeros((2, 32, 50), np.float32)
    whole[:, row : row + 7, col : col + 6] = excess
    factor = np.ones((32, 50), np.float32)
    block = blur_moving((Block(row, col, excess),), uniform(kernel), 1, factor)[0]
    ours = np.zeros((2, 32, 50))
    _, h, w = block.excess.shape
    ours[:, block.row : block.row + h, block.col : block.col + w] = block.excess
    for t in range(2):
        wide = extend(whole[t], half)
        theirs = make_blur(kernel, wide.shape).apply(wide)[half:-half, half:-half]
        np.testing.assert_allclose(ours[t], theirs, atol=1e-6)


@pytest.mark.parametrize("ratio", [3.0, 2.88])
def test_the_relay_operator_has_an_exact_adjoint(ratio):
    rng = np.random.default_rng(3)
    geometry = RelayGeometry(36, 48, 40, 52, ratio / 3, 0.68, 0.3, -0.2, 2e-3)
    relay = operator(geometry)
    panel, ccd = rng.random((36, 48)), rng.random((40, 52))
    # Sums of float32 entries, but in float64: rounding only.
    assert (relay.apply(panel) * ccd).sum() == pytest.approx((relay.adjoint(ccd) * panel).sum(), rel=1e-10)


def test_the_relay_never_creates_energy_and_loses_only_its_transmission_inside():
    geometry = RelayGeometry(36, 48, 60, 80, 0.96, 0.65376, 0.3, -0.2, 2e-3)
    transmission = 0.9
    matrix = overlap_operator(geometry, transmission)
    # J m^-2 to J m^-2; in joules, a panel cell is cell_px / M pixels wide.
    joules = np.asarray(matrix.sum(axis=0)).ravel() * geometry.magnification**2 / geometry.cell_px**2
    np.testing.assert_allclose(joules, transmission, rtol=1e-5)  # float32 entries
    clipped = overlap_operator(RelayGeometry(36, 48, 20, 30, 0.96, 0.65376), transmission)
    joules = np.asarray(clipped.sum(axis=0)).ravel() * geometry.magnification**2 / geometry.cell_px**2
    assert joules.max() <= transmission * (1 + 1e-5)
    assert joules.min() == 0


def test_veiling_glare_spreads_light_and_keeps_its_sum():
    geometry = RelayGeometry(36, 48, 40, 52, 1.0, 0.681)
    panel = np.zeros((36, 48))
    panel[:3, :3] = 1e4
    with_veil, without = (operator(geometry, glare=g).apply(panel) for g in (0.005, 0.0))
    assert with_veil.sum() == pytest.approx(without.sum(), rel=1e-12)
    assert with_veil[-1, -1] == pytest.approx(0.995 * without[-1, -1] + 0.005 * without.mean(), rel=1e-9)


def test_one_bright_panel_pixel_lands_where_it_should():
    geometry = RelayGeometry(30, 45, 40, 60, 1.0, 0.681)
    panel = np.zeros((10, 15))
    panel[2, 11] = 1.0
    fine = panel.repeat(3, axis=0).repeat(3, axis=1)
    image = operator(geometry, sigma_m=0, glare=0).project(fine)
    rows, cols = np.nonzero(image > 1e-6)
    # 2 x 3 + (40 - 30) / 2 = 11 and 11 x 3 + (60 - 45) / 2 = 40.5: rows and columns both increase with v, u.
    assert (rows.min(), rows.max()) == (11, 13)
    assert (cols.min(), cols.max()) == (40, 43)
    assert image[12, 40] == pytest.approx(image[12, 41] / 2, rel=1e-6)
    row, col, on_ccd = geometry.ccd_pixels(3)
    assert (row[2, 11], col[2, 11], on_ccd.all()) == (12, 42, True)


def test_a_rotation_moves_pixels_as_a_rotation_does():
    angle = 0.02
    geometry = RelayGeometry(90, 90, 100, 100, 1.0, 0.681, rotation_rad=angle)
    fine = np.zeros((90, 90))
    fine[44:46, 84:86] = 1  # 40 pixels right of the centre
    image = operator(geometry, glare=0).project(fine)
    y, x = np.mgrid[:100, :100] + 0.5
    assert (image * y).sum() / image.sum() == pytest.approx(50 + 40 * np.sin(angle), abs=1e-4)
    assert (image * x).sum() / image.sum() == pytest.approx(50 + 40 * np.cos(angle), abs=1e-4)


def test_keystone_and_distortion_place_pixels_by_their_formulas_and_keep_the_energy():
    geometry = RelayGeometry(90, 120, 110, 150, 1.1, 0.7, keystone_y=0.03, distortion=-0.02)
    y, x = geometry.place(np.array([90.0, 45.0, 90.0]), np.array([60.0, 120.0, 120.0]))
    # Half sides of 49.5 and 66; the corner is 82.5 away.
    middle = 49.5 * (1 - 0.02 * 49.5**2 / 82.5**2) / 1.03
    np.testing.assert_allclose([y[0] - 55, x[0] - 75], [middle, 0], atol=1e-9)
    np.testing.assert_allclose([y[1] - 55, x[1] - 75], [0, 66 * (1 - 0.02 * 66**2 / 82.5**2)], atol=1e-9)
    np.testing.assert_allclose([y[2] - 55, x[2] - 75], np.array([49.5, 66]) * 0.98 / 1.03, atol=1e-9)
    matrix = overlap_operator(geometry, 0.9)
    joules = np.asarray(matrix.sum(axis=0)).ravel() * geometry.magnification**2 / geometry.cell_px**2
    np.testing.assert_allclose(joules, 0.9, rtol=1e-5)
    lit = np.zeros((90, 120))
    lit[80, 100] = 1
    image = (matrix @ lit.ravel()).reshape(110, 150)
    rows, cols = np.mgrid[:110, :150] + 0.5
    centre = geometry.place(np.array([80.5]), np.array([100.5]))
    assert (image * rows).sum() / image.sum() == pytest.approx(centre[0][0], abs=0.05)
    assert (image * cols).sum() / image.sum() == pytest.approx(centre[1][0], abs=0.05)
    # A flat gets brighter where the image is smaller: by the inverse of the local area.
    flat = (matrix @ np.ones(90 * 120)).reshape(110, 150)
    top, bottom = (geometry.place(np.array([v, v + 1.0]), np.array([60.0, 60.0]))[0] for v in (8, 80))
    wide = [np.diff(geometry.place(np.full(2, v), np.array([59.5, 60.5]))[1])[0] for v in (8.5, 80.5)]
    area = np.diff(top)[0] * wide[0] / (np.diff(bottom)[0] * wide[1])
    assert flat[int(bottom[0]), 75] / flat[int(top[0]), 75] == pytest.approx(area, rel=5e-3)
    assert area > 1.1


def test_a_ghost_is_mirrored_keeps_its_share_and_has_an_exact_adjoint():
    geometry = RelayGeometry(60, 90, 66, 96, 1.0, 0.681)
    plain = operator(geometry, glare=0)
    haunted = RelayOperator(plain.blur, plain.overlap, 0.0, plain.ccd_shape, Ghost(0.1, 2.0, 3))
    panel = np.zeros((60, 90))
    panel[21:24, 30:33] = 1
    ghost = haunted.apply(panel) - 0.9 * plain.apply(panel)
    y, x = np.mgrid[:66, :96] + 0.5
    # (22.5, 31.5) of (60, 90) is mirrored to (37.5, 58.5), and the border is 3 wide.
    assert (ghost * y).sum() / ghost.sum() == pytest.approx(40.5, abs=0.05)
    assert (ghost * x).sum() / ghost.sum() == pytest.approx(61.5, abs=0.05)
    assert ghost.sum() == pytest.approx(0.1 * plain.apply(panel).sum(), rel=0.01)
    rng = np.random.default_rng(3)
    a, b = rng.random((60, 90)), rng.random((66, 96))
    left, right = (haunted.apply(a) * b).sum(), (a * haunted.adjoint(b)).sum()
    assert left == pytest.approx(right, rel=1e-6)


def test_a_disc_of_confusion_has_its_diameter():
    kernel = psf_kernel(2.0, 0.0, 2e-6, WAVELENGTH_M, 2e-2, disc_m=60e-6)
    half = kernel.shape[0] // 2
    radius = np.hypot(*np.mgrid[-half : half + 1, -half : half + 1]) * 2e-6
    assert kernel[radius < 27e-6].sum() == pytest.approx((27 / 30) ** 2, abs=0.03)
    assert kernel[radius > 36e-6].sum() < 0.03
    inside = kernel[radius < 22e-6]
    assert inside.std() / inside.mean() < 0.15


def test_without_diffraction_and_aberrations_nothing_is_blurred():
    np.testing.assert_array_equal(psf_kernel(4.0, 0.0, 5e-6, WAVELENGTH_M, 1e-3, diffraction=False)[2, 2], 1)
    wide = psf_kernel(4.0, 10e-6, 5e-6, WAVELENGTH_M, 1e-3, diffraction=False)
    y = np.arange(len(wide)) - len(wide) // 2
    assert (wide.sum(axis=1) * y**2).sum() == pytest.approx(4.0, rel=1e-4)


def test_crosstalk_of_a_sharp_relay_at_an_integer_ratio_is_nothing():
    geometry = RelayGeometry(90, 120, 98, 128, 1.0, 0.681)
    row, col, _ = geometry.ccd_pixels(3)
    sharp = RelayOperator(
        make_blur(np.pad([[1.0]], 1), (90, 120)), overlap_operator(geometry, 1.0), 0.005, (98, 128)
    )
    offset, good = geometry.offsets_px(3), np.ones(row.shape, np.bool_)
    np.testing.assert_allclose(offset, 0, atol=1e-9)
    plain = border_shares(0.0, 3)
    kernel = crosstalk_kernels(true_dots(sharp, plain, row, col, 3), offset, good)
    np.testing.assert_allclose(kernel[:, :, 3, 3], 1, atol=1e-6)
    blurred = crosstalk_kernels(true_dots(operator(geometry), plain, row, col, 3), offset, good)[10, 10]
    assert blurred.sum() == pytest.approx(1)
    assert 0.8 < blurred[3, 3] < 0.99
    np.testing.assert_allclose(blurred, blurred.T, atol=1e-5)


def test_crosstalk_predicts_a_random_mosaic_at_a_ratio_that_shifts_every_pick():
    """Exposures 1 : 36 side by side at 2.88 CCD pixels: one kernel for all is off by whole slots."""
    geometry = RelayGeometry(300, 330, 300, 330, 0.96, 0.654)
    relay, (row, col, on_ccd) = operator(geometry), geometry.ccd_pixels(3)
    kernels = crosstalk_kernels(
        true_dots(relay, border_shares(0.0, 3), row, col, 3), geometry.offsets_px(3), on_ccd
    )
    light = np.random.default_rng(4).choice([1.36, 3.3, 11.2, 36], row.shape)

    def at_picks(panel):
        return relay.project(relay.blur.apply(panel.repeat(3, axis=0).repeat(3, axis=1)))[row, col]

    seen = (at_picks(light) / at_picks(np.ones_like(light)))[6:-6, 6:-6]
    windows = np.lib.stride_tricks.sliding_window_view(light, (7, 7))

    def off(kernel):
        predicted = (windows * kernel[3:-3, 3:-3]).sum(axis=(2, 3))[3:-3, 3:-3]
        return np.sqrt(np.mean((predicted - seen) ** 2))

    one_for_all = np.broadcast_to(kernels.mean(axis=(0, 1)), kernels.shape)
    assert off(kernels) < 0.2
    assert off(one_for_all) > 4 * off(kernels)


def test_mueller_matrices_between_crossed_polarisers():
    into, out = polariser(1, 0), polariser(0, 1)

    def through(*elements):
        light = UNPOLARISED
        for element in elements:
            light = element @ light
        return light[0]

    assert through(into, mirror(), out) == pytest.approx(0, abs=1e-15)  # a bare mirror is dark
    assert through(into, mirror() @ retarder_45(0), out) == pytest.approx(0, abs=1e-15)
    assert through(into, mirror() @ retarder_45(np.pi), out) == pytest.approx(0.5)
    gamma = 0.7
    assert through(into, mirror() @ retarder_45(gamma), out) == pytest.approx(np.sin(gamma / 2) ** 2 / 2)
    # Half of depolarised light passes the analyser.
    assert through(into, depolariser(0.02), mirror(), out) == pytest.approx(0.5 * 0.01)


def test_radiometry_closed_forms():
    # f/6: sin(theta') = 1/12, so pi / 144 of the radiance.
    assert irradiance_factor(6.0, 0.9) == pytest.approx(np.pi * 0.9 / 144)
    field = cos4(101, 101, 0.01)
    assert field[50, 50] == 1
    assert field[50, 100] == pytest.approx(np.cos(np.arctan(0.5)) ** 4)
    assert photons_per_joule(550e-9) == pytest.approx(2.7688e18, rel=1e-4)  # 3.6117e-19 J a photon
