"""A coded frame without blur, pixel by pixel, against sums written here: radiance, slots, parts, patterns."""

import numpy as np
import pytest

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware import demo
from optsim.camera.parts.chain import stage_transmissions
from optsim.core.quantities import ExposureCode, RadianceVideo, Segment
from optsim.optics.aberrations import Wavefront

V, U, SLOTS, CODED, N_SUB = 6, 8, 8, 6, 4
MARGIN = 4  # CCD pixels around the panel's image
TOTAL_ROWS = 3 * V  # of the panel, of which the middle third is used
DELAY, SCAN = 0.1, 0.6  # slots


def camera(**sensor) -> CodedCamera:
    """A sharp camera with patterns on panel and CCD, rows that turn late, and a readout without overlap."""
    whole = demo()
    sharp = {
        "diffraction": False,
        "aberration_m": 0.0,
        "glare_share": 0.0,
        "distortion": 0.0,
        "wavefront": Wavefront(),
    }
    slot_s = 1 / whole.modulator.field_rate_hz
    panel = {
        "rows": TOTAL_ROWS,
        "cols": 3 * U,
        "tau_on_s": 0.0,
        "tau_off_s": 0.0,
        "field_drive": (1.0, 1.0, 1.0),
        "polarity_drive": 0.0,
        "fringing_px": 0.0,
        "nonuniformity_rms": 0.1,
        "stuck_share": 0.0,
        "delay_s": DELAY * slot_s,
        "scan_s": SCAN * slot_s,
    }
    chip = {
        "rows": 3 * V + 2 * MARGIN,
        "cols": 3 * U + 2 * MARGIN,
        "prnu": 0.05,
        "dark_current_e_s": 900.0,
        "readout_s": (SLOTS - CODED - 0.5) * slot_s,
        "readout_rows": None,
    }
    return whole.model_copy(
        update={
            "objective": whole.objective.model_copy(update={**sharp, "natural_vignetting": False}),
            "splitter": whole.splitter.model_copy(update={"tp": 0.9, "rs": 0.8, "ts": 0.004, "rp": 0.05}),
            "modulator": whole.modulator.model_copy(update=panel),
            # Slower than the cone that comes from the panel.
            "relay": whole.relay.model_copy(update={**sharp, "ghost_share": 0.0, "f_number": 6.0}),
            "sensor": whole.sensor.model_copy(update={**chip, **sensor}),
            "panel_rows": V,
            "panel_cols": U,
            "slots_per_frame": SLOTS,
            "overlap": False,
        }
    )


def radiance_at(pixels, slots):
    """Radiance of panel pixels at a time in slots: it grows evenly."""
    return pixels * (1 + slots)


def light(made: CodedCamera, pixels):
    def load(slot):
        fine = np.kron(pixels, np.ones((3, 3))).astype(np.float32)
        return Segment(radiance_at(fine, slot), radiance_at(fine, slot + 1), (), N_SUB)

    video = RadianceVideo.on_view(
        made.view, made.slot_s, load, slots_per_segment=1, n_slots=2 * SLOTS, instants_per_slot=N_SUB
    )
    return made.form_image(video)


def on_and_off(made: CodedCamera) -> tuple[float, float]:
    """Share of unpolarised light that passes a bright and a dark panel: powers of p and of s by hand."""
    s, m = made.splitter, made.modulator
    clean, weak = s.cleanup_transmission, s.cleanup_transmission / s.cleanup_contrast
    into_p, into_s = s.tp * clean / 2, s.ts * weak / 2
    kept, turned = 1 - m.depolarised_share / 2, m.depolarised_share / 2
    mirrors = m.mirror_reflectivity * m.fill_factor
    gaps = (1 - m.fill_factor) * m.gap_reflectivity * (into_p + into_s) / 2
    straight = mirrors * (into_p * kept + into_s * turned) + gaps
    crossed = mirrors * (into_p * turned + into_s * kept) + gaps
    out_p, out_s = (share * s.face_transmission for share in (s.rp * weak, s.rs * clean))
    return crossed * out_p + straight * out_s, straight * out_p + crossed * out_s


