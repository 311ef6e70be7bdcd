"""The liquid-crystal panel: its numbers, its Mueller matrix and its fixed patterns."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from optsim.core.config import Part
from optsim.core.quantities import Bools, Bytes, Doubles, Floats, PanelState
from optsim.optics.fringe_correction import FringeCorrection, FringeModel
from optsim.optics.mueller import depolariser, mirror, retarder_45
from optsim.optics.panel import GreyCurve, PanelResponse
from optsim.optics.radiometry import MONO_WAVELENGTH_M

_PATTERN = 0x70616E65  # separates the panel's fixed patterns from the sensor's
_TAU_PER_DEGREE = 0.03
_SHARP_PX = 1e-3  # narrower borders need no fringe-field correction
_FARTHEST = 4.0  # standard deviations of jitter at most: it lies beyond once in 16 000 frames
_Drive = Annotated[float, Field(ge=0.5, le=1.5)]


class Modulator(Part):
    """A reflective panel as one equivalent retarder at 45 degrees, with first-order response.

    Parameters
    ----------
    pitch_m : float
        Pixel pitch, m.
    rows, cols : int
        Pixels of the whole panel; the camera uses some around its centre.
    field_rate_hz : float
        Patterns a second: one slot lasts one field.
    mirror_reflectivity : float
        Share of the light that the pixels' mirrors reflect, gaps left out.
    fill_factor : float
        Share of a pitch cell that its mirror covers. The fine grid does not resolve the gaps, so their loss
        and light are spread evenly.
    gap_reflectivity : float
        Share of the light that the gaps between the mirrors reflect. The crystal is not driven there, and the
        light comes back unpolarised.
    tau_on_s, tau_off_s : float
        Time constants towards larger and smaller retardance, at 25 degrees C.
    temperature_c : float
        Temperature of the crystal, degrees C, may be negative: the time constants fall by 3 % a degree (no
        source, a sensible default).
    half_wave_m : float
        Wavelength at which level 255 is a half wave there and back, the brightest state. At another
        wavelength the retardance scales with the ratio of the two, for a constant path difference (dispersion
        of the birefringence is not modelled). 550 nm has no source.
    stated_half_wave_m : float or None
        ``half_wave_m`` as stated in the data sheet, the only value given to a bench. None: the data sheet is
        right. An error of 2 % puts the bench's slot weights off by 0.12 % rms, 5 % by 0.31 %. The grey
        curve's exponent and ``tau_on_s``, 8 and 20 % off, absorb the rest.
    drive_exponent : float
        Exponent of retardance against drive level: white times (level / 255) to this power.
    grey_curve : tuple of (float, float)
        Level and reflectance as measured with the panel held, or in TOML the path of a CSV file of the two.
        It replaces the exponent.
    field_drive : tuple of three float
        Relative retardance of the three colour fields, shown in turn; all 1 for a panel without colours.
    polarity_drive : float
        Relative change of the retardance with the sign of the voltage, which alternates from slot to slot.
    delay_s : float
        Delay at which the first used row is driven to a slot's level, after the shutter's clock. If negative,
        it is early: the last slot of a frame then ends with the level of its first, since the next code isn't
        known yet.
    scan_s : float
        Duration of the scan: from the first row to one after the panel's last; rows go downwards.
    jitter_s : float
        Standard deviation of the delay from frame to frame, cut at four of these.
    fringing_px : float
        Standard deviation of the retardance blur by fringing fields, panel pixels.
    fringe_model : {"coarse", "fine", "mixed"}
        Fringe-field correction at pixel edges (:mod:`optsim.optics.fringe_correction`). ``coarse`` errs by
        2 % of what fringing changes, and by 0.04 dB at most in any score measured; ``fine`` by 0.1 %, in a
        fifth more of a run's time; ``mixed`` only mixes the weights of neighbours.
    depolarised_share : float
        Share of the reflected light that is no longer polarised; half of it passes the analyser.
    nonuniformity_rms : float
        Rms of the relative reflectivity over the panel; the pattern is smooth.
    stuck_share : float
        Share of stuck pixels, dark or bright.
    """

    pitch_m: float = Field(gt=0, le=1e-3)
    rows: int = Field(ge=1)
    cols: int = Field(ge=1)
    field_rate_hz: float = Field(gt=0)
    mirror_reflectivity: float = Field(gt=0, le=1)
    fill_factor: float = Field(gt=0, le=1)
    gap_reflectivity: float = Field(default=0.0, ge=0, le=1)
    tau_on_s: float = Field(ge=0, le=10)
    tau_off_s: float = Field(ge=0, le=10)
    temperature_c: float = Field(default=25.0, ge=-20, le=90)
    half_wave_m: float = Field(default=550e-9, gt=0)
    stated_half_wave_m: float | None = Field(default=None, gt=0)
    drive_exponent: float = Field(gt=0)
    grey_curve: GreyCurve = ()
    field_drive: tuple[_Drive, _Drive, _Drive] = (1.0, 1.0, 1.0)
    polarity_drive: float = Field(default=0.0, ge=0, le=0.2)
    delay_s: float = 0.0
    scan_s: float = Field(default=0.0, ge=0)
    jitter_s: float = Field(default=0.0, ge=0)
    fringing_px: float = Field(default=0.0, ge=0, le=0.25)
    fringe_model: FringeModel = "coarse"
    depolarised_share: float = Field(ge=0, le=1)
    nonuniformity_rms: float = Field(ge=0, le=0.2)
    stuck_share: float = Field(ge=0, le=1)

    @model_validator(mode="after")
    def _rows_turn_within_a_slot(self) -> Modulator:
        latest_s = self.delay_s + self.scan_s + _FARTHEST * self.jitter_s
        if latest_s >= 1 / self.field_rate_hz:
            raise ValueError(
                f"delay_s + scan_s + {_FARTHEST:g} jitter_s: got {latest_s:g} s, "
                f"expected less than a slot of {1 / self.field_rate_hz:g} s; lower one of them"
            )
        earliest_s = self.delay_s - _FARTHEST * self.jitter_s
        if earliest_s <= -1 / self.field_rate_hz:
            raise ValueError(
                f"delay_s - {_FARTHEST:g} jitter_s: got {earliest_s:g} s, expected more than minus a slot of "
                f"{1 / self.field_rate_hz:g} s; raise delay_s, or lower jitter_s"
            )
        return self

    @property
    def reflectivity(self) -> float:
        """Reflectivity of the mirrors, averaged over a pitch cell."""
        return self.mirror_reflectivity * self.fill_factor

    @property
    def drives(self) -> tuple[float, ...]:
        """Relative retardance of six successive slots: three colours with alternating sign."""
        signs = (1, -1) * 3
        return tuple(
            field * (1 + sign * self.polarity_drive)
            for sign, field in zip(signs, self.field_drive * 2, strict=True)
        )

    def white_rad(self, wavelength_m: float) -> float:
        """Round-trip retardance of level 255 in light of a wavelength, rad."""
        return np.pi * (self.half_wave_m / wavelength_m)

    def stated_white_rad(self, wavelength_m: float) -> float:
        """Return :meth:`white_rad` by the data sheet, rad."""
        return np.pi * ((self.stated_half_wave_m or self.half_wave_m) / wavelength_m)

    def response(self, leak: float, rows: int, wavelength_m: float = MONO_WAVELENGTH_M) -> PanelResponse:
        """Temporal response of the panel to its drive.

        Parameters
        ----------
        leak : float
            Off over on of the whole chain.
        rows : int
            Rows used, around the centre of the panel.
        wavelength_m : float
            Wavelength of the light, m.
        """
        slower = np.exp(-_TAU_PER_DEGREE * (self.temperature_c - 25))
        # More rows than the panel has are refused by geometry.py; here they scan like a larger panel's.
        there = max(self.rows, rows)
        first = (there - rows) / 2 / there
        drive = self.drives
        return PanelResponse(
            tau_on_s=self.tau_on_s * slower,
            tau_off_s=self.tau_off_s * slower,
            leak=leak,
            white_rad=self.white_rad(wavelength_m),
            drive_exponent=self.drive_exponent,
            grey_curve=self.grey_curve,
            field_drive=drive if len(set(drive)) > 1 else (drive[0],),
            delay_s=self.delay_s + self.scan_s * first,
            scan_s=self.scan_s * rows / there,
        )

    def fringe_correction(
        self,
        levels: Bytes,
        start: PanelState,
        response: PanelResponse,
        slot_s: float,
        instants_per_slot: int,
        leaks: Doubles,
        pitch: int,
    ) -> FringeCorrection | None:
        """Fringe-field correction for pixels of ``pitch`` fine cells; None where mixing suffices."""
        if self.fringing_px < _SHARP_PX or self.fringe_model == "mixed":
            return None
        blur = self.fringing_px, pitch, self.fringe_model
        return FringeCorrection(levels, start, response, slot_s, instants_per_slot, leaks, *blur)

    def lateness_s(self, slots_displayed: int, serial_number: int) -> float:
        """Extra delay beyond ``delay_s`` of a frame that begins after so many slots, s."""
        if not self.jitter_s:
            return 0.0
        rng = np.random.default_rng([serial_number, _PATTERN, 2, slots_displayed])
        return self.jitter_s * float(np.clip(rng.standard_normal(), -_FARTHEST, _FARTHEST))

    def mueller(self, retardance_rad: float) -> Doubles:
        """Mueller matrix of the panel in reflection, the mirror's flip included once.

        The round-trip retardance is that of one equivalent retarder before the mirror. With the flip after
        it, retardance 0 is dark and pi is bright between crossed polarisers.
        """
        retarder = mirror() @ retarder_45(retardance_rad)
        pixels = self.reflectivity * depolariser(self.depolarised_share) @ retarder
        return pixels + (1 - self.fill_factor) * self.gap_reflectivity * depolariser(1.0)

    def gain(self, rows: int, cols: int, serial_number: int) -> Floats:
        """Relative reflectivity of the used pixels, (v, u), mean about 1."""
        return _smooth_pattern(rows, cols, self.nonuniformity_rms, serial_number)

    def stuck(self, rows: int, cols: int, serial_number: int) -> tuple[Bools, Bytes]:
        """Stuck pixels, (v, u), and the level, 0 or 255, at which each pixel would be stuck."""
        rng = np.random.default_rng([serial_number, _PATTERN, 1])
        stuck = rng.random((rows, cols)) < self.stuck_share
        return stuck, rng.integers(0, 2, (rows, cols), dtype=np.uint8) * np.uint8(255)


@lru_cache(maxsize=8)
def _smooth_pattern(rows: int, cols: int, rms: float, serial_number: int) -> Floats:
    """One plus a random mixture of the 15 lowest cosines over the rectangle, of a given rms."""
    rng = np.random.default_rng([serial_number, _PATTERN, 0])
    y = (np.arange(rows) + 0.5) / rows
    x = (np.arange(cols) + 0.5) / cols
    pattern = np.zeros((rows, cols))
    for i in range(4):
        for j in range(4):
            if i or j:
                pattern += rng.standard_normal() * np.outer(np.cos(np.pi * i * y), np.cos(np.pi * j * x))
    # On a line of pixels the cosines across it are constant, and a single pixel has no spread.
    pattern -= pattern.mean()
    spread = pattern.std()
    # The largest rms may give a negative reflectivity in a corner.
    return np.maximum(1 + rms * pattern / (spread if spread > 0 else 1), 0).astype(np.float32)
