"""The whole camera: contracts of expose, the ledger against a calculation by hand, geometry, calibrations."""

import numpy as np
import pytest

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import ALL, demo, prototype
from optsim.camera.true_calibration import ideal_calibration, true_calibration
from optsim.core.errors import ConfigError, GeometryError, ValueCheckError
from optsim.core.quantities import CodedFrame, ExposureCode, PanelState
from optsim.footage.made import still

V, U = 24, 32


def small(**changes) -> CodedCamera:
    """The demo camera cut to 32 x 24 panel pixels, without fixed patterns, glare, bend or ND."""
    camera = demo().without_glare()
    sensor = camera.sensor.model_copy(
        update={
            "rows": 3 * V + 16,
            "cols": 3 * U + 16,
            "prnu": 0.0,
            "dsnu_e": 0.0,
            "dark_current_e_s": 0.0,
            "smear_share": 0.0,
        }
    )
    modulator = camera.modulator.model_copy(
        update={
            "nonuniformity_rms": 0.0,
            "stuck_share": 0.0,
            "field_drive": (1.0, 1.0, 1.0),
            "polarity_drive": 0.0,
        }
        | changes.pop("modulator", {})
    )
    relay = camera.relay.model_copy(update={"distortion": 0.0, "ghost_share": 0.0})
    base = {
        "relay": relay,
        "sensor": sensor,
        "modulator": modulator,
        "panel_rows": V,
        "panel_cols": U,
        "slots_per_frame": 12,
    }
    return camera.model_copy(update=base | changes)


INSTANT = {"tau_on_s": 0.0, "tau_off_s": 0.0}


def code(levels):
    return ExposureCode(levels, np.zeros(levels.shape[1:], np.bool_))


def uniform(level, slots=12):
    return code(np.full((slots, V, U), level, np.uint8))


def truth(camera, image, n_slots=12):
    video = still(image.astype(np.float32), n_slots=n_slots, slot_s=camera.slot_s, samples_per_pitch=3)
    return camera.form_image(video)


def flat(camera, radiance=0.1):
    return truth(camera, np.full((3 * V, 3 * U), radiance))


def electrons(camera, light, shown, panel=None):
    return camera.expected_electrons(light, 0, shown, panel or camera.panel_at_rest())[0]


def test_the_ledger_reproduces_a_calculation_by_hand():
    # The anchor: 0.1 W m^-2 sr^-1, f/4 (f/6 on the panel), 0.9 x 0.28, M = 0.653, 200 ms, all-on.
    camera = prototype()
    splitter = camera.splitter.model_copy(
        update={"rs": 0.95, "rp": 0.0, "ts": 0.0, "cleanup_transmission": 1.0, "cleanup_contrast": 1.0}
    )
    modulator = camera.modulator.model_copy(update={"depolarised_share": 0.0})
    relay = camera.relay.model_copy(update={"magnification": 0.653})
    camera = camera.model_copy(update={"splitter": splitter, "modulator": modulator, "relay": relay})
    rows = {row.stage: row.value for row in camera.ledger(0.1)}
    on_panel = np.pi * 0.1 * 0.9 / (4 * 6**2)
    on_ccd = on_panel * (0.5 * 0.95 * 0.70 * 0.95 * 0.92 * 0.97) / 0.653**2
    photons = on_ccd * (4.54e-6) ** 2 * 0.2 / (6.626e-34 * 2.998e8 / 550e-9)
    by_hand = photons * 0.663
    assert rows["electrons a frame"] == pytest.approx(by_hand, rel=0.01)
    assert by_hand == pytest.approx(10_000, rel=0.05)
    assert rows["electrons a slot"] == pytest.approx(270, rel=0.02)
    assert rows["neutral density: modulator irradiance"] == pytest.approx(
        0.1 * camera.irradiance_per_radiance
    )


def even_lenses(camera: CodedCamera) -> CodedCamera:
    """The same camera with PSFs that don't vary: over so few pixels they would vary too fast."""
    lenses = {
        name: getattr(camera, name).model_copy(update={"field_error": 1.0}) for name in ("objective", "relay")
    }
    return camera.model_copy(update=lenses)