def open_share(levels, before, on: float, off: float):
    """Share of the light that each pixel passes in each instant of the period, (slot, instant, v, u)."""
    share = np.zeros((SLOTS, N_SUB, V, U))
    first = (TOTAL_ROWS - V) // 2
    for v in range(V):
        turn = N_SUB * (DELAY + SCAN * (first + v + 0.5) / TOTAL_ROWS)
        for instant in range(N_SUB):
            old = np.clip(turn - instant, 0, 1)
            for slot in range(CODED):
                earlier = levels[slot - 1, v] if slot else before[v]
                opened = old * (earlier > 0) + (1 - old) * (levels[slot, v] > 0)
                share[slot, instant, v] = off + (on - off) * opened
    return share


def middles(index: int):
    """Middles of a frame's instants, slots from the start: (slot, instant)."""
    return index * SLOTS + np.arange(SLOTS)[:, None] + (np.arange(N_SUB) + 0.5) / N_SUB


def test_electrons_of_two_frames_are_the_sum_over_instants():
    made = camera()
    assert made.coded_slots == CODED
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0.02, 0.06, (V, U))
    levels = (rng.random((2, SLOTS, V, U)) < 0.5).astype(np.uint8) * np.uint8(255)
    shown = light(made, pixels)
    on, off = on_and_off(made)
    pattern = made.modulator.gain(V, U, made.serial_number)
    per_radiance = np.pi * made.objective.transmission * made.objective.nd_transmission / (4 * 6.0**2)
    accepted = (6.0 * made.relay.magnification / 6.0) ** 2
    per_irradiance = made.relay.transmission * accepted / made.relay.magnification**2
    pixel_m2 = 4.54e-6**2
    photons_j = 550e-9 / (6.62607015e-34 * 299792458.0)
    electrons_j_m2 = pixel_m2 * photons_j * made.sensor.quantum_efficiency
    panel = made.panel_at_rest()
    before = np.zeros((V, U), np.uint8)
    for index in (0, 1):
        code = ExposureCode(levels[index], np.zeros((V, U), bool))
        found, panel = made.expected_electrons(shown, index, code, panel)
        share = open_share(levels[index], before, on, off)
        times = middles(index)[:, :, None, None]
        energy = (share * radiance_at(pixels, times)).sum(axis=(0, 1)) * made.slot_s / N_SUB
        arrived = np.kron(per_radiance * energy * pattern * per_irradiance, np.ones((3, 3)))
        response = made.sensor.pixel_response(made.serial_number)[MARGIN:-MARGIN, MARGIN:-MARGIN]
        expected = arrived * electrons_j_m2 * response + 900.0 * CODED * made.slot_s
        np.testing.assert_allclose(found[MARGIN:-MARGIN, MARGIN:-MARGIN], expected, rtol=2e-5)
        # The panel is dark while the shutter is closed.
        before = np.zeros_like(before)


def test_the_reference_is_the_irradiance_in_the_middle_of_each_slot():
    made = camera()
    pixels = np.random.default_rng(4).uniform(0.02, 0.06, (V, U))
    irradiance = np.pi * made.objective.transmission * made.objective.nd_transmission / (4 * 6.0**2)
    middle = SLOTS + np.arange(SLOTS)[:, None, None] + 0.5
    found = made.reference(light(made, pixels), 1)
    np.testing.assert_allclose(found, irradiance * radiance_at(pixels, middle), rtol=1e-5)


def test_each_stage_of_splitter_and_panel_passes_the_powers_of_p_and_s():
    made = camera()
    s, m = made.splitter, made.modulator
    found = stage_transmissions(s, m, np.pi, 6.0, np.zeros(1))[:, 0]
    into = (s.tp * 0.9 + s.ts * 0.9 / s.cleanup_contrast) / 2
    on, _ = on_and_off(made)
    assert found[0] == pytest.approx(into, rel=1e-9)
    assert found.prod() == pytest.approx(on, rel=1e-9)
    mirrors = m.mirror_reflectivity * m.fill_factor
    assert found[1] == pytest.approx(mirrors + (1 - m.fill_factor) * m.gap_reflectivity, rel=1e-9)


