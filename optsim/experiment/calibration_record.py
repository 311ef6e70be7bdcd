"""The record of a calibration: its numbers with their intervals, and their deviation from a known camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from optsim.calibration import Bench, Calibration
from optsim.calibration.estimate import BenchResult
from optsim.calibration.held_out import Explained
from optsim.calibration.misalignment import NAMES, misalignment
from optsim.calibration.orientation import in_words
from optsim.camera.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.camera.true_calibration import true_calibration
from optsim.core.quantities import Bools, Doubles, Floats
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import planned
from optsim.experiment.misalignment_record import misaligned
from optsim.metrics.student import half_width
from optsim.optics.fringing import border_shares, fine_image
from optsim.report.calibration_page import (
    INTERVAL_SIGMAS,
    CalibrationRecord,
    HeldIntervals,
    HeldOut,
    Quantity,
    TruthScore,
)

# Key -> what it is. Their values and standard errors stand in the calibration.
_NAMES = {
    "leak": "leak: light with the panel off over on",
    "tau_on_s": "time constant of the retardance, rising",
    "tau_off_s": "time constant of the retardance, falling",
    "delay_s": "when the first row turns, after its slot began, with any delay common to all flashes",
    "scan_s": "how much later the last row turns",
    "drive_exponent": "exponent of the grey curve",
    "dn_per_e": "gain, DN an electron",
    "read_noise_dn": "read noise",
    "glare_veil": "veiling glare: share of light spread evenly",
    "glare_ghost": "ghost: share of light that comes back mirrored",
}
# Deviations of the residual, and of flashes over their noise, that deserve a word; sensible defaults.
_LARGE_RESIDUAL_PX, _LARGE_MISFIT = 0.03, 3.0
# Share of a slot beyond which the panel's delay is larger than a panel's usually is; a sensible default.
_LARGE_DELAY = 0.1
# Half width of the windows in which the pixel map takes the centre of a dot, panel pixels, and a lattice on
# which dots don't meet in them.
_WINDOW_PX, _LATTICE_PX = 2, 7


def bench_camera(experiment: Experiment) -> CodedCamera:
    """Return the camera that stands on the bench: as planned, without neutral density or drift."""
    return planned(experiment)[0].camera.with_nd(1.0)


def calibration_record(measured: BenchResult, bench: Bench, folder: Path) -> CalibrationRecord:
    """Collect the numbers of a calibration.

    Parameters
    ----------
    measured : Measured
        The calibration.
    bench : Bench
        Its images.
    folder : Path
        Where they came from.
    """
    found, pixel_map = measured.calibration, measured.pixel_map
    off_px = pixel_map.on_panel(pixel_map.off_ccd_px)
    values = _values(found)
    quantities = [
        Quantity(key="map_residual_px", what="map residual: rms of the dots", value=found.map_residual_px),
        Quantity(key="map_worst_px", what="map residual: worst dot", value=float(np.hypot(*off_px.T).max())),
        Quantity(
            key="map_error_px",
            what="standard error of the map, rms over the panel",
            value=found.standard_errors["map_px"],
        ),
        *(
            Quantity(key=key, what=what, value=values[key], standard_error=found.standard_errors.get(key))
            for key, what in _NAMES.items()
            if key != "drive_exponent" or not bench.grey_curve
        ),
        *(Quantity(key=key, what=what, value=values[key]) for key, what in _UNCERTAIN_NAMES.items()),
        *(
            Quantity(key=key, what=NAMES[key], value=value, standard_error=found.standard_errors[key])
            for key, value in found.misalignment.items()
        ),
    ]
    images = len(bench.darks) + sum(len(group.dn) for _, group in bench.groups())
    return CalibrationRecord(
        bench=str(folder),
        about={key: str(value) for key, value in bench.about.items()},
        n_images=images,
        panel=found.shape,
        ccd=found.ccd_shape,
        reading_px=found.reading_px,
        orientation=in_words(pixel_map.orientation),
        valid_share=float(found.valid.mean()),
        quantities=quantities,
        edges_off_px=measured.edges_off_px,
        misaligned=misaligned(quantities, bench, found),
        remarks=_remarks(measured, bench),
    )


# What has no standard error of its own.
_UNCERTAIN_NAMES = {
    "own_share": "PSF: share of a pixel's light that its own reading keeps",
    "beside_share": "PSF: share that the four pixels beside it get, together",
    "saturation_dn": "saturation above black, median",
    "black_dn": "black level, median",
    "gain_uncertainty": "relative standard error of a pixel's responsivity",
    "leak_uncertainty": "relative standard error of a pixel's leak",
}


def _values(found: Calibration) -> dict[str, float]:
    """Numbers of a calibration by key."""
    valid, reach, kernels = found.valid, found.reach, found.crosstalk
    beside = (
        [kernels[:, :, reach + v, reach + u] for v, u in ((-1, 0), (1, 0), (0, -1), (0, 1))] if reach else []
    )
    response = found.response
    return {
        "leak": response.leak,
        "tau_on_s": response.tau_on_s,
        "tau_off_s": response.tau_off_s,
        "delay_s": response.delay_s,
        "scan_s": response.scan_s,
        "drive_exponent": response.drive_exponent,
        "dn_per_e": found.dn_per_e,
        "read_noise_dn": found.read_noise_dn,
        "glare_veil": found.glare.veil,
        "glare_ghost": found.glare.ghost,
        "own_share": float(found.own_share[valid].mean()),
        "beside_share": float(sum(each[valid].mean(dtype=np.float64) for each in beside)),
        "saturation_dn": float(np.median((found.saturation_dn - found.black_dn)[valid])),
        "black_dn": float(np.median(found.black_dn[valid])),
        "gain_uncertainty": found.gain_uncertainty,
        "leak_uncertainty": found.leak_uncertainty,
    }


def _remarks(measured: BenchResult, bench: Bench) -> list[str]:
    """Say what was extrapolated, could not be told, or looks unlike the model."""
    found, pixel_map = measured.calibration, measured.pixel_map
    beyond = pixel_map.beyond_dots()
    error_px = pixel_map.error_px()
    unseen = [side for side in ("top", "bottom", "left", "right") if side not in measured.edges_off_px]
    early_s = -INTERVAL_SIGMAS * found.standard_errors["delay_s"]
    sets = (bench.darks, *(group.dn for _, group in bench.groups()))
    used = int(np.bitwise_or.reduce([np.bitwise_or.reduce(dn, axis=None) for dn in sets]))
    step_dn = used & -used  # largest power of two that divides all DN
    n_invalid = int(np.count_nonzero(~found.valid))
    said = [
        (
            beyond.any(),
            f"The map is extrapolated beyond the outermost dots on {beyond.mean():.1%} of the panel, by a "
            f"standard error of up to {error_px[beyond].max(initial=0.0):.3g} panel pixels.",
        ),
        (
            measured.on_ccd_share < 1,
            f"{1 - measured.on_ccd_share:.1%} of the panel's pixels are off the CCD or at its border: not "
            "valid.",
        ),
        (n_invalid > 0, f"{n_invalid} panel pixels are not valid: off the CCD, dead, stuck or saturated."),
        (
            bool(unseen),
            f"The panel's edge is not seen on the {', '.join(unseen)}: a pattern that is shifted along it, "
            "dots and anchors alike, would not be noticed.",
        ),
        (
            bench.orientation is None,
            "The manifest says no orientation: the image was taken as it is. Is it as you built it?",
        ),
        (
            len(bench.flats) == 1,
            "Flats of one irradiance cannot tell whether the gain changes with the light: its interval and "
            "the leak's are of noise alone.",
        ),
        (
            not bench.greys and not bench.grey_curve,
            "Without greys the exponent of the grey curve is the default.",
        ),
        (not bench.glare, "Without glare images stray light counts as none."),
        (not bench.fields, "Without field images all slots count as equal."),
        (
            found.standard_errors["scan_s"] == 0,
            "The flash lights too few rows to tell their scan: all count as written at once.",
        ),
        (
            found.map_residual_px > _LARGE_RESIDUAL_PX,
            f"The map's residual is above {_LARGE_RESIDUAL_PX:g} panel pixels: the image is distorted beyond "
            "the third order, or dots are dim. The map's interval holds only in the mean over the field.",
        ),
        (
            measured.step_misfit > _LARGE_MISFIT,
            f"The flashes are {measured.step_misfit:.1f} times their noise off the panel's model; the "
            "intervals of its times are as much wider.",
        ),
        (
            not early_s <= found.response.delay_s <= _LARGE_DELAY * bench.slot_s,
            f"The first row seems to turn {found.response.delay_s / bench.slot_s:+.3f} slots after its slot "
            "began. A delay common to all flashes looks alike: check delay_s against their trigger.",
        ),
        (
            step_dn > 1,
            f"All DN are multiples of {step_dn}: left-justified by {step_dn.bit_length() - 1} bits. Gain and "
            "noise are in these DN, so frames to decode must be stored alike.",
        ),
        (
            bench.ccd_pitch_m is None or bench.ccd_per_panel_px is None,
            "Micrometres need ccd_pitch_m in the manifest, magnification_error needs ccd_per_panel_px.",
        ),
    ]
    return [text for applies, text in said if applies]


def with_truth(
    record: CalibrationRecord, measured: BenchResult, bench: Bench, camera: CodedCamera, name: str
) -> CalibrationRecord:
    """Add the deviations from the camera that the bench was of.

    Parameters
    ----------
    record, measured, bench
        The calibration.
    camera : CodedCamera
        The true camera.
    name : str
        Its name for the page.
    """
    found = measured.calibration
    true = true_calibration(camera, found.reading_px)
    # The flats see the mean over the columns, the response has the leak on axis.
    values = _values(true) | {"leak": float(camera.column_leaks.mean())}
    values |= misalignment(*light_places(camera), measured.pixel_map, found.ccd_shape, camera.ratio)[0]
    del values["gain_uncertainty"], values["leak_uncertainty"]
    quantities = [each.model_copy(update={"true": values.get(each.key)}) for each in record.quantities]
    known = [each.holds for each in quantities if each.holds is not None]
    off_px = map_off_px(measured, camera)
    distance: Doubles = np.hypot(off_px[..., 0], off_px[..., 1])[found.valid]
    same: Bools = found.valid & true.valid
    same &= (found.centre_row == true.centre_row) & (found.centre_col == true.centre_col)
    relative = found.responsivity_dn / true.responsivity_dn - 1
    error_px = measured.pixel_map.error_px()[..., None]
    score = TruthScore(
        truth=name,
        map_rms_px=float(np.sqrt(np.mean(distance**2))),
        map_worst_px=float(distance.max()),
        same_pixel_share=float(np.mean(same[found.valid])),
        intervals=len(known),
        held=sum(known),
        coverage=[
            _coverage("pixel map, either axis", "panel pixels", off_px, error_px, found.valid),
            _coverage("responsivity", "", relative, found.gain_uncertainty, same),
            _coverage(
                "black level",
                "DN",
                found.black_dn - true.black_dn,
                found.read_noise_dn / np.sqrt(len(bench.darks)),
                same,
            ),
        ],
    )
    return record.model_copy(update={"quantities": quantities, "score": score})


def with_before(record: CalibrationRecord, compared: Sequence[Explained], before: Path) -> CalibrationRecord:
    """Add how an earlier calibration and this one explain held-out images: one that isn't better is flagged.

    Parameters
    ----------
    record : CalibrationRecord
        Of this calibration.
    compared : sequence of Explained
        Each held-out image; the later calibration is made from the others.
    before : Path
        File of the earlier calibration.
    """
    gains = [each.before - each.after for each in compared]
    gain, half = float(np.mean(gains)), half_width(gains) or 0.0
    found = HeldOut(
        before=str(before),
        n_images=len(compared),
        before_sigmas=float(np.mean([each.before for each in compared])),
        after_sigmas=float(np.mean([each.after for each in compared])),
        gain_sigmas=gain,
        gain_half=half,
        better=gain > half,
    )
    return record.model_copy(update={"held_out": found, "remarks": [found.said, *record.remarks]})


def map_off_px(measured: BenchResult, camera: CodedCamera) -> Doubles:
    """Give where the map has each panel pixel minus where its light is: (v, u, 2), panel pixels."""
    centres, places = light_places(camera)
    off = measured.pixel_map.on_ccd(centres) - places
    return measured.pixel_map.on_panel(off).reshape(*measured.calibration.shape, 2)


def light_places(camera: CodedCamera) -> tuple[Doubles, Doubles]:
    """Give the panel pixels' centres, and where their light is on the CCD: each (n, 2)."""
    # Coma moves the centre of a pixel's light away from its geometric image, and a bench sees light.
    centres: Doubles = np.indices((camera.panel_rows, camera.panel_cols), np.float64).reshape(2, -1).T + 0.5
    lit = centres + light_shift_px(camera).reshape(-1, 2)
    places = camera.relay_geometry().place(lit[:, 0] * SAMPLES_PER_PITCH, lit[:, 1] * SAMPLES_PER_PITCH)
    return centres, np.stack(places, axis=-1)


