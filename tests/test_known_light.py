"""Calibrations that no bench measured read known light, darkness, clips and stray light as they are."""

import numpy as np
import pytest
from test_scoring import COLS, ROWS, flat, small

from optsim.calibration import Calibration
from optsim.camera.camera import CodedCamera
from optsim.camera.true_calibration import ideal_calibration, true_calibration
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.experiment.experiment import Experiment

IDEAL = "camera.effects.all=ideal"
OPEN = ExposureCode(np.full((36, ROWS, COLS), 255, np.uint8), np.zeros((ROWS, COLS), np.bool_))
KNOWN = pytest.mark.parametrize("known", [ideal_calibration, true_calibration])


def taken(experiment: Experiment, radiance: float, code: ExposureCode = OPEN) -> tuple[CodedFrame, float]:
    """A frame of even light, and the irradiance by the area of the cone and what the glass lets through."""
    camera = experiment.camera
    light = camera.objective
    frame, _ = camera.expose(
        camera.form_image(flat(experiment, radiance)), 0, code, None, np.random.default_rng(1)
    )
    cone_sr = np.pi / (4 * light.working_f_number**2)
    return frame, radiance * cone_sr * light.transmission


@KNOWN
@pytest.mark.parametrize("side", [1, 3])
def test_even_light_reads_as_what_it_is(known: type, side: int) -> None:
    experiment = small(IDEAL)
    calibration: Calibration = known(experiment.camera, side)
    frame, irradiance = taken(experiment, 0.15)
    seen = calibration.observe(frame)
    found = seen.signal[seen.valid] / 36 / irradiance
    # 768 pixels of 11 400 electrons: 0.03 %; five of these, and the cone's exact solid angle.
    assert found.mean() == pytest.approx(1, abs=3e-3)
    assert found.std() == pytest.approx(1 / np.sqrt(11_435) / side, rel=0.15)
    # And so it says, to a percent.
    assert np.median(seen.variance / seen.signal**2) == pytest.approx(1 / 11_435 / side**2, rel=0.01)
    assert not seen.saturated.any()


def test_a_dark_frame_reads_as_dark() -> None:
    """With dark current and the fixed pattern of a warm CCD, which the true calibration holds."""
    experiment = small(IDEAL, "camera.effects.dark_current=pessimistic")
    assert experiment.camera.dark_e > 1
    calibration = true_calibration(experiment.camera)
    frame, _ = taken(experiment, 0.0)
    raw = calibration.observe(frame).signal * calibration.responsivity_dn
    noise = np.sqrt(experiment.camera.dark_e) / experiment.camera.sensor.step_e
    assert raw.mean() == pytest.approx(0, abs=5 * noise / np.sqrt(raw.size))


@KNOWN
def test_what_clips_is_known_to_clip_four_sigma_below(known: type) -> None:
    """At one sigma a sixth of what clips would pass as measured."""
    experiment = small(IDEAL, "camera.effects.read_noise=nominal")
    sensor = experiment.camera.sensor
    calibration: Calibration = known(experiment.camera)
    clip = min(sensor.full_well_e / sensor.step_e + sensor.zero_dn, 2**sensor.converter_bits - 1)
    sigma = sensor.read_noise_e / sensor.step_e
    np.testing.assert_allclose(clip - calibration.saturation_dn, 4 * sigma, rtol=0.02)
    rng = np.random.default_rng(2)
    dn = np.rint(clip + sigma * rng.standard_normal((sensor.rows, sensor.cols)))
    frame = CodedFrame(0, dn.clip(0, 2**16 - 1).astype(np.uint16), OPEN)
    # 3e-5 of 768 is none.
    assert calibration.observe(frame).saturated.all()


@pytest.mark.parametrize(
    "stray", ["camera.relay.glare_share=0.02", "camera.relay.ghost_share=0.02"], ids=["veil", "ghost"]
)
def test_stray_light_of_the_relay_is_as_much_as_the_camera_adds(stray: str) -> None:
    """A lit quarter: what its opposite sees of it, by the camera's own electrons and by the calibration."""
    experiment = small(IDEAL, stray, "camera.relay.ghost_blur_px=4")
    camera: CodedCamera = experiment.camera
    calibration = true_calibration(camera)
    levels = np.zeros((36, ROWS, COLS), np.uint8)
    levels[:, : ROWS // 2, : COLS // 2] = 255
    code = ExposureCode(levels, OPEN.moving)
    truth = camera.form_image(flat(experiment, 0.2))
    electrons, _ = camera.expected_electrons(truth, 0, code, None)
    far = np.s_[-8:-2, -8:-2]
    arrived = electrons[calibration.centre_row, calibration.centre_col][far] - camera.dark_e
    light = 36 * camera.reference(truth, 0)[0] * (levels[0] > 0)
    told = calibration.mix(light) * calibration.responsivity_dn * camera.sensor.step_e
    assert arrived.mean() > 20
    assert told[far].mean() == pytest.approx(arrived.mean(), rel=0.03)
