"""The photon ledger: the light of one radiance stage by stage, with every loss listed once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from optsim.camera.parts import Ccd, Modulator, Objective, Relay, Splitter, stage_transmissions
from optsim.optics.radiometry import photons_per_joule


@dataclass(frozen=True)
class LedgerRow:
    """Light that is left after a stage, or a quantity counted there."""

    stage: str
    factor: float | None  # Over the value of the row above, if they share a unit.
    value: float
    unit: str


def photon_ledger(
    radiance_w_m2_sr: float,
    *,
    objective: Objective,
    splitter: Splitter,
    modulator: Modulator,
    relay: Relay,
    sensor: Ccd,
    coded_slots: int,
    wavelength_m: float,
) -> tuple[LedgerRow, ...]:
    """Follow a uniform radiance on axis through an all-on camera, without glare and fixed patterns."""
    rows = [LedgerRow("scene radiance", None, radiance_w_m2_sr, "W m^-2 sr^-1")]
    cone = math.pi / (4 * objective.working_f_number**2)
    rows.append(
        LedgerRow(
            f"cone of f/{objective.f_number:g}, f/{objective.working_f_number:g} on the panel",
            cone,
            cone * radiance_w_m2_sr,
            "W m^-2",
        )
    )
    on_axis = np.zeros(1)
    into, panel, out = stage_transmissions(
        splitter,
        modulator,
        modulator.white_rad(wavelength_m),
        objective.working_f_number,
        on_axis,
        wavelength_m,
    ).ravel()
    for stage, factor in (
        ("objective glass", objective.transmission),
        ("neutral density: modulator irradiance", objective.nd_transmission),
        ("splitter in, polariser", into),
        ("panel's fill factor", modulator.fill_factor),
        ("panel's mirrors and gaps, fully on", panel / modulator.fill_factor),
        ("splitter out, polariser, faces", out),
        ("relay glass", relay.transmission),
        ("relay stop", relay.accepted_share(objective.working_f_number)),
        ("magnification to the CCD", relay.magnification**-2),
    ):
        rows.append(LedgerRow(stage, float(factor), float(factor * rows[-1].value), "W m^-2"))
    exposure_s = coded_slots / modulator.field_rate_hz
    photons = rows[-1].value * sensor.pixel_area_m2 * exposure_s * photons_per_joule(wavelength_m)
    efficiency = sensor.efficiency_at(wavelength_m)
    electrons = photons * efficiency
    per_slot = electrons / coded_slots
    dark = sensor.dark_rate_e_s * exposure_s
    ratio = modulator.pitch_m * relay.magnification / sensor.pitch_m
    clips = ": clips" if electrons > sensor.most_e else ""
    rows += [
        LedgerRow(f"photons a pixel in {exposure_s * 1e3:.1f} ms", None, photons, "photons"),
        LedgerRow("electrons a frame", efficiency, electrons, "e-"),
        LedgerRow(f"of the full well{clips}", None, electrons / sensor.full_well_e, "1"),
        LedgerRow(f"of the converter's range{clips}", None, electrons / sensor.range_e, "1"),
        LedgerRow("electrons a slot", 1 / coded_slots, per_slot, "e-"),
        LedgerRow(f"SNR of a frame, centre pixel{clips}", None, _snr(electrons, dark, sensor, 1), "1"),
        LedgerRow(f"SNR of a frame, all nine pixels{clips}", None, _snr(electrons, dark, sensor, 9), "1"),
        LedgerRow("SNR of a single slot, centre pixel", None, _snr(per_slot, dark, sensor, 1), "1"),
        LedgerRow("SNR of a single slot, all nine pixels", None, _snr(per_slot, dark, sensor, 9), "1"),
        LedgerRow("share of a panel pixel's light in its centre pixel", None, ratio**-2, "1"),
    ]
    return tuple(rows)


def _snr(electrons: float, dark_e: float, sensor: Ccd, pixels: int) -> float:
    """Signal-to-noise ratio by EMVA 1288 (release 4.0 Linear, section 2.6), quantisation included."""
    clipped = min(electrons, sensor.most_e)
    noise = sensor.dark_noise_e**2
    return pixels * clipped / math.sqrt(pixels * (clipped + dark_e + noise))
