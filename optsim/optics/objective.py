"""The objective: from scene radiance to irradiance on the modulator."""

from __future__ import annotations

import numpy as np
from pydantic import Field, model_validator

from optsim.forward.psf import kernel_half_width
from optsim.forward.radiometry import MONO_WAVELENGTH_M, cos4, irradiance_factor
from optsim.optics.lens import LensGroup
from optsim.quantities import Doubles

# Beyond this share of the PSF's energy, moving blocks get its wings coarser (see forward/wings.py).
CORE_SHARE = 5e-3


class Objective(LensGroup):
    """A lens without distortion whose image is laid on the modulator at a magnification.

    Parameters
    ----------
    focal_length_m : float
        m.
    f_number : float
        Of the objective itself; the cone on the modulator is ``magnification`` times slower.
    magnification : float
        From the objective's image to the modulator.
    transmission : float
        Of the glass; 0.9 has no source, it is a sensible default.
    nd_transmission : float
        Of a neutral density in front: the knob of the light rule.
    aberration_m : float
        Standard deviation of the other aberrations' Gaussian on the modulator; 3 um has no source.
    glare_share : float
        Share of the light that veiling glare (ISO 9358) spreads evenly over the field; 0.25 % has no source.
    natural_vignetting : bool
        Whether irradiance falls with cos^4 of the field angle.
    """

    focal_length_m: float = Field(default=12.5e-3, gt=0)
    f_number: float = Field(default=4.0, ge=0.7, le=64)
    magnification: float = Field(default=1.5, gt=0)
    transmission: float = Field(default=0.9, gt=0, le=1)
    nd_transmission: float = Field(default=1.0, gt=0, le=1)
    aberration_m: float = Field(default=3e-6, ge=0)
    glare_share: float = Field(default=0.0025, ge=0, lt=1)
    natural_vignetting: bool = True

    @model_validator(mode="after")
    def _cone_within_a_half_space(self) -> Objective:
        if self.working_f_number < 0.5:
            raise ValueError(
                f"magnification x f_number: got f/{self.working_f_number:.3g} on the panel, expected at "
                "least f/0.5, light from a whole half space; raise one of them"
            )
        return self

    @property
    def working_f_number(self) -> float:
        """f-number of the cone on the modulator."""
        return self.magnification * self.f_number

    @property
    def irradiance_per_radiance(self) -> float:
        """Irradiance on the modulator, on axis and without glare, W m^-2 per W m^-2 sr^-1."""
        return irradiance_factor(self.working_f_number, self.transmission * self.nd_transmission)

    def tan_per_metre(self) -> float:
        """Tangent of the field angle per metre on the modulator."""
        return 1 / (self.magnification * self.focal_length_m)

    def shading(self, rows: int, cols: int, cell_m: float) -> Doubles:
        """Relative irradiance of a flat field at the samples of a grid, (y, x); 1 on axis."""
        if not self.natural_vignetting:
            return np.ones((rows, cols))
        return cos4(rows, cols, cell_m * self.tan_per_metre())

    def core_half_width(self, cell_m: float) -> int:
        """Cells from the centre to the edge of the part of the PSF that moving light gets in each instant."""
        return kernel_half_width(MONO_WAVELENGTH_M, self.working_f_number, cell_m, CORE_SHARE)
