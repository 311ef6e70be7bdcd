"""Standard errors of a calibration against the scatter that they stand for.

Bounds on a ratio of scatters are five standard deviations of it: a false alarm in a million.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_camera import small
from synthetic_bench import Camera

from optsim.calibration import estimate
from optsim.calibration.bench import Flat
from optsim.calibration.estimate import measure_calibration
from optsim.calibration.misalignment import misalignment
from optsim.calibration.sensor_noise import photon_transfer
from optsim.camera.camera import SAMPLES_PER_PITCH
from optsim.camera.true_calibration import true_calibration
from optsim.experiment.calibration_record import light_shift_px
from optsim.optics.fringing import border_shares, fine_image

DRAWS = 150


def test_errors_of_the_misalignment_are_the_scatter_of_fits() -> None:
    """A coma that never was widened the scale's six times."""
    rng = np.random.default_rng(3)
    shape, scale = (48, 64), 3.0
    dots = (
        np.stack(np.meshgrid(np.arange(3, 46, 5), np.arange(3, 62, 5), indexing="ij"), -1).reshape(-1, 2)
        + 0.5
    )
    places = (dots - np.array(shape) / 2) * scale + 80.0
    slope = np.eye(2) * scale
    known: Any = SimpleNamespace(panel_shape=shape, slope=slope, ccd_per_panel_px=scale)
    fits = [
        misalignment(dots, places + rng.normal(0, 0.02, places.shape), known, (160, 160), None)
        for _ in range(DRAWS)
    ]
    for key in ("shift_y_px", "rotation_rad", "ccd_per_panel_px", "keystone_x", "distortion"):
        scatter = np.std([values[key] for values, _ in fits])
        stated = np.sqrt(np.mean([errors[key] ** 2 for _, errors in fits]))
        assert scatter / stated == pytest.approx(1, abs=5 / np.sqrt(2 * DRAWS)), key


def test_the_error_of_the_gain_is_not_the_noise_of_its_change_with_light() -> None:
    rng = np.random.default_rng(4)
    gains, errors = [], []
    for _ in range(DRAWS):
        darks = np.rint(200 + rng.normal(0, 9, (6, 40, 40))).astype(np.uint16)
        flats = []
        for light in (0.15, 0.3, 0.45):
            signal = 0.7 * rng.poisson(15000 * light, (2, 40, 40)) + rng.normal(0, 9, (2, 40, 40))
            flats.append(Flat(255, light, np.rint(200 + signal).astype(np.uint16)))
        bench: Any = SimpleNamespace(darks=darks, flats=flats)
        noise = photon_transfer(bench, darks.mean(axis=0, dtype=np.float32), (slice(None), slice(None)))
        gains.append(noise.dn_per_e)
        errors.append(noise.dn_per_e_error)
    # Half of the changes are below their noise and count for nothing; when all counted it was 0.45.
    assert np.std(gains) / np.median(errors) == pytest.approx(0.95, abs=5 / np.sqrt(2 * DRAWS))


def test_response_times_know_the_error_of_the_fields(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Camera(panel=(30, 40), ccd=(108, 140), ratio=3.0, shift=(0, 0)).bench()
    off, drive = 2e-3, np.array([1.0, 1.0, 1.0])

    def calibrated(change: float, error: float) -> Any:
        driven, unit = drive + change * np.array([0, 1, 0]), np.diag([0, 1.0, 0])

        def field_drive(fields: Any, reader: Any, valid: Any, slot_s: float, response: Any) -> Any:
            return response.model_copy(update={"field_drive": tuple(driven)}), error**2 * unit

        monkeypatch.setattr(estimate, "field_drive", field_drive)
        return measure_calibration(replace(bench, fields=bench.steps[:1], greys=())).calibration

    plain, wider, moved = calibrated(0, 0), calibrated(0, off), calibrated(off, 0)
    for key in ("tau_on_s", "tau_off_s", "delay_s"):
        change = abs(getattr(moved.response, key) - getattr(plain.response, key))
        added = np.sqrt(wider.standard_errors[key] ** 2 - plain.standard_errors[key] ** 2)
        assert added == pytest.approx(change, rel=0.1, abs=1e-8), key


def test_noise_in_the_dark_is_read_noise_rounding_and_shot_noise_of_dark_electrons() -> None:
    camera = small(panel_rows=30, panel_cols=40)
    camera = camera.model_copy(
        update={
            "sensor": camera.sensor.model_copy(update={"rows": 108, "cols": 140, "dark_current_e_s": 300})
        }
    )
    sensor = camera.sensor
    rng, nothing = np.random.default_rng(5), np.full((108, 140), float(camera.dark_e))
    darks = [sensor.digitise(nothing, camera.exposure_s, 1, rng)[0].astype(np.float64) for _ in range(9)]
    seen = np.sqrt(np.mean(np.var(darks, axis=0, ddof=1)))
    known = true_calibration(camera, alone=True).read_noise_dn
    # 8 x 15120 differences.
    assert known == pytest.approx(seen, rel=5 / np.sqrt(2 * 8 * nothing.size))


@pytest.mark.parametrize("place", [(3, 3), (5, 34), (24, 10)])
def test_a_dots_light_is_weighed_as_far_as_in_the_maps_windows(place: tuple[int, int]) -> None:
    """Coma's tails move the centre by how much of them counts: with one sample more it is a quarter less."""
    camera = small(panel_rows=30, panel_cols=40)
    relay = camera.relay.model_copy(update={"defocus_m": 45e-6})
    camera = camera.model_copy(update={"relay": relay})
    panel, n = np.zeros((30, 40)), SAMPLES_PER_PITCH
    panel[place] = 1
    borders = border_shares(camera.modulator.fringing_px, n)
    image = camera.relay_operator().blur.apply(fine_image(panel, borders))
    v, u = (n * each + n // 2 for each in place)
    # The map's window at 3 CCD pixels a panel pixel: round(2 x 3) each way from the pixel of the centre.
    window = image[v - 6 : v + 7, u - 6 : u + 7]
    light = window - np.median([*window[0], *window[-1], *window[:, 0], *window[:, -1]])
    by_hand = (light.sum(axis=0) @ np.arange(-6, 7)) / light.sum() / n
    # The map is a polynomial through some dots.
    assert light_shift_px(camera)[(*place, 1)] == pytest.approx(by_hand, rel=0.12)
