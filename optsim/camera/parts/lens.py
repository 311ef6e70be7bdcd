"""Base of objective and relay: a PSF with aberrations, and veiling glare."""

from __future__ import annotations

from functools import lru_cache

from pydantic import Field

from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.optics.aberrations import Wavefront, field_psf
from optsim.optics.field_blur import FieldPsf, uniform
from optsim.optics.psf import kernel_half_width, psf_kernel
from optsim.optics.radiometry import MONO_WAVELENGTH_M

LARGEST_TAIL_SHARE = 0.1  # of a PSF's energy: windows then end at the second dark ring of an Airy pattern
# Half width of the largest PSF window, cells: 0.5 GB, and a few times that while it is made.
_LARGEST_HALF = 4096
# Rms waves of a wavefront, all aberrations together: worse lenses form no image, and take minutes to model.
_MOST_WAVES = 3.0


class LensGroup(Part):
    """A group of lenses that forms an image.

    Parameters
    ----------
    aberration_m : float
        Standard deviation in its image of a Gaussian that stands for aberrations outside ``wavefront``.
    diffraction : bool
        Whether aperture and wavefront blur; the Gaussian does anyway.
    wavefront : Wavefront
        Its third-order aberrations; the path differences are the same at every wavelength.
    glare_share : float
        Share of the light that veiling glare (ISO 9358) spreads evenly over its image.
    tail_share : float
        Share of the PSF's energy that may lie outside its window; it is added to the central cell.
    field_error : float
        Share of a point's light that interpolating the PSF over the field may misplace; 1 makes the PSF the
        same everywhere.
    """

    aberration_m: float = Field(ge=0)
    diffraction: bool = True
    wavefront: Wavefront = Wavefront()
    glare_share: float = Field(ge=0, lt=1)
    tail_share: float = Field(default=1e-3, ge=1e-4, le=LARGEST_TAIL_SHARE)
    field_error: float = Field(default=0.02, ge=1e-3, le=1)

    def psf(
        self,
        f_number: float,
        cell_m: float,
        sides: tuple[int, int],
        defocus_m: float = 0.0,
        wavelength_m: float = MONO_WAVELENGTH_M,
    ) -> FieldPsf:
        """PSF in its image on a grid of square cells."""
        self._check_window(f_number, cell_m, defocus_m, wavelength_m)
        wavefront = self.wavefront.in_light_of(wavelength_m)
        numbers = (self.aberration_m, self.tail_share, self.field_error, f_number, cell_m, defocus_m)
        # A frozen model is hashable, but its type does not declare it.
        return _psf(wavefront, self.diffraction, sides, *numbers, wavelength_m)  # pyright: ignore[reportArgumentType]

    def half_width(
        self, f_number: float, cell_m: float, tail_share: float, wavelength_m: float = MONO_WAVELENGTH_M
    ) -> int:
        """Half width in cells of a PSF window that misses a share of the light."""
        return kernel_half_width(wavelength_m, f_number, cell_m, tail_share)

    def _check_window(self, f_number: float, cell_m: float, defocus_m: float, wavelength_m: float) -> None:
        part = f"camera.{type(self).__name__.lower()}"
        half = self.half_width(f_number, cell_m, self.tail_share, wavelength_m)
        if self.diffraction and half > _LARGEST_HALF:
            raise ConfigError(
                f"{part}.tail_share: got {self.tail_share:g}, at f/{f_number:.3g} and cells of "
                f"{cell_m * 1e6:.3g} um the PSF would reach {half} cells, expected at most {_LARGEST_HALF}; "
                f"raise it to {self.tail_share * half / _LARGEST_HALF * 1.05:.2g}, or lower the f-number"
            )
        waves = sum(abs(value) for _, value in self.wavefront)
        if self.diffraction and not waves <= _MOST_WAVES:
            raise ConfigError(
                f"{part}.wavefront: got {waves:g} waves rms in all, expected at most {_MOST_WAVES:g}; lower "
                "them, or let aberration_m stand for them"
            )
        blur_m, limit_m = abs(defocus_m) / f_number + 4 * self.aberration_m, _LARGEST_HALF / 4 * cell_m
        if blur_m > limit_m:
            raise ConfigError(
                f"{part}: defocus_m and aberration_m = {self.aberration_m:g} blur over {blur_m:.3g} m, "
                f"expected at most {limit_m:.3g} m, {_LARGEST_HALF // 4} cells; lower them"
            )


# Cached by the relevant numbers only: cameras are often copied with another neutral density.
@lru_cache(maxsize=16)
def _psf(
    wavefront: Wavefront,
    diffraction: bool,
    sides: tuple[int, int],
    sigma_m: float,
    tail_share: float,
    field_error: float,
    f_number: float,
    cell_m: float,
    defocus_m: float,
    wavelength_m: float,
) -> FieldPsf:
    disc_m = abs(defocus_m) / f_number
    kernel = psf_kernel(
        f_number, sigma_m, cell_m, wavelength_m, tail_share, disc_m=disc_m, diffraction=diffraction
    )
    # Without diffraction defocus blurs by the geometrical disc, which is part of the kernel.
    if not diffraction:
        return uniform(kernel)
    return field_psf(
        wavefront,
        kernel,
        f_number=f_number,
        sigma_m=sigma_m,
        cell_m=cell_m,
        wavelength_m=wavelength_m,
        sides=sides,
        field_error=field_error,
        defocus_m=defocus_m,
    )
