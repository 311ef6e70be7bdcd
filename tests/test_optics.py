"""Contrast as an output, the objective on a video, fixed patterns."""

import numpy as np
import pytest

from optsim.camera.effects import with_effects
from optsim.camera.hardware import lcr720, prototype, prototype_relay
from optsim.camera.parts import (
    Objective,
    Splitter,
    form_image,
    leak,
    leak_budget,
    stage_transmissions,
    throughput,
)
from optsim.core.quantities import Block, RadianceVideo, Segment
from optsim.footage.made import still
from optsim.optics.integrate import cell_means
from optsim.optics.psf import make_blur
from optsim.optics.radiometry import clipped_pupil

PITCH_M = 20e-6
AXIS = np.zeros(1)


def imaged(lens, picture, pitch=3):
    """Irradiance of a single picture."""
    scene = still(picture.astype(np.float32), n_slots=1, slot_s=1.0, samples_per_pitch=pitch)
    return form_image(lens, scene, PITCH_M, 1)


def test_the_nominal_contrast_is_100_and_its_parts_add_up():
    panel, splitter = lcr720(), Splitter()
    assert 1 / leak(splitter, panel, 6.0, AXIS) == pytest.approx(100, abs=10)
    # By hand: half of the depolarised light gets through, and half of the gaps'; p through a 3 % port and a
    # 1000:1 polariser.
    d, gaps = panel.depolarised_share, 0.08 * 0.05 / (0.92 * panel.mirror_reflectivity)
    from_splitter = 0.03 / 1000 / 0.99 + 0.001 / 1000 / 0.95
    by_hand = (d / 2 + gaps / 2) / (1 - d / 2 + gaps / 2) + from_splitter
    assert leak(splitter, panel, 6.0, AXIS) == pytest.approx(by_hand, rel=2e-3)
    assert gaps / 2 > 0.2 * by_hand


@pytest.mark.parametrize("placement", ["collimated", "converging"])
def test_the_budget_of_the_contrast_adds_up(placement):
    """By hand on axis, each source; together nearly the sum, there and where the coating is off its angle."""
    panel, splitter = lcr720(), Splitter(placement=placement, collimator_m=30e-3)
    budget = leak_budget(splitter, panel, 6.0, np.array([0.0, 6e-3]))
    depolarised, gaps, coating, angles, together = budget.values()
    d, g = panel.depolarised_share, 0.08 * 0.05 / (0.92 * panel.mirror_reflectivity)
    np.testing.assert_allclose(depolarised, (d / 2) / (1 - d / 2), rtol=1e-3)
    np.testing.assert_allclose(gaps, (g / 2) / (1 + g / 2), rtol=1e-3)
    np.testing.assert_allclose(coating, 0.03 / 1000 / 0.99 + 0.001 / 1000 / 0.95, rtol=1e-2)
    np.testing.assert_allclose(together, leak(splitter, panel, 6.0, np.array([0.0, 6e-3])), rtol=1e-12)
    np.testing.assert_allclose(depolarised + gaps + coating + angles, together, rtol=0.03)
    if placement == "collimated":
        assert angles[0] == pytest.approx(0, abs=1e-9)
        assert angles[1] > coating[1], "7.5 degrees in glass, three times past what the coating accepts"
    else:
        assert angles[0] > 2 * coating[0], "skew rays"


@pytest.mark.parametrize("light", [{"tp": 0.97, "rp": 0.03}, {"ts": 0.01, "rs": 0.99}])
def test_ports_of_a_splitter_that_absorbs_nothing_add_up_at_every_angle(light):
    """What the coating sends on and what it sends back: all, of p and of s, on axis and far off it."""
    cube = Splitter(
        cleanup_transmission=1, cleanup_contrast=1, face_transmission=1, collimator_m=10e-3, **light
    )
    rays = cube.rays(np.linspace(-6e-3, 6e-3, 13), 6.0)
    into, back = cube.inbound(rays), cube.outbound(rays)
    sign = 1 if "tp" in light else -1
    stokes = np.array([1.0, sign, 0, 0])
    passed, returned = (0.5 * (m @ stokes)[..., 0] * 2 for m in (into, back))
    np.testing.assert_allclose(passed + returned, 1, atol=1e-12)
    assert passed.min() < 0.9 if sign > 0 else returned.min() < 0.95


def test_without_polarisers_and_with_a_perfect_panel_the_splitter_alone_gives_about_32():
    bare = Splitter(cleanup_transmission=1, cleanup_contrast=1)
    perfect = lcr720().model_copy(update={"depolarised_share": 0.0, "gap_reflectivity": 0.0})
    # (0.95 x 0.03 + 0.001 x 0.99) / (0.95 x 0.99 + 0.001 x 0.03)
    assert 1 / leak(bare, perfect, 6.0, AXIS) == pytest.approx(31.9, abs=0.1)


