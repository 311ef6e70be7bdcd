"""Rims of panel pixels and far wings of the PSF: against the same thing done without the short cut."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from optsim.camera.parts import Objective, form_image
from optsim.core.quantities import Block, IrradianceVideo, RadianceVideo, Segment
from optsim.optics.aberrations import Wavefront
from optsim.optics.field_blur import FieldPsf, make_field_blur, uniform
from optsim.optics.fringing import border_shares, fine_image, fine_image_adjoint
from optsim.optics.integrate import Shutter, cell_means, integrate_exposure
from optsim.optics.pixel_splines import spline_kernel, splines
from optsim.optics.psf import extend, make_blur, psf_kernel
from optsim.optics.psf_tails import (
    Ring,
    TailedBlur,
    coarse_kernel,
    cut_softly,
    far_light,
    keep_above_zero,
    line_ends,
    make_tails,
    moving_ends,
    near_half,
    with_tails,
)


@pytest.mark.parametrize("pitch", [1, 3, 5])
def test_a_border_between_black_and_white_is_that_of_blurred_retardance(pitch):
    sigma, steps = 0.12, 600
    gamma = np.pi * np.repeat([0.0, 0, 1, 1], steps)
    blurred = np.sin(gaussian_filter1d(gamma, sigma * steps, truncate=6) / 2) ** 2
    cells = blurred.reshape(4 * pitch, -1).mean(axis=1)
    ours = fine_image(np.array([[0.0, 0, 1, 1]]), border_shares(sigma, pitch))[0]
    np.testing.assert_allclose(ours[pitch : 3 * pitch], cells[pitch : 3 * pitch], atol=2e-4)
    if pitch > 1:
        assert ours[2 * pitch - 1] > 0.05


def test_without_fringing_each_pixel_is_itself_and_shares_always_sum_to_one():
    panel = np.random.default_rng(1).random((5, 7))
    plain = panel.repeat(3, axis=0).repeat(3, axis=1)
    np.testing.assert_array_equal(fine_image(panel, border_shares(0.0, 3)), plain)
    shares = border_shares(0.2, 3)
    np.testing.assert_allclose(shares.sum(axis=1), 1)
    np.testing.assert_allclose(shares[:, 0], shares[::-1, 2])
    assert fine_image(panel, shares).mean() == pytest.approx(panel.mean(), rel=0.02)
    assert np.abs(fine_image(panel, shares) - plain).max() > 0.05


def test_an_exposure_mixes_weights_on_base_and_blocks_alike():
    """Light as base and blocks, or as whole pictures: the same energy behind the panel."""
    rng = np.random.default_rng(2)
    start, stop = rng.random((2, 18, 24)).astype(np.float32)
    blocks = (
        Block(2, 1, rng.standard_normal((4, 9, 13)).astype(np.float32)),
        Block(10, 11, rng.standard_normal((4, 8, 13)).astype(np.float32)),
    )
    segment = Segment(start, stop, blocks, 4)
    video = IrradianceVideo(
        rows=18, cols=24, samples_per_pitch=3, slot_s=0.1, instants_per_slot=2, slots_per_segment=2,
        n_slots=2, load=lambda _: segment, shading=np.ones((6, 8), np.float32),
    )  # fmt: skip
    weights = rng.random((4, 6, 8)).astype(np.float32)
    borders = border_shares(0.15, 3)
    whole = sum(fine_image(weights[t].astype(float), borders) * segment.instant(t) for t in range(4)) * 0.05
    found = integrate_exposure(video, 0, Shutter(weights, borders))
    np.testing.assert_allclose(found, whole, atol=2e-7)
    assert np.abs(integrate_exposure(video, 0, Shutter(weights, border_shares(0.0, 3))) - whole).max() > 0.01


def test_core_and_wings_add_up_and_the_coarse_kernel_keeps_the_light():
    kernel = psf_kernel(6.0, 3e-6, 20e-6 / 3, 550e-9, 2e-3)
    core = uniform(kernel).middle(10).kernel
    margin = kernel.shape[0] // 2 - 10
    wings = kernel - np.pad(core, margin)
    assert 0.002 < wings.sum() < 0.02
    for pitch in (1, 3, 4):
        coarse = coarse_kernel(wings, pitch)
        assert coarse.shape[0] % 2 == 1
        assert coarse.sum() == pytest.approx(wings.sum(), rel=1e-9)
        np.testing.assert_allclose(coarse, coarse[::-1, ::-1], atol=1e-12)
    np.testing.assert_allclose(coarse_kernel(wings, 1), wings)


def test_lines_in_time_are_least_squares():
    t = (np.arange(7) + 0.5) / 7
    signal = np.random.default_rng(3).random(7)
    slope, offset = np.polyfit(t, signal, 1)
    np.testing.assert_allclose(line_ends(7) @ signal, [offset, offset + slope])
    np.testing.assert_allclose(line_ends(1) @ [3.0], [3, 3])


@pytest.mark.parametrize("side", [20, 200])  # whole arrays, and the compiled loop
def test_ends_of_lines_are_where_blocks_are_and_add_up(side):
    rng, shape = np.random.default_rng(4), (side + 9, side + 30)
    blocks = [Block(4, 7, rng.standard_normal((5, side, side)).astype(np.float32))]
    blocks.append(Block(0, 29, rng.standard_normal((5, side + 1, side)).astype(np.float32)))
    dark = np.zeros(shape, np.float32)
    expected = np.zeros((2, *shape))
    for block in blocks:
        _, height, width = block.excess.shape
        line = np.einsum("kt,tyx->kyx", line_ends(5), block.excess)
        expected[:, block.row : block.row + height, block.col : block.col + width] += line
    found = moving_ends(Segment(dark, dark, tuple(blocks), 5))
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("varies", [0, 4, 9])
def test_a_soft_cut_loses_nothing_and_passes_evenly(varies):
    kernel = psf_kernel(6.0, 3e-6, 20e-6 / 3, 550e-9, 2e-3)
    at = len(kernel) // 2
    cores = np.zeros((0, 0, 1, 1))
    if varies:
        inner = slice(at - varies, at + varies + 1)
        cores = np.tile(kernel[inner, inner], (2, 2, 1, 1))
    psf = FieldPsf(kernel, cores)
    core, wings = cut_softly(psf, 12)
    # As far as asked for, or some cells beyond what varies.
    assert core.half == max(12, psf.core_half + 6)
    np.testing.assert_array_equal(core.cores, cores)
    np.testing.assert_allclose(wings + np.pad(core.kernel, at - core.half), kernel, atol=1e-18)
    assert wings.min() >= 0
    assert core.kernel.min() >= 0
    assert not wings[at - varies : at + varies + 1, at - varies : at + varies + 1].any()
    # At its edge next to nothing of the PSF is left in the core: what is beyond is no step.
    assert core.kernel[core.half, 0] < 0.1 * kernel[at, at - core.half]
    # What is no wider than that stays whole.
    same, nothing = cut_softly(psf, at)
    assert same is psf
    assert not nothing.any()
    assert make_tails(nothing, 3, (30, 30)) == ()


@pytest.mark.parametrize("pitch", [1, 2, 3, 4])
def test_kernels_between_splines_stand_for_smooth_ones_between_samples(pitch):
    """Of a Gaussian six pixels wide, cut at four times that, where it has 3e-4 of its height."""
    place = np.arange(-24 * pitch, 24 * pitch + 1) / pitch
    line = np.exp(-(place**2) / 2 / 6**2)
    kernel = np.outer(line, line) / line.sum() ** 2
    found = spline_kernel(kernel, pitch)
    assert found.sum() == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(found, found[::-1, ::-1], atol=1e-15)
    n = len(found)
    shares = splines(pitch)
    # A point of light at each place within the pixel in the middle.
    for place_y, place_x in np.ndindex(pitch, pitch):
        light = np.zeros((n * pitch, n * pitch))
        y, x = n // 2 * pitch + place_y, n // 2 * pitch + place_x
        light[y, x] = 1
        pixels = fine_image_adjoint(light, shares) / pitch**2
        drawn = fine_image(make_blur(found, pixels.shape).apply(pixels), shares)
        half, end = len(kernel) // 2, 2 * len(kernel)
        exact = np.pad(kernel, end)[end + half - y :, end + half - x :][: len(light), : len(light)]
        np.testing.assert_allclose(drawn, exact, atol=3e-4 * kernel.max())


def test_far_light_is_the_wings_of_what_moves_up_to_its_coarseness():
    kernel = psf_kernel(6.0, 3e-6, 20e-6 / 3, 550e-9, 2e-3)
    _, wings = cut_softly(uniform(kernel), 17)
    shape = (60, 90)
    excess = np.ones((3, 20, 30), np.float32) * np.array([1, 2, 3], np.float32)[:, None, None]
    segment = Segment(*np.zeros((2, *shape), np.float32), (Block(40, 33, excess),), 3)
    ends = moving_ends(segment)
    np.testing.assert_allclose(ends[:, 45, 40], [0.5, 3.5], rtol=1e-6)
    far = far_light(ends, make_tails(wings, 3, shape), 3)
    reach = kernel.shape[0] // 2
    wide = np.stack([extend(end, reach) for end in ends])
    whole = make_blur(wings, wide.shape[1:]).apply(wide)[:, reach:-reach, reach:-reach]
    for drawn, exact in zip(far, whole, strict=True):
        assert np.abs(fine_image(drawn, splines(3)) - exact).max() < 0.06 * exact.max()


def test_the_outer_ring_of_the_wings_is_coarser_but_no_less_light_nor_elsewhere():
    """Lamps of a panel pixel at several places of a coarse cell; a panel that is no whole number of cells."""
    kernel = psf_kernel(6.0, 3e-6, 20e-6 / 3, 550e-9, 2e-4)
    assert kernel.shape[0] // 2 > 450
    _, wings = cut_softly(uniform(kernel), 17)
    rings = make_tails(wings, 3, (450, 609))
    assert [ring.cell for ring in rings] == [1, 4]
    assert sum(total_of(ring) for ring in rings) == pytest.approx(wings.sum(), rel=1e-9)
    for row, col in ((14, 17), (13, 102), (91, 191)):
        ends = np.zeros((2, 450, 609))
        ends[:, 3 * row : 3 * row + 3, 3 * col : 3 * col + 3] = [[[1.0]], [[2.0]]]
        far = far_light(ends, rings, 3)
        np.testing.assert_allclose(far[1], 2 * far[0], rtol=1e-9, atol=1e-15)
        whole = make_blur(wings, (450, 609)).apply(ends[0])
        # Whole cells alone: of 148 x 200 panel pixels.
        means, found = (
            image[: 148 * 3, : 200 * 3].reshape(37, 12, 50, 12).mean(axis=(1, 3))
            for image in (whole, fine_image(far[0], splines(3)))
        )
        distance = np.hypot(*np.ogrid[-row + 1.5 : 148 - row : 4, -col + 1.5 : 200 - col : 4])
        outer = (distance > 64) & (distance < 140)
        # A lamp is up to 1.5 pixels from the middle of its cell, along both axes, and light falls with the
        # third power of the distance: off by at most 3 * 1.5 * sqrt(2) / 64, and a tenth of that by its bend.
        np.testing.assert_allclose(found[outer], means[outer], rtol=0.11)


def test_a_flat_that_moves_has_flat_wings_to_the_edge_of_any_panel():
    """A panel of 101 x 135 pixels, no whole number of coarse cells: the light goes on beyond its edge."""
    kernel = psf_kernel(6.0, 3e-6, 20e-6 / 3, 550e-9, 2e-4)
    _, wings = cut_softly(uniform(kernel), 17)
    far = far_light(np.ones((2, 303, 405), np.float32), make_tails(wings, 3, (303, 405)), 3)
    # Compiled loops spread light to pixels in single precision.
    np.testing.assert_allclose(far, wings.sum(), rtol=1e-6)


def moving_video(shape, n, base, blocks):
    segment = Segment(base, (base * np.float32(1.1)), blocks, n)
    return RadianceVideo(
        rows=shape[0], cols=shape[1], samples_per_pitch=3, slot_s=1.0, instants_per_slot=1,
        slots_per_segment=n, n_slots=n, load=lambda _: segment,
    )  # fmt: skip


def moving_scene():
    """A room with a window in it; a dark body that crosses the window, a patch that goes on and off."""
    rng, shape, n = np.random.default_rng(12), (90, 120), 6
    base = rng.uniform(0.5, 1, shape).astype(np.float32)
    base[20:60, 30:80] = 500
    body, flash = np.zeros((n, 30, 60), np.float32), np.zeros((n, 9, 12), np.float32)
    for t in range(n):
        body[t, :, 4 * t : 4 * t + 20] = 0.3 - base[30:60, 20 + 4 * t : 40 + 4 * t]
    flash[2:4] = 80
    return moving_video(shape, n, base, (Block(30, 20, body), Block(81, 105, flash)))


LENS = Objective(glare_share=0.01, clipped_share=0.2, wavefront=Wavefront(coma_waves=0.1))


def test_without_a_share_for_wings_every_instant_is_a_still_picture():
    video = moving_scene()
    exact = LENS.model_copy(update={"moving_tail_share": 0.0})
    found = form_image(exact, video, 20e-6, 1).load(0)
    assert [block.excess.shape for block in found.blocks] == [(6, 90, 120)]
    for t in range(6):
        picture = video.load(0).instant(t)
        still = replace(video, slots_per_segment=1, load=lambda _, p=picture: Segment(p, p, (), 1))
        whole = form_image(exact, still, 20e-6, 1).load(0).instant(0)
        np.testing.assert_allclose(found.instant(t), whole, rtol=1e-6, atol=3e-7 * whole.max())


def test_where_nothing_moves_the_share_for_wings_changes_nothing():
    video = moving_scene()
    still = replace(video, load=lambda _: replace(video.load(0), blocks=()))
    ours, whole = (
        form_image(LENS.model_copy(update={"moving_tail_share": share}), still, 20e-6, 1).load(0)
        for share in (0.006, 0.0)
    )
    assert ours.blocks == whole.blocks == ()
    np.testing.assert_array_equal(ours.start, whole.start)
    np.testing.assert_array_equal(ours.stop, whole.stop)


def test_wings_along_lines_are_off_by_their_share_of_what_is_no_line():
    """And by nothing else: the more of the light is in them, the more."""
    video = moving_scene()
    exact, *cheaper = (
        form_image(LENS.model_copy(update={"moving_tail_share": share}), video, 20e-6, 1).load(0)
        for share in (0.0, 0.003, 0.012)
    )
    window = 500 * LENS.irradiance_per_radiance
    off = [
        max(np.abs(found.instant(t) - exact.instant(t)).max() for t in range(6)) / window for found in cheaper
    ]
    means = [
        np.abs(sum(found.instant(t) - exact.instant(t) for t in range(6))).max() / 6 / window
        for found in cheaper
    ]
    # Up to 3 % of what is in the wings, a tenth of that in the mean over the segment, which lines keep.
    assert 0.01 < off[0] / 0.003 < 0.04
    assert 0.01 < off[1] / 0.012 < 0.05
    assert max(means[0] / 0.003, means[1] / 0.012) < 0.003


def test_wings_of_blocks_that_overlap_add_up():
    one = np.ones((2, 6, 6), np.float32)
    segment = Segment(*np.zeros((2, 12, 12), np.float32), (Block(0, 0, one), Block(3, 3, 2 * one)), 2)
    ends = moving_ends(segment)
    np.testing.assert_allclose(ends[:, [1, 4, 8], [1, 4, 8]], [[1, 3, 2], [1, 3, 2]])


def total_of(ring: Ring) -> float:
    """Sum of a ring's kernel: what a flat sees of itself."""
    return float(ring.light(np.ones((1, 8, 8))).mean())


