# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportMissingImports=false, reportUnknownArgumentType=false
"""Denoised pictures for viewing, by Open Image Denoise: biased, so never used for figures."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from optsim.core.errors import ConfigError, ValueCheckError
from optsim.core.quantities import Floats
from optsim.core.quantities.arrays import checked


@dataclass(frozen=True, eq=False)
class Denoised:
    """A denoised picture beside the raw one; scores and truths do not accept it.

    Measured on ``window_room``, 240 x 200, 16 samples a pixel, against 1024: half of all pixels are within
    3.6 % of the reference (raw: 9.8 %), and the mean is 0.2 % low. In the dark passage (8 % of the pixels)
    the relative RMSE stays at 0.97 (raw: 1.28): detail is lost with the noise.
    """

    LABEL: ClassVar[str] = "denoised: for looking at, not for accuracy figures"

    raw_w_m2_sr: Floats  # (y, x), the render; unbiased, so it may be slightly negative.
    w_m2_sr: Floats  # (y, x), never negative; biased by about a per cent where the raw one was noisy.
    made_by: str  # Package, version and settings.

    def attributes(self) -> dict[str, str]:
        """Attributes that a file with the denoised picture must have."""
        return {"unit": "W m^-2 sr^-1", "axes": "y, x", "label": self.LABEL, "denoiser": self.made_by}


def denoiser() -> Any:
    """Return the denoising module.

    Raises
    ------
    ConfigError
        When the extra ``denoise`` is not installed.
    """
    try:
        import mitsuba_oidn
    except ImportError:
        raise ConfigError(
            "denoise: Open Image Denoise is not installed; cure: pip install 'optsim[denoise]', or leave "
            "denoising out (truths and scores never use it)"
        ) from None
    return mitsuba_oidn


def denoised(radiance: Floats, albedo: Floats, normals: Floats) -> Denoised:
    """Denoise a render with noise-free passes of the same instant.

    Parameters
    ----------
    radiance : ndarray of shape (y, x), float32
        Mean of any number of samples, W m^-2 sr^-1. Negative values count as 0 in the denoised picture.
    albedo : ndarray of shape (y, x), float32
        Diffuse reflectance of the first surface, 0 .. 1.
    normals : ndarray of shape (y, x, 3), float32
        Unit shading normals, 0 where there is no surface; in any frame of reference.

    Returns
    -------
    Denoised
        The denoised picture and the raw one.

    Raises
    ------
    ConfigError
        When the extra ``denoise`` is not installed.
    ValueCheckError
        For a wrong rank, dtype or size, or a value that is not finite.
    """
    oidn = denoiser()
    for name, image, axes in (
        ("radiance", radiance, ("y", "x")),
        ("albedo", albedo, ("y", "x")),
        ("normals", normals, ("y", "x", "normal")),
    ):
        checked(name, image, axes=axes, dtype=np.float32, unit="of its pass", nonnegative=False)
    if albedo.shape != radiance.shape or normals.shape != (*radiance.shape, 3):
        raise ValueCheckError(
            f"denoise: got albedo {albedo.shape} and normals {normals.shape} for a render of "
            f"{radiance.shape}; give the passes of the same view"
        )
    picture = oidn.denoise(
        np.maximum(radiance, 0),
        albedo=np.repeat(albedo[..., None], 3, axis=-1),
        normal=np.ascontiguousarray(normals),
        hdr=True,
        clean_aux=True,
    )
    made_by = f"mitsuba-oidn {version('mitsuba-oidn')}, filter RT, high quality, clean albedo and normals"
    return Denoised(radiance, np.array(picture, np.float32), made_by)
