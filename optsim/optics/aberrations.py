"""Point spread functions that vary over the field, from a lens's Zernike aberrations.

The wavefront error has the third-order terms. Each is a Zernike polynomial in Noll's normalisation (R. J.
Noll, J. Opt. Soc. Am. 66, 207, 1976), so a coefficient is an rms over the pupil. Spherical aberration is the
same everywhere, coma grows with the field radius, astigmatism and field curvature grow with its square (M.
Born and E. Wolf, *Principles of Optics*, 7th ed., section 5.3). Coma and astigmatism point along the radius.
The tilt in coma is chosen so that the PSF's centroid stays in place: other displacement belongs to
distortion. A PSF is the squared Fourier transform of the pupil, integrated over a cell. Defocus adds a term
to the wavefront, with the sign of positive field curvature.

Between the nodes of a square grid over the field the PSF is interpolated bilinearly. So it is nowhere
negative, and every point keeps its energy. A stated error sets the number of nodes. The PSF tails, which
aberrations hardly change, are the same everywhere.

Not modelled: terms beyond third order, mechanical vignetting of the pupil, and dispersion: the path
differences are those of 550 nm at every wavelength.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.config import Part
from optsim.core.quantities import Doubles
from optsim.optics.field_blur import FieldPsf, uniform
from optsim.optics.psf import rounded
from optsim.optics.radiometry import MONO_WAVELENGTH_M

# Choices of nodes along each side of the field; each grid contains the one before. The last one is not
# checked further, and misplaces 1e-3 of the light of a common lens.
_NODES = (2, 3, 5, 9, 17)
_MEAN_OF = 9  # places along each side that a uniform PSF is the mean of
_PUPIL = 64  # samples across the pupil, at least
_RIM = 4  # parts of a sample at the pupil's rim, along each axis
# Margin of the window beyond the rays' reach, in Airy radii and in sigmas.
_MARGIN = 4.0


class Wavefront(Part):
    """Rms wavefront error of a lens, waves of 550 nm: spherical everywhere, the others at the panel's corner.

    Parameters
    ----------
    spherical_waves : float
        Spherical aberration, the same everywhere; positive has the sign of Noll's polynomial, as a positive
        defocus has.
    coma_waves : float
        Coma at the corner, growing with the distance from the axis; if positive, its tail points away from
        the axis.
    astigmatism_waves : float
        Astigmatism at the corner, growing with the square of the distance; positive has the sign of Noll's
        polynomial along the distance.
    curvature_waves : float
        Field curvature at the corner, growing with the square of the distance; positive is a positive
        defocus.
    """

    spherical_waves: float = 0.0
    coma_waves: float = 0.0
    astigmatism_waves: float = 0.0
    curvature_waves: float = 0.0

    def in_light_of(self, wavelength_m: float) -> Wavefront:
        """Return the same path differences in waves of another wavelength."""
        waves = MONO_WAVELENGTH_M / wavelength_m
        return Wavefront(**{name: value * waves for name, value in self})

    def at(self, field_y: float, field_x: float, pupil_y: Doubles, pupil_x: Doubles) -> Doubles:
        """Wavefront error in the pupil, in the waves of its coefficients.

        Parameters
        ----------
        field_y, field_x : float
            Field position, as a share of the distance from the centre to the corner.
        pupil_y, pupil_x : ndarray, float64
            Pupil coordinates; the radius is 1.
        """
        square = pupil_y**2 + pupil_x**2
        # h rho cos(theta - phi), and h^2 rho^2 cos 2(theta - phi).
        along = field_y * pupil_y + field_x * pupil_x
        across = field_x * pupil_y - field_y * pupil_x
        h2 = field_y**2 + field_x**2
        return (
            self.spherical_waves * np.sqrt(5) * (6 * square**2 - 6 * square + 1)
            + self.coma_waves * np.sqrt(8) * 3 * (square - 1) * along
            + self.astigmatism_waves * np.sqrt(6) * (along**2 - across**2)
            + self.curvature_waves * h2 * np.sqrt(3) * (2 * square - 1)
        )


def field_psf(
    wavefront: Wavefront,
    kernel: Doubles,
    *,
    f_number: float,
    sigma_m: float,
    cell_m: float,
    wavelength_m: float,
    sides: tuple[int, int],
    field_error: float,
    defocus_m: float = 0.0,
) -> FieldPsf:
    """Replace the core of an aberration-free kernel by the PSFs of a lens's wavefront.

    Parameters
    ----------
    wavefront : Wavefront
        The lens's aberrations, in waves of this light.
    kernel : ndarray of shape (2 h + 1, 2 h + 1), float64
        From :func:`optsim.optics.psf.psf_kernel`, with the same numbers.
    f_number, sigma_m, cell_m, wavelength_m : float
        As there.
    sides : tuple of int
        Rows and columns of the field; its corners have the stated aberrations.
    field_error : float
        Share of a point's light that interpolation may misplace; 1 makes the PSF uniform.
    defocus_m : float
        Distance of the plane from the sharp image, m.
    """
    if wavefront == Wavefront() and not defocus_m:
        return uniform(kernel)
    # In cells, lenses that differ only in scale are the same one, after rounding.
    sigma = sigma_m / cell_m
    # The cell's own variance is taken out of the Gaussian, as in the kernel.
    optics = _Optics(rounded(wavelength_m * f_number / cell_m), rounded(max(sigma**2 - 1 / 12, 0.0) ** 0.5))
    # Path difference at the rim of the pupil, waves (Goodman, section 6.4).
    defocus = rounded(defocus_m / (8 * f_number**2 * wavelength_m))
    half = _reach(_pupil(wavefront, _grid(np.linspace(-1, 1, 3), sides), defocus), optics.spread, sigma)
    whole = np.pad(kernel, max(0, half - len(kernel) // 2))
    inner = slice(len(whole) // 2 - half, len(whole) // 2 + half + 1)

    def cores(nodes: int) -> Doubles:
        """PSFs on an even grid over the whole field."""
        found = _quarter(wavefront, optics, sides, defocus, half, nodes)  # pyright: ignore[reportArgumentType]
        # Light beyond the window would be lost: it is added back to the point.
        right = found * (whole[inner, inner].sum() / found.sum(axis=(2, 3), keepdims=True))
        # A lens is symmetric about both axes.
        lower = np.concatenate([right[:, : -(nodes // 2) - 1 : -1, :, ::-1], right], axis=1)
        return np.concatenate([lower[: -(nodes // 2) - 1 : -1, :, ::-1], lower])

    mean = cores(_MEAN_OF).mean(axis=(0, 1))
    if np.abs(cores(3) - mean).sum(axis=(2, 3)).max() / 2 <= field_error:
        whole[inner, inner] = mean
        return uniform(whole)
    return FieldPsf(whole, _enough_nodes(cores, field_error))


# Cached: a plan asks for the same lens with other errors and tails.
@lru_cache(maxsize=32)
def _quarter(
    wavefront: Wavefront, optics: _Optics, sides: tuple[int, int], defocus: float, half: int, nodes: int
) -> Doubles:
    """PSFs over cells on the quarter of an even grid with no negative field coordinate, (n, n, y, x)."""
    numbers = (wavefront, optics, sides, defocus, half)
    if nodes < _MEAN_OF:
        # These nodes are among those of the mean; they are counted from the edge.
        step = (_MEAN_OF - 1) // (nodes - 1)
        all_of_them = _quarter(*numbers, _MEAN_OF)  # pyright: ignore[reportArgumentType]
        return all_of_them[::-step, ::-step][::-1, ::-1]
    grid = _grid(np.linspace(-1, 1, nodes)[nodes // 2 :], sides)
    side = nodes // 2 + 1
    found, new = np.empty((side, side, 2 * half + 1, 2 * half + 1)), np.ones((side, side), np.bool_)
    if nodes > _MEAN_OF:
        new[::2, ::2] = False
        found[~new] = _quarter(*numbers, side).reshape(-1, *found.shape[2:])  # pyright: ignore[reportArgumentType]
    places = [place for place, wanted in zip(grid, new.ravel(), strict=True) if wanted]
    found[new] = _cells(_pupil(wavefront, places, defocus), optics, half)
    return found


def _enough_nodes(cores: Callable[[int], Doubles], field_error: float) -> Doubles:
    """Cores on the coarsest grid that misplaces at most a share of the light at the centres of its cells."""
    found = cores(_NODES[0])
    for finer in _NODES[1:]:
        between = cores(finer)
        straight = (found[1:] + found[:-1]) / 2
        straight = (straight[:, 1:] + straight[:, :-1]) / 2
        if np.abs(straight - between[1::2, 1::2]).sum(axis=(2, 3)).max() / 2 <= field_error:
            break
        found = between
    return found


@dataclass(frozen=True, eq=False)
class _Pupil:
    """Samples of the pupil: positions along an axis, the open share of each, path differences in waves."""

    axis: Doubles
    open: Doubles
    waves: Doubles  # (place, y, x)


@dataclass(frozen=True)
class _Optics:
    """Wavelength times f-number, and standard deviation of the Gaussian over the sum over a cell; cells."""

    spread: float
    sigma: float


def _grid(places: Doubles, sides: tuple[int, int]) -> list[tuple[float, float]]:
    """All pairs of field coordinates, as shares of the distance to the corner."""
    y, x = (places * side / np.hypot(*sides) for side in sides)
    return [(float(a), float(b)) for a in y for b in x]


def _pupil(wavefront: Wavefront, places: list[tuple[float, float]], defocus: float) -> _Pupil:
    samples = _PUPIL
    while True:
        axis = (np.arange(samples) + 0.5) * 2 / samples - 1
        y, x = axis[:, None] + 0 * axis, axis + 0 * axis[:, None]
        waves = np.stack([wavefront.at(*place, y, x) for place in places]) + defocus * (y**2 + x**2)
        within = y**2 + x**2 <= 1
        # More than a quarter of a wave between samples would undersample the phase.
        steps = np.abs(np.diff(np.where(within, waves, np.nan), axis=2))
        if np.nanmax(steps) < 0.25 or samples >= 16 * _PUPIL:
            break
        samples *= 2
    fine = (np.arange(samples * _RIM) + 0.5) * 2 / (samples * _RIM) - 1
    inside = (fine[:, None] ** 2 + fine**2 <= 1).astype(np.float64)
    share = inside.reshape(samples, _RIM, samples, _RIM).mean(axis=(1, 3))
    return _Pupil(axis, share, waves)


def _reach(pupil: _Pupil, spread: float, sigma: float) -> int:
    """Reach of the rays in cells, with a margin for diffraction and the Gaussian."""
    step = pupil.axis[1] - pupil.axis[0]
    slope_y, slope_x = np.gradient(pupil.waves, step, axis=(1, 2))
    steepest = float(np.hypot(slope_y, slope_x)[:, pupil.open == 1].max())
    return int(np.ceil(2 * spread * steepest + _MARGIN * (1.22 * spread + sigma)))


def _cells(pupil: _Pupil, optics: _Optics, half: int) -> Doubles:
    """PSFs of a pupil's wavefronts over cells, (place, 2 half + 1, 2 half + 1); the whole plane sums to 1."""
    spread = optics.spread
    # The intensity has no detail finer than a wavelength times the f-number. Two samples of that resolve it,
    # but their sum over a cell overestimates the finest detail. With four it is right to 1e-3.
    parts = max(1, int(np.ceil(4 / spread)))
    size = (2 * half + 1) * parts
    place = (np.arange(size) - (size - 1) / 2) / parts
    # The pupil sample at p contributes exp(2 pi i p x / (2 lambda N)) at x.
    kernel = np.exp(2j * np.pi * np.outer(place, pupil.axis) / (2 * spread)).astype(np.complex64)
    # Whole waves have no effect, and would cost precision.
    phase = (-2 * np.pi * (pupil.waves - np.rint(pupil.waves))).astype(np.float32)
    seen = np.empty(phase.shape, np.complex64)
    seen.real, seen.imag = pupil.open * np.cos(phase), pupil.open * np.sin(phase)
    fields: NDArray[np.complex64] = _along_both_axes(kernel, seen)
    pupil_step = pupil.axis[1] - pupil.axis[0]
    share = (pupil_step / parts / (2 * spread)) ** 2 / (pupil.open**2).sum()
    to_cells = _gaussian_rows(size, optics.sigma * parts).reshape(2 * half + 1, parts, size).sum(axis=1)
    intensity = fields.real**2 + fields.imag**2
    return _along_both_axes(to_cells.astype(np.float32), intensity) * np.float64(share)


def _gaussian_rows(size: int, sigma: float) -> Doubles:
    """Matrix of a Gaussian blur of a standard deviation in samples, dark outside; cut at four of them."""
    distance = np.abs(np.arange(size)[:, None] - np.arange(size))
    reach = int(4 * sigma + 0.5)
    weight = np.exp(-((np.arange(reach + 1) / sigma) ** 2) / 2) if reach else np.ones(1)
    weight /= 2 * weight.sum() - weight[0]
    return np.where(distance <= reach, weight[np.minimum(distance, reach)], 0.0)


def _along_both_axes(matrix: NDArray[Any], images: NDArray[Any]) -> NDArray[Any]:
    """Apply a matrix to the columns and the rows of images, (k, y, x); the result is (k, x, y)."""
    # Two large products: with many small ones threads would wait for each other.
    k, rows, cols = images.shape
    found = (images.reshape(-1, cols) @ matrix.T).reshape(k, rows, len(matrix))
    found = np.ascontiguousarray(found.transpose(0, 2, 1))
    return (found.reshape(-1, rows) @ matrix.T).reshape(k, len(matrix), len(matrix))
