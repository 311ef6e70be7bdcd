"""Calibrations without a new bench: true parameters, the paper's equations, or a stored file."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np

from optsim.calibration import Bench, Calibration, Glare, calibrate_from, read_calibration
from optsim.calibration.choice import BENCH_FILE, CalibrationChoice, stored_file
from optsim.calibration.glare import ring_strengths
from optsim.calibration.sensor_noise import SensorNoise
from optsim.camera.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.optics.crosstalk import REACH, crosstalk_kernels, seen_by_ccd_pixels, true_dots
from optsim.optics.fringing import border_shares, whole_cells
from optsim.optics.panel import PanelResponse
from optsim.optics.readings import mean_reading
from optsim.optics.relay import RelayOperator

_SAME_TIME = 1e-6  # relative difference of slots within rounding


def true_calibration(camera: CodedCamera, reading_px: int = 1, *, alone: bool = False) -> Calibration:
    """Calibration copied from the parts; it cannot represent non-linearity.

    Parameters
    ----------
    camera : CodedCamera
        The camera.
    reading_px : int
        Side of the readout window, CCD pixels, odd.
    alone : bool
        Leave out crosstalk and glare, as if there were none: they take most of the time.
    """
    geometry, sensor, modulator = camera.relay_geometry(), camera.sensor, camera.modulator
    row, col, on_ccd = geometry.ccd_pixels(SAMPLES_PER_PITCH, reading_px)
    square = row, col, reading_px
    view = camera.view
    shading = camera.objective.shading(view.rows, view.cols, modulator.pitch_m / SAMPLES_PER_PITCH)
    gain = whole_cells(camera.panel_gain, SAMPLES_PER_PITCH)
    operator = camera.relay_operator()
    image = operator.apply(shading * gain * camera.slot_s)
    nothing = _no_crosstalk(camera), Glare()
    crosstalk, glare = nothing if alone else _of_others(camera, operator, image, square, on_ccd)
    return _from_electrons(
        "true",
        camera,
        response=camera.panel_response,
        ccd_pixels=(row, col, on_ccd & ~camera.stuck_pixels[0]),
        reading_px=reading_px,
        responsivity_e=np.maximum(mean_reading(camera.photon_electrons(image), *square), 1e-30),
        offset_e=mean_reading(
            sensor.dark_signal_e(camera.serial_number) + np.float64(camera.dark_e), *square
        ),
        # Dark electrons fill the well, too.
        full_well_e=float(sensor.bent(np.array(sensor.full_well_e))) - camera.dark_e,
        dark_e=camera.dark_e,
        crosstalk=crosstalk,
        glare=glare,
    )


def _of_others(
    camera: CodedCamera, operator: RelayOperator, flat: Doubles, square: tuple[Ints, Ints, int], on_ccd: Bools
) -> tuple[Floats, Glare]:
    """Compute crosstalk kernels and glare, by the CCD's image of even light (``flat``)."""
    # The pixel map, and the side of the readout window.
    row, col, side = square
    rows, cols = camera.panel_rows, camera.panel_cols
    reach = min(REACH, (min(rows, cols) - 1) // 2)
    borders = border_shares(camera.modulator.fringing_px, SAMPLES_PER_PITCH)
    kernels = crosstalk_kernels(
        true_dots(operator, borders, row, col, reach, side),
        camera.relay_geometry().offsets_px(SAMPLES_PER_PITCH),
        on_ccd,
        reach,
    )
    panel, middle = np.ones((rows, cols)), (rows // 2, cols // 2)
    whole = np.maximum(seen_by_ccd_pixels(panel, operator, borders, *square), 1e-30)
    lit = 0 * panel
    lit[middle] = 1
    glare = Glare(
        # The relay spreads a share of the CCD's mean; a calibration uses the mean over the panel.
        veil=camera.relay.glare_share * float(flat.mean() / mean_reading(flat, *square).mean()),
        ghost=camera.relay.ghost_share,
        ghost_blur_px=camera.relay.ghost_blur_px,
        wings=ring_strengths(seen_by_ccd_pixels(lit, operator, borders, *square) / whole, *middle),
    )
    return kernels, glare


def _no_crosstalk(camera: CodedCamera) -> Floats:
    return np.ones((camera.panel_rows, camera.panel_cols, 1, 1), np.float32)


def ideal_calibration(camera: CodedCamera, reading_px: int = 1) -> Calibration:
    """Calibration of the paper's equations: an instantaneous, aligned panel without leak, crosstalk or veil.

    Arguments as of :func:`true_calibration`.
    """
    straight = ("shift_y_px", "shift_x_px", "rotation_rad", "keystone_y", "keystone_x", "distortion")
    aligned = camera.relay.model_copy(update=dict.fromkeys(straight, 0.0))
    nominal = camera.model_copy(update={"relay": aligned})
    electrons = {row.stage: row.value for row in camera.ledger(1.0)}["electrons a slot"]
    shape = (camera.panel_rows, camera.panel_cols)
    curve = {key: getattr(camera.modulator, key) for key in ("drive_exponent", "grey_curve")}
    white_rad = camera.modulator.stated_white_rad(camera.wavelength_m)
    return _from_electrons(
        "ideal",
        camera,
        response=PanelResponse(tau_on_s=0, tau_off_s=0, leak=0, white_rad=white_rad, **curve),
        ccd_pixels=nominal.relay_geometry().ccd_pixels(SAMPLES_PER_PITCH, reading_px),
        reading_px=reading_px,
        responsivity_e=np.full(shape, electrons / camera.irradiance_per_radiance),
        offset_e=np.zeros(shape),
        full_well_e=camera.sensor.full_well_e,
        crosstalk=_no_crosstalk(camera),
        glare=Glare(),
    )


def _from_electrons(
    source: Literal["true", "ideal"],
    camera: CodedCamera,
    *,
    response: PanelResponse,
    ccd_pixels: tuple[Ints, Ints, Bools],
    reading_px: int,
    responsivity_e: Doubles,
    offset_e: Doubles,
    full_well_e: float,
    crosstalk: Floats,
    glare: Glare,
    dark_e: float = 0.0,
) -> Calibration:
    """Make a calibration from electrons, (v, u), instead of images; the well is that after the bend."""
    sensor = camera.sensor
    # Electrons of the dark current have shot noise of their own.
    noise = SensorNoise(math.hypot(sensor.dark_noise_e, math.sqrt(dark_e)) / sensor.step_e, 1 / sensor.step_e)
    of_reading = noise.of_mean(reading_px**2)
    black_dn = sensor.zero_dn + offset_e / sensor.step_e
    margin_dn = _below_clip_e(sensor.dark_noise_e, sensor.smear_share > 0) / sensor.step_e
    clip_dn = np.minimum(black_dn + full_well_e / sensor.step_e, sensor.max_dn)
    row, col, valid = ccd_pixels
    return Calibration(
        source=source,
        slot_s=camera.slot_s,
        slots_per_frame=camera.slots_per_frame,
        coded_slots=camera.coded_slots,
        ccd_shape=(sensor.rows, sensor.cols),
        response=response,
        centre_row=row,
        centre_col=col,
        valid=valid,
        responsivity_dn=(responsivity_e / sensor.step_e).astype(np.float32),
        black_dn=black_dn.astype(np.float32),
        # Half a number more: the CCD rounds.
        saturation_dn=(clip_dn - margin_dn - 0.5).astype(np.float32),
        read_noise_dn=of_reading.read_noise_dn,
        dn_per_e=of_reading.dn_per_e,
        crosstalk=crosstalk,
        gain_uncertainty=0.0,
        leak_uncertainty=0.0,
        map_residual_px=0.0,
        glare=glare,
        reading_px=reading_px,
    )


def _below_clip_e(noise_e: float, smeared: bool) -> float:
    """Distance of the saturation threshold from the clip: four sigma, so 1 full well in 30 000 is missed."""
    # Smear of s electrons lifts a full well by s and adds their shot noise. The threshold is the lowest
    # s - 4 sqrt(noise_e^2 + s): at s = 4 - noise_e^2 if that is above 0, else without smear.
    return 4 + noise_e**2 if smeared and noise_e < 2 else 4 * noise_e


def check_stored(calibration_choices: Iterable[CalibrationChoice], camera: CodedCamera) -> None:
    """Refuse stored calibrations of another camera, or invalid ones, before long work."""
    for choice in calibration_choices:
        if choice.file is not None:
            read_stored(choice, camera)


def stored_calibration(choice: CalibrationChoice, camera: CodedCamera) -> Calibration:
    """Calibration from a file, or from a bench folder's images; errors of :func:`read_stored`."""
    found = read_stored(choice, camera)
    return calibrate_from(found, choice.reading_px) if isinstance(found, Bench) else found


def read_stored(choice: CalibrationChoice, camera: CodedCamera) -> Calibration | Bench:
    """Read a stored calibration or bench whole, and refuse that of another camera."""
    file = stored_file(Path(choice.operator))
    if file.name == BENCH_FILE:
        found = Bench.read(file.parent)
        panel, ccd, reading_px = found.panel_shape, found.darks.shape[1:], choice.reading_px
    else:
        found = read_calibration(file)
        panel, ccd, reading_px = found.shape, found.ccd_shape, found.reading_px
    where = f"calibration {file}"
    for what, got, expected in (
        ("panel pixels (rows, columns)", panel, (camera.panel_rows, camera.panel_cols)),
        ("CCD pixels (rows, columns)", ccd, (camera.sensor.rows, camera.sensor.cols)),
        ("slots a frame", found.slots_per_frame, camera.slots_per_frame),
        ("slots with the shutter open", found.coded_slots, camera.coded_slots),
    ):
        if got != expected:
            raise ConfigError(
                f"{where}: got {got} {what}, expected {expected} as the experiment's camera has; cure: name "
                "a calibration of this camera, or correct camera"
            )
    if abs(found.slot_s / camera.slot_s - 1) > _SAME_TIME:
        raise ConfigError(
            f"{where}: got slots of {found.slot_s:g} s, expected {camera.slot_s:g} s as the experiment's "
            "camera has; cure: name a calibration of this camera, or correct camera"
        )
    if reading_px != choice.reading_px:
        raise ConfigError(
            f"reading_px: got {choice.reading_px}, expected {reading_px} as {where} is of; set reading_px = "
            f"{reading_px}, or name another calibration"
        )
    return found
