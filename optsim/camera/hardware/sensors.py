"""Image sensors, with a source beside each number."""

from __future__ import annotations

from optsim.camera.parts import Ccd

# Quantum efficiency over that at 550 nm. No source for the shape: no curve of either chip was found in print;
# a sensible default for silicon behind micro-lenses.
_INTERLINE = tuple(
    (nm / 1e9, relative / 0.99)
    for nm, relative in (
        (400, 0.72),
        (450, 0.95),
        (500, 1.03),
        (525, 1.0),
        (550, 0.99),
        (600, 0.90),
        (650, 0.76),
        (700, 0.60),
        (750, 0.44),
        (800, 0.31),
        (850, 0.20),
        (900, 0.13),
        (1000, 0.04),
    )
)


def icx674() -> Ccd:
    """Point Grey GS3-U3-28S5M (Sony ICX674, interline), the coded camera of the prototype, 14 bit."""
    return Ccd(
        # Point Grey camera table of an exposure-time calculator (AudeLA): 1920 x 1440, 4.54 um.
        rows=1440,
        cols=1920,
        pitch_m=4.54e-6,
        # Point Grey camera table (AudeLA): 0.67 at 525 nm; times 0.99 to 550 nm (no source for the shape of
        # the curve).
        quantum_efficiency=0.663,
        spectral_response=_INTERLINE,
        # Published Mitsuba-based simulation of the ICX674. The camera table's 14 693 e- is the EMVA
        # saturation capacity, the peak of the variance, a little below.
        full_well_e=15770.0,
        # Point Grey camera table (AudeLA).
        read_noise_e=9.39,
        dark_current_e_s=1.27,
        # No source for either; sensible defaults.
        prnu=0.008,
        dsnu_e=1.5,
        # Point Grey camera table (AudeLA): 0.24 e- per 16-bit number, so 0.96 at 14 bit.
        gain_e=0.96,
        bits=14,
        # No source; the clamp can be set from 0 to 1023 (Grasshopper3 Technical Reference, "ADC").
        black_dn=64.0,
        # No source; at most 1 % up to 80 % of the well, 3 % at the well. It moves the peak of the variance to
        # 0.87 of the well, so that EMVA's evaluation finds a saturation capacity of 14.0 ke- (within 3 %,
        # validation/emva1288); the table's 14 693 e- would ask for a bend of 2.3 %.
        bend_at_full_well=0.03,
        # Read-out table of beam-line software for this camera model.
        readout_s=39.1e-3,
        readout_rows=1440,
        # No source; interline shields of about 0.1 % (ccd-sensor.de, "Smear").
        smear_share=1e-3,
    )


def imx174() -> Ccd:
    """Point Grey GS3-U3-23S6 (Sony IMX174, global-shutter CMOS), the paper's ground truth, mono, 12 bit."""
    return Ccd(
        # Data of the same pixel in matrix-vision's mvBlueFOX3 manual (IMX249): 1920 x 1200, 5.86 um.
        rows=1200,
        cols=1920,
        pitch_m=5.86e-6,
        # Point Grey's figure at 525 nm, not seen in print; 550 nm taken as equal.
        quantum_efficiency=0.76,
        # No source: no curve of it was found; taken as that of the CCD.
        spectral_response=_INTERLINE,
        # From the same manual's SNR of 45.1 dB and dynamic range of 73 dB.
        full_well_e=32400.0,
        read_noise_e=7.2,
        # No source from here to dsnu_e; sensible defaults.
        dark_current_e_s=1.0,
        prnu=0.008,
        dsnu_e=1.5,
        # Full well over the range of 12 bit.
        gain_e=8.0,
        bits=12,
        # No source for either; sensible defaults.
        black_dn=16.0,
        bend_at_full_well=0.01,
        # Read-out table of beam-line software for this camera model, Mono16.
        readout_s=12.2e-3,
        readout_rows=1200,
    )