def test_a_lamp_a_million_billion_times_as_bright_as_the_rest_leaves_no_negative_light():
    """It moves as a block; its wings' window ends within the picture, where nothing of it arrives."""
    lens = Objective(glare_share=0.0, tail_share=2e-3)
    base = np.full((300, 360), 1e-6, np.float32)
    excess = np.zeros((2, 4, 4), np.float32)
    excess[0] = 1e9
    segment = Segment(base, base, (Block(30, 40, excess),), 2)
    video = RadianceVideo(
        rows=300, cols=360, samples_per_pitch=3, slot_s=1.0, instants_per_slot=1, slots_per_segment=2,
        n_slots=2, load=lambda _: segment,
    )  # fmt: skip
    found = form_image(lens, video, 20e-6, 1).load(0)
    dark = form_image(lens, replace(video, load=lambda _: Segment(base, base, (), 2)), 20e-6, 1).load(0).start
    lit = found.start / 2 + found.stop / 2
    for light in (found.instant(0), lit):
        np.testing.assert_allclose(light[-60:, -60:], dark[-60:, -60:], rtol=0.01)
    # Near by, wings alone may be less than nothing, the core's light is on top.
    for block in found.blocks:
        _, height, width = block.excess.shape
        lit[block.row : block.row + height, block.col : block.col + width] += block.excess.mean(axis=0)
    assert lit.min() >= 0.99 * dark.min()
    assert found.instant(0).min() >= 0.99 * dark.min()


