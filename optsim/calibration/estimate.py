"""Estimate a Calibration from bench images; this module sets the order of the steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.calibration.bench import Bench
from optsim.calibration.calibration import Calibration
from optsim.calibration.image_checks import check_images
from optsim.calibration.light_spread import crosstalk, measured_glare
from optsim.calibration.misalignment import misalignment
from optsim.calibration.panel_edges import check_edges, edges_off_px
from optsim.calibration.pixel_map import PixelMap, map_pixels
from optsim.calibration.sensor_noise import photon_transfer, saturation_threshold
from optsim.calibration.shading import PixelReader, drive_exponent, shading
from optsim.calibration.step_response import field_drive, response_times
from optsim.core.errors import BenchError
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats
from optsim.optics.panel import PanelResponse
from optsim.optics.readings import mean_reading, places

_MARGIN = 1  # CCD pixels at the border that are not used: their light may be cut
_STEPS = 7  # that progress is told of
_LEAST_ON_CCD = 0.9  # of the panel's pixels: no source, a sensible default


@dataclass(frozen=True, eq=False)
class BenchResult:
    """A calibration with what only its bench tells.

    Parameters
    ----------
    calibration : Calibration
        The estimate.
    pixel_map : PixelMap
        Its pixel map, between CCD pixels too.
    edges_off_px : dict
        Where the panel's sides are, beyond where the map has them, panel pixels; sides not seen are left out.
    step_misfit : float
        Rms deviation of the flashes from the panel's model over their noise.
    on_ccd_share : float
        Share of the panel's pixels that fall on the CCD.
    """

    calibration: Calibration
    pixel_map: PixelMap
    edges_off_px: dict[str, float]
    step_misfit: float
    on_ccd_share: float


def calibrate_from(bench: Bench, reading_px: int = 1) -> Calibration:
    """Estimate a calibration from images and stated settings alone: that of :func:`measure_calibration`."""
    return measure_calibration(bench, reading_px).calibration


def measure_calibration(bench: Bench, reading_px: int = 1, progress: Progress = silent) -> BenchResult:
    """Estimate a calibration from images and stated settings alone.

    Parameters
    ----------
    bench : Bench
        From a real bench, or from the virtual laboratory.
    reading_px : int
        Side of the readout window, CCD pixels, odd.
    progress : Progress
        Told after each step.

    Returns
    -------
    Measured
        Its calibration has ``source = "bench"``.

    Raises
    ------
    BenchError
        When the images cannot identify a parameter, or are not what the bench says. It names the images and
        the cure.
    """
    steps = iter(range(1, _STEPS + 1))

    def done() -> None:
        progress("calibrate", next(steps), _STEPS)

    check_images(bench)
    done()
    black_dn = bench.darks.mean(axis=0, dtype=np.float32)
    pixel_map = map_pixels(bench, black_dn)
    done()
    row, col = pixel_map.ccd_pixels()
    height, width = black_dn.shape
    edge = _MARGIN + reading_px // 2
    inside = (row >= edge) & (row < height - edge) & (col >= edge) & (col < width - edge)
    on_ccd_share = float(inside.mean())
    if on_ccd_share < _LEAST_ON_CCD:
        raise BenchError(
            f"{bench.where('dots[0]')}: got {on_ccd_share:.0%} of the panel's pixels on the CCD, expected "
            f"at least {_LEAST_ON_CCD:.0%}; cure: centre the panel's image, or use fewer panel pixels"
        )
    row, col = np.clip(row, 0, height - 1), np.clip(col, 0, width - 1)
    lit = (
        slice(int(row[inside].min()), int(row[inside].max()) + 1),
        slice(int(col[inside].min()), int(col[inside].max()) + 1),
    )
    pixel_noise = photon_transfer(bench, black_dn, lit)
    done()
    noise = pixel_noise.of_mean(reading_px**2)
    square = row, col, reading_px
    black_at: Floats = mean_reading(black_dn, *square)
    clipped = zip(places(bench.saturated.dn, *square), places(black_dn, *square), strict=True)
    thresholds = [
        saturation_threshold(dn, black, inside, pixel_noise, bench.where("saturated"))
        for dn, black in clipped
    ]
    reader = PixelReader(
        row,
        col,
        black_dn=black_at,
        black_variance=noise.read_noise_dn**2 / len(bench.darks),
        saturation_dn=np.minimum.reduce(thresholds),
        coded_slots=bench.coded_slots,
        noise=noise,
        side=reading_px,
    )
    flat = shading(bench, reader, inside)
    off_px = edges_off_px(bench, pixel_map, black_dn)
    check_edges(bench, off_px)
    done()
    valid = flat.valid
    # Pixels that are not valid get the median, so that no later division gives infinity or NaN.
    responsivity_dn = np.where(valid, flat.responsivity_dn, np.median(flat.responsivity_dn[valid]))
    saturation_dn = np.where(valid, reader.saturation_dn, np.median(reader.saturation_dn[valid]))
    glare = measured_glare(bench, reader, flat)
    done()
    kernels = crosstalk(bench.dots, reader, flat, pixel_map.offsets_px(row, col), glare.glare)
    done()
    response = PanelResponse(leak=flat.leak, white_rad=bench.white_rad, grey_curve=bench.grey_curve)
    errors = {
        "read_noise_dn": noise.read_noise_error_dn,
        "dn_per_e": noise.dn_per_e_error,
        "leak": flat.leak_error,
    }
    errors |= {"glare_veil": glare.veil_error, "glare_ghost": glare.ghost_error} if bench.glare else {}
    misfit, drive_covariance = 0.0, None
    # These estimates depend on each other; fields that differ by 5 % converge after two rounds.
    for _ in range(2 if bench.fields else 1):
        grey = None if bench.grey_curve else drive_exponent(bench, reader, flat, response)
        if grey is not None:
            response = response.model_copy(update={"drive_exponent": grey[0]})
            errors["drive_exponent"] = grey[1]
        steps_fit = response_times(bench, reader, flat, response, glare.glare, kernels, drive_covariance)
        response, misfit = steps_fit.response, steps_fit.misfit
        errors |= steps_fit.errors_s
        response, drive_covariance = field_drive(bench.fields, reader, valid, bench.slot_s, response)
    seen = pixel_map.on_ccd(pixel_map.dots_px) + pixel_map.off_ccd_px
    aligned, aligned_errors = misalignment(
        pixel_map.dots_px, seen, pixel_map, (height, width), bench.ccd_per_panel_px
    )
    map_error_px = float(np.sqrt(2 * np.mean(pixel_map.error_px() ** 2)))
    calibration = Calibration(
        source="bench",
        slot_s=bench.slot_s,
        slots_per_frame=bench.slots_per_frame,
        coded_slots=bench.coded_slots,
        ccd_shape=(height, width),
        response=response,
        centre_row=row,
        centre_col=col,
        valid=valid,
        responsivity_dn=responsivity_dn.astype(np.float32),
        black_dn=black_at,
        saturation_dn=saturation_dn.astype(np.float32),
        read_noise_dn=noise.read_noise_dn,
        dn_per_e=noise.dn_per_e,
        crosstalk=kernels,
        gain_uncertainty=flat.gain_uncertainty,
        leak_uncertainty=flat.leak_uncertainty,
        map_residual_px=pixel_map.residual_px,
        glare=glare.glare,
        reading_px=reading_px,
        standard_errors=errors | {"map_px": map_error_px} | aligned_errors,
        misalignment=aligned,
    )
    done()
    return BenchResult(calibration, pixel_map, off_px, misfit, on_ccd_share)
