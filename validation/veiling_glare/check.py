"""Light in a black patch of a bright field, as ISO 9358 measures veiling glare."""

from __future__ import annotations

import numpy as np

from optsim.camera.hardware import demo
from optsim.core.quantities import ExposureCode
from optsim.footage.made import still

CLAIM = "a black patch in a bright field shows the stated share of the field's mean, for each lens group"
ORACLE = (
    "share x mean of the field with the patch left out by its area, over the brightness beside the patch; "
    "the lenses otherwise perfect; arithmetic only"
)
SOURCE = "ISO 9358:1994, veiling glare of image forming systems (black patch method)"
TOLERANCE = 1e-4
REASON = "Float32 images and operator entries."
FILES = ("optsim/optics/relay.py", "optsim/camera/parts/*.py")

_SHARES = (0.012, 0.007)


def _worst(scale: float) -> float:
    """Deviation of the glare index, relative, for objective and relay."""
    camera = demo()
    even = {
        "nonuniformity_rms": 0.0,
        "stuck_share": 0.0,
        "tau_on_s": 0.0,
        "tau_off_s": 0.0,
        "fringing_px": 0.0,
    }
    sensor = camera.sensor.model_copy(update={"rows": 360, "cols": 480, "prnu": 0.0, "dark_current_e_s": 0.0})
    perfect = {"aberration_m": 0.0, "diffraction": False}
    deviations: list[float] = []
    for objective_share, relay_share in ((_SHARES[0], 0.0), (0.0, _SHARES[1])):
        lens = perfect | {"natural_vignetting": False, "glare_share": scale * objective_share}
        relay = perfect | {"ghost_share": 0.0, "distortion": 0.0, "glare_share": scale * relay_share}
        built = camera.model_copy(
            update={
                "objective": camera.objective.model_copy(update=lens),
                "relay": camera.relay.model_copy(update=relay),
                "modulator": camera.modulator.model_copy(update=even),
                "sensor": sensor,
            }
        )
        picture = np.ones((360, 480), np.float32)
        picture[120:240, 150:330] = 0
        light = built.form_image(still(picture, n_slots=36, slot_s=built.slot_s, samples_per_pitch=3))
        code = ExposureCode(np.full((36, 120, 160), 255, np.uint8), np.zeros((120, 160), np.bool_))
        seen, _ = built.expected_electrons(light, 0, code, None)
        found = seen[180, 240] / seen[20, 240]
        share = objective_share + relay_share
        mean = 1 - 120 * 180 / (360 * 480)
        expected = share * mean / (1 - share + share * mean)
        deviations.append(float(found / expected - 1))
    return max(deviations, key=abs)


def measure() -> float:
    """Find the largest relative deviation of the glare index."""
    return _worst(1.0)


def perturbed() -> float:
    """With a tenth more glare."""
    return _worst(1.1)
