"""From irradiance on the modulator back to the luminance that a viewer of the scene would see."""

from __future__ import annotations

import functools
import warnings

import numpy as np
from pydantic import Field

from optsim.config import Part
from optsim.quantities import Doubles, Floats

_K_LM_W = 683.0
"""Luminous efficacy at 555 nm, lm/W: the SI's definition of the candela."""
_BAND_NM = 550
"""Where the mono band puts all its light."""


@functools.cache
def luminous_efficacy_lm_w() -> float:
    """Luminous efficacy of the mono band, lm/W: 683 V(550 nm), V of CIE 1924 (as in ISO/CIE 23539)."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message='"Matplotlib" related API features')
        import colour
    return _K_LM_W * float(colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"][_BAND_NM])


class PhotometricScale(Part):
    """The one stated scale of a scene: what a decoder's irradiance means as luminance.

    Parameters
    ----------
    white_w_m2_sr
        Radiance of the scene's declared white, W m^-2 sr^-1.
    irradiance_per_radiance
        On-axis irradiance on the modulator over scene radiance, sr (``CodedCamera.irradiance_per_radiance``).
    """

    white_w_m2_sr: float = Field(gt=0)
    irradiance_per_radiance: float = Field(gt=0)

    @property
    def cd_m2_per_w_m2(self) -> float:
        """Luminance over modulator irradiance, cd/m^2 per W/m^2."""
        return luminous_efficacy_lm_w() / self.irradiance_per_radiance

    @property
    def white_cd_m2(self) -> float:
        """Luminance of the scene's declared white, cd/m^2."""
        return luminous_efficacy_lm_w() * self.white_w_m2_sr

    def luminance_cd_m2(self, irradiance_w_m2: Floats | Doubles) -> Floats:
        """Luminance, cd/m^2, of modulator irradiances, W/m^2; any shape, float32."""
        return (irradiance_w_m2 * np.float64(self.cd_m2_per_w_m2)).astype(np.float32)
