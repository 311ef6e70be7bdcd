"""A flat scene through the objective, against solid angles summed numerically over the exit pupil."""

from __future__ import annotations

import numpy as np

from optsim.camera.parts import Objective, form_image
from optsim.footage.made import still

CLAIM = "irradiance of a flat scene: pi L T sin^2(theta') on axis and cos^4 of the field angle off it"
ORACLE = (
    "projected solid angle of a small disc pupil, summed over 200 000 points of it for every field point, "
    "normalised to the cone's sin^2 on axis; numpy only"
)
SOURCE = "Born and Wolf, Principles of Optics, 7th ed., section 4.8.3"
TOLERANCE = 2e-3
REASON = (
    "The closed form holds for a small pupil: at f/16 and a field of 24 degrees the pupil's size changes "
    "the fall-off by less than 0.1 %; the FFT adds 1e-7."
)
FILES = (
    "optsim/optics/radiometry.py",
    "optsim/optics/psf.py",
    "optsim/camera/parts/objective.py",
    "optsim/camera/parts/image_formation.py",
)

_ROWS, _COLS, _CELL_M = 40, 64, 2e-4
_LENS = Objective(
    focal_length_m=12.5e-3,
    f_number=16.0,
    magnification=1.0,
    transmission=0.8,
    glare_share=0.0,
    tail_share=0.05,
)
_RADIANCE = 3.0


def measure() -> float:
    return _deviation(_LENS)


def perturbed() -> float:
    """Without the fall-off."""
    return _deviation(_LENS.model_copy(update={"natural_vignetting": False}))


def _deviation(lens: Objective) -> float:
    scene = still(np.full((_ROWS, _COLS), _RADIANCE, np.float32), n_slots=1, slot_s=1.0)
    image = form_image(lens, scene, _CELL_M, 1).load(0).start.astype(np.float64)
    relative = image / _oracle() - 1
    return float(relative.flat[np.abs(relative).argmax()])


def _oracle() -> np.ndarray:
    """Integrate L T cos^2 / r^2 over the pupil; the disc's radius is set by sin(theta') = 1 / (2 N)."""
    distance, f_number = 12.5e-3, 16.0
    radius = distance * np.tan(np.arcsin(1 / (2 * f_number)))
    n = 200_000
    k = np.arange(n) + 0.5
    r, phi = radius * np.sqrt(k / n), k * np.pi * (3 - np.sqrt(5))  # equal areas on a sunflower
    px, py = r * np.cos(phi), r * np.sin(phi)
    area = np.pi * radius**2 / n
    out = np.empty((_ROWS, _COLS))
    for i in range(_ROWS // 2):
        y = (i + 0.5 - _ROWS / 2) * _CELL_M
        for j in range(_COLS // 2):
            x = (j + 0.5 - _COLS / 2) * _CELL_M
            square = distance**2 + (px - x) ** 2 + (py - y) ** 2
            # cos at the image times cos at the pupil over distance squared: d^2 / r^4.
            value = _RADIANCE * 0.8 * (distance**2 / square**2).sum() * area
            out[i, j] = out[-1 - i, j] = out[i, -1 - j] = out[-1 - i, -1 - j] = value
    return out
