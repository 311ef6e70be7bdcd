"""Conversion of irradiance on the modulator to luminance of the scene."""

from __future__ import annotations

import functools
import warnings

import numpy as np
from pydantic import Field

from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.core.quantities import Doubles, Floats
from optsim.optics.radiometry import MONO_WAVELENGTH_M

_K_LM_W = 683.0
"""Luminous efficacy at 555 nm, lm/W: the SI's definition of the candela."""
_SEEN_NM = (360.0, 830.0)


@functools.cache
def luminous_efficacy_lm_w(wavelength_m: float = MONO_WAVELENGTH_M) -> float:
    """Luminous efficacy of light of a wavelength, lm/W: 683 V, V of CIE 1924 (as in ISO/CIE 23539).

    V is tabulated in steps of a nanometre and interpolated linearly.

    Raises
    ------
    ConfigError
        For light without response of the eye, whose luminance is undefined.
    """
    wavelength_nm = round(wavelength_m * 1e9, 6)
    if not _SEEN_NM[0] <= wavelength_nm <= _SEEN_NM[1]:
        raise ConfigError(
            f"camera.wavelength_m: got {wavelength_nm:g} nm, expected {_SEEN_NM[0]:g} to {_SEEN_NM[1]:g} nm, "
            "where luminance is defined; choose a visible band"
        )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message='"Matplotlib" related API features')
        import colour
    table = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    below = int(wavelength_nm)
    seen, part = float(table[below]), wavelength_nm - below
    return _K_LM_W * (seen + part * (float(table[below + 1]) - seen) if part else seen)


class PhotometricScale(Part):
    """The stated scale of a scene: luminance for a decoder's irradiance.

    Parameters
    ----------
    white_w_m2_sr
        Radiance of the scene's declared white, W m^-2 sr^-1.
    irradiance_per_radiance
        On-axis irradiance on the modulator over scene radiance, sr (``CodedCamera.irradiance_per_radiance``).
    wavelength_m
        Wavelength of the light, m; it sets the lumens of a watt.
    """

    white_w_m2_sr: float = Field(gt=0)
    irradiance_per_radiance: float = Field(gt=0)
    wavelength_m: float = Field(default=MONO_WAVELENGTH_M, gt=0)

    @property
    def cd_m2_per_w_m2(self) -> float:
        """Luminance over modulator irradiance, cd/m^2 per W/m^2."""
        return luminous_efficacy_lm_w(self.wavelength_m) / self.irradiance_per_radiance

    @property
    def white_cd_m2(self) -> float:
        """Luminance of the scene's declared white, cd/m^2."""
        return luminous_efficacy_lm_w(self.wavelength_m) * self.white_w_m2_sr

    def luminance_cd_m2(self, irradiance_w_m2: Floats | Doubles) -> Floats:
        """Luminance, cd/m^2, of modulator irradiances, W/m^2; any shape, float32."""
        return (irradiance_w_m2 * np.float64(self.cd_m2_per_w_m2)).astype(np.float32)
