"""Sine patterns through objective and relay, and the wings of a point, against closed forms."""

from __future__ import annotations

import numpy as np
from scipy.special import j0, j1

from optsim.camera.hardware import prototype
from optsim.camera.parts import form_image
from optsim.footage.made import still
from optsim.optics.aberrations import Wavefront
from optsim.optics.psf import psf_kernel

CLAIM = (
    "a sine pattern keeps the contrast that diffraction at a circular aperture and Gaussian aberrations "
    "leave it, up to the panel's limit of half a cycle a pixel, through the objective and through the relay; "
    "rings around a point get their share of an Airy pattern as far out as 1e-4 of its light is beyond"
)
ORACLE = (
    "closed forms of both transfer functions and of the mean over a fine cell; contrast by a fit of sine and "
    "cosine in the middle of the image; encircled energy of an Airy pattern; numpy, scipy's Bessel functions"
)
SOURCE = (
    "J. W. Goodman, Introduction to Fourier Optics, 3rd ed., section 6.3 (incoherent transfer function of a "
    "circular aperture); Fourier transform of a Gaussian; Born and Wolf, Principles of Optics, 7th ed., "
    "8.5.2 (encircled energy, 1 - J0^2 - J1^2)"
)
TOLERANCE = 0.025
REASON = (
    "Cells of a third of a pixel send their light from their centres: at half a cycle a pixel the replica "
    "beyond a cycle a cell passes the lens with 1.8 %. Taking a cell's variance out of the Gaussian is "
    "right to 0.05 % there, and 0.1 % of wings is put back. A sharper lens lets more of the replica pass: "
    "5.7 % with 2 um. Rings, relative to their own light: the mean over an Airy pattern's rings comes "
    "within 2 % of them."
)
FILES = ("optsim/optics/psf.py", "optsim/camera/parts/*.py")

_PITCH_M, _WAVELENGTH_M, _SIGMA_M = 20e-6, 550e-9, 3e-6
_CYCLES = (0.05, 0.1, 0.25, 0.4, 0.5)  # a panel pixel
_RINGS = (16, 24, 40, 100, 300, 900)  # cells from the point: where the transform still rules, and beyond


def _transfer(frequency: float, f_number: float, sigma_m: float) -> float:
    """Contrast left at a frequency in cycles a metre."""
    rho = frequency * _WAVELENGTH_M * f_number
    diffraction = 2 / np.pi * (np.arccos(rho) - rho * np.sqrt(1 - rho**2))
    return float(diffraction * np.exp(-2 * (np.pi * sigma_m * frequency) ** 2))


def _contrast(line: np.ndarray, radians: np.ndarray) -> float:
    """Amplitude over mean of a sine of known frequency."""
    waves = np.stack([np.ones_like(radians), np.sin(radians), np.cos(radians)], axis=1)
    mean, sine, cosine = np.linalg.lstsq(waves, line, rcond=None)[0]
    return float(np.hypot(sine, cosine) / mean)


def _worst(sigma_scale: float) -> float:
    camera = prototype()
    # Without a wavefront error, which has no closed form: that is validated in field_psf.
    plain = {"glare_share": 0.0, "wavefront": Wavefront(), "aberration_m": _SIGMA_M}
    lens = camera.objective.model_copy(update={**plain, "natural_vignetting": False})
    blurred = lens.model_copy(update={"aberration_m": sigma_scale * _SIGMA_M})
    sharp = camera.relay.model_copy(update={**plain, "ghost_share": 0.0})
    relay = sharp.model_copy(update={"aberration_m": sigma_scale * _SIGMA_M})
    built = camera.model_copy(update={"relay": relay, "panel_rows": 200, "panel_cols": 240})
    on_ccd = camera.relay.magnification
    relay_f_number = max(camera.relay.f_number, 6.0 * on_ccd)
    middle = np.s_[300, 180:540]
    deviations: list[float] = []
    for cycles in _CYCLES:
        radians = 2 * np.pi * cycles / 3 * (np.arange(720) + 0.5)
        picture = np.broadcast_to(1 + 0.9 * np.sin(radians), (600, 720)).astype(np.float32)
        scene = still(picture, n_slots=1, slot_s=1.0, samples_per_pitch=3)
        image = form_image(blurred, scene, _PITCH_M, 1).load(0).start.astype(float)
        expected = 0.9 * _transfer(cycles / _PITCH_M, 6.0, _SIGMA_M)
        deviations.append(_contrast(image[middle], radians[180:540]) / expected - 1)
        image = built.relay_operator().blur.apply(picture)
        frequency = cycles / (_PITCH_M * on_ccd)
        expected = 0.9 * _transfer(frequency, relay_f_number, _SIGMA_M)
        deviations.append(_contrast(image[middle], radians[180:540]) / expected - 1)
    return float(max(deviations, key=abs))


def _worst_ring(f_number: float) -> float:
    """Largest relative deviation of a ring's light from an Airy pattern's at f/6."""
    cell_m = _PITCH_M / 3
    kernel = psf_kernel(f_number, 2e-6, cell_m, _WAVELENGTH_M, 1e-4)
    half = len(kernel) // 2
    place = np.arange(-half, half + 1)
    radius = np.hypot(place[:, None], place)
    # Cells on a circle count by the share of them that is inside, as if it were straight there.
    within = [(kernel * np.clip(edge - radius + 0.5, 0, 1)).sum() for edge in _RINGS]
    v = np.pi * np.array(_RINGS) * cell_m / (_WAVELENGTH_M * 6.0)
    deviations = np.diff(within) / np.diff(-(j0(v) ** 2) - j1(v) ** 2) - 1
    return float(max(deviations, key=abs))


def measure() -> float:
    """Find the largest relative deviation of a contrast, or of a ring's light."""
    return max(_worst(1.0), _worst_ring(6.0), key=abs)


def perturbed() -> float:
    """With aberrations a fifth larger."""
    return _worst(1.2)
