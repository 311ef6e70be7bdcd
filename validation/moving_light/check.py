"""Light that moves before a bright window, instant by instant, against each instant as a still picture."""

from __future__ import annotations

import numpy as np
from scipy.signal import fftconvolve

from optsim.camera.hardware import prototype
from optsim.camera.parts import form_image
from optsim.core.quantities import Block, RadianceVideo, Segment
from optsim.optics import moving_blur
from optsim.optics.aberrations import Wavefront
from optsim.optics.moving_psf import MovingPsf
from optsim.optics.radiometry import MONO_WAVELENGTH_M

CLAIM = (
    "what walks in front of a bright window, and a patch that goes bright and dark, are imaged in every "
    "instant as a still picture of that instant would be: a PSF's middle on fine samples, its rest on panel "
    "pixels, and its far wings along a straight line in time"
)
ORACLE = (
    "each instant as a whole picture, convolved in double precision with a PSF of the check's own: from the "
    "closed form of the transfer function of diffraction and Gaussian, on a grid five times as fine and four "
    "times as wide; numpy and scipy's convolution"
)
SOURCE = (
    "J. W. Goodman, Introduction to Fourier Optics, 3rd ed., section 6.3 (incoherent transfer function of a "
    "circular aperture); Fourier transform of a Gaussian"
)
TOLERANCE = 5e-4
REASON = (
    "The largest deviation of a panel pixel in any instant, in the window's light. Middle and rest of the "
    "PSF add up to the whole within 1e-4 of an edge's height (tests/test_moving_psf.py). Beyond them are "
    "0.35 % of the light, as a straight line in time: a body that covers and uncovers the window is off that "
    "line beside its way by some per cent of them."
)
FILES = (
    "optsim/optics/*.py",
    "optsim/camera/parts/*.py",
    "optsim/core/quantities/*.py",
)

_ROWS, _COLS, _N = 240, 300, 18
_PITCH, _PITCH_M, _SIGMA_M, _WINDOW = 3, 20e-6, 3e-6, 1000.0
_FINER, _HALF, _WIDE = 5, 100, 801  # of the oracle's PSF: parts of a cell, cells to its edge, and of its grid


def _psf(f_number: float, cell_m: float, wavelength_m: float) -> np.ndarray:
    """PSF of a cell's middle, integrated over cells: (2 _HALF + 1)^2. What lies beyond stays in it."""
    frequency = np.fft.fftfreq(_WIDE * _FINER, cell_m / _FINER)
    radius = np.hypot(frequency[:, None], frequency)
    rho = np.minimum(radius * wavelength_m * f_number, 1.0)
    transfer = 2 / np.pi * (np.arccos(rho) - rho * np.sqrt(1 - rho**2))
    # A cell's own variance is taken out of the Gaussian, as the model's docstring says.
    transfer *= np.exp(-2 * np.pi**2 * (_SIGMA_M**2 - cell_m**2 / 12) * radius**2)
    # Integrated over parts of cells, too.
    along = np.sinc(frequency * cell_m / _FINER)
    transfer *= along[:, None] * along
    fine = np.fft.fftshift(np.fft.ifft2(transfer).real)
    cells = fine.reshape(_WIDE, _FINER, _WIDE, _FINER).sum(axis=(1, 3))
    middle = slice(_WIDE // 2 - _HALF, _WIDE // 2 + _HALF + 1)
    kernel = cells[middle, middle]
    return kernel / kernel.sum()


def _scene() -> tuple[np.ndarray, tuple[Block, ...]]:
    """Room, window, a dark textured body that walks across it, and a patch that goes bright and dark."""
    rng = np.random.default_rng(1991)
    base = rng.uniform(0.5, 1, (_ROWS, _COLS)).astype(np.float32)
    base[60:180, 90:240] = _WINDOW
    body, texture = np.zeros((_N, 90, 90), np.float32), rng.uniform(0.1, 0.4, (90, 30))
    for t in range(_N):
        left = 10 + 2 * t
        body[t, :, left : left + 30] = texture - base[75:165, 110 + left : 140 + left]
    flash = np.zeros((_N, 24, 30), np.float32)
    flash += (_WINDOW / 10 * np.sin(np.pi * (np.arange(_N) + 0.5) / _N)).astype(np.float32)[:, None, None]
    return base, (Block(75, 110, body), Block(200, 130, flash))


def _worst() -> float:
    """Largest deviation of a panel pixel in any instant, in the window's light."""
    plain = {
        "glare_share": 0.0,
        "wavefront": Wavefront(),
        "aberration_m": _SIGMA_M,
        "natural_vignetting": False,
    }
    lens = prototype().objective.model_copy(update={**plain, "tail_share": 1e-3})
    base, blocks = _scene()
    video = RadianceVideo(
        rows=_ROWS, cols=_COLS, samples_per_pitch=_PITCH, slot_s=1.0, instants_per_slot=1,
        slots_per_segment=_N, n_slots=_N, load=lambda _: Segment(base, base, blocks, _N), white_w_m2_sr=1.0,
    )  # fmt: skip
    image = form_image(lens, video, _PITCH_M, 1).load(0)
    kernel = _psf(lens.working_f_number, _PITCH_M / _PITCH, MONO_WAVELENGTH_M)
    still = video.load(0)
    deviations: list[float] = []
    for t in range(_N):
        wide = np.pad(still.instant(t).astype(np.float64), _HALF, mode="edge")
        exact = fftconvolve(wide, kernel, mode="valid") * lens.irradiance_per_radiance
        left = (
            (image.instant(t) - exact).reshape(_ROWS // _PITCH, _PITCH, _COLS // _PITCH, _PITCH).mean((1, 3))
        )
        deviations.append(float(left.flat[np.abs(left).argmax()]))
    return max(deviations, key=abs) / (_WINDOW * lens.irradiance_per_radiance)


def measure() -> float:
    """Find the largest deviation, relative to the window's light."""
    return _worst()


def perturbed() -> float:
    """Without what panel pixels collect of the light that moves."""
    whole = moving_blur.divided
    moving_blur.divided = lambda psf, pitch: MovingPsf(whole(psf, pitch).near)
    try:
        return _worst()
    finally:
        moving_blur.divided = whole
