"""From radiance to irradiance to photons: the few closed forms of the light budget.

Source of the first three: M. Born and E. Wolf, *Principles of Optics*, 7th ed., Cambridge 1999, section 4.8
(photometry of optical systems).
"""

from __future__ import annotations

import numpy as np

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


def cos4(rows: int, cols: int, tan_per_sample: float) -> Doubles:
    """Natural vignetting of a lens without distortion: cos^4 of the field angle at each sample's centre.

    Parameters
    ----------
    rows, cols : int
        Samples; the axis passes through the middle of the grid.
    tan_per_sample : float
        Sample pitch over focal length.

    Returns
    -------
    ndarray of shape (rows, cols), float64
        1 on axis.
    """
    y = (np.arange(rows) + 0.5 - rows / 2) * tan_per_sample
    x = (np.arange(cols) + 0.5 - cols / 2) * tan_per_sample
    return 1 / (1 + y[:, None] ** 2 + x**2) ** 2


def photons_per_joule(wavelength_m: float = MONO_WAVELENGTH_M) -> float:
    """Photons in a joule of light: wavelength / (h c)."""
    return wavelength_m / (PLANCK_J_S * LIGHT_M_S)
