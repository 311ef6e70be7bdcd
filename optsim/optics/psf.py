# pyright: reportMissingTypeStubs=false
"""Field-constant point spread functions on the fine grid, and their application by FFT.

A kernel is diffraction at a circular aperture, convolved with a Gaussian for the aberrations and integrated
over a cell. Every cell emits its light from its centre. The transfer function is the product of the three
closed forms (J. W. Goodman, *Introduction to Fourier Optics*, 3rd ed., Roberts 2005, section 6.3, for the
diffraction-limited incoherent one). Far from the centre a sampled transfer function would be aliased. There
the kernel is the mean over the rings of an Airy pattern, lambda N / (pi^3 r^3) an area (from Born and Wolf,
8.5.2, encircled energy). The energy beyond the window, a stated share, is added to the central cell, and the
kernel sums to 1.

Integrating over a cell of side h adds h^2/12 to the variance. It is subtracted from the Gaussian's, so second
moments are exact wherever sigma >= h/sqrt(12). Below that the blur is too large by the difference.

Not modelled here: variation over the field, coma and astigmatism (:mod:`optsim.optics.aberrations`), colour.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft as _scipy_fft
from scipy.special import j1, ndtr

from optsim.core.quantities import Doubles
from optsim.core.threads import n_threads

fft: Any = _scipy_fft  # comes without types
_GAUSSIAN_REACH = 5.0  # sigmas: 3e-7 of the energy lies beyond
# Cells and rings from the centre beyond which the mean over an Airy pattern's rings is right to 2 %.
_NEAR_CELLS, _NEAR_SPREADS = 24, 8
# Below this wavelength times f-number, in cells, all those rings lie in the central cell.
_POINT_SPREAD = 0.5 / _NEAR_SPREADS


def diffraction_mtf(frequency: Doubles, cutoff: float) -> Doubles:
    """Incoherent transfer function of a circular aperture without aberrations (Goodman, section 6.3)."""
    rho = np.minimum(np.abs(frequency) / cutoff, 1.0)
    return (2 / np.pi) * (np.arccos(rho) - rho * np.sqrt(1 - rho**2))


def kernel_half_width(wavelength_m: float, f_number: float, cell_m: float, tail_share: float) -> int:
    """Half width in cells of a window that misses at most ``tail_share`` of an Airy pattern."""
    return max(2, int(np.ceil(share_beyond(wavelength_m, f_number, cell_m) / tail_share)))


def share_beyond(wavelength_m: float, f_number: float, radius_m: float) -> float:
    """Share of an Airy pattern's energy beyond a large radius, about 2 lambda N / (pi^2 r).

    From M. Born and E. Wolf, Principles of Optics, 8.5.2.
    """
    return 2 * wavelength_m * f_number / (np.pi**2 * radius_m)


def psf_kernel(
    f_number: float,
    sigma_m: float,
    cell_m: float,
    wavelength_m: float,
    tail_share: float,
    *,
    disc_m: float = 0.0,
    diffraction: bool = True,
) -> Doubles:
    """Kernel of diffraction and aberrations on a grid of square cells.

    Parameters
    ----------
    f_number : float
        Working f-number of the cone that lands on the grid.
    sigma_m : float
        Standard deviation of the aberrations' Gaussian along each axis, m.
    cell_m : float
        Side of a cell in the plane where f-number and sigma hold, m.
    wavelength_m : float
        Wavelength, m.
    tail_share : float
        Share of the energy that may lie outside the window; it is added to the central cell.
    disc_m : float
        Diameter of the disc of confusion of geometrical optics, for a plane out of focus, m.
    diffraction : bool
        False gives Gaussian and disc only.

    Returns
    -------
    ndarray of shape (2 h + 1, 2 h + 1), float64
        Not negative, symmetric, sums to 1.
    """
    variance = max((sigma_m / cell_m) ** 2 - 1 / 12, 0.0)
    if not diffraction:
        # The variance of a disc along each axis is a sixteenth of its squared diameter.
        return _gaussian_kernel(np.sqrt(variance + (disc_m / cell_m) ** 2 / 16))
    spread = wavelength_m * f_number / cell_m
    half = kernel_half_width(wavelength_m, f_number, cell_m, tail_share) + int(np.ceil(disc_m / cell_m / 2))
    if spread <= _POINT_SPREAD and not variance and not disc_m:
        return _point_kernel(spread, half)
    # The rings' mean is used beyond this: far from disc and Gaussian, and many rings from the centre.
    near = int(np.ceil(max(_NEAR_CELLS, _NEAR_SPREADS * spread, 2 * disc_m / cell_m + 8 * sigma_m / cell_m)))
    # Four times as wide, so that aliasing stays small beside the tails within the used part. It is 1 % of the
    # ring from 16 to 24 cells; twice as wide would leave 8 %.
    wide = 4 * near
    middle = _middle(wide, rounded(spread), rounded(variance), rounded(disc_m / cell_m))
    place = np.arange(-half, half + 1)
    square = place[:, None] ** 2 + place**2
    kernel = spread / np.pi**3 / np.maximum(square, 1) ** 1.5
    reach = min(half, near)
    inner, own = slice(half - reach, half + reach + 1), slice(wide - reach, wide + reach + 1)
    close = square[inner, inner] <= near**2
    kernel[inner, inner] = np.where(close, middle[own, own], kernel[inner, inner])
    within = square <= near**2
    kernel[within] *= (1 - kernel[~within].sum()) / kernel[within].sum()
    return kernel


def _point_kernel(spread: float, half: int) -> Doubles:
    """Kernel of an Airy pattern far smaller than a cell: the rings' mean, integrated over cells."""
    edges = np.arange(-half, half + 2) - 0.5
    # The integral of r^-3 over a rectangle is the difference of -r / (x y) between its corners.
    corners = -np.hypot(edges[:, None], edges) / np.outer(edges, edges)
    kernel = spread / np.pi**3 * np.diff(np.diff(corners, axis=0), axis=1)
    kernel[half, half] = 0
    kernel[half, half] = 1 - kernel.sum()
    return kernel


