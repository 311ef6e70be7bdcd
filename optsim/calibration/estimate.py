"""Estimate a Calibration from bench images; this module sets the order of the steps."""

from __future__ import annotations

import numpy as np

from optsim.calibration.bench import Bench
from optsim.calibration.calibration import Calibration
from optsim.calibration.light_spread import crosstalk, measured_glare
from optsim.calibration.pixel_map import map_pixels
from optsim.calibration.sensor_noise import photon_transfer, saturation_threshold
from optsim.calibration.shading import PixelReader, drive_exponent, shading
from optsim.calibration.step_response import field_drive, response_times
from optsim.core.errors import BenchError
from optsim.optics.panel import PanelResponse
from optsim.optics.readings import mean_reading, places

_MARGIN = 1  # CCD pixels at the border that are not used: their light may be cut


def calibrate_from(bench: Bench, reading_px: int = 1) -> Calibration:
    """Estimate a calibration from images and stated settings alone.

    Parameters
    ----------
    bench : Bench
        From a real bench, or from the virtual laboratory.
    reading_px : int
        Side of the readout window, CCD pixels, odd.

    Returns
    -------
    Calibration
        With ``source = "bench"``.

    Raises
    ------
    BenchError
        When the images cannot identify a parameter; it names the parameter and the images to take.
    """
    black_dn = bench.darks.mean(axis=0, dtype=np.float32)
    pixel_map = map_pixels(bench, black_dn)
    row, col = pixel_map.ccd_pixels()
    height, width = black_dn.shape
    edge = _MARGIN + reading_px // 2
    inside = (row >= edge) & (row < height - edge) & (col >= edge) & (col < width - edge)
    if not inside.any():
        raise BenchError("bench dots: no panel pixel falls on the CCD; check their panel coordinates")
    row, col = np.clip(row, 0, height - 1), np.clip(col, 0, width - 1)
    lit = (
        slice(int(row[inside].min()), int(row[inside].max()) + 1),
        slice(int(col[inside].min()), int(col[inside].max()) + 1),
    )
    pixel_noise = photon_transfer(bench, black_dn, lit)
    noise = pixel_noise.of_mean(reading_px**2)
    square = row, col, reading_px
    black_at = mean_reading(black_dn, *square)
    clipped = zip(places(bench.saturated.dn, *square), places(black_dn, *square), strict=True)
    reader = PixelReader(
        row,
        col,
        black_dn=black_at,
        black_variance=noise.read_noise_dn**2 / len(bench.darks),
        saturation_dn=np.minimum.reduce(
            [saturation_threshold(dn, black, inside, pixel_noise) for dn, black in clipped]
        ),
        coded_slots=bench.coded_slots,
        noise=noise,
        side=reading_px,
    )
    flat = shading(bench, reader, inside)
    valid = flat.valid
    # Pixels that are not valid get the median, so that no later division gives infinity or NaN.
    responsivity_dn = np.where(valid, flat.responsivity_dn, np.median(flat.responsivity_dn[valid]))
    saturation_dn = np.where(valid, reader.saturation_dn, np.median(reader.saturation_dn[valid]))
    response = PanelResponse(leak=flat.leak, white_rad=bench.white_rad)
    # These estimates depend on each other; fields that differ by 5 % converge after two rounds.
    for _ in range(2 if bench.fields else 1):
        exponent = drive_exponent(bench.greys, reader, flat, response, bench.slot_s)
        if exponent is not None:
            response = response.model_copy(update={"drive_exponent": exponent})
        response = response_times(bench.steps, reader, valid, bench.slot_s, response)
        response = field_drive(bench.fields, reader, valid, bench.slot_s, response)
    glare = measured_glare(bench.glare, reader, flat)
    return Calibration(
        source="bench",
        slot_s=bench.slot_s,
        slots_per_frame=bench.slots_per_frame,
        coded_slots=bench.coded_slots,
        ccd_shape=(height, width),
        response=response,
        pick_row=row,
        pick_col=col,
        valid=valid,
        responsivity_dn=responsivity_dn.astype(np.float32),
        black_dn=black_at,
        saturation_dn=saturation_dn.astype(np.float32),
        read_noise_dn=noise.read_noise_dn,
        dn_per_e=noise.dn_per_e,
        crosstalk=crosstalk(bench.dots, reader, flat, pixel_map.offsets_px(row, col), glare),
        gain_uncertainty=flat.gain_uncertainty,
        leak_uncertainty=flat.leak_uncertainty,
        map_residual_px=pixel_map.residual_px,
        glare=glare,
        reading_px=reading_px,
    )
