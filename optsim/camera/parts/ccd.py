"""The CCD: from photons to digital numbers, by EMVA 1288 with a physical full well.

    e  = Poisson(QE (1 + PRNU) photons + dark current x time), clipped at the full well
    DN = round((bend(e + smear) + read noise + DSNU) / gain + black level), clipped by the converter

Source: EMVA Standard 1288, release 4.0 Linear (2021), section 2; the order of clip and noise is that of an
interline CCD, whose well clips before its output amplifier adds noise.

Smear: while charge is shifted down its column to the output, a little light leaks under the shield of each
row it passes. In one readout every pixel passes all rows of its column in the same time. So it collects the
column's sum times the shield's leak times the dwell in a row over the exposure. The light during readout is
taken from the frame's own exposure; really it is the start of the next one.

Not modelled: blooming, lag, charge-transfer loss, hot pixels, fixed row and column patterns.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from pydantic import Field, field_validator, model_validator

from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.core.quantities import Doubles, Floats, Words
from optsim.core.threads import side_by_side
from optsim.optics.radiometry import MONO_WAVELENGTH_M

# Below zero by up to this, or this share of the brightest pixel, is rounding of the optics' transforms, not
# negative light. Next to 1e12 electrons they round by more than any fixed bound.
_ROUNDING_E, _ROUNDING_SHARE = 1e-6, 1e-14
# More than any full well, and less than the largest mean of a Poisson generator.
_MOST_E = 1e18
_STREAMS = 8
_FEWEST_BITS, _MOST_BITS = 8, 16
_LEAST_RANGE = 10  # of the converter, in standard deviations of read noise; no source
# Temperature at which dark currents are stated.
_DATA_SHEET_C = 25.0
_PATTERN = 0x63636421  # separates the sensor's fixed patterns from the panel's


class Ccd(Part):
    """A monochrome CCD, or a region of interest of it.

    Parameters
    ----------
    rows, cols : int
        Pixels read out: the region of interest, at the centre of the chip.
    pitch_m : float
        Pixel pitch, m.
    quantum_efficiency : float
        Electrons per photon at 550 nm.
    spectral_response : tuple of (float, float)
        Wavelength, m, and quantum efficiency over that at 550 nm, in rising wavelengths. Linear between them,
        unknown beyond. Empty: known at 550 nm only.
    full_well_e : float
        Electrons at which a pixel's well clips (not the EMVA saturation capacity, which lies a little below).
    read_noise_e : float
        Temporal dark noise, rms.
    dark_current_e_s : float
        Electrons a second and pixel at 25 degrees C.
    temperature_c : float
        Temperature of the chip, degrees C, may be negative. At the default the data sheet's dark current
        holds: sheets seldom state the temperature of their measurement.
    dark_doubling_k : float
        Rise of the temperature that doubles the dark current (EMVA 1288, release 4.0 Linear, section 7.2); 7
        K has no source, a sensible default for silicon.
    prnu : float
        Photo response non-uniformity: rms over the pixels, relative to their mean response.
    dsnu_e : float
        Dark signal non-uniformity: rms over the pixels, independent of the exposure.
    gain_e : float
        Electrons per digital number.
    bits : int
        Bits of the converter's digital numbers, the units of ``gain_e`` and ``black_dn``.
    black_dn : float
        Black level: the digital number of a pixel without a signal.
    finer_bits : int
        Bits of the converter beyond ``bits``, fewer if negative, for the same range of light. ``gain_e`` and
        ``black_dn`` still refer to ``bits``. In all 8 to 16, the most that frames hold.
    bend_at_full_well : float
        Share of the signal that is missing at the full well. It grows with the fifth power of the signal up
        to there, and stays constant beyond, which smear may reach.
    readout_s : float
        Time to read out ``readout_rows`` rows, as a data sheet states it for the whole chip. A region of
        interest takes the same time a row. Rows around it are assumed to be dumped instantly. Cameras differ:
        for an ICX674, 25.0 ms binned 2 x 2 against 39.1 ms suggest up to 0.3 of a row's time for each.
    readout_rows : int or None
        Rows that ``readout_s`` refers to; by default those that are read.
    smear_share : float
        Share of a pixel's light that leaks under the shield of its column's register; 0 for CMOS.
    """

    rows: int = Field(ge=1)
    cols: int = Field(ge=1)
    pitch_m: float = Field(gt=0, le=1e-3)
    quantum_efficiency: float = Field(gt=0, le=1)
    spectral_response: tuple[tuple[float, float], ...] = ()
    full_well_e: float = Field(ge=100)
    read_noise_e: float = Field(ge=0)
    dark_current_e_s: float = Field(ge=0)
    prnu: float = Field(ge=0, le=0.1)
    dsnu_e: float = Field(ge=0)
    gain_e: float = Field(gt=0)
    bits: int = Field(ge=_FEWEST_BITS, le=_MOST_BITS)
    black_dn: float = Field(ge=0)
    bend_at_full_well: float = Field(ge=0, le=0.1)
    readout_s: float = Field(gt=0)
    readout_rows: int | None = Field(default=None, ge=1)
    smear_share: float = Field(default=0.0, ge=0, le=1)
    finer_bits: int = Field(default=0, ge=-8, le=8)
    temperature_c: float = Field(default=_DATA_SHEET_C, ge=-60, le=100)
    dark_doubling_k: float = Field(default=7.0, ge=3, le=20)

    @field_validator("spectral_response")
    @classmethod
    def _rises(cls, pairs: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        wavelengths = [wavelength_m for wavelength_m, _ in pairs]
        if any(b <= a for a, b in pairwise(wavelengths)) or any(relative <= 0 for _, relative in pairs):
            raise ValueError("expected pairs of a wavelength in m and a response > 0, wavelengths rising")
        if pairs and wavelengths[0] <= MONO_WAVELENGTH_M <= wavelengths[-1]:
            here = _interpolated(MONO_WAVELENGTH_M, pairs)
            if abs(here - 1) > 1e-6:
                raise ValueError(f"got {here:g} at 550 nm, expected 1 there: it is relative to that")
        return pairs

    @model_validator(mode="after")
    def _converter_shows_light(self) -> Ccd:
        if self.zero_dn >= self.max_dn:
            raise ValueError(
                f"black_dn: got {self.black_dn:g}, expected less than {2**self.bits - 1}, the most "
                f"number of {self.bits} bits; lower it, or take more bits"
            )
        least_e = _LEAST_RANGE * max(self.read_noise_e, 1.0)
        if self.range_e < least_e:
            raise ValueError(
                f"gain_e: got {self.gain_e:g}, by which the numbers above black_dn end at {self.range_e:.3g} "
                f"electrons; expected {least_e:.3g} or more, {_LEAST_RANGE} times the read noise; raise it"
            )
        return self

    @property
    def range_e(self) -> float:
        """Electrons of the largest digital number."""
        return (self.max_dn - self.zero_dn) * self.step_e

    @property
    def most_e(self) -> float:
        """Electrons at which a pixel clips, by its well or by the converter."""
        return min(self.full_well_e, self.range_e)

    @property
    def dark_rate_e_s(self) -> float:
        """Dark current at the chip's temperature, electrons a second and pixel."""
        return self.dark_current_e_s * 2 ** ((self.temperature_c - _DATA_SHEET_C) / self.dark_doubling_k)

    def efficiency_at(self, wavelength_m: float) -> float:
        """Electrons per photon in light of a wavelength.

        Raises
        ------
        ConfigError
            Where the efficiency is unknown, or more than 1.
        """
        if wavelength_m == MONO_WAVELENGTH_M:
            return self.quantum_efficiency
        known_m = [pair[0] for pair in self.spectral_response] or [MONO_WAVELENGTH_M]
        if not known_m[0] <= wavelength_m <= known_m[-1]:
            raise ConfigError(
                f"camera.sensor.spectral_response: got light of {wavelength_m * 1e9:g} nm, expected "
                f"{known_m[0] * 1e9:g} to {known_m[-1] * 1e9:g} nm, where the quantum efficiency is known; "
                "choose another band, or add its response"
            )
        efficiency = self.quantum_efficiency * _interpolated(wavelength_m, self.spectral_response)
        if efficiency > 1:
            raise ConfigError(
                f"camera.sensor.quantum_efficiency x spectral_response: got {efficiency:.4g} at "
                f"{wavelength_m * 1e9:g} nm, expected at most 1; lower one of them"
            )
        return efficiency

    @property
    def row_s(self) -> float:
        """Time to read out a row, s."""
        return self.readout_s / (self.readout_rows or self.rows)

    @property
    def frame_readout_s(self) -> float:
        """Time to read out the rows of the region of interest, s."""
        return self.row_s * self.rows

    @property
    def converter_bits(self) -> int:
        """Bits of the digital numbers."""
        return min(max(self.bits + self.finer_bits, _FEWEST_BITS), _MOST_BITS)

    @property
    def max_dn(self) -> int:
        """Largest digital number."""
        return 2**self.converter_bits - 1

    @property
    def step_e(self) -> float:
        """Electrons per digital number, finer bits included."""
        return self.gain_e * 2.0 ** (self.bits - self.converter_bits)

    @property
    def zero_dn(self) -> float:
        """Black level in digital numbers, finer bits included."""
        return self.black_dn * 2.0 ** (self.converter_bits - self.bits)

    @property
    def dark_noise_e(self) -> float:
        """Temporal noise of a frame without any electrons, rms: read noise and rounding."""
        return float(np.hypot(self.read_noise_e, self.step_e * 12**-0.5))

    @property
    def pixel_area_m2(self) -> float:
        """Area of a pixel, m^2, all of it sensitive: micro-lenses are part of the quantum efficiency."""
        return self.pitch_m**2

    def pixel_response(self, serial_number: int) -> Floats:
        """1 + PRNU of every pixel, (y, x)."""
        return _patterns(self.rows, self.cols, self.prnu, self.dsnu_e, serial_number)[0]

    def dark_signal_e(self, serial_number: int) -> Floats:
        """DSNU of every pixel, (y, x), electrons."""
        return _patterns(self.rows, self.cols, self.prnu, self.dsnu_e, serial_number)[1]

    def bent(self, electrons: Doubles) -> Doubles:
        """Signal after the non-linearity, electrons: e (1 - bend min(e / full well, 1)^5)."""
        # Smear may exceed the full well. The fifth power is known up to the well only. It turns back at 1.4
        # of it and reaches zero at twice: a column under a very bright lamp would read black.
        x = np.minimum(electrons / self.full_well_e, 1)
        # Repeated products: a general power takes ten times as long on a frame.
        x2 = x * x
        return electrons * (1 - self.bend_at_full_well * x2 * x2 * x)

    def smear_e(self, expected_e: Doubles, exposure_s: float) -> Doubles:
        """Mean electrons that smear adds to every pixel of a column, (x,); the well does not limit it.

        Parameters
        ----------
        expected_e : ndarray of shape (y, x), float64
            Expected electrons of the exposure. Dark electrons are not smeared.
        exposure_s : float
            Exposure time, s.
        """
        dwell_s, dark_e = self.row_s, self.dark_rate_e_s * exposure_s
        light_e = np.maximum(expected_e, dark_e).sum(axis=0) - len(expected_e) * dark_e
        return self.smear_share * dwell_s / exposure_s * light_e

    def signal_e(self, expected_e: Doubles, exposure_s: float, serial_number: int) -> Doubles:
        """Signal of a frame without noise, electrons: clip, smear, bend and fixed pattern."""
        smear = self.smear_e(expected_e, exposure_s)
        return self._bent_signal(expected_e, smear) + self.dark_signal_e(serial_number)

    def _bent_signal(self, electrons: Doubles, smear_e: Doubles | float) -> Doubles:
        return self.bent(np.minimum(electrons, self.full_well_e) + smear_e)

    def noise_e(self, expected_e: Doubles, exposure_s: float) -> Doubles:
        """Temporal noise of a frame, rms electrons after the bend, (y, x), as if no well were full."""
        filled = np.clip(expected_e, 0, self.full_well_e)
        x = filled / self.full_well_e
        # Derivative of the bend, which applies to shot noise alone.
        slope = 1 - 6 * self.bend_at_full_well * x**5
        smear = self.smear_e(expected_e, exposure_s)
        return np.sqrt(slope**2 * filled + smear + self.dark_noise_e**2)

    def digitise(
        self, expected_e: Doubles, exposure_s: float, serial_number: int, rng: Generator
    ) -> tuple[Words, int]:
        """Take a frame of given expected electrons.

        Parameters
        ----------
        expected_e : ndarray of shape (y, x), float64
            Expected electrons before any clip; negative where the light is (Monte-Carlo noise).
        exposure_s : float
            Exposure time, s.
        serial_number : int
            Seed of the fixed patterns.
        rng : Generator
            Generator of this frame's shot and read noise.

        Returns
        -------
        dn : ndarray of shape (y, x), uint16
            Raw frame.
        negative_light : int
            Pixels with negative expected light, exposed as dark.
        """
        smear = self.smear_e(expected_e, exposure_s)
        # Smear's shot noise is Gaussian wherever it exceeds the read noise.
        noise = np.sqrt(self.read_noise_e**2 + smear).astype(np.float32)
        dark = self.dark_signal_e(serial_number)
        dn = np.empty(expected_e.shape, np.uint16)
        negative = np.zeros(_STREAMS, np.int64)
        rounding_e = _ROUNDING_E + _ROUNDING_SHARE * float(expected_e.max())
        edges = [self.rows * stream // _STREAMS for stream in range(_STREAMS + 1)]

        def strip(stream: int, draw: Generator) -> None:
            rows = slice(edges[stream], edges[stream + 1])
            expected = expected_e[rows]
            negative[stream] = np.count_nonzero(expected < -rounding_e)
            electrons = draw.poisson(np.clip(expected, 0, _MOST_E)).astype(np.float64)
            signal = self._bent_signal(electrons, smear) + dark[rows]
            signal += draw.standard_normal(signal.shape, np.float32) * noise
            np.clip(np.rint(signal / self.step_e + self.zero_dn), 0, self.max_dn, out=signal)
            dn[rows] = signal

        # One noise stream a strip, so frames don't depend on the number of cores.
        side_by_side(lambda n=n, draw=draw: strip(n, draw) for n, draw in enumerate(rng.spawn(_STREAMS)))
        return dn, int(negative.sum())


def _interpolated(x: float, pairs: tuple[tuple[float, float], ...]) -> float:
    return float(np.interp(x, [pair[0] for pair in pairs], [pair[1] for pair in pairs]))


@lru_cache(maxsize=4)
def _patterns(rows: int, cols: int, prnu: float, dsnu_e: float, serial_number: int) -> tuple[Floats, Floats]:
    rng = np.random.default_rng([serial_number, _PATTERN])
    response = 1 + prnu * rng.standard_normal((rows, cols), np.float32)
    dark = dsnu_e * rng.standard_normal((rows, cols), np.float32)
    return response.astype(np.float32), dark.astype(np.float32)