def test_the_ledger_agrees_with_what_the_camera_collects():
    camera = even_lenses(small(modulator=INSTANT))
    ledger = {row.stage: row.value for row in camera.ledger(0.1)}
    # On axis; PSF wings carry 0.25 % away from the middle of so small a panel, whose surroundings are dark.
    middle = electrons(camera, flat(camera), uniform(255))[3 * V // 2 + 8, 3 * U // 2 + 8]
    assert middle == pytest.approx(ledger["electrons a frame"], rel=4e-3)
    assert middle < ledger["electrons a frame"]


def test_all_on_is_a_plain_camera_after_settling_and_all_off_is_the_leak():
    camera = small()
    light = flat(camera)
    settled = PanelState(np.full((V, U), np.pi, np.float32), np.full((V, U), 255, np.uint8))
    on = electrons(camera, light, uniform(255), settled)
    plain = electrons(small(modulator=INSTANT), light, uniform(255))
    np.testing.assert_allclose(on, plain, rtol=1e-5)
    cold = electrons(camera, light, uniform(255))
    inside = plain > 0.5 * plain.max()
    assert (cold < 0.999 * plain)[inside].all()
    off = electrons(camera, light, uniform(0))
    np.testing.assert_allclose(off[inside] / plain[inside], 1 / camera.contrast, rtol=1e-5)


def test_complementary_codes_add_to_all_on_plus_all_off_for_an_instantaneous_panel_only():
    rng = np.random.default_rng(1)
    levels = (rng.integers(0, 2, (12, V, U)) * 255).astype(np.uint8)
    for modulator, agrees in ((INSTANT, True), ({}, False)):
        # The default nodes at pixel edges agree to 1.1e-5.
        camera = small(modulator=modulator | {"fringe_model": "fine"})
        light = truth(camera, rng.uniform(0, 1, (3 * V, 3 * U)))
        both = electrons(camera, light, code(levels)) + electrons(camera, light, code(255 - levels))
        ends = electrons(camera, light, uniform(255)) + electrons(camera, light, uniform(0))
        assert bool(np.abs(both - ends).max() < 1e-5 * ends.max()) is agrees


def test_at_ratio_3_a_shift_by_one_panel_pixel_is_a_shift_by_three_ccd_pixels():
    camera = small()
    flat = camera.objective.model_copy(update={"natural_vignetting": False})
    camera = even_lenses(camera.model_copy(update={"objective": flat}))
    rng = np.random.default_rng(2)
    # Dark border, so that nothing enters or leaves; the kernels are field-constant.
    image = np.zeros((3 * V, 3 * U))
    image[12:-12, 12:-12] = rng.uniform(0, 1, (3 * V - 24, 3 * U - 24))
    levels = rng.integers(0, 256, (12, V, U), dtype=np.uint8)
    one = electrons(camera, truth(camera, image), code(levels))
    moved = electrons(
        camera, truth(camera, np.roll(image, (3, 3), (0, 1))), code(np.roll(levels, (1, 1), (1, 2)))
    )
    np.testing.assert_allclose(moved[13:, 13:][:50, :70], one[10:, 10:][:50, :70], atol=2e-4 * one.max())
    assert np.abs(moved - one).max() > 0.1 * one.max()


def test_a_grey_scene_reads_back_through_the_true_calibration_within_its_stated_noise():
    camera = small()
    light = flat(camera, 0.2)
    calibration = true_calibration(camera)
    frame, after = camera.expose(light, 0, uniform(255), camera.panel_at_rest(), np.random.default_rng(3))
    weights, after_too = calibration.weights(frame.code, calibration.panel_at_rest())
    np.testing.assert_allclose(after.retardance_rad, after_too.retardance_rad, atol=1e-6)
    seen = calibration.observe(frame)
    residual = seen.signal / weights.sum(axis=0) - camera.reference(light, 0)[0]
    sigma = np.sqrt(seen.variance) / weights.sum(axis=0)
    score = (residual / sigma)[2:-2, 2:-2]
    # 560 pixels: the mean of z has sigma 0.042 and its rms 0.030; 5 sigma is one alarm in two million.
    # The bend (0.2 % at this signal of 9 ke-, sigma 1 %) shifts the mean by up to 0.3.
    assert abs(score.mean()) < 0.21 + 0.3
    assert score.std() == pytest.approx(1, abs=0.15)


def test_without_overlap_the_last_slots_are_dark_and_closed():
    camera = small(overlap=False, slots_per_frame=36, modulator=INSTANT)
    # 88 rows of 27.2 us are 2.4 ms, less than a slot; the whole chip's 39.1 ms are 7.04.
    assert camera.coded_slots == 35
    slow = camera.sensor.model_copy(update={"readout_rows": None})
    camera = camera.model_copy(update={"sensor": slow})
    assert camera.coded_slots == 28
    light = truth(camera, np.full((3 * V, 3 * U), 0.1), 36)
    shown = np.full((36, V, U), 255, np.uint8)
    frame, after = camera.expected_electrons(light, 0, code(shown), camera.panel_at_rest())
    full = camera.model_copy(update={"overlap": True})
    whole, after_full = full.expected_electrons(light, 0, code(shown), full.panel_at_rest())
    np.testing.assert_allclose(frame, whole * 28 / 36, rtol=1e-5)
    assert after.retardance_rad.max() == 0
    assert after_full.retardance_rad.min() > 3


def test_an_experiment_begins_after_a_cycle_of_its_first_code():
    camera = small(modulator={"tau_on_s": 2e-3, "tau_off_s": 4e-3})
    light, shown = flat(camera), code(np.random.default_rng(1).integers(0, 256, (12, V, U), dtype=np.uint8))
    first, panel = camera.expected_electrons(light, 0, shown, None)
    _, before = camera.expected_electrons(light, 0, shown, camera.panel_at_rest())
    second, _ = camera.expected_electrons(light, 0, shown, before)
    np.testing.assert_array_equal(first, second)
    assert np.abs(first - camera.expected_electrons(light, 0, shown, camera.panel_at_rest())[0]).max() > 1
    _, same = true_calibration(camera).weights(shown, None)
    np.testing.assert_allclose(same.retardance_rad, panel.retardance_rad, atol=1e-6)
    assert same.slots_displayed == panel.slots_displayed == 24


def test_fringing_fields_soften_the_borders_of_pixels_on_the_ccd():
    levels = np.zeros((12, V, U), np.uint8)
    levels[:, :, U // 2 :] = 255
    hard, soft = (small(modulator=INSTANT | {"fringing_px": sigma}) for sigma in (0.0, 0.2))
    a, b = (electrons(camera, flat(camera), code(levels)) for camera in (hard, soft))
    edge = 3 * (U // 2) + 8
    assert b[20, edge - 1] > 1.2 * a[20, edge - 1]
    assert b[20, edge] < 0.97 * a[20, edge]
    np.testing.assert_allclose(b[20, edge + 9], a[20, edge + 9], rtol=1e-3)
    assert b[20].sum() == pytest.approx(a[20].sum(), rel=1e-4)


def test_rows_written_late_show_the_slot_before():
    levels = np.zeros((12, V, U), np.uint8)
    levels[6:] = 255
    camera = small(modulator=INSTANT | {"delay_s": 1e-3, "scan_s": 2e-3, "rows": V})
    seen = electrons(camera, flat(camera), code(levels))
    prompt = electrons(small(modulator=INSTANT), flat(camera), code(levels))
    row = np.arange(4, V - 4)
    share = (seen / np.maximum(prompt, 1))[3 * row + 9, 3 * U // 2 + 8]
    # One of six bright slots is shortened by the delay of the row; what leaks meanwhile is 1 %.
    late = (1e-3 + 2e-3 * (row + 0.5) / V) * 180 / 6
    np.testing.assert_allclose(share, 1 - late * 0.99, atol=2e-3)


@pytest.mark.slow
def test_jitter_makes_each_frame_late_by_a_time_of_its_own():
    levels = np.zeros((12, V, U), np.uint8)
    levels[1:] = 255
    shown = code(levels)
    camera = small(modulator=INSTANT | {"delay_s": 1e-3, "jitter_s": 0.2e-3})
    steady, light = small(modulator=INSTANT | {"delay_s": 1e-3}), flat(camera)
    dark = camera.panel_at_rest()
    middle = 3 * V // 2 + 8, 3 * U // 2 + 8
    late = [
        electrons(camera, light, shown, PanelState(dark.retardance_rad, dark.levels, 12 * k))[middle]
        for k in range(200)
    ]
    again = electrons(camera, light, shown, PanelState(dark.retardance_rad, dark.levels, 12))[middle]
    assert again == late[1]
    on_time = electrons(steady, light, shown, dark)[middle]
    prompt = electrons(small(modulator=INSTANT), light, shown, dark)[middle]
    # One of eleven bright slots is shortened; what leaks meanwhile is 1 %. Of 200 draws the mean errs by
    # 14 us and their spread by 10 us: beyond 4.5 of these once in 1.5e5 runs.
    delays_s = 1e-3 + (on_time - np.array(late)) / prompt * 11 / 180 / 0.99
    assert abs(delays_s.mean() - 1e-3) < 4.5 * 0.2e-3 / np.sqrt(200)
    assert abs(delays_s.std() - 0.2e-3) < 4.5 * 0.2e-3 / np.sqrt(400)


def test_stuck_pixels_ignore_the_code_and_are_not_valid():
    camera = small(modulator={"stuck_share": 0.05})
    light, settled = flat(camera), PanelState(np.zeros((V, U), np.float32), np.zeros((V, U), np.uint8))
    calibration = true_calibration(camera)
    picked = electrons(camera, light, uniform(0), settled)[calibration.centre_row, calibration.centre_col]
    bright = picked > 0.3 * picked.max()
    assert bright.any()
    assert not calibration.valid[bright].any()
    assert 0.01 < (~calibration.valid).mean() < 0.12  # 5 % of 768 pixels, sigma 0.8 %


@pytest.mark.parametrize("full_well_e", [14_000.0, 14_000.3, 14_000.6])
@pytest.mark.parametrize("dark_current_e_s", [0.0, 20.0])
def test_a_full_well_is_saturated_without_read_noise_too(full_well_e, dark_current_e_s):
    camera = small()
    changes = {"read_noise_e": 0.0, "full_well_e": full_well_e, "dark_current_e_s": dark_current_e_s}
    camera = camera.model_copy(update={"sensor": camera.sensor.model_copy(update=changes)})
    sensor = camera.sensor
    electrons = np.full((sensor.rows, sensor.cols), 3 * full_well_e)
    dn, _ = sensor.digitise(electrons, camera.exposure_s, camera.serial_number, np.random.default_rng(1))
    calibration = true_calibration(camera)
    assert calibration.observe(CodedFrame(0, dn, uniform(255))).saturated[calibration.valid].all()


def test_shot_noise_of_smear_hides_no_saturation():
    camera = small()
    changes = {"read_noise_e": 0.0, "full_well_e": 14_000.0, "bend_at_full_well": 0.03, "finer_bits": 2}
    sensor = camera.sensor.model_copy(update=changes | {"smear_share": 1e-3})
    electrons = np.full((sensor.rows, sensor.cols), 42_000.0)
    # Four electrons of smear: where their shot noise exceeds their mean by most.
    share = 4 * sensor.smear_share / sensor.smear_e(electrons, camera.exposure_s)[0]
    sensor = sensor.model_copy(update={"smear_share": float(share)})
    camera = camera.model_copy(update={"sensor": sensor})
    dn, _ = sensor.digitise(electrons, camera.exposure_s, camera.serial_number, np.random.default_rng(1))
    calibration = true_calibration(camera)
    # 3e-5 of 768 pixels is none, but once in 40 seeds.
    assert calibration.observe(CodedFrame(0, dn, uniform(255))).saturated[calibration.valid].all()


def test_the_reference_undoes_the_shading_of_the_objective():
    camera = small()
    reference = camera.reference(flat(camera, 0.3), 0)
    assert reference.shape == (12, V, U)
    np.testing.assert_allclose(reference, 0.3 * camera.irradiance_per_radiance, rtol=1e-5)


def test_the_ideal_calibration_holds_the_papers_equations():
    calibration = ideal_calibration(small())
    weights, _ = calibration.weights(uniform(255), calibration.panel_at_rest())
    assert weights.min() == 1
    assert calibration.weights(uniform(0), calibration.panel_at_rest())[0].max() < 1e-9
    assert calibration.crosstalk.shape == (V, U, 1, 1)
    assert np.ptp(calibration.responsivity_dn) == 0
    true = true_calibration(small()).responsivity_dn[V // 2, U // 2]
    assert calibration.responsivity_dn[0, 0] == pytest.approx(true, rel=5e-3)


def test_the_paper_geometry_fits_at_2_88_and_not_at_3():
    camera = prototype()
    report = camera.geometry()
    report.check()
    assert report.fits
    straight = camera.model_copy(update={"relay": camera.relay.model_copy(update={"distortion": 0.0})})
    assert straight.geometry().margin_rows_px == pytest.approx(0, abs=1e-6)
    # A barrel of 0.3 % at the corners takes 0.12 % from the middle of the upper side: 250^2 of 390^2.
    assert report.margin_rows_px == pytest.approx(720 * 0.003 * 250**2 / (250**2 + 300**2), rel=0.01)
    assert report.moire_period_px == pytest.approx(8.33, abs=0.01)
    at_three = camera.model_copy(
        update={"relay": camera.relay.model_copy(update={"magnification": 3 * 4.54 / 20})}
    ).geometry()
    assert not at_three.fits
    assert (at_three.largest_panel_rows, at_three.largest_panel_cols) == (480, 640)
    assert at_three.moire_period_px is None
    with pytest.raises(GeometryError, match=r"camera\.panel_rows = 500 .*at most 480 fit"):
        at_three.check()
    with pytest.raises(GeometryError, match=r"camera\.modulator\.rows has only 768"):
        camera.model_copy(update={"panel_rows": 800}).geometry().check()


def test_the_demo_sees_the_field_of_the_prototype():
    for camera in (make() for make in ALL.values()):
        assert camera.geometry().fits
        degrees = 2 * np.degrees(np.arctan(camera.view.tan_half_width))
        assert degrees == pytest.approx(35.5, abs=0.1)
        assert camera.contrast == pytest.approx(100, abs=10)
    assert demo().ratio == pytest.approx(3.0, abs=1e-12)
    assert CodedCamera.model_validate(demo().model_dump()) == demo()


def test_the_smallest_latency_adds_up_readout_transfer_computation_and_display():
    report = prototype().smallest_latency_frames()
    assert report.frames == 2
    # 39.1 + 15.8 + 200 + 16.7 ms are more than one period of 200 ms.
    assert prototype().smallest_latency_frames(computation_s=0.2).frames == 3
    # Readout within the period: the eight uncoded slots count for the loop.
    sequential = prototype().model_copy(update={"overlap": False})
    assert sequential.smallest_latency_frames(computation_s=0.16).frames == 2
    # The demo reads 368 of the chip's 1440 rows.
    assert demo().smallest_latency_frames().readout_s == pytest.approx(39.1e-3 * 368 / 1440, rel=1e-12)


@pytest.mark.parametrize(("slots", "enough"), [(7, False), (8, True)])
def test_a_readout_that_outlasts_a_period_is_told(slots, enough):
    # 39.1 ms are 7.04 slots.
    report = prototype().model_copy(update={"slots_per_frame": slots}).smallest_latency_frames()
    assert report.keeps_up == enough


def test_what_does_not_belong_to_this_camera_is_refused_with_the_keys():
    camera = small()
    with pytest.raises(ValueCheckError, match=r"camera\.panel_rows"):
        camera.form_image(
            still(np.ones((30, 30), np.float32), n_slots=1, slot_s=1 / 180, samples_per_pitch=3)
        )
    with pytest.raises(ValueCheckError, match="slot"):
        camera.form_image(
            still(np.ones((3 * V, 3 * U), np.float32), n_slots=1, slot_s=1.0, samples_per_pitch=3)
        )
    with pytest.raises(ValueCheckError, match="levels"):
        electrons(camera, flat(camera), uniform(255, slots=36))
    with pytest.raises(ConfigError, match="nd_transmission"):
        camera.with_nd(1.5)
    assert camera.with_nd(0.5).irradiance_per_radiance == pytest.approx(camera.irradiance_per_radiance / 2)
