# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Responsivity, leak and grey curve of every panel pixel, from flats.

A flat identifies only the product of objective, splitter, panel, relay and CCD-pixel response. So one map
holds it. The leak is one number, the ratio of the light with the panel all off and all on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optsim.calibration.bench import Bench, Flat, Patches
from optsim.calibration.sensor_noise import SensorNoise, towards_zero
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.optics.panel import PanelResponse, slot_weights
from optsim.optics.readings import brightest, mean_reading

# No source, sensible defaults. A pixel is dead below this share of the median around it: stuck off, it still
# reads 0.2 to 0.4 from its neighbours. It is stuck on if this share of its light remains when commanded off.
_DEAD, _STUCK = 0.5, 0.5
# Shares above which a flat, or its light, is another than the bench says.
_MOST_CLIPPED, _MOST_UNEVEN = 0.2, 0.1
_MOST_UNLIKE = 1.5  # ratio of the exponents that greys give: beyond, they are exchanged
# Search range of the grey curve's exponent.
_EXPONENTS = (0.02, 50.0)


@dataclass(frozen=True, eq=False)
class PixelReader:
    """Reads light rates at the CCD pixels of the pixel map, or in readout windows around them."""

    row: Ints  # (v, u), CCD pixels of the pixel map, like ``col``.
    col: Ints
    black_dn: Floats  # (v, u), of the readout window.
    black_variance: float  # Of this black level, DN^2.
    saturation_dn: Floats  # (v, u), raw DN from which a CCD pixel of the window is saturated.
    coded_slots: int  # Slots with the shutter open.
    noise: SensorNoise  # Of the readout window.
    side: int = 1  # Of the readout window, CCD pixels, odd.

    def rate(self, shots: Sequence[Flat | Patches]) -> tuple[Doubles, Doubles]:
        """DN per (W m^-2 slot) over all frames of some shots, and its variance: two arrays (v, u)."""
        signal, light, n_frames = np.zeros(self.row.shape), 0.0, 0
        for shot in shots:
            signal += mean_reading(shot.dn, self.row, self.col, self.side).sum(axis=0, dtype=np.float64)
            light += len(shot.dn) * shot.irradiance_w_m2 * self.coded_slots
            n_frames += len(shot.dn)
        signal -= n_frames * self.black_dn.astype(np.float64)
        variance = self.noise.dn_per_e * np.maximum(signal, 0) + n_frames * self.noise.read_noise_dn**2
        variance += n_frames**2 * self.black_variance
        return signal / light, variance / light**2

    def clipped(self, shots: Sequence[Flat]) -> Bools:
        """Whether a pixel saturates in some frame: array (v, u)."""
        square = self.row, self.col, self.side
        return np.any([(brightest(s.dn, *square) >= self.saturation_dn).any(axis=0) for s in shots], axis=0)


@dataclass(frozen=True, eq=False)
class Shading:
    """Responsivity and leak of the panel pixels, arrays (v, u)."""

    responsivity_dn: Doubles  # DN per (W m^-2 slot), all on.
    off_dn: Doubles  # The same, all off.
    valid: Bools  # Neither dead nor stuck.
    gain_uncertainty: float  # Relative standard error of a pixel's responsivity, rms.
    leak: float  # Off over on.
    leak_uncertainty: float  # Relative, with the spread over the field: the leak is a single number.
    leak_error: float  # Standard error of the field's mean leak, by noise and by the scatter over flats.


