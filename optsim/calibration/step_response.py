# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportMissingTypeStubs=false
"""Delay and time constants of the panel, from flashes around a change of its level.

Under constant light a frame shows little more than the difference of the two time constants. So the bench
samples a slot with flashes much shorter than it. Rows are written one after the other, so bands of rows are
fitted separately.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optsim.calibration.bench import Bench, Step
from optsim.calibration.glare import Glare
from optsim.calibration.shading import PixelReader, Shading
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Bytes, Doubles, Floats, Ints
from optsim.optics.crosstalk import REACH
from optsim.optics.panel import (
    PanelResponse,
    mean_intensity,
    settled_panel,
    settled_retardance,
    slot_weights,
)

# Bounds and start of the fit, as shares of a slot; a panel below the lower bound counts as instantaneous.
_LEAST, _FIRST, _MOST = 1e-4, 0.15, 5.0
# The flashes start half a slot before a step, so that they also find an early panel.
_EARLIEST = 0.45
_LIT = 0.5
_BANDS = 48
_LEAST_SPAN = 0.25
_INSTANTLY_S = 1e-12
# What the model leaves out, slots: light of rows beside that turn earlier or later. On benches of another
# program times were found 0.5 us too long (validation/calibration_intervals).
_MODEL_SLOTS = 1e-4
_DRIVE_STEP = 1e-4
# Of full light: a flash that is farther off the fit is another one than the bench says. Jitter of 0.12 ms rms
# moves one by up to 0.2; of five exchanged pairs of neighbours on an edge, four are off by 0.33 or more.
_MOST_OFF = 0.3


@dataclass(frozen=True)
class StepFit:
    """The panel's response by its flashes."""

    response: PanelResponse  # With the estimated delays and time constants.
    # Standard errors of tau_on_s, tau_off_s, delay_s and scan_s, by the fit's own scatter.
    errors_s: dict[str, float]
    misfit: float  # Rms deviation over its noise: 1 for a panel that follows the model.


def step_weights(
    steps: Sequence[Step], response: PanelResponse, row_delays_s: Doubles, slot_s: float
) -> Doubles:
    """Weight of rows during each step's flash, by the closed form of the relaxing retardance."""
    ends = np.array([[s.before, s.after] for s in steps], np.uint8)
    held = settled_retardance(ends, response).astype(np.float64)
    flash_s = np.array([[s.flash_s] for s in steps])
    # Times since the row was driven; the change is at a frame's second slot, hence the second field.
    begin = np.array([[s.delay_s] for s in steps]) - row_delays_s
    drive = response.field_drive
    gamma = np.broadcast_to(held[:, :1] * drive[0], begin.shape)
    light = np.clip(-begin, 0, flash_s) * np.sin(gamma / 2) ** 2
    for slot in range(int(np.ceil((begin + flash_s).max() / slot_s))):
        target = held[:, 1:] * drive[(slot + 1) % len(drive)]
        tau = np.maximum(np.where(target > gamma, response.tau_on_s, response.tau_off_s), _INSTANTLY_S)
        first = np.clip(begin - slot * slot_s, 0, slot_s)
        length = np.clip(begin + flash_s - slot * slot_s, 0, slot_s) - first
        start = target + (gamma - target) * np.exp(-first / tau)
        light += length * mean_intensity(start, target, np.maximum(length, _INSTANTLY_S), tau)
        gamma = target + (gamma - target) * np.exp(-slot_s / tau)
    return response.leak + (1 - response.leak) / response.white * light / flash_s


