"""Lit panel pixels through the prototype in blue, green and red light: where they land on the CCD."""

from __future__ import annotations

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import with_effects
from optsim.camera.hardware import prototype
from optsim.core.quantities import Doubles, ExposureCode
from optsim.footage.made import still

CLAIM = (
    "the relay's image of the panel grows evenly with wavelength about its centre, from 450 to 650 nm by "
    "what is stated, and is as large as the magnification says in 550 nm"
)
ORACLE = (
    "a panel pixel's square by magnification and pitches, clipped by CCD pixels, and the centroid of what "
    "each gets; numpy only"
)
SOURCE = "definition of lateral colour (W. J. Smith, Modern Optical Engineering, 4th ed., ch. 5)"
TOLERANCE = 2e-6
REASON = "Float32 entries and energies: 6e-8 of lever arms of three pixels, over four pixels along each axis."
FILES = (
    "optsim/camera/camera.py",
    "optsim/optics/relay.py",
    "optsim/camera/parts/relay.py",
    "optsim/camera/hardware/cameras.py",
)

_GROWTH, _RATIO = 3.9e-4, 2.88
_ROWS, _COLS, _CCD_ROWS, _CCD_COLS = 500, 600, 1440, 1920
_AT_V, _AT_U = np.array([2, 110, 251, 377, 497]), np.array([1, 140, 300, 433, 598])
_NM = (450.0, 500.0, 550.0, 586.0, 650.0)
_REACH = 3


def measure() -> float:
    """Find the largest deviation of a centroid, CCD pixels."""
    return _worst(_GROWTH)


def perturbed() -> float:
    """With an image that is larger in blue than in red: the wrong sign."""
    return _worst(-_GROWTH)


def _worst(growth: float) -> float:
    # Sharp and without anything that tells places or colours apart, but for the relay's scale.
    camera = with_effects(prototype(), {"all": "ideal", "lateral_colour": "nominal"})
    relay = camera.relay.model_copy(update={"lateral_colour": growth})
    camera = camera.model_copy(update={"relay": relay, "slots_per_frame": 1})
    worst = 0.0
    for nm in _NM:
        frame = _frame(camera.model_copy(update={"wavelength_m": nm * 1e-9}))
        scale = _RATIO * (1 + _GROWTH * (nm - 550) / 200)
        for v in _AT_V:
            for u in _AT_U:
                y, x = (v + 0.5 - _ROWS / 2) * scale, (u + 0.5 - _COLS / 2) * scale
                places = y + _CCD_ROWS / 2, x + _CCD_COLS / 2
                found = _centroid(frame, *(int(place) for place in places))
                expected = [_clipped(place, scale) for place in places]
                worst = max(worst, *(a - b for a, b in zip(found, expected, strict=True)), key=abs)
    return worst


def _frame(camera: CodedCamera) -> Doubles:
    """Electrons with some panel pixels lit by the scene, all of them on."""
    lit = np.zeros((_ROWS, _COLS), np.float32)
    lit[np.ix_(_AT_V, _AT_U)] = 1.0
    scene = still(lit.repeat(3, 0).repeat(3, 1), n_slots=1, slot_s=camera.slot_s, samples_per_pitch=3)
    code = ExposureCode(np.full((1, _ROWS, _COLS), 255, np.uint8), np.zeros((_ROWS, _COLS), np.bool_))
    return camera.expected_electrons(camera.form_image(scene), 0, code, None)[0]


def _centroid(frame: Doubles, row: int, col: int) -> tuple[float, float]:
    top, left = max(row - _REACH, 0), max(col - _REACH, 0)
    window = frame[top : row + _REACH + 1, left : col + _REACH + 1]
    y, x = (np.arange(n) + first + 0.5 for n, first in zip(window.shape, (top, left), strict=True))
    return float(y @ window.sum(1) / window.sum()), float(x @ window.sum(0) / window.sum())


def _clipped(place: float, side: float) -> float:
    """Centroid along an axis of an even stretch around a place, as pixels see it."""
    pixel = np.arange(int(place) - 5, int(place) + 6)
    share = np.clip(np.minimum(pixel + 1, place + side / 2) - np.maximum(pixel, place - side / 2), 0, 1)
    return float(share @ (pixel + 0.5) / share.sum())