def test_raw_frames_have_the_sensors_own_dark_signal():
    made = camera(dsnu_e=40.0, prnu=0.0)
    sensor = made.sensor
    rng = np.random.default_rng(5)
    expected = np.full((sensor.rows, sensor.cols), 2000.0)
    taken = [sensor.digitise(expected, made.exposure_s, 7, rng)[0] for _ in range(64)]
    electrons = (np.mean(taken, axis=0) - sensor.zero_dn) * sensor.step_e
    pattern = sensor.dark_signal_e(7).astype(np.float64)
    slope = np.polyfit(pattern.ravel(), electrons.ravel(), 1)[0]
    # 832 pixels, each of 64 frames with 47 electrons of noise: 0.005 of the slope.
    assert slope == pytest.approx(1, abs=0.03)


def test_weights_of_two_frames_are_those_of_a_rate_equation_in_small_steps():
    """Warm panel, unequal fields, greys, pixels that stand still, and what the frame before left open."""
    made = camera()
    slow = {
        "tau_on_s": 1.0e-3,
        "tau_off_s": 2.0e-3,
        "temperature_c": 35.0,
        "field_drive": (1.04, 1.0, 0.93),
        "polarity_drive": 0.03,
        "stuck_share": 0.2,
    }
    made = made.model_copy(
        update={"modulator": made.modulator.model_copy(update=slow), "splitter": demo().splitter}
    )
    rng = np.random.default_rng(6)
    levels = rng.choice([0, 90, 160, 255], (2, SLOTS, V, U)).astype(np.uint8)
    stuck, stands = made.modulator.stuck(V, U, made.serial_number)
    assert 0 < stuck.sum() < stuck.size
    assert len(np.unique(stands[stuck])) == 2
    told = levels.copy()
    told[:, CODED:] = 0
    told[:, :, stuck] = stands[stuck]
    told = np.concatenate([np.zeros((1, V, U)), told.reshape(-1, V, U)])
    drive = np.tile([1.04, 1.0, 0.93], 2) * (1 + 0.03 * np.array([1, -1] * 3))
    # The field before the first slot is the last of six.
    ask = np.array([drive[(slot - 1) % 6] for slot in range(len(told))])[:, None, None]
    targets = ask * np.pi * (told / 255) ** 1.2
    steps, warmer = 1200, np.exp(-0.03 * 10)
    first = (TOTAL_ROWS - V) // 2
    turn = (DELAY + SCAN * (first + np.arange(V) + 0.5) / TOTAL_ROWS)[:, None]
    gamma, light = targets[0].copy(), np.zeros((2 * SLOTS, N_SUB, V, U))
    for slot, step in np.ndindex(2 * SLOTS, steps):
        target = np.where((step + 0.5) / steps < turn, targets[slot], targets[slot + 1])
        tau_s = np.where(target > gamma, 1.0e-3, 2.0e-3) * warmer
        after = target + (gamma - target) * np.exp(-made.slot_s / steps / tau_s)
        light[slot, step * N_SUB // steps] += np.sin((gamma + after) / 4) ** 2 * N_SUB / steps
        gamma = after
    leak = 1 / made.contrast
    expected = (leak + (1 - leak) * light).reshape(2, SLOTS, N_SUB, V, U)
    expected[:, CODED:] = 0
    panel = made.panel_at_rest()
    assert 50 < made.contrast < 200
    for index in (0, 1):
        code = ExposureCode(levels[index], np.zeros((V, U), bool))
        shutter, panel = made.shutter(code, panel, N_SUB)
        # A step is 1/300 of an instant, in which a row may turn early or late.
        np.testing.assert_allclose(shutter.weights, expected[index].reshape(-1, V, U), atol=4e-3)
        np.testing.assert_allclose(
            shutter.weights.mean(axis=(1, 2)), expected[index].mean(axis=(2, 3)).ravel(), atol=1e-3
        )
