"""Do the estimators find the camera that made the images? The camera is a plain numpy one of the tests.

Statistical bounds are five standard deviations of the estimate, from its counts or (where it says "20
benches") from the spread over 20 seeds: a false alarm in 2 million for each.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_bench import Camera

from optsim.calibration import Bench, Calibration, Glare, calibrate_from
from optsim.calibration.pixel_map import map_pixels
from optsim.core.errors import BenchError, ValueCheckError
from optsim.core.quantities import CodedFrame, ExposureCode


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera()


@pytest.fixture(scope="module")
def bench(camera: Camera) -> Bench:
    return camera.bench()


@pytest.fixture(scope="module")
def calibration(bench: Bench) -> Calibration:
    return calibrate_from(bench)


def true_responsivity(camera: Camera, calibration: Calibration) -> np.ndarray:
    """DN per (W m^-2 slot) of an all-on flat at the CCD pixels that the calibration picked."""
    pick = (calibration.centre_row * camera.ccd[1] + calibration.centre_col).ravel()
    light = np.asarray(camera.relay[pick].sum(axis=1)).ravel() * camera.response.ravel()[pick]
    return (light * camera.electrons_per_w * camera.dn_per_e).reshape(camera.panel)


def all_on(camera: Camera, value: int = 255) -> ExposureCode:
    levels = np.full((camera.slots, *camera.panel), value, np.uint8)
    return ExposureCode(levels, np.zeros(camera.panel, np.bool_))


def test_sensor_constants_are_found(camera: Camera, calibration: Calibration) -> None:
    # Read noise: 15 differences of 33280 pixels; rounding adds 1/12 DN^2.
    expected = np.sqrt((camera.read_e * camera.dn_per_e) ** 2 + 1 / 12)
    assert calibration.read_noise_dn == pytest.approx(expected, rel=5 / np.sqrt(2 * 15 * 33280 * 2 / 3))
    # Gain: 7 differences each of 26000 pixels, mostly of the brightest flat.
    assert calibration.dn_per_e == pytest.approx(camera.dn_per_e, rel=5 * np.sqrt(2 / (26000 * 7 * 2 / 3)))
    picked = camera.fixed_black[calibration.centre_row, calibration.centre_col]
    error = calibration.black_dn - picked
    assert error.std() == pytest.approx(expected / 4, rel=5 / np.sqrt(2 * error.size))
    assert abs(error.mean()) < 5 * expected / 4 / np.sqrt(error.size)


def test_saturation_threshold_is_four_sigma_below_the_clip(camera: Camera, calibration: Calibration) -> None:
    sigma = camera.read_e * camera.dn_per_e
    clip = camera.full_well_e * camera.dn_per_e
    below = clip - (calibration.saturation_dn - calibration.black_dn)
    assert below.mean() == pytest.approx(
        4 * sigma + 1e-3 * clip, abs=5 * sigma * np.sqrt((1 / 4 + 1 / 16) / below.size)
    )


def test_every_pixel_is_found_with_shift_rotation_and_magnification(
    camera: Camera, calibration: Calibration
) -> None:
    assert calibration.valid.all()
    true = camera.place(np.indices(camera.panel).reshape(2, -1).T + 0.5).reshape(*camera.panel, 2)
    picked = np.stack([calibration.centre_row, calibration.centre_col], axis=-1)
    # A centre within 0.02 CCD pixels of a border may fall on either side of it.
    assert np.abs(true - picked - 0.5).max() < 0.52
    # Dots have about 100 kDN: centroid noise of 0.004..0.008 CCD pixels an axis by shot and read noise.
    assert 0.001 < calibration.map_residual_px < 0.006


@settings(max_examples=12, deadline=None)
@given(
    rotation=st.floats(-0.03, 0.03),
    magnification=st.floats(0.98, 1.02),
    down=st.floats(-6, 6),
    right=st.floats(-6, 6),
    mirrored=st.booleans(),
)
def test_map_is_found_for_any_misalignment(
    rotation: float, magnification: float, down: float, right: float, mirrored: bool
) -> None:
    camera = Camera(
        panel=(30, 40), ccd=(120, 150), rotation=rotation, magnification=magnification,
        shift=(down, right), mirrored=mirrored,
    )  # fmt: skip
    bench = camera.bench()
    found = map_pixels(bench, bench.darks.mean(axis=0, dtype=np.float32))
    centres = np.indices(camera.panel).reshape(2, -1).T + 0.5
    # Cubic fits extrapolate four pixels beyond the outermost dots: 0.01 px centroids give below 0.1 px there.
    assert np.abs(found.on_ccd(centres) - camera.place(centres)).max() < 0.1


def test_a_distortion_outside_the_family_shows_in_the_residual() -> None:
    def ripple(y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 0.4 * np.sin(x / 7), 0.0 * y

    camera = Camera(distortion=ripple)
    calibration = calibrate_from(camera.bench())
    # A sine of amplitude 0.4 CCD pixels has 0.4 / sqrt 2 rms; a cubic cannot follow its 4 periods.
    assert calibration.map_residual_px == pytest.approx(0.4 / np.sqrt(2) / camera.ratio, rel=0.15)


def test_responsivity_matches_a_flat_within_its_stated_uncertainty(
    camera: Camera, calibration: Calibration
) -> None:
    error = calibration.responsivity_dn / true_responsivity(camera, calibration) - 1
    assert error.std() == pytest.approx(calibration.gain_uncertainty, rel=5 / np.sqrt(2 * error.size))
    assert abs(error.mean()) < 5 * calibration.gain_uncertainty / np.sqrt(error.size)


def test_crosstalk_follows_the_offset_of_each_pick(camera: Camera, calibration: Calibration) -> None:
    pick = calibration.centre_row * camera.ccd[1] + calibration.centre_col
    index = np.arange(pick.size).reshape(camera.panel)
    total = np.asarray(camera.relay.sum(axis=1)).ravel()
    v, u = camera.panel
    seen_at = pick[3:-3, 3:-3].ravel()
    true = np.empty((v - 6, u - 6, 7, 7))
    for i in range(7):
        for j in range(7):
            lit = index[i : i + v - 6, j : j + u - 6].ravel()
            share = np.asarray(camera.relay[seen_at, lit]).ravel() / total[seen_at]
            true[:, :, i, j] = share.reshape(v - 6, u - 6)
    found = calibration.crosstalk[3:-3, 3:-3]
    # 88 dots for 21 coefficients a neighbour leave a part of what one kernel for all would leave.
    one_for_all = np.sqrt(np.mean((true - true.mean(axis=(0, 1))) ** 2))
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.3 * one_for_all
    assert 0.02 < np.ptp(true[:, :, 3, 4]) < 0.3
    assert np.corrcoef(found[:, :, 3, 4].ravel(), true[:, :, 3, 4].ravel())[0, 1] > 0.95
    assert np.corrcoef(found[:, :, 4, 3].ravel(), true[:, :, 4, 3].ravel())[0, 1] > 0.95


@pytest.mark.parametrize(
    ("tau_on_s", "tau_off_s", "leak", "exponent"),
    [(0.5e-3, 1.0e-3, 0.01, 1.2), (1.4e-3, 0.3e-3, 0.05, 0.9), (0.0, 0.8e-3, 0.002, 1.5)],
)
def test_panel_response_is_found(tau_on_s: float, tau_off_s: float, leak: float, exponent: float) -> None:
    camera = Camera(tau_on_s=tau_on_s or 1e-12, tau_off_s=tau_off_s, leak=leak, exponent=exponent)
    response = calibrate_from(camera.bench()).response
    # Spread over 20 benches: 1.3e-7 s, 3.5e-6, 1.7e-4; a tau below 1e-4 slots counts as none.
    assert response.tau_on_s == pytest.approx(tau_on_s, abs=2e-6)
    assert response.tau_off_s == pytest.approx(tau_off_s, abs=2e-6)
    assert response.leak == pytest.approx(leak, abs=5 * 3.5e-6 * max(1, np.sqrt(leak / 0.01)))
    assert response.drive_exponent == pytest.approx(exponent, abs=5 * 1.7e-4 * max(1, exponent / 1.2))


def test_a_leak_that_varies_over_the_field_is_owned_up_to(bench: Bench) -> None:
    v = np.linspace(0.8, 1.2, bench.off.dn.shape[1])[:, None]
    black = bench.darks.mean()
    tilted = ((bench.off.dn - black) * v + black).round().astype(np.uint16)
    found = calibrate_from(replace(bench, off=replace(bench.off, dn=tilted)))
    # +-20 % over the CCD, of which the panel covers 139 of 160 rows, uniformly: rms 0.2 x 0.87 / sqrt 3.
    assert found.leak_uncertainty == pytest.approx(0.2 * 0.87 / np.sqrt(3), rel=0.1)


def test_observations_have_the_variance_they_state(camera: Camera, calibration: Calibration) -> None:
    exact = replace(
        calibration,
        responsivity_dn=true_responsivity(camera, calibration).astype(np.float32),
        black_dn=camera.fixed_black[calibration.centre_row, calibration.centre_col].astype(np.float32),
    )
    for irradiance in (0.0, 0.01, 0.3, 1.0):
        dn = camera.held(np.full(camera.panel, 255), irradiance, 1)[0]
        seen = exact.observe(CodedFrame(0, dn, all_on(camera)))
        residual = (seen.signal - irradiance * camera.slots) / np.sqrt(seen.variance)
        # A dark pixel's variance is stated from its own, clipped, signal: up to half a sigma of bias.
        tolerance = 5 * np.sqrt(2 / residual.size) + (0.03 if irradiance <= 0.01 else 0)
        assert np.var(residual) == pytest.approx(1, abs=tolerance), irradiance
        assert not seen.saturated.any()
        assert seen.valid.all()


def test_the_bench_calibration_reads_a_flat_within_noise(camera: Camera, calibration: Calibration) -> None:
    dn = camera.held(np.full(camera.panel, 255), 0.5, 1)[0]
    seen = calibration.observe(CodedFrame(0, dn, all_on(camera)))
    systematic = (calibration.gain_uncertainty * 18) ** 2
    black = (calibration.read_noise_dn / calibration.responsivity_dn) ** 2 / 16
    residual = (seen.signal - 18) / np.sqrt(seen.variance + systematic + black)
    assert np.var(residual) == pytest.approx(1, abs=5 * np.sqrt(2 / residual.size))


def test_saturation_is_seen_on_raw_numbers(camera: Camera, calibration: Calibration) -> None:
    for irradiance, expected in ((1.0, False), (5.0, True)):
        dn = camera.held(np.full(camera.panel, 255), irradiance, 1)[0]
        seen = calibration.observe(CodedFrame(0, dn, all_on(camera))).saturated
        # 4 sigma, of which the threshold's own error is a part: 1e-4 a pixel.
        assert np.mean(seen == expected) > 1 - 1e-3


@pytest.mark.parametrize("off_irradiance", [1.0, 10.0])  # a pixel stuck on clips in the stronger light
def test_dead_and_stuck_pixels_are_invalid_and_the_rest_is_not_hurt(off_irradiance: float) -> None:
    whole = Camera()
    dead, stuck = (20, 30), ((10, 12, 1.0), (33, 50, 0.0))
    at = np.floor(whole.place(np.array(dead) + 0.5)).astype(int)
    camera = Camera(dead_ccd=[(int(at[0]), int(at[1]))], stuck=stuck)
    calibration = calibrate_from(replace(camera.bench(), off=camera.flat(0, off_irradiance, 4)))
    expected = np.ones(camera.panel, bool)
    for v, u in (dead, stuck[0][:2], stuck[1][:2]):
        expected[v, u] = False
    np.testing.assert_array_equal(calibration.valid, expected)
    assert np.isfinite(calibration.responsivity_dn).all()
    assert calibration.response.tau_off_s == pytest.approx(camera.tau_off_s, abs=2e-6)
    assert calibration.response.leak == pytest.approx(camera.leak, abs=5 * 3.5e-6 * (10 / off_irradiance))
    assert calibration.leak_uncertainty < 0.1


def test_pixels_off_the_ccd_are_invalid_and_counted() -> None:
    camera = Camera(ccd=(130, 208), shift=(0.0, 0.0), rotation=0.0, magnification=1.0)
    calibration = calibrate_from(camera.bench())
    # 48 rows of 2.88 pixels are 138.24 of the CCD's 130; centres within a pixel of the border are left out.
    rows = (np.arange(48) + 0.5 - 24) * camera.ratio + 65
    inside = (np.floor(rows) >= 1) & (np.floor(rows) < 129)
    np.testing.assert_array_equal(calibration.valid, np.repeat(inside[:, None], 64, axis=1))
    frame = CodedFrame(0, camera.held(np.full(camera.panel, 255), 1.0, 1)[0], all_on(camera))
    assert np.isfinite(calibration.observe(frame).signal).all()


def test_closed_slots_have_no_weight(camera: Camera, calibration: Calibration) -> None:
    short = replace(calibration, coded_slots=28)
    weights, panel = short.weights(all_on(camera), short.panel_at_rest())
    assert not weights[28:].any()
    np.testing.assert_allclose(weights[5:28], 1, atol=1e-4)
    np.testing.assert_allclose(panel.retardance_rad, np.pi, rtol=1e-5)


@pytest.mark.parametrize("few_pixels", [100_000, 0], ids=["at once", "in bands"])
def test_spreading_gathers_and_keeps_uniform_light(
    few_pixels: int, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    from scipy.ndimage import correlate

    monkeypatch.setattr("optsim.calibration.calibration._FEW_PIXELS", few_pixels)
    rng = np.random.default_rng(1)
    skew = rng.random((3, 3)).astype(np.float32)
    skew /= skew.sum()
    kernels = np.ascontiguousarray(np.broadcast_to(skew, (*calibration.shape, 3, 3)))
    kernels[5, 7] = np.roll(skew, 1, axis=0)
    skewed = replace(calibration, crosstalk=kernels)
    stack = rng.random((2, *calibration.shape)).astype(np.float32)
    expected = np.stack([correlate(image, skew, mode="nearest") for image in stack])
    expected[:, 5, 7] = (stack[:, 4:7, 6:9] * kernels[5, 7]).sum(axis=(1, 2))
    np.testing.assert_allclose(skewed.spread(stack), expected, atol=1e-6)
    np.testing.assert_allclose(skewed.spread(np.ones_like(stack)), 1, atol=1e-6)


def test_effective_weights_predict_a_coded_frame_of_uniform_light(
    camera: Camera, calibration: Calibration
) -> None:
    rng = np.random.default_rng(3)
    levels = np.where(rng.random(camera.panel) < 0.5, 255, 0).astype(np.uint8)
    code = ExposureCode(np.repeat(levels[None], 36, axis=0), np.zeros(camera.panel, np.bool_))
    held = calibration.weights(code, calibration.panel_at_rest())[1]  # 36 slots: ten times the response
    weights, _ = calibration.effective_weights(code, held)
    dn = camera.frames(camera.electrons(camera.weight(levels) * 36, 1.0), 1)[0]
    seen = calibration.observe(CodedFrame(0, dn, code))
    error = seen.signal / 36 - weights.mean(axis=0)
    # One kernel for all phases: picks up to half a CCD pixel off centre see 2..5 % more of one neighbour.
    assert np.sqrt(np.mean(error[1:-1, 1:-1] ** 2)) < 0.06
    plain = seen.signal / 36 - calibration.weights(code, held)[0].mean(axis=0)
    assert np.sqrt(np.mean(plain[1:-1, 1:-1] ** 2)) > 0.1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b: {"saturated": b.flats[0]}, "saturated"),
        (lambda b: {"flats": (replace(b.flats[0], dn=b.darks[:4]),)}, "up to half of full well"),
        (lambda b: {"anchors": (replace(b.anchors[0], dn=b.darks[:1]), *b.anchors[1:])}, r"anchors\[0\]"),
        (lambda b: {"dots": (replace(b.dots[0], dn=b.darks[:1]),)}, "dots"),
        (lambda b: {"steps": b.steps[:26]}, "lower level"),
        (lambda b: {"steps": tuple(replace(s, dn=b.darks[:1]) for s in b.steps)}, "flash"),
        (
            lambda b: {"flats": (replace(b.flats[0], dn=b.saturated.dn), *b.flats[1:])},
            "100% of its pixels sat",
        ),
        (lambda b: {"greys": (replace(b.off, level=128),)}, "level 128"),
    ],
)
def test_images_that_cannot_identify_a_parameter_are_refused(bench: Bench, change, message: str) -> None:
    with pytest.raises(BenchError, match=message):
        calibrate_from(replace(bench, **change(bench)))


def test_a_flash_that_lights_a_part_of_the_panel_is_enough(camera: Camera, bench: Bench) -> None:
    middle = np.zeros(camera.ccd, bool)
    middle[60:100, 80:130] = True
    # Elsewhere the short exposures have another black level than the long darks.
    steps = tuple(
        replace(s, dn=np.where(middle, s.dn, bench.darks[:1] + 30).astype(np.uint16)) for s in bench.steps
    )
    response = calibrate_from(replace(bench, steps=steps)).response
    # A thirteenth of the pixels: 3.6 times the spread over 20 benches.
    assert response.tau_on_s == pytest.approx(camera.tau_on_s, abs=5 * 3.6 * 1.3e-7)
    assert response.tau_off_s == pytest.approx(camera.tau_off_s, abs=5 * 3.6 * 1.3e-7)


def test_glare_of_more_than_all_light_is_refused() -> None:
    for wrong in ({"veil": 0.6, "ghost": 0.5}, {"ghost": -0.1}, {"ghost_blur_px": 0.0}, {"wings": (0.1,)}):
        with pytest.raises(ValueCheckError, match="glare: got veil"):
            Glare(**wrong)


@pytest.mark.parametrize("true_veil", [0.0, 0.003, 0.02])
def test_veil_is_found(true_veil: float) -> None:
    """Within a tenth of itself and 2e-4.

    A fifth of the picture at 9000 DN gives 2 DN a promille, averaged over 1000 pixels with noise of some DN;
    the tenth allows for the veil's own share in the responsivity, which is neglected.
    """
    camera = Camera(veil=true_veil)
    found = calibrate_from(camera.bench()).glare.veil
    # The camera spreads a share of the CCD's mean, a calibration counts in means over the panel.
    covered = camera.panel[0] * camera.panel[1] * (camera.ratio * camera.magnification) ** 2
    expected = true_veil * covered / (camera.ccd[0] * camera.ccd[1])
    assert found == pytest.approx(expected, rel=0.1, abs=2e-4)


def test_mixing_keeps_uniform_light_and_spreads_a_bright_corner(calibration: Calibration) -> None:
    veiled = replace(calibration, glare=Glare(veil=0.01))
    uniform = np.full(veiled.shape, 2.0, np.float32)
    np.testing.assert_allclose(
        np.mean(veiled.mix(uniform) * veiled.responsivity_dn),
        np.mean(uniform * veiled.responsivity_dn),
        rtol=1e-5,
    )
    corner = np.zeros(veiled.shape, np.float32)
    corner[:10, :10] = 1
    far = veiled.mix(corner)[-8:, -8:] * veiled.responsivity_dn[-8:, -8:]
    np.testing.assert_allclose(far, 0.01 * np.mean(corner * veiled.responsivity_dn), rtol=1e-4)