def response_times(
    bench: Bench,
    reader: PixelReader,
    flat: Shading,
    known: PanelResponse,
    glare: Glare,
    kernels: Floats,
    drive_covariance: Doubles | None = None,
) -> StepFit:
    """Fit time constants and row delays to the signals of bands of rows, by least squares.

    The flash's energy is free in each band, so its light need not be uniform nor cover all bands.
    """
    from scipy.optimize import least_squares

    steps, slot_s = bench.steps, bench.slot_s
    if not any(s.after > s.before for s in steps) or not any(s.after < s.before for s in steps):
        raise BenchError(
            "bench steps: got one direction, expected steps to a higher and to a lower level; cure: take both"
        )
    rows = len(flat.valid)
    lit = _lit(steps, reader, _away_from_ends(flat.valid))
    bands = np.minimum(np.nonzero(lit)[0] * _BANDS // rows, _BANDS - 1)
    used, counts = np.unique(bands, return_counts=True)
    read = _rows_read(kernels)[lit]
    places = np.array([(read[bands == band].mean() + 0.5) / rows for band in used])
    signal = _band_means(steps, reader, lit, bands, used)
    peak, noise = float(signal.max()), reader.noise
    samples = np.array([len(s.dn) for s in steps])[:, None] * counts
    sigma = np.sqrt((noise.dn_per_e * np.maximum(signal, 0) + noise.read_noise_dn**2) / samples) / peak
    signal = signal / peak

    stray = _stray(glare, lit, bands, used)

    # A few rows do not determine the scan of the others.
    tells_scan = float(np.ptp(places) > _LEAST_SPAN)

    def response(guess: Doubles, held: PanelResponse = known) -> PanelResponse:
        on, off, delay, scan = (float(value) for value in guess * slot_s * [1, 1, 1, tells_scan])
        return held.model_copy(update={"tau_on_s": on, "tau_off_s": off, "delay_s": delay, "scan_s": scan})

    def misfit(guess: Doubles, held: PanelResponse = known) -> Doubles:
        panel = response(guess, held)
        weights = step_weights(steps, panel, panel.delay_s + panel.scan_s * places, slot_s)

        def fitted(light: Doubles) -> Doubles:
            return weights * ((weights * light / sigma**2).sum(axis=0) / ((weights / sigma) ** 2).sum(axis=0))

        own = signal - fitted(signal) @ stray
        return ((fitted(own) - own) / sigma).ravel()

    start, low = [_FIRST, _FIRST, 0.01, 0.01], [_LEAST, _LEAST, -_EARLIEST, 0.0]
    fit = least_squares(misfit, start, bounds=(low, [_MOST, _MOST, 0.5, 0.49]), x_scale="jac")
    off = (fit.fun.reshape(sigma.shape) * sigma).mean(axis=1)
    worst = int(np.abs(off).argmax())
    if abs(off[worst]) > _MOST_OFF:
        raise BenchError(
            f"{bench.where(f'steps[{worst}]')}: got {-off[worst]:+.0%} of full light beside what the other "
            "flashes tell, expected the same; cure: correct before, after and delay_s, or exchange the file"
        )
    # Beside the parameters, each band's energy is fitted.
    freedom = max(fit.fun.size - sigma.shape[1] - len(start), 1)
    scatter = float(np.sqrt(np.sum(fit.fun**2) / freedom))
    inverse = np.linalg.pinv(fit.jac.T @ fit.jac)
    covariance = inverse * max(scatter, 1.0) ** 2
    if drive_covariance is not None:
        # An error of a field's drive looks like another time constant.
        drive = np.array(known.field_drive)
        steps_off = [drive + _DRIVE_STEP * unit for unit in np.eye(len(drive))]
        tried = [misfit(fit.x, known.model_copy(update={"field_drive": tuple(each)})) for each in steps_off]
        change = inverse @ fit.jac.T @ (np.stack(tried, axis=1) - fit.fun[:, None]) / _DRIVE_STEP
        covariance = covariance + change @ drive_covariance @ change.T
    by_scatter = np.sqrt(np.diag(covariance))
    errors = np.hypot(by_scatter, _MODEL_SLOTS * (by_scatter > 0)) * slot_s
    names = ("tau_on_s", "tau_off_s", "delay_s", "scan_s")
    return StepFit(response(fit.x), dict(zip(names, errors.tolist(), strict=True)), scatter)


def field_drive(
    fields: tuple[Step, ...], reader: PixelReader, valid: Bools, slot_s: float, response: PanelResponse
) -> tuple[PanelResponse, Doubles | None]:
    """Relative retardance of successive slots, with covariance, from slot-long flashes on a held panel."""
    if not fields:
        return response, None
    from scipy.optimize import least_squares

    level = min(s.before for s in fields)
    slots = {(s.before, round(s.delay_s / slot_s)): i for i, s in enumerate(fields)}
    n = len(fields) // 2
    wanted = [(lv, slot) for lv in (level, 255) for slot in range(n)]
    if n < 2 or level == 255 or set(slots) != set(wanted):
        raise BenchError(
            "bench fields: expected a flash in each of two or more successive slots, from the first one on, "
            "once with the panel held at a grey level and once at 255; take them all"
        )
    lit = _lit(fields, reader, valid)
    every = np.zeros(int(lit.sum()), np.int64)
    signal = _band_means(fields, reader, lit, every, np.zeros(1, np.int64))[:, 0]
    dark, bright = (signal[[slots[lv, slot] for slot in range(n)]] for lv in (level, 255))
    held: Bytes = np.full((2 * n, 1, 1), level, np.uint8)

    def weights(drive: Doubles, levels: Bytes) -> Doubles:
        driven = response.model_copy(update={"field_drive": tuple(drive / drive.mean())})
        whole, _ = slot_weights(levels, settled_panel(levels[0], driven), driven, slot_s)
        return whole[n:, 0, 0].astype(np.float64)

    def misfit(drive: Doubles) -> Doubles:
        ratio = weights(drive, held) / weights(drive, np.full_like(held, 255))
        measured = dark / bright
        return np.append(ratio / ratio.mean() - measured / measured.mean(), drive.mean() - 1)

    # Steps near the square root of float32's precision, since weights are float32.
    fit = least_squares(misfit, np.ones(n), diff_step=1e-3)
    drives = fit.x / fit.x.mean()
    noise, ratio = reader.noise, dark / bright
    variance = sum((noise.dn_per_e * s + noise.read_noise_dn**2) / len(every) / s**2 for s in (dark, bright))
    scaled = np.linalg.pinv(fit.jac)[:, :-1] * (ratio / ratio.mean() * np.sqrt(variance))
    found = response.model_copy(update={"field_drive": tuple(float(d) for d in drives)})
    return found, scaled @ scaled.T


def _lit(steps: tuple[Step, ...], reader: PixelReader, valid: Bools) -> Bools:
    """Panel pixels that the flash lights well enough to fit."""
    row, col, black = reader.row[valid], reader.col[valid], reader.black_dn[valid]
    brightest = max(steps, key=lambda s: float(np.mean(s.dn[:, row, col])))
    light = brightest.dn[:, row, col].mean(axis=0) - black
    full = float(np.percentile(light, 99.9))
    if full < 20 * reader.noise.read_noise_dn:
        raise BenchError(
            f"bench steps: even the brightest has {full:.1f} DN only; check that flash and exposure meet"
        )
    lit = valid.copy()
    lit[valid] = light > _LIT * full
    return lit


def _away_from_ends(valid: Bools) -> Bools:
    """Leave out the first and last rows: neighbours on one side only make them look earlier or later."""
    inner = valid.copy()
    if len(valid) > 4 * REACH:
        inner[:REACH] = inner[-REACH:] = False
    return inner


def _rows_read(kernels: Floats) -> Doubles:
    """Row of the centre of the light that each pixel reads, array (v, u)."""
    reach = kernels.shape[2] // 2
    rows = np.arange(len(kernels), dtype=np.float64)[:, None]
    away: Doubles = kernels.sum(axis=3, dtype=np.float64) @ np.arange(-reach, reach + 1, dtype=np.float64)
    return rows + away


def _stray(glare: Glare, lit: Bools, bands: Ints, used: Ints) -> Doubles:
    """Glare in each band (second axis) of light in each band (first), as a share of it."""
    shares = np.zeros((len(used), len(used)))
    if glare.share(REACH) == 0:
        return shares
    for number, band in enumerate(used):
        light = np.zeros(lit.shape)
        light[lit] = bands == band
        seen = glare.light(light, REACH)[lit]
        shares[number] = [seen[bands == each].mean() for each in used]
    return shares


def _band_means(steps: tuple[Step, ...], reader: PixelReader, lit: Bools, bands: Ints, used: Ints) -> Doubles:
    """Mean signal of each band of lit pixels in each step, DN: array (step, band)."""
    row, col, black = reader.row[lit], reader.col[lit], reader.black_dn[lit]
    light = np.stack([s.dn[:, row, col].mean(axis=0, dtype=np.float64) - black for s in steps])
    return np.stack([light[:, bands == band].mean(axis=1) for band in used], axis=1)
