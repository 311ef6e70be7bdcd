"""Holoeye LC-R 720, the panel of the paper's prototype (nematic, field-sequential, 180 patterns a second)."""

from __future__ import annotations

from optsim.camera.parts import Modulator


def lcr720() -> Modulator:
    """Panel with a source beside each number; its own data sheet was not at hand."""
    return Modulator(
        # Set-up note on Li et al., Optica 5(7) 803 (2018), which used this panel.
        pitch_m=20e-6,
        rows=768,
        cols=1280,
        # Nagahara et al., "Space-Time-Brightness Sampling Using an Adaptive Pixel-Wise Coded Exposure".
        field_rate_hz=180.0,
        # Set-up note on Li et al. (2018): fill factor 92 %, reflectivity about 70 % in the visible, taken to
        # be that of the whole cell, gaps included (the note doesn't say).
        mirror_reflectivity=0.70 / 0.92,
        fill_factor=0.92,
        # No source: half a percent of the area as bright as aluminium.
        gap_reflectivity=0.05,
        # No source for the split. The set-up note on Li et al. (2018) says "< 3 ms" without defining it;
        # 10-90 % times of 2.2 tau, rise and fall together, are then 3.3 ms.
        tau_on_s=0.5e-3,
        tau_off_s=1.0e-3,
        # No source: the set-up note's phase range of about pi in the visible says as much, not where.
        half_wave_m=550e-9,
        # No source: no measured grey curve was found.
        drive_exponent=1.2,
        # No source for the next four. Fields that differ by 1 %, a polarity that is 1 % off balance, rows
        # written at once (what the panel really does was not found), and a border between black and white
        # that takes 0.2 pixels or 4 um, one or two cell gaps, from 10 to 90 %.
        field_drive=(1.01, 1.0, 0.99),
        polarity_drive=0.01,
        scan_s=0.0,
        fringing_px=0.12,
        # No source: chosen so that the nominal system contrast comes out at 100. Other panels reach 10 %
        # (Opt. Express 16(3) 1669 and 1965, 2008).
        depolarised_share=0.0137,
        # No source for either; sensible defaults.
        nonuniformity_rms=0.02,
        stuck_share=1e-5,
    )
