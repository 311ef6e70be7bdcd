"""The camera in other light than 550 nm: what must be absent at 550 nm, and closed forms at 470 and 630."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.special import j1
from test_bands import SMALL
from test_bands import scene as coloured

from optsim.calibration import calibrate_from
from optsim.camera.effects import changed, with_effects
from optsim.camera.hardware import demo, icx674, imx174, lcr720, prototype
from optsim.camera.laboratory import measure_bench
from optsim.camera.parts import Splitter
from optsim.camera.true_calibration import ideal_calibration, true_calibration
from optsim.core.errors import BenchError, ConfigError, ValueCheckError
from optsim.core.quantities import ExposureCode
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import explanation
from optsim.experiment.truth import chosen_scene, describe_truth
from optsim.footage.made import still
from optsim.metrics import PhotometricScale, luminous_efficacy_lm_w
from optsim.optics.aberrations import Wavefront
from optsim.optics.panel import PanelResponse, settled_panel, slot_weights
from optsim.optics.radiometry import photons_per_joule

GREEN, BLUE, RED = 550e-9, 470e-9, 630e-9
PERFECT = {"depolarised_share": 0.0, "gap_reflectivity": 0.0}


def small(wavelength_m, **parts):
    camera = demo().model_copy(update={"panel_rows": 40, "panel_cols": 48, "wavelength_m": wavelength_m})
    return changed(camera, {"sensor": {"rows": 128, "cols": 152}, **parts})


def mean_electrons(camera, level=255):
    view, shape = camera.view, (camera.slots_per_frame, camera.panel_rows, camera.panel_cols)
    white = still(
        np.ones((view.rows, view.cols), np.float32), n_slots=36, slot_s=camera.slot_s, samples_per_pitch=3
    )
    code = ExposureCode(np.full(shape, level, np.uint8), np.zeros(shape[1:], np.bool_))
    electrons, _ = camera.expected_electrons(camera.form_image(white), 0, code, None)
    return float(electrons[54:74, 66:86].mean() - camera.dark_e)


def test_at_550_nm_nothing_is_scaled():
    camera = demo()
    assert camera.wavelength_m == GREEN
    assert camera.modulator.white_rad(GREEN) == np.pi
    assert camera.panel_response.white == 1.0
    assert camera.splitter.growth_of_leak(GREEN) == 1.0
    assert camera.sensor.efficiency_at(GREEN) == camera.sensor.quantum_efficiency
    waves = Wavefront(spherical_waves=0.07, coma_waves=0.139, curvature_waves=-0.3)
    assert waves.in_light_of(GREEN) == waves


def test_from_blue_to_red_the_prototypes_corners_move_outwards_by_2_um_and_no_light_is_lost():
    camera = prototype()
    corners = np.array([[0.0, 0.0], [0.0, 1800.0], [1500.0, 0.0], [1500.0, 1800.0]])
    places = {}
    for wavelength_m in (450e-9, GREEN, 650e-9):
        there = camera.model_copy(update={"wavelength_m": wavelength_m}).relay_geometry()
        places[wavelength_m] = np.stack(there.place(*corners.T), axis=1)
        assert there.cell_px / there.magnification == pytest.approx(20e-6 / 4.54e-6 / 3)
    assert changed(camera, {"relay": {"lateral_colour": 0.0}}).relay_geometry() == camera.relay_geometry()
    middle = places[GREEN].mean(axis=0)
    outwards = np.linalg.norm(places[650e-9] - middle, axis=1) - np.linalg.norm(
        places[450e-9] - middle, axis=1
    )
    np.testing.assert_allclose(outwards * camera.sensor.pitch_m, 2e-6, rtol=0.05)
    np.testing.assert_allclose(places[GREEN], (places[450e-9] + places[650e-9]) / 2, atol=1e-9)
    # The image is larger, and as much darker: as much light lands on the CCD, all of which it holds.
    red = small(650e-9, relay={"ghost_share": 0.0})
    sums = [
        changed(red, {"relay": {"lateral_colour": share}}).relay_operator().apply(np.ones((120, 144))).sum()
        for share in (0.0, 2e-2)
    ]
    assert sums[1] == pytest.approx(sums[0], rel=1e-6)


@pytest.mark.parametrize("wavelength_m", [BLUE, RED])
def test_diffraction_scales_with_the_wavelength(wavelength_m):
    """A PSF in units of its own wavelength: the same kernel on cells as much larger."""
    over = wavelength_m / GREEN
    sharp = demo().objective.model_copy(update={"aberration_m": 0.0, "field_error": 1e-3})
    # As many waves of this light as the other lens has of green.
    same = changed_waves(sharp, over)
    here = same.psf(6.0, 2e-6 * over, (30, 40), 40e-6 * over, wavelength_m)
    green = sharp.psf(6.0, 2e-6, (30, 40), 40e-6)
    np.testing.assert_allclose(here.kernel, green.kernel, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(here.cores, green.cores, rtol=1e-9, atol=1e-15)
    assert here.cores.size
    # The first dark ring of a perfect lens, 1.2197 lambda N, by the cells on an axis.
    perfect = sharp.model_copy(update={"wavefront": Wavefront(), "tail_share": 0.03})
    kernel = perfect.psf(6.0, 0.1e-6, (1, 1), 0.0, wavelength_m).kernel
    line = kernel[len(kernel) // 2, len(kernel) // 2 :]
    ring = int(np.argmax(np.diff(line) > 0))
    assert ring * 0.1e-6 == pytest.approx(1.2197 * wavelength_m * 6.0, abs=0.1e-6)


def changed_waves(lens, factor):
    waves = {name: value * factor for name, value in lens.wavefront}
    return lens.model_copy(update={"wavefront": Wavefront(**waves)})


def test_the_same_path_difference_is_more_waves_of_shorter_light():
    waves = Wavefront(spherical_waves=0.1, coma_waves=-0.2)
    assert waves.in_light_of(275e-9) == Wavefront(spherical_waves=0.2, coma_waves=-0.4)


@pytest.mark.parametrize("wavelength_m", [BLUE, RED])
def test_camera_blurs_by_its_wavelength(wavelength_m):
    """Both lens groups, through the camera's own operator and image, on one bright sample."""
    camera = small(wavelength_m, relay={"focus": "paraxial"})
    camera = with_effects(camera, {"relay_glare": "ideal", "ghost": "ideal"})
    operator = camera.relay_operator()
    kernel = camera.relay.psf(
        camera.relay.image_f_number(6.0),
        20e-6 / 3 * camera.relay.magnification,
        (120, 144),
        0.0,
        wavelength_m,
    )
    spot = np.zeros((120, 144))
    spot[60, 72] = 1
    # On axis and within the window the operator's blur is the PSF of this light.
    row = operator.blur.apply(spot)[60, 72:80]
    middle = kernel.at(0.5 / 60, 0.5 / 72)
    np.testing.assert_allclose(row, middle[len(middle) // 2, len(middle) // 2 :][:8], rtol=1e-6, atol=1e-9)
    picture = np.zeros((120, 144), np.float32)
    picture[60, 72] = 1
    bare = with_effects(small(wavelength_m), {"objective_glare": "ideal"})
    bare = changed(bare, {"objective": {"aberration_m": 0.0, "wavefront": no_waves(), "f_number": 16.0}})
    video = still(picture, n_slots=36, slot_s=bare.slot_s, samples_per_pitch=3)
    peak = float(bare.form_image(video).load(0).start.max()) / bare.irradiance_per_radiance
    # A sample's share of an Airy disc around its middle, whose density there is pi / (2 lambda N)^2.
    place = (np.arange(200) + 0.5) / 200 - 0.5
    v = np.pi * np.hypot(place[:, None], place) * 20e-6 / 3 / (wavelength_m * 24)
    share = np.mean((2 * j1(v) / v) ** 2) * np.pi * (20e-6 / 3 / (2 * wavelength_m * 24)) ** 2
    # Of the wings, 1e-3, some stays with its point.
    assert peak == pytest.approx(share, abs=1.2e-3)


def no_waves():
    return dict.fromkeys(("spherical_waves", "coma_waves", "astigmatism_waves", "curvature_waves"), 0.0)


@pytest.mark.parametrize("wavelength_m", [BLUE, RED])
def test_electrons_of_a_white_frame_by_closed_forms(wavelength_m):
    """Photons a joule, quantum efficiency, sin^2 of half the retardance, and what the coating takes away."""
    quiet = {"modulator": {**PERFECT, "tau_on_s": 0.0, "tau_off_s": 0.0, "stuck_share": 0.0}}
    cameras = [with_effects(small(light, **quiet), {"fields": "ideal"}) for light in (GREEN, wavelength_m)]
    green, other = (mean_electrons(camera) for camera in cameras)
    shape = {BLUE: np.interp(470, (450, 500), (0.95, 1.03)), RED: np.interp(630, (600, 650), (0.90, 0.76))}
    dilated = ((wavelength_m - GREEN) / 100e-9) ** 2
    coating = (0.95 - 0.03 * dilated) * (0.99 - 0.001 * dilated) / (0.95 * 0.99)
    panel = np.sin(np.pi / 2 * GREEN / wavelength_m) ** 2
    expected = wavelength_m / GREEN * shape[wavelength_m] / 0.99 * panel * coating
    # The polarisers' thousandth of crossed light is all that is left out.
    assert other / green == pytest.approx(expected, rel=1e-3)
    ledgers = [{row.stage: row.value for row in camera.ledger(1.0)} for camera in cameras]
    assert ledgers[1]["electrons a frame"] / ledgers[0]["electrons a frame"] == pytest.approx(
        expected, rel=1e-3
    )
    photons = photons_per_joule(wavelength_m) / photons_per_joule(GREEN)
    assert photons == pytest.approx(wavelength_m / GREEN, rel=1e-12)


@pytest.mark.parametrize("wavelength_m", [BLUE, RED])
@pytest.mark.parametrize("level", [0, 128, 200])
def test_greys_by_the_retardance_of_this_light(wavelength_m, level):
    """An instantaneous panel: leak + (1 - leak) sin^2(Gamma / 2) / sin^2(white / 2), through all of it."""
    camera = small(wavelength_m, modulator={"tau_on_s": 0.0, "tau_off_s": 0.0, "stuck_share": 0.0})
    camera = with_effects(camera, {"fields": "ideal"})
    gamma, white = (np.pi * GREEN / wavelength_m * (g / 255) ** 1.2 for g in (level, 255))
    leak = 1 / camera.contrast
    expected = leak + (1 - leak) * np.sin(gamma / 2) ** 2 / np.sin(white / 2) ** 2
    assert mean_electrons(camera, level) / mean_electrons(camera) == pytest.approx(expected, rel=2e-3)


def test_contrast_falls_with_the_coating_and_the_darker_white():
    """One over contrast by hand: depolarised light and gaps over the darker white, the coating grown."""
    panel = lcr720()
    for wavelength_m in (GREEN, BLUE, RED):
        camera = small(wavelength_m)
        d, white = panel.depolarised_share, np.sin(np.pi / 2 * GREEN / wavelength_m) ** 2
        gaps = 0.08 * 0.05 / (0.92 * panel.mirror_reflectivity)
        dilated = 1 + ((wavelength_m - GREEN) / 100e-9) ** 2
        p, s = 0.95 - 0.03 * (dilated - 1), 0.99 - 0.001 * (dilated - 1)
        coating = dilated * (0.03 / s + 0.001 / p) / 1000
        off = d / 2 + gaps / 2 + coating * (1 - d)
        on = white * (1 - d) + off
        assert 1 / camera.contrast == pytest.approx(off / on, rel=3e-3)
    assert small(BLUE).contrast < 0.95 * small(GREEN).contrast


@pytest.mark.parametrize("wavelength_m", [450e-9, BLUE, RED])
def test_a_panel_that_relaxes_past_a_half_wave_by_small_steps(wavelength_m):
    """Up, down and between greys, with overshoot where white is past a half wave, by 20 000 steps a slot."""
    slot_s = 1 / 180
    response = lcr720().response(0.01, 1, wavelength_m).model_copy(update={"field_drive": (1.0,)})
    told = np.array([255, 0, 128, 255, 255, 40], np.uint8)
    levels = np.zeros((6, 1, 1), np.uint8)
    levels[:, 0, 0] = told
    dark = settled_panel(np.zeros((1, 1), np.uint8), response)
    weights, _ = slot_weights(levels, dark, response, slot_s)
    gamma, steps, white = 0.0, 20_000, np.pi * GREEN / wavelength_m
    for slot, level in enumerate(told):
        target = white * (level / 255) ** 1.2
        tau = 0.5e-3 if target > gamma else 1.0e-3
        t = (np.arange(steps) + 0.5) / steps * slot_s
        path = target + (gamma - target) * np.exp(-t / tau)
        seen = np.mean(np.sin(path / 2) ** 2) / np.sin(white / 2) ** 2
        assert weights[slot, 0, 0] == pytest.approx(0.01 + 0.99 * seen, abs=2e-6)
        gamma = target + (gamma - target) * np.exp(-slot_s / tau)
    if wavelength_m < GREEN:
        assert weights.max() > 1


@pytest.mark.slow
@pytest.mark.parametrize("wavelength_m", [BLUE, RED])
def test_the_bench_works_in_the_same_light(wavelength_m):
    """Calibrated from images in this light: exponent, times and weights of random codes as the truth's."""
    camera = small(wavelength_m)
    bench = measure_bench(camera, np.random.default_rng(5))
    assert bench.white_rad == pytest.approx(np.pi * GREEN / wavelength_m, rel=1e-12)
    found, truth = calibrate_from(bench), true_calibration(camera)
    assert found.response.drive_exponent == pytest.approx(1.2, rel=0.01)
    assert found.response.tau_on_s == pytest.approx(0.5e-3, rel=0.05)
    assert found.response.tau_off_s == pytest.approx(1.0e-3, rel=0.05)
    assert found.response.leak == pytest.approx(1 / camera.contrast, rel=0.05)
    rng = np.random.default_rng(6)
    levels = rng.choice(np.array([0, 64, 128, 180, 255], np.uint8), (36, 40, 48))
    code = ExposureCode(levels, np.zeros((40, 48), np.bool_))
    ours, exact = (each.weights(code, None)[0].sum(axis=0) for each in (found, truth))
    assert np.sqrt(np.mean((ours / exact - 1) ** 2)) < 0.005
    # It would not do to take white for a half wave: past one, greys brighter than white have no meaning then.
    blind = replace(bench, white_rad=np.pi)
    if wavelength_m < GREEN:
        with pytest.raises(BenchError, match=r"level 208 that lets 1\.0"):
            calibrate_from(blind)
    else:
        wrong = calibrate_from(blind).weights(code, None)[0].sum(axis=0)
        assert np.sqrt(np.mean((wrong / exact - 1) ** 2)) > 0.01
    shares = found.responsivity_dn[truth.valid] / truth.responsivity_dn[truth.valid]
    assert np.median(shares) == pytest.approx(1, abs=0.01)
    ideal = ideal_calibration(camera)
    assert ideal.response.white_rad == truth.response.white_rad


@pytest.mark.slow
def test_the_bench_is_told_the_data_sheets_retardance_which_may_be_wrong():
    camera = small(GREEN)
    panel = camera.modulator.model_copy(update={"stated_half_wave_m": 0.95 * camera.modulator.half_wave_m})
    camera = camera.model_copy(update={"modulator": panel})
    assert camera.panel_response.white_rad == np.pi
    bench = measure_bench(camera, np.random.default_rng(5))
    found, right = calibrate_from(bench), calibrate_from(replace(bench, white_rad=np.pi))
    assert found.response.white_rad == ideal_calibration(camera).response.white_rad == 0.95 * np.pi
    truth = true_calibration(camera)
    assert truth.response.white_rad == np.pi
    levels = (np.random.default_rng(6).random((36, 40, 48)) < 0.1).astype(np.uint8) * np.uint8(255)
    code = ExposureCode(levels, np.zeros((40, 48), np.bool_))
    ours, best, exact = (each.weights(code, None)[0] for each in (found, right, truth))
    wrong, rest = (np.sqrt(np.mean((each - exact) ** 2) / np.mean(exact**2)) for each in (ours, best))
    # Time constants and the grey curve take up most of the 5 %.
    assert 5e-4 < wrong < 0.01
    assert wrong > 3 * rest


def test_luminance_is_that_of_the_band():
    # CIE 1924 V(lambda) as printed, three digits.
    for wavelength_m, seen in ((BLUE, 0.091), (510e-9, 0.503), (RED, 0.265)):
        assert luminous_efficacy_lm_w(wavelength_m) == pytest.approx(683 * seen, rel=5e-3)
        scale = PhotometricScale(white_w_m2_sr=0.5, irradiance_per_radiance=0.02, wavelength_m=wavelength_m)
        assert scale.white_cd_m2 == pytest.approx(0.5 * 683 * seen, rel=5e-3)
        assert scale.luminance_cd_m2(np.ones(1)) == pytest.approx(683 * seen / 0.02, rel=5e-3)
    half = luminous_efficacy_lm_w(470.5e-9)
    assert half == pytest.approx((luminous_efficacy_lm_w(BLUE) + luminous_efficacy_lm_w(471e-9)) / 2)
    with pytest.raises(ConfigError, match=r"wavelength_m: got 900 nm, expected 360 to 830"):
        luminous_efficacy_lm_w(900e-9)


def test_light_in_which_a_part_is_not_known_is_refused():
    for nm in (400, 700):
        with pytest.raises(ConfigError, match=rf"camera.wavelength_m: got {nm} nm, expected 420 to 680 nm"):
            load_experiment("demo", [f"camera.wavelength_m='{nm} nm'"])
    with pytest.raises(ConfigError, match=r"spectral_response: got light of 470 nm, expected 550 to 550 nm"):
        load_experiment("demo", ["camera.wavelength_m='470 nm'", "camera.sensor.spectral_response=[]"])
    with pytest.raises(ConfigError, match=r"quantum_efficiency x spectral_response: got 1.04.* at 500 nm"):
        load_experiment("demo", ["camera.wavelength_m='500 nm'", "camera.sensor.quantum_efficiency=1.0"])
    with pytest.raises(ConfigError, match=r"half_wave_m: got 850 nm, .*430 nm white is up to 1.01 waves"):
        load_experiment("demo", ["camera.wavelength_m='430 nm'", "camera.modulator.half_wave_m='850 nm'"])
    with pytest.raises(ConfigError, match="wavelengths rising"):
        load_experiment("demo", ["camera.sensor.spectral_response=[[5e-7, 1.0], [5e-7, 0.9]]"])
    with pytest.raises(ConfigError, match=r"got 0.9 at 550 nm, expected 1 there"):
        load_experiment("demo", ["camera.sensor.spectral_response=[[4e-7, 0.9], [7e-7, 0.9]]"])
    driven = PanelResponse(white_rad=1.9 * np.pi, field_drive=(1.1, 0.9))
    held = settled_panel(np.zeros((1, 1), np.uint8), driven)
    with pytest.raises(ValueCheckError, match="at most a whole wave"):
        slot_weights(np.zeros((1, 1, 1), np.uint8), held, driven, 1 / 180)


@pytest.mark.parametrize("sensor", [icx674(), imx174()])
def test_quantum_efficiency_goes_straight_between_its_points(sensor):
    for nm, relative in ((400, 0.72), (450, 0.95), (475, 0.99), (525, 1.0), (650, 0.76), (1000, 0.04)):
        assert sensor.efficiency_at(nm / 1e9) == pytest.approx(sensor.quantum_efficiency * relative / 0.99)
    with pytest.raises(ConfigError, match=r"got light of 399 nm, expected 400 to 1000 nm"):
        sensor.efficiency_at(399e-9)


def test_coating_leaks_twice_as_much_100_nm_away():
    splitter = Splitter()
    rays = splitter.rays(np.zeros(1), 6.0)
    for wavelength_m in (450e-9, 650e-9):
        into = splitter.inbound(rays, wavelength_m)[0, 0]
        p, s = into[0, 0] + into[0, 1], into[0, 0] - into[0, 1]
        assert s == pytest.approx(2 * 0.001 * 0.9 / 1000)
        assert p == pytest.approx((0.95 - 0.03) * 0.9)


def test_an_experiment_takes_its_light_from_the_scenes_band(tmp_path: Path):
    coloured(tmp_path / "s")
    chosen = [*SMALL, f"scene.name={tmp_path / 's'}"]
    red = load_experiment("demo", [*chosen, "scene.band=red"])
    assert red.camera.wavelength_m == 620e-9
    assert load_experiment("demo", chosen).camera.wavelength_m == 540e-9
    assert load_experiment("demo").camera.wavelength_m == 550e-9
    # Said by hand: agreed with, where the scene says the same or nothing.
    again = load_experiment("demo", [*chosen, "scene.band=red", "camera.wavelength_m='620 nm'"])
    assert again.fingerprint() == red.fingerprint()
    assert load_experiment("demo", ["camera.wavelength_m='500 nm'"]).camera.wavelength_nm == 500
    with pytest.raises(ConfigError, match=r"wavelength_m: got 550 nm, but the scene's band 'red' is at 620"):
        load_experiment("demo", [*chosen, "scene.band=red", "camera.wavelength_m='550 nm'"])
    choice = red.scene.model_copy(update={"band": "blue"})
    with pytest.raises(ConfigError, match=r"got 620 nm, expected the scene's band 'blue' at 460 nm"):
        chosen_scene(red.model_copy(update={"scene": choice}))
    assert "band red at 620 nm" in describe_truth(red).description
    with pytest.raises(ConfigError, match="'red'"):
        load_experiment("demo", [*chosen, "scene.band=rad"])


def test_explain_says_what_the_band_decides(tmp_path: Path):
    coloured(tmp_path / "s")
    said = explanation("demo", [*SMALL, f"scene.name={tmp_path / 's'}", "scene.band=red", "tolerance=0"])
    assert said["band"]["wavelength_nm"] == 620
    assert said["band"]["white_retardance_in_half_waves"] == pytest.approx(550 / 620)
    assert said["band"]["splitter_leak_over_that_at_550_nm"] == pytest.approx(1.49)