def light_shift_px(camera: CodedCamera) -> Doubles:
    """Centre of the light of each panel pixel behind fringing and relay blur, minus its own: (v, u, 2)."""
    rows, cols, n = camera.panel_rows, camera.panel_cols, SAMPLES_PER_PITCH
    lit = np.zeros((rows, cols))
    first = _WINDOW_PX + 1
    lit[first : rows - first : _LATTICE_PX, first : cols - first : _LATTICE_PX] = 1
    borders = border_shares(camera.modulator.fringing_px, n)
    image = camera.relay_operator().blur.apply(fine_image(lit, borders))
    places = np.argwhere(lit)
    half = _WINDOW_PX * n  # the tails of coma count as far as in the map's windows
    span = np.arange(-half, half + 1)
    shifts: list[Doubles] = []
    for v, u in places * n + n // 2:
        window = image[v - half : v + half + 1, u - half : u + half + 1]
        edge = np.concatenate([window[0], window[-1], window[:, 0], window[:, -1]])
        light = window - np.median(edge)
        shifts.append(np.array([span @ light.sum(axis=1), light.sum(axis=0) @ span]) / light.sum() / n)
    low = np.array([rows, cols]) / 2
    # Measured on a lattice of single bright pixels; between them a cubic polynomial in the place.
    everywhere: Doubles = (np.indices((rows, cols)).reshape(2, -1).T + 0.5) / low - 1
    known = np.linalg.lstsq(_cubic((places + 0.5) / low - 1), np.stack(shifts))[0]
    return (_cubic(everywhere) @ known).reshape(rows, cols, 2)