def rounded(number: float) -> float:
    """Round to twelve digits, so that equal numbers have the same key in a cache."""
    return float(f"{number:.12g}")


# Cached: it does not depend on the extent of the tails.
@lru_cache(maxsize=16)
def _middle(half: int, spread: float, variance: float, disc: float) -> Doubles:
    """Kernel by its transfer function, lengths in cells; its tails are aliased."""
    cutoff = 1 / spread  # cycles a cell, like all frequencies here
    size = 2 * half + 1
    # The transfer function is even along both axes: a quarter of it suffices.
    base = np.arange(half + 1) / size
    reach = int(np.ceil(cutoff + 0.5))
    folds = [base + fold for fold in range(-reach, reach + 1)]
    lines = [np.exp(-2 * np.pi**2 * variance * f**2) * np.sinc(f) for f in folds]
    quarter = np.zeros((half + 1, half + 1))
    for (fy, line_y), (fx, line_x) in combinations_with_replacement(zip(folds, lines, strict=True), 2):
        if np.hypot(np.abs(fy).min(), np.abs(fx).min()) >= cutoff:
            continue
        frequency = np.hypot(fy[:, None], fx)
        part = diffraction_mtf(frequency, cutoff) * line_y[:, None] * line_x
        if disc:
            part *= _disc_transfer(frequency * disc)
        # It is symmetric about the diagonal, too.
        quarter += part if fy is fx else part + part.T
    at = np.abs(np.fft.fftfreq(size, 1 / size)).astype(np.int64)
    return np.maximum(np.fft.fftshift(np.fft.ifft2(quarter[np.ix_(at, at)]).real), 0)


def _disc_transfer(cycles: Doubles) -> Doubles:
    """Transfer function of an even disc, frequency in cycles a diameter: 2 J1(pi f) / (pi f)."""
    x = np.pi * np.maximum(cycles, 1e-9)
    return 2 * j1(x) / x


def _gaussian_kernel(sigma: float) -> Doubles:
    """Gaussian of a standard deviation in cells, integrated over cells."""
    half = max(2, int(np.ceil(_GAUSSIAN_REACH * sigma)))
    edges = np.arange(-half, half + 2) - 0.5
    line = np.diff(ndtr(edges / sigma) if sigma > 0 else (edges > 0).astype(np.float64))
    return np.outer(line, line) / line.sum() ** 2


class SomeBlur(Protocol):
    """A linear blur on a grid of one size."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        ...

    def apply(self, image: NDArray[np.floating]) -> Doubles:
        """Spread the light of an image."""
        ...

    def adjoint(self, image: NDArray[np.floating]) -> Doubles:
        """Transpose of :meth:`apply`, for images (..., y, x)."""
        ...


@dataclass(frozen=True, eq=False)
class Blur:
    """Convolution with a symmetric kernel on a grid of one size, dark outside: its own adjoint.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the grid.
    padded : tuple of int
        Size of the transforms.
    transfer : ndarray, float64
        Real transfer function on the half plane of ``rfft2``.
    """

    shape: tuple[int, int]
    padded: tuple[int, int]
    transfer: Doubles

    def apply(self, image: NDArray[np.floating]) -> Doubles:
        """Convolve an image, or a stack of them, (..., y, x)."""
        rows, cols = self.shape
        exact = image.astype(np.float64, copy=False)
        spectrum = fft.rfft2(exact, s=self.padded, workers=n_threads())
        spectrum *= self.transfer
        whole = fft.irfft2(spectrum, s=self.padded, workers=n_threads(), overwrite_x=True)
        return np.asarray(whole[..., :rows, :cols])

    def adjoint(self, image: NDArray[np.floating]) -> Doubles:
        """Transpose of :meth:`apply`: the same, since the kernel is symmetric."""
        return self.apply(image)


def make_blur(kernel: Doubles, shape: tuple[int, int], *, wraps: bool = False) -> Blur:
    """Prepare a kernel for images of one shape.

    Parameters
    ----------
    kernel : ndarray of shape (2 h + 1, 2 h + 1), float64
        Symmetric about its centre.
    shape : tuple of int
        Rows and columns of the images.
    wraps : bool
        Whether light may wrap around into the outermost h cells, for images used without them.
    """
    half = kernel.shape[0] // 2
    sides = [max(side if wraps else side + half, len(kernel)) for side in shape]
    padded = (fft.next_fast_len(sides[0], real=True), fft.next_fast_len(sides[1], real=True))
    wrapped = np.zeros(padded)
    wrapped[: 2 * half + 1, : 2 * half + 1] = kernel
    wrapped = np.roll(wrapped, (-half, -half), axis=(0, 1))
    return Blur(shape, padded, np.ascontiguousarray(fft.rfft2(wrapped, workers=n_threads()).real))


def extend(image: NDArray[np.floating], reach: int) -> NDArray[np.floating]:
    """Continue an image beyond its border with the border's values, as the scene continues there."""
    return np.pad(image, reach, mode="edge")