def shading(bench: Bench, reader: PixelReader, inside: Bools) -> Shading:
    """Estimate responsivity and leak from the flats with the panel on and off."""
    from scipy.ndimage import binary_dilation, median_filter

    for number, shot in enumerate(bench.flats):
        clipped = float(np.mean(reader.clipped((shot,))[inside])) if inside.any() else 0.0
        if clipped > _MOST_CLIPPED:
            raise BenchError(
                f"{bench.where(f'flats[{number}]')}: got {clipped:.0%} of its pixels saturated, expected "
                "none; cure: take flats below half of full well, or exchange the file"
            )
    on, on_variance = reader.rate(bench.flats)
    off, off_variance = reader.rate((bench.off,))
    typical = float(np.median(on[inside])) if inside.any() else 0.0
    valid = (
        inside
        & (on > _DEAD * median_filter(on, size=5))
        & (on > 0)
        & (off < _STUCK * on)
        & ~reader.clipped((*bench.flats, bench.off))
    )
    if typical <= 0 or not valid.any():
        dark = float(np.median(off[inside])) if inside.any() else 0.0
        raise BenchError(
            f"{bench.where('off')}, {bench.where('flats[0]')}: got {dark:.3g} DN per W m^-2 and slot with "
            f"the panel off and {typical:.3g} in the flats, expected pixels that are lit, darker when off, "
            "and never saturated; cure: check the levels shown and the darks, and take the flats below half "
            "of full well"
        )
    rates = np.array([float(reader.rate((shot,))[0][valid].mean()) for shot in bench.flats])
    for number, rate in enumerate(rates / np.median(rates)):
        if abs(rate - 1) > _MOST_UNEVEN:
            raise BenchError(
                f"{bench.where(f'flats[{number}]')}: got {rate:.2f} times the light of the other flats for "
                "its irradiance, expected as much; cure: correct irradiance_w_m2, or exchange the files"
            )
    gain_uncertainty = float(np.sqrt(np.mean(on_variance[valid] / on[valid] ** 2)))
    # Light from a pixel stuck on exceeds its neighbours' leak.
    suspect = np.asarray(binary_dilation(inside & ~valid, np.ones((3, 3), np.bool_)), np.bool_)
    clean = valid & ~suspect if np.any(valid & ~suspect) else valid
    leak = max(float(off[clean].sum() / on[clean].sum()), 0.0)
    ratio = off[clean] / on[clean]
    noise = off_variance[clean] / on[clean] ** 2 + (ratio * gain_uncertainty) ** 2
    spread = max(float(np.mean((ratio - leak) ** 2 - noise)), 0.0)
    error = float(np.sqrt(spread + np.mean(noise) / ratio.size))
    light = np.array([shot.irradiance_w_m2 for shot in bench.flats])
    pooled = float(on[valid].mean())
    uneven = leak * (towards_zero(light, rates) / pooled - 1)
    leak_error = float(np.hypot(np.sqrt(np.mean(noise) / ratio.size), uneven))
    return Shading(on, off, valid, gain_uncertainty, leak, error / max(leak, error), leak_error)


def drive_exponent(
    bench: Bench, reader: PixelReader, flat: Shading, response: PanelResponse
) -> tuple[float, float] | None:
    """Exponent of retardance against level, with standard error, from flats at grey levels; None without."""
    from scipy.optimize import root_scalar

    held = np.full(4 * len(response.field_drive), 255, np.uint8)

    # Flats are means over slots whose fields may be driven differently: the panel's lag follows them.
    def opened(exponent: float, level: int) -> float:
        guess = response.model_copy(update={"drive_exponent": exponent, "leak": 0.0})
        levels = np.stack([np.full(len(held), level, np.uint8), held], axis=1)[:, None, :]
        weights, _ = slot_weights(levels, None, guess, bench.slot_s)
        seen, full = weights[-len(response.field_drive) :, 0].mean(axis=0, dtype=np.float64)
        return float(seen / full)

    exponents, errors = list[float](), list[float]()
    on = float(flat.responsivity_dn[flat.valid].sum())
    for number, grey in enumerate(bench.greys):
        where = bench.where(f"greys[{number}]")
        rate, variance = reader.rate((grey,))
        open_share = (float(rate[flat.valid].sum()) / on - flat.leak) / (1 - flat.leak)
        past_a_half_wave = response.white_rad > np.pi
        if not (0 < grey.level < 255 and open_share > 0 and (open_share < 1 or past_a_half_wave)):
            raise BenchError(
                f"{where}: got level {grey.level} that lets {open_share:.3g} of the light through, expected "
                "a level and a share strictly between off and on; cure: correct level, or exchange the file"
            )

        if open_share >= 1:
            # Above a half wave some greys exceed white, and each transmission occurs at two retardances.
            continue

        def solved(share: float, level: int = grey.level) -> float:
            def off(exponent: float) -> float:
                return opened(exponent, level) - share

            return float(root_scalar(off, bracket=_EXPONENTS).root)

        exponents.append(solved(open_share))
        noise = float(np.sqrt(variance[flat.valid].sum())) / on + flat.leak_error
        errors.append(abs(solved(min(open_share + noise, 1 - 1e-6)) - exponents[-1]))
        if max(exponents) > _MOST_UNLIKE * min(exponents):
            raise BenchError(
                f"{where}: got a grey curve of exponent {exponents[-1]:.2f}, expected about "
                f"{exponents[0]:.2f} as of the greys before; cure: correct level, or exchange the files"
            )
    if not exponents:
        return None
    n = len(exponents)
    spread = float(np.std(exponents, ddof=1)) if n > 1 else 0.0
    return float(np.mean(exponents)), float(np.hypot(np.linalg.norm(errors) / n, spread / np.sqrt(n)))