def test_light_that_would_begin_or_end_below_zero_begins_or_ends_there_with_the_same_mean():
    start = np.array([[3, -1, 4, -1, -2, 0]], np.float32)
    stop = np.array([[2, 5, -3, -2, 1, 0]], np.float32)
    keep_above_zero(start, stop)
    # The fourth and fifth have less than nothing in the mean, too: they are dark.
    np.testing.assert_array_equal(start, [[3, 0, 1, 0, 0, 0]])
    np.testing.assert_array_equal(stop, [[2, 4, 0, 0, 0, 0]])


def test_a_flash_in_a_dark_room_leaves_no_negative_light():
    lens = Objective(glare_share=0.0, tail_share=2e-3)
    base = np.full((300, 360), 1e-5, np.float32)
    excess = np.zeros((9, 30, 30), np.float32)
    excess[0] = 1e5
    video = RadianceVideo(
        rows=300, cols=360, samples_per_pitch=3, slot_s=1.0, instants_per_slot=1, slots_per_segment=9,
        n_slots=9, load=lambda _: Segment(base, base, (Block(30, 40, excess),), 9),
    )  # fmt: skip
    found = form_image(lens, video, 20e-6, 1).load(0)
    assert min(found.instant(t).min() for t in range(9)) >= 0
    # Mean light is what it would be without wings along lines, up to what their splines round away.
    whole = lens.model_copy(update={"moving_tail_share": 0.0})
    exact = form_image(whole, video, 20e-6, 1).load(0)
    means = [np.mean([each.instant(t).mean() for t in range(9)]) for each in (found, exact)]
    assert means[0] == pytest.approx(means[1], rel=1e-4)
    # The difference of two lights has no zero to keep to: it is linear.
    signed = replace(video, load=lambda _: Segment(-base, base, (Block(30, 40, -excess),), 9))
    lit = replace(video, load=lambda _: Segment(base, -base, (Block(30, 40, excess),), 9))
    one, other = (form_image(lens, each, 20e-6, 1).load(0) for each in (signed, lit))
    for t in (0, 4, 8):
        np.testing.assert_array_equal(one.instant(t), -other.instant(t))


