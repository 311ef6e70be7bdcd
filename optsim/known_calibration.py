"""A calibration that no bench measured: known numbers of the camera put into the form that decoders use."""

from __future__ import annotations

from typing import Literal

import numpy as np

from optsim.calibrate import Calibration
from optsim.forward.panel import PanelResponse
from optsim.quantities import Bools, Doubles, Floats, Ints, Timing
from optsim.sensor import Ccd


def known_calibration(
    source: Literal["true", "ideal"],
    *,
    sensor: Ccd,
    timing: Timing,
    coded_slots: int,
    response: PanelResponse,
    picks: tuple[Ints, Ints, Bools],
    responsivity_e: Doubles,
    offset_e: Doubles,
    full_well_e: float,
    crosstalk: Floats,
    veil: float,
) -> Calibration:
    """Make a calibration from electrons rather than from images.

    Parameters
    ----------
    source : {"true", "ideal"}
        Copied from the parts, or the paper's equations.
    sensor : Ccd
        For gain, black level, noise and converter.
    timing : Timing
        Slots and their period.
    coded_slots : int
        Slots with the shutter open.
    response : PanelResponse
        Of the panel.
    picks : tuple of ndarray of shape (v, u)
        Row, column and validity of each panel pixel's CCD pixel.
    responsivity_e : ndarray of shape (v, u), float64
        Electrons per W m^-2 and slot.
    offset_e : ndarray of shape (v, u), float64
        Signal in the dark above the black level, electrons.
    full_well_e : float
        Signal at which a pixel clips, electrons after the non-linearity.
    crosstalk : ndarray of shape (v, u, k, k), float32
        Kernel of each panel pixel; each sums to 1.
    veil : float
        Share of the light that is spread evenly.
    """
    read_noise_dn = float(np.hypot(sensor.read_noise_e / sensor.gain_e, 12**-0.5))
    black_dn = sensor.black_dn + offset_e / sensor.gain_e
    # Four sigma below the clip: of saturated pixels one in 30 000 is missed.
    clip_dn = np.minimum(black_dn + full_well_e / sensor.gain_e, sensor.max_dn)
    row, col, valid = picks
    return Calibration(
        source=source,
        slot_s=timing.slot_s,
        slots_per_frame=timing.slots_per_frame,
        coded_slots=coded_slots,
        response=response,
        pick_row=row,
        pick_col=col,
        valid=valid,
        responsivity_dn=(responsivity_e / sensor.gain_e).astype(np.float32),
        black_dn=black_dn.astype(np.float32),
        saturation_dn=(clip_dn - 4 * read_noise_dn).astype(np.float32),
        read_noise_dn=read_noise_dn,
        dn_per_e=1 / sensor.gain_e,
        crosstalk=crosstalk,
        gain_uncertainty=0.0,
        leak_uncertainty=0.0,
        map_residual_px=0.0,
        veil=veil,
    )
