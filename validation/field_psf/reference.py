"""Compute a point spread function with prysm: a wavefront in, cells out.

A program for the environment of validation/environments.py, not for optsim's: ``python reference.py JOB
RESULT``. Zernike polynomials, pupil, propagation and the formula of defocus are the library's, used through
its public functions.
"""

from __future__ import annotations

import json
import sys

import numpy as np
from prysm.coordinates import cart_to_polar, make_xy_grid
from prysm.geometry import circle
from prysm.polynomials import noll_to_nm, zernike_nm
from prysm.propagation import Wavefront
from prysm.thinlens import image_displacement_to_defocus
from scipy.ndimage import gaussian_filter

# Across the pupil: the field repeats after this many wavelengths times f-number, beyond every window here.
_PUPIL = 1024
_PARTS = 9  # of a cell, along each side
_DIAMETER_MM = 10.0


def main(job: str, result: str) -> None:
    """Write the PSF of a job over its cells; the whole plane's sum is 1."""
    with open(job) as file:
        np.save(result, _cells(**json.load(file)))


def _cells(
    noll: dict[str, float],
    f_number: float,
    wavelength_m: float,
    defocus_m: float,
    sigma_m: float,
    cell_m: float,
    half: int,
) -> np.ndarray:
    x, y = make_xy_grid(_PUPIL, diameter=2)
    radius, angle = cart_to_polar(x, y)
    inside = circle(1, radius)
    waves = image_displacement_to_defocus(defocus_m, f_number, wavelength_m) * radius**2
    for index, rms_waves in noll.items():
        waves = waves + rms_waves * zernike_nm(*noll_to_nm(int(index)), radius, angle, norm=True)
    waves = waves - _tilt(waves, x, y, inside)
    wavelength_um = wavelength_m * 1e6
    pupil = Wavefront.from_amp_and_phase(
        inside.astype(float), waves * wavelength_um * 1e3, wavelength_um, _DIAMETER_MM / _PUPIL
    )
    step_um = cell_m * 1e6 / _PARTS
    side = 2 * half + 1
    image = pupil.focus_fixed_sampling(_DIAMETER_MM * f_number, step_um, side * _PARTS)
    light = np.abs(image.data) ** 2 / inside.sum()
    if sigma_m:
        light = gaussian_filter(light, sigma_m * 1e6 / step_um, mode="constant")
    return light.reshape(side, _PARTS, side, _PARTS).sum(axis=(1, 3))


def _tilt(waves: np.ndarray, x: np.ndarray, y: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Plane with the wavefront's mean slope over the pupil, which is where the PSF's centroid lies."""
    slope_y, slope_x = np.gradient(waves, y[:, 0], x[0])
    return slope_y[inside].mean() * y + slope_x[inside].mean() * x


if __name__ == "__main__":
    main(*sys.argv[1:])
