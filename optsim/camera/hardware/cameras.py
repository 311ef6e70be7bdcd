"""Whole cameras: the paper's prototype as far as it is known, and a small one for demonstrations."""

from __future__ import annotations

from optsim.camera.camera import CodedCamera
from optsim.camera.hardware.lcr720 import lcr720
from optsim.camera.hardware.sensors import icx674
from optsim.camera.parts import Objective, Relay, Splitter
from optsim.optics.aberrations import Wavefront

# No source: 0.07 waves rms is the limit of what counts as diffraction-limited (Marechal), for the axis; with
# the others 0.25 waves at the corner, as achromats used off axis have, shared out evenly.
_ACHROMATS = Wavefront(spherical_waves=0.07, coma_waves=0.139, astigmatism_waves=0.139, curvature_waves=0.139)


def prototype_relay() -> Relay:
    """Relay of the prototype: the paper says three lenses and a splitter, and gives no numbers."""
    return Relay(
        # The paper's "three times" does not fit 500 rows on 1440: 2.88 = 1440 / 500 does, without margin.
        magnification=2.88 * 4.54 / 20,
        # No source; just fast enough for the cone of an f/4 objective (f/6 on the panel).
        f_number=3.9,
        # No source; four passes through coated lenses.
        transmission=0.92,
        # No source: what is left in the middle of usual achromats.
        aberration_m=2e-6,
        wavefront=_ACHROMATS,
        # As a builder would, by dots all over the field: 18 um before the sharp image of a curved field.
        focus="field",
        # No source for the next three; sensible defaults for coated achromats and a cube.
        glare_share=0.0025,
        ghost_share=0.002,
        # 0.3 % at the corners, which the calibrated map takes out.
        distortion=-0.003,
        # No source: 2 um at the corners, 5.1 mm from the middle, from 450 to 650 nm.
        lateral_colour=3.9e-4,
    )


def _objective(focal_length_m: float) -> Objective:
    """Objective of the prototype; no lens data was found, so it has the relay's aberrations."""
    return Objective(
        # Tokina, f = 12.5 mm (the paper); its f-number is not given, f/4 is a sensible default. 1.5 is a
        # design choice (no source) that gives a field of 35.5 x 30 degrees.
        focal_length_m=focal_length_m,
        f_number=4.0,
        magnification=1.5,
        # No source: taken to be those of the relay.
        aberration_m=2e-6,
        wavefront=_ACHROMATS,
        # No source: a barrel of 1 % in the corners is usual for C-mount lenses of this focal length.
        distortion=-0.01,
    )


def prototype() -> CodedCamera:
    """Camera of Nagahara et al.: 600 x 500 panel pixels, 36 slots at 180 Hz, 5 frames a second."""
    return CodedCamera(
        objective=_objective(12.5e-3),
        splitter=Splitter(),
        modulator=lcr720(),
        relay=prototype_relay(),
        sensor=icx674(),
        # Nagahara et al., "Space-Time-Brightness Sampling Using an Adaptive Pixel-Wise Coded Exposure": 500
        # x 600 pixels at 180 Hz, 36 fields a frame, masks three frames late.
        panel_rows=500,
        panel_cols=600,
        slots_per_frame=36,
        latency_frames=3,
    )


def demo() -> CodedCamera:
    """Return a hypothetical small camera: 160 x 120 panel pixels at exactly 3 CCD pixels each.

    The lens does not exist. Its focal length shrinks with the panel, so the horizontal field stays at the
    prototype's 35.5 degrees. Its aperture shrinks too, which increases its depth of field. The CCD reads a
    region of interest with a margin of 4 pixels.
    """
    full = prototype()
    return full.model_copy(
        update={
            "objective": _objective(12.5e-3 * 160 / 600),
            "relay": full.relay.model_copy(update={"magnification": 3 * 4.54 / 20}),
            "sensor": full.sensor.model_copy(update={"rows": 120 * 3 + 8, "cols": 160 * 3 + 8}),
            "panel_rows": 120,
            "panel_cols": 160,
        }
    )