def test_throughput_lists_every_loss_once_and_follows_the_retardance():
    panel = lcr720().model_copy(update={"gap_reflectivity": 0.0})
    splitter = Splitter(rs=0.95, cleanup_transmission=1, cleanup_contrast=1e9)
    on, off = (throughput(splitter, panel, g, 6.0, AXIS) for g in (np.pi, 0.0))
    # 0.5 x 0.95 x 0.70 x 0.95 x 0.97 x (relay 0.92) = 0.28; half of the depolarised share is lost.
    assert float(on[0]) * prototype_relay().transmission == pytest.approx(0.2819 * (1 - 0.0137 / 2), rel=2e-3)
    assert np.prod(stage_transmissions(splitter, panel, np.pi, 6.0, AXIS)) == pytest.approx(on)
    gamma = 1.1
    middle = off + (on - off) * np.sin(gamma / 2) ** 2
    assert throughput(splitter, panel, gamma, 6.0, AXIS) == pytest.approx(middle, rel=1e-12)


def test_in_collimated_space_the_splitter_shades_the_ends_of_the_rows_and_in_converging_space_it_leaks():
    panel, x_m = lcr720(), np.array([-6e-3, 0.0, 2e-3, 6e-3])
    along, cone = Splitter(), Splitter(placement="converging")
    on = throughput(along, panel, np.pi, 6.0, x_m)
    assert on[0] == pytest.approx(on[3])
    assert on[1] == pytest.approx(on[2]), "within the acceptance"
    # 6 mm / 75 mm is 3.0 degrees in glass: rp grows from 3 % to 3 % x (3.0 / 2.0)^2, and tp loses as much.
    growth = (np.arcsin(np.sin(np.arctan(0.08)) / 1.52) / 0.035) ** 2
    in_, out = (0.95 - 0.03 * (growth - 1)) / 0.95, (0.99 - 0.001 * (growth - 1)) / 0.99
    assert on[0] / on[1] == pytest.approx(in_ * out, rel=3e-4)
    dark = leak(cone, panel, 6.0, x_m) - leak(along, panel, 6.0, AXIS)
    # Small angles: 1 / (2 N n)^2 of the light, whatever the column; what the coating lets through of the
    # wrong polarisation, 0.03 of 0.99 and 0.001 of 0.95, is in phase and against it.
    against = 1 - (np.sqrt(0.03 / 0.99) + np.sqrt(0.001 / 0.95)) / 2
    np.testing.assert_allclose(dark, (against / (2 * 6 * 1.52)) ** 2, rtol=0.03)


def test_a_flat_scene_becomes_cos4_times_the_analytic_irradiance():
    lens = Objective(glare_share=0.0, focal_length_m=1e-3, f_number=2.8, nd_transmission=0.5)
    video = imaged(lens, np.full((60, 90), 2.0))
    image = video.load(0).start
    on_axis = 2.0 * np.pi * 0.9 * 0.5 / (4 * (1.5 * 2.8) ** 2)
    y, x = (np.arange(60) + 0.5 - 30)[:, None], np.arange(90) + 0.5 - 45
    tangent_squared = (y**2 + x**2) * (PITCH_M / 3 / 1.5 / 1e-3) ** 2
    np.testing.assert_allclose(image, on_axis / (1 + tangent_squared) ** 2, rtol=1e-5)
    assert video.shading.shape == (20, 30)
    assert video.shading.min() < 0.95  # the test would notice a missing cos^4
    flat = imaged(lens.model_copy(update={"natural_vignetting": False}), np.full((60, 90), 2.0))
    np.testing.assert_allclose(flat.load(0).start, on_axis, rtol=1e-5)


def moving_video(rng, excess_scale=1.0):
    keys = rng.uniform(1, 2, (3, 36, 48)).astype(np.float32)
    # A mean that grows linearly, as the glare of blocks is modelled, plus noise.
    ramp = 1 + np.arange(4)[:, None, None]
    blocks = [
        Block(8, 10, (excess_scale * (ramp + rng.normal(0, 0.3, (4, 10, 12)))).astype(np.float32))
        for _ in range(2)
    ]
    return RadianceVideo(
        rows=36, cols=48, samples_per_pitch=3, slot_s=1.0, instants_per_slot=2, slots_per_segment=2,
        n_slots=4, load=lambda i: Segment(keys[i], keys[i + 1], (blocks[i],), 4),
    )  # fmt: skip