@pytest.mark.parametrize("least", [3, 8, 40])
def test_the_middle_of_a_kernel_has_all_but_its_share(least):
    kernel = psf_kernel(6.0, 3e-6, 20e-6 / 3, 550e-9, 2e-3)
    half = len(kernel) // 2
    for share in (0.3, 0.01, 5e-3, 0.0):
        near = near_half(kernel, least, share)
        assert least <= near <= half
        assert uniform(kernel).middle(near).kernel.sum() >= 1 - share or near == half
        if near > least:
            assert uniform(kernel).middle(near * 3 // 4).kernel.sum() < 1 - share
    assert near_half(kernel, 10 * half, 0.01) == half


@pytest.mark.parametrize("varies", [True, False])
def test_a_blur_with_wings_on_panel_pixels_is_the_whole_blur_up_to_their_coarseness(varies):
    kernel = psf_kernel(6.0, 3e-6, 20e-6 / 3, 550e-9, 2e-3)
    cores = np.tile(uniform(kernel).middle(10).kernel, (2, 2, 1, 1))
    psf = FieldPsf(kernel, cores) if varies else uniform(kernel)
    near, shape = psf.middle(24), (60, 90)
    blur = with_tails(make_field_blur(near, shape), kernel, near.half, 3)
    assert isinstance(blur, TailedBlur)
    rng = np.random.default_rng(1)
    image, other = rng.random((2, *shape)) ** 8
    forth, back = (blur.apply(image) * other).sum(), (blur.adjoint(other) * image).sum()
    assert forth == pytest.approx(back, rel=1e-12)
    pair = blur.adjoint(np.stack([other, image]))
    np.testing.assert_allclose(pair, [blur.adjoint(other), blur.adjoint(image)], rtol=1e-12)
    whole = make_blur(kernel, shape)
    # One point: less than a tenth of the wings lies elsewhere than it should.
    point = np.zeros(shape)
    point[31, 44] = 1.0
    wings = kernel.sum() - near.kernel.sum()
    wrong = np.abs(blur.apply(point) - whole.apply(point)).sum() / 2
    assert 0.005 * wings < wrong < 0.1 * wings
    # A panel pixel: its means over panel pixels are exact.
    pixel = np.zeros(shape)
    pixel[30:33, 42:45] = 1.0
    means, exact = (cell_means(each.apply(pixel), 3) for each in (blur, whole))
    np.testing.assert_allclose(means, exact, atol=1e-13)
    assert with_tails(whole, kernel, len(kernel) // 2, 3) is whole


def test_light_that_stands_still_in_a_block_is_imaged_as_in_the_base_wings_and_all():
    """A lamp a thousand times as bright, as base or as a moving block that doesn't move: the same image."""
    lens = Objective(glare_share=0.0, aberration_m=3e-6, moving_tail_share=6e-3)
    base = np.full((120, 150), 0.1, np.float32)
    excess = np.zeros((4, 24, 30), np.float32)
    excess[:, 6:18, 6:24] = 100.0
    lit = base.copy()
    lit[45:69, 60:90] += excess[0]

    def imaged(image, blocks):
        segment = Segment(image, image, blocks, 4)
        video = RadianceVideo(
            rows=120, cols=150, samples_per_pitch=3, slot_s=1.0, instants_per_slot=1, slots_per_segment=4,
            n_slots=4, load=lambda _: segment,
        )  # fmt: skip
        return form_image(lens, video, 20e-6, 1).load(0)

    whole = imaged(lit, ()).instant(1)
    found = imaged(base, (Block(45, 60, excess),))
    assert found.blocks[0].excess.shape[1] < 80, "in each instant only the core"
    error = np.abs(found.instant(1) / whole - 1)
    # The wings lie on panel pixels, between which splines draw them.
    assert error.max() < 0.004
    assert np.median(error) < 1e-4
    # Without its wings the lamp would be missing from half of the picture.
    dark = found.start / imaged(base, ()).start
    assert np.median(dark) > 1.02
    assert dark.max() > 1.1
