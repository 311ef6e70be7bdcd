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
from optsim.calibration.sensor_noise import SensorNoise
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.optics.panel import PanelResponse, slot_weights
from optsim.optics.readings import brightest, mean_reading

# No source, sensible defaults. A pixel is dead below this share of the median around it: stuck off, it still
# reads 0.2 to 0.4 from its neighbours. It is stuck on if this share of its light remains when commanded off.
_DEAD, _STUCK = 0.5, 0.5
# Search range of the grey curve's exponent.
_EXPONENTS = (0.02, 50.0)


@dataclass(frozen=True, eq=False)
class PixelReader:
    """Reads light rates at the CCD pixels of the pixel map, or in readout windows around them.

    Parameters
    ----------
    row, col : ndarray of shape (v, u), int64
        CCD pixels of the pixel map.
    black_dn : ndarray of shape (v, u), float32
        Black level of the readout window.
    black_variance : float
        Variance of this black level, DN^2.
    saturation_dn : ndarray of shape (v, u), float32
        Raw DN from which a CCD pixel of the window is saturated.
    coded_slots : int
        Slots with the shutter open.
    noise : SensorNoise
        Gain and read noise of the readout window.
    side : int
        Side of the readout window, CCD pixels, odd.
    """

    row: Ints
    col: Ints
    black_dn: Floats
    black_variance: float
    saturation_dn: Floats
    coded_slots: int
    noise: SensorNoise
    side: int = 1

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
    """Responsivity and leak of the panel pixels.

    Parameters
    ----------
    responsivity_dn : ndarray of shape (v, u), float64
        DN per (W m^-2 slot), all on.
    off_dn : ndarray of shape (v, u), float64
        The same, all off.
    valid : ndarray of shape (v, u), bool
        Neither dead nor stuck.
    gain_uncertainty : float
        Relative standard error of a pixel's responsivity, rms.
    leak, leak_uncertainty : float
        Off over on, and its relative uncertainty. The uncertainty includes the spread over the field, since
        the leak is a single number.
    """

    responsivity_dn: Doubles
    off_dn: Doubles
    valid: Bools
    gain_uncertainty: float
    leak: float
    leak_uncertainty: float


def shading(bench: Bench, reader: PixelReader, inside: Bools) -> Shading:
    """Estimate responsivity and leak from the flats with the panel on and off.

    Raises
    ------
    BenchError
        When no pixel is lit.
    """
    from scipy.ndimage import binary_dilation, median_filter

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
        raise BenchError(
            f"bench flats, off: no pixel is lit (median {typical:.3g} DN per W m^-2 and slot), darker when "
            "off, and never saturated; check the levels shown, and take the flats below half of full well"
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
    return Shading(on, off, valid, gain_uncertainty, leak, error / max(leak, error))


def drive_exponent(
    greys: Sequence[Flat], reader: PixelReader, flat: Shading, response: PanelResponse, slot_s: float
) -> float | None:
    """Exponent of retardance against level, from flats at levels between 0 and 255; None without any.

    Flats are means over slots whose fields may be driven differently: a held level follows them with the
    response's lag.
    """
    from scipy.optimize import root_scalar

    held = np.full(4 * len(response.field_drive), 255, np.uint8)

    def opened(exponent: float, level: int) -> float:
        guess = response.model_copy(update={"drive_exponent": exponent, "leak": 0.0})
        levels = np.stack([np.full(len(held), level, np.uint8), held], axis=1)[:, None, :]
        weights, _ = slot_weights(levels, None, guess, slot_s)
        seen, full = weights[-len(response.field_drive) :, 0].mean(axis=0, dtype=np.float64)
        return float(seen / full)

    exponents: list[float] = []
    on = float(flat.responsivity_dn[flat.valid].sum())
    for grey in greys:
        rate, _ = reader.rate((grey,))
        open_share = (float(rate[flat.valid].sum()) / on - flat.leak) / (1 - flat.leak)
        past_a_half_wave = response.white_rad > np.pi
        if not (0 < grey.level < 255 and open_share > 0 and (open_share < 1 or past_a_half_wave)):
            raise BenchError(
                f"bench greys: level {grey.level} lets {open_share:.3g} of the light through, expected a "
                "level and a share strictly between off and on"
            )

        if open_share >= 1:
            # Above a half wave some greys exceed white, and each transmission occurs at two retardances.
            continue

        def off(exponent: float, level: int = grey.level, seen: float = open_share) -> float:
            return opened(exponent, level) - seen

        exponents.append(float(root_scalar(off, bracket=_EXPONENTS).root))
    return float(np.mean(exponents)) if exponents else None
