"""Joules from the modulator to the CCD, against Jones vectors and a rectangle on a piece of paper."""

from __future__ import annotations

import numpy as np

from optsim.camera.hardware import demo
from optsim.core.quantities import ExposureCode, PanelState
from optsim.footage.made import still

CLAIM = (
    "a bright rectangle on the modulator arrives on the CCD with its energy x transmissions x quantum "
    "efficiency, all-on and all-off alike"
)
ORACLE = (
    "energy of the rectangle from area x irradiance x time; polarised transmissions from incoherent sums "
    "over Jones vectors (p and s, and their depolarised halves); photons from Planck's constant; numpy only"
)
SOURCE = "R. C. Jones, J. Opt. Soc. Am. 31(7) 488 (1941); conservation of energy"
TOLERANCE = 1e-4
REASON = (
    "Float32 weights and operator entries; the rectangle is so far from the border that no wing leaves "
    "the CCD."
)
FILES = (
    "optsim/camera/camera.py",
    "optsim/optics/*.py",
    "optsim/camera/parts/*.py",
    "optsim/camera/parts/*.py",
    "optsim/camera/hardware/*.py",
)

_RADIANCE = 2.0


def measure() -> float:
    return _worst(1.0)


def perturbed() -> float:
    """With a relay that passes 2 % more than it is said to."""
    return _worst(1.02)


def _worst(broken: float) -> float:
    return max((_deviation(level, broken) for level in (255, 0)), key=abs)


def _deviation(level: int, broken: float) -> float:
    camera = demo()
    sensor = camera.sensor.model_copy(update={"prnu": 0.0, "dark_current_e_s": 0.0})
    even = {"nonuniformity_rms": 0.0, "stuck_share": 0.0, "field_drive": (1.0,) * 3, "polarity_drive": 0.0}
    modulator = camera.modulator.model_copy(update=even)
    relay = camera.relay.model_copy(update={"transmission": camera.relay.transmission * broken})
    # What an objective keeps along a ray is radiance; energy only as far as its PSF does not vary.
    even = {"natural_vignetting": False, "glare_share": 0.0, "field_error": 1.0}
    lens = camera.objective.model_copy(update=even)
    camera = camera.model_copy(
        update={"sensor": sensor, "modulator": modulator, "relay": relay, "objective": lens}
    )
    picture = np.zeros((360, 480), np.float32)
    picture[150:210, 180:300] = _RADIANCE  # 60 x 120 fine cells = 20 x 40 panel pixels
    light = camera.form_image(still(picture, n_slots=36, slot_s=1 / 180, samples_per_pitch=3))
    shown = ExposureCode(np.full((36, 120, 160), level, np.uint8), np.zeros((120, 160), np.bool_))
    gamma = np.float32(np.pi if level else 0.0)
    panel = PanelState(np.full((120, 160), gamma, np.float32), np.full((120, 160), level, np.uint8))
    collected = camera.expected_electrons(light, 0, shown, panel)[0].sum()
    return float(collected / _oracle(on=level > 0) - 1)


def _oracle(*, on: bool) -> float:
    irradiance = np.pi * _RADIANCE * 0.9 / (4 * 6.0**2)
    area_m2 = (20 * 20e-6) * (40 * 20e-6)
    joules = irradiance * area_m2 * 36 / 180
    total = 0.0
    for amplitude in (np.array([1.0, 0.0]), np.array([0.0, 1.0])):  # unpolarised: half p, half s
        before = np.sqrt([0.95 * 0.9, 0.001 * 0.9 / 1000]) * amplitude
        turn = np.array([[0, 1], [1, 0]]) if on else np.eye(2)  # half-wave at 45 degrees, or nothing
        after = turn @ before
        analyser = np.array([0.03 * 0.9 / 1000, 0.99 * 0.9]) * 0.97  # powers of p and s
        kept = (analyser * after**2).sum()
        lost = analyser.mean() * (before**2).sum()  # depolarised: half p, half s
        total += 0.5 * 0.70 * ((1 - 0.0137) * kept + 0.0137 * lost)
        total += 0.5 * 0.08 * 0.05 * lost  # gaps between the mirrors: unpolarised
    photon_j = 6.62607015e-34 * 299792458.0 / 550e-9
    return joules * total * 0.92 / photon_j * 0.663