def _cubic(places: Doubles) -> Doubles:
    """Products of powers up to the third of rows and columns, (n, 16)."""
    v, u = (np.stack([each**power for power in range(4)], axis=1) for each in places.T)
    return (v[:, :, None] * u[:, None, :]).reshape(len(places), 16)


def _coverage(
    what: str, unit: str, off: Doubles | Floats, error: Doubles | float, where: Bools
) -> HeldIntervals:
    held = np.abs(off) <= INTERVAL_SIGMAS * error
    rms = float(np.sqrt(np.mean(np.square(off[where], dtype=np.float64))))
    return HeldIntervals(what=what, rms=rms, unit=unit, held=float(held[where].mean()))


def field_images(measured: BenchResult) -> dict[str, tuple[Floats, str]]:
    """Images over the panel for the page, with their units, by caption."""
    found = measured.calibration
    relative = found.responsivity_dn / np.median(found.responsivity_dn[found.valid])
    off = np.float32(np.nan)
    return {
        "Responsivity over its median; empty: not valid": (
            np.where(found.valid, relative, off).astype(np.float32),
            "of the median",
        ),
        "Share of its light that a pixel keeps": (
            np.where(found.valid, found.own_share, off).astype(np.float32),
            "share",
        ),
        "Standard error of the pixel map, either axis": (
            measured.pixel_map.error_px().astype(np.float32),
            "panel pixels",
        ),
        "Black level": (found.black_dn, "DN"),
    }