def test_a_moving_video_is_imaged_like_each_of_its_instants():
    scene = moving_video(np.random.default_rng(1))
    lens = Objective(glare_share=0.1, tail_share=0.02)
    video = form_image(lens, scene, PITCH_M, 2)
    for index in range(2):
        segment, source = video.load(index), scene.load(index)
        for t in range(4):
            direct = imaged(lens, source.instant(t)).load(0).start
            # Exact but for what the glare of the blocks does off a straight line in time: here, with 10 %
            # of glare, the mean of the blocks' noise: sigma 2e-3 x 0.1 of the picture.
            np.testing.assert_allclose(segment.instant(t), direct, rtol=0, atol=1e-3 * direct.mean())


def test_blocks_cut_off_at_most_their_stated_share_of_wings():
    scene = moving_video(np.random.default_rng(2), excess_scale=100.0)
    lens = Objective(glare_share=0.0, tail_share=1e-3)
    segment = form_image(lens, scene, PITCH_M, 2).load(0)
    direct = imaged(lens, scene.load(0).instant(1))
    excess = np.abs(scene.load(0).blocks[0].excess[1]).sum() * lens.irradiance_per_radiance
    assert np.abs(segment.instant(1) - direct.load(0).start).sum() < 2 * 5e-3 * excess


def test_glare_keeps_the_mean_and_lifts_the_dark():
    image = np.zeros((36, 48), np.float32)
    image[10:16, 20:30] = 1000
    lens = Objective(glare_share=0.01, natural_vignetting=False)
    with_veil = imaged(lens, image).load(0).start
    without = imaged(lens.model_copy(update={"glare_share": 0.0}), image).load(0).start
    assert with_veil.mean(dtype=float) == pytest.approx(without.mean(dtype=float), rel=1e-6)
    assert with_veil[0, 0] == pytest.approx(0.99 * without[0, 0] + 0.01 * without.mean(), rel=1e-4)


def test_moving_light_in_a_dark_corner_brings_less_glare():
    still_light, ramp = np.ones((36, 48), np.float32), np.arange(1, 5, dtype=np.float32)[:, None, None]
    corner = Segment(still_light, still_light, (Block(0, 0, 50 * ramp * np.ones((4, 9, 12), np.float32)),), 4)
    scene = RadianceVideo(
        rows=36, cols=48, samples_per_pitch=3, slot_s=1.0, instants_per_slot=1, slots_per_segment=4,
        n_slots=4, load=lambda _: corner,
    )  # fmt: skip
    lens = Objective(glare_share=0.3, focal_length_m=0.2e-3)
    found = form_image(lens, scene, PITCH_M, 2)
    assert found.shading[1, 1] < 0.9 * found.shading.mean()  # else all places would count alike
    for t in range(4):
        direct = imaged(lens, corner.instant(t)).load(0).start
        # Glare is of the light before it is blurred: off by what blur moves over the shading.
        np.testing.assert_allclose(found.load(0).instant(t)[20:], direct[20:], rtol=2e-2)


def test_negative_monte_carlo_light_stays_in_the_sums():
    image = np.random.default_rng(3).normal(0, 1, (36, 48)).astype(np.float32)
    video, other = imaged(Objective(), image), imaged(Objective(), -image)
    assert video.load(0).start.min() < 0
    np.testing.assert_allclose(video.load(0).start, -other.load(0).start, atol=1e-9)


@pytest.mark.parametrize("field_error", [0.02, 1.0])
def test_what_a_panel_pixel_sends_through_the_relay_has_its_whole_psf_wings_and_all(field_error):
    """In panel pixels, on which the wings work: each mean is that of the pixel's own cells' PSFs."""
    relay = prototype_relay().model_copy(
        update={"field_error": field_error, "ghost_share": 0.0, "focus": "paraxial"}
    )
    rows, cols, pitch, cell_m = 240, 300, 3, 20e-6 / 3
    geometry = relay.geometry((rows, cols), (240, 300), 0.96, 4.54e-6)
    blur = relay.operator(geometry, 6.0, cell_m, 0.9, pitch).blur
    psf = relay.psf(relay.image_f_number(6.0), cell_m * relay.magnification, (rows, cols), 0.0)
    assert psf.half > 8 * pitch
    pixel, exact = np.zeros((rows, cols)), np.zeros((rows + 2 * psf.half, cols + 2 * psf.half))
    for y in range(90, 93):
        for x in range(171, 174):
            pixel[y, x] = 1.0
            own = psf.at((y + 0.5) / rows * 2 - 1, (x + 0.5) / cols * 2 - 1)
            exact[y : y + len(own), x : x + len(own)] += own
    inside = exact[psf.half : psf.half + rows, psf.half : psf.half + cols]
    point = np.zeros((rows, cols))
    point[90, 171] = 1.0
    own = psf.at(90.5 / rows * 2 - 1, 171.5 / cols * 2 - 1)
    found = blur.apply(point)[90 - 20 : 90 + 21, 171 - 20 : 171 + 21]
    near = own[psf.half - 20 : psf.half + 21, psf.half - 20 : psf.half + 21]
    # Each fine cell is right: wings begin beyond eight pixels, and are never more than four cells off.
    np.testing.assert_allclose(found, near, rtol=1e-6, atol=1e-10)
    np.testing.assert_allclose(
        cell_means(blur.apply(pixel), pitch), cell_means(inside, pitch), rtol=1e-6, atol=1e-12
    )


