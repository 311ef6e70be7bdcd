"""From radiance to irradiance to photons: the few closed forms of the light budget.

Source of the first three: M. Born and E. Wolf, *Principles of Optics*, 7th ed., Cambridge 1999, section 4.8
(photometry of optical systems).
"""

from __future__ import annotations

import numpy as np

from optsim.forward.lens import area_scale, corner_tan, object_scale
from optsim.quantities import Doubles

PLANCK_J_S = 6.62607015e-34  # exact, SI 2019
LIGHT_M_S = 299792458.0  # exact, SI
MONO_WAVELENGTH_M = 550e-9


def irradiance_factor(working_f_number: float, transmission: float) -> float:
    """Irradiance on axis per radiance, W m^-2 per W m^-2 sr^-1: pi T sin^2(theta'), sin(theta') = 1/(2 N).

    Parameters
    ----------
    working_f_number : float
        f-number of the cone that lands on the image.
    transmission : float
        Of everything before the image.
    """
    return float(np.pi * transmission / (4 * working_f_number**2))


def cos4(rows: int, cols: int, tan_per_sample: float, distortion: float = 0.0) -> Doubles:
    """Natural vignetting at each sample's centre: cos^4 of the field angle, over the area that light gets.

    A pupil of area A that looks the same from everywhere takes L A cos(angle) from each steradian, wherever
    distortion puts it: a barrel gives a steradian less area than the image without distortion, so that it
    is brighter there (the effect is treated by D. Reshidko and J. Sasian, Opt. Eng. 55, 115105, 2016).

    Parameters
    ----------
    rows, cols : int
        Samples of the used field; the axis passes through its middle.
    tan_per_sample : float
        Sample pitch over focal length.
    distortion : float
        Relative displacement of what belongs into the corner (:mod:`optsim.forward.lens`).

    Returns
    -------
    ndarray of shape (rows, cols), float64
        1 on axis.
    """
    y = (np.arange(rows) + 0.5 - rows / 2) * tan_per_sample
    x = (np.arange(cols) + 0.5 - cols / 2) * tan_per_sample
    squared = y[:, None] ** 2 + x**2
    if not distortion:
        return 1 / (1 + squared) ** 2
    corner = corner_tan(rows, cols, tan_per_sample * cols / 2) ** 2
    squared *= object_scale(squared / corner, distortion) ** 2
    return 1 / ((1 + squared) ** 2 * area_scale(squared / corner, distortion))


def photons_per_joule(wavelength_m: float = MONO_WAVELENGTH_M) -> float:
    """Photons in a joule of light: wavelength / (h c)."""
    return wavelength_m / (PLANCK_J_S * LIGHT_M_S)