def test_a_relay_far_out_of_focus_keeps_its_disc_out_of_the_wings():
    """Without diffraction there is one kernel, a wide one: at most 0.5 % of it works on panel pixels."""
    relay = prototype_relay().model_copy(update={"diffraction": False, "defocus_m": 2e-3, "ghost_share": 0.0})
    rows, cols, pitch, cell_m = 300, 360, 3, 20e-6 / 3
    operator = relay.operator(
        relay.geometry((rows, cols), (300, 360), 0.96, 4.54e-6), 6.0, cell_m, 0.9, pitch
    )
    psf = relay.psf(relay.image_f_number(6.0), cell_m * relay.magnification, (rows, cols), relay.defocus_m)
    assert psf.half > 24
    assert 1 - psf.middle(24).kernel.sum() > 0.5
    point = np.zeros((rows, cols))
    point[151, 184] = 1.0
    found = operator.blur.apply(point)
    exact = make_blur(psf.kernel, (rows, cols)).apply(point)
    assert np.abs(found - exact).sum() / 2 < 1e-3


def test_fixed_patterns_of_the_panel():
    panel = lcr720().model_copy(update={"stuck_share": 0.01})
    gain = panel.gain(120, 160, 7)
    assert gain.std() == pytest.approx(0.02, rel=1e-3)
    assert np.abs(np.diff(gain, axis=1)).max() < 0.005  # smooth
    assert not np.array_equal(gain, panel.gain(120, 160, 8))
    stuck, levels = panel.stuck(500, 600, 7)
    # 3000 expected, sigma 54.5: five sigma, one false alarm in two million.
    assert stuck.sum() == pytest.approx(3000, abs=273)
    assert set(np.unique(levels)) == {0, 255}


@pytest.mark.parametrize("loss", [0.05, 0.2, 0.6])
def test_a_rim_hides_what_two_circles_do_not_share(loss):
    """Against counted points of a pupil, on a straight way from the axis to a corner."""
    rows, cols = 240, 320
    opened = clipped_pupil(rows, cols, loss)
    assert opened[0, 0] == pytest.approx(1 - loss, abs=0.01 * loss + 0.004)
    assert opened[rows // 2, cols // 2] == 1
    assert (opened == opened[::-1, ::-1]).all()
    y, x = np.mgrid[-1:1:1001j, -1:1:1001j]
    pupil = y**2 + x**2 < 1
    # The rim is larger than the pupil by half of its shift at the corner: from the overlap there the shift.
    shifts = np.linspace(0, 3, 301)
    overlap = [(pupil & ((x - s) ** 2 + y**2 < (1 + s / 2) ** 2)).sum() / pupil.sum() for s in shifts]
    shift = np.interp(loss, 1 - np.array(overlap), shifts)
    for share in (0.4, 0.6, 0.8):
        v, u = int(rows / 2 * (1 + share)), int(cols / 2 * (1 + share))
        place = np.hypot(v + 0.5 - rows / 2, u + 0.5 - cols / 2) / np.hypot(rows / 2, cols / 2)
        seen = pupil & ((x - shift * place) ** 2 + y**2 < (1 + shift / 2) ** 2)
        assert opened[v, u] == pytest.approx(seen.sum() / pupil.sum(), abs=0.004)


def test_the_worst_vignetting_leaves_60_percent_in_the_corners():
    """The ranking's figures (hardware notes, section 5, rank 7): nominal 0.75, pessimistic 0.6."""
    for state, corner in (("ideal", 1.0), ("nominal", 0.75), ("pessimistic", 0.6)):
        camera = with_effects(prototype(), {"vignetting": state})
        shading = camera.objective.shading(500, 600, camera.modulator.pitch_m)
        assert shading[0, 0] == pytest.approx(corner, abs=0.01)
