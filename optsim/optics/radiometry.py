# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""Radiance to irradiance to photons: the closed forms of the light budget.

Source of the first three: M. Born and E. Wolf, *Principles of Optics*, 7th ed., Cambridge 1999, section 4.8
(photometry of optical systems).
"""

from __future__ import annotations

from typing import cast

import numpy as np

from optsim.core.quantities import Doubles
from optsim.optics.lens import area_scale, corner_tan, object_scale

PLANCK_J_S = 6.62607015e-34  # exact, SI 2019
LIGHT_M_S = 299792458.0  # exact, SI
MONO_WAVELENGTH_M = 550e-9
_CLEAR_FIELD = 0.5  # of the way to the corners a rim hides nothing


def irradiance_factor(working_f_number: float, transmission: float) -> float:
    """Irradiance on axis per radiance, W m^-2 per W m^-2 sr^-1: pi T sin^2(theta'), sin(theta') = 1/(2 N).

    Parameters
    ----------
    working_f_number : float
        f-number of the cone on the image.
    transmission : float
        Transmission of everything before the image.
    """
    return float(np.pi * transmission / (4 * working_f_number**2))


def cos4(rows: int, cols: int, tan_per_sample: float, distortion: float = 0.0) -> Doubles:
    """Natural vignetting at each sample's centre: cos^4 of the field angle, over the local area scale.

    A pupil of the same apparent area A from everywhere takes L A cos(angle) from each steradian. Distortion
    only changes the image area of a steradian. A barrel makes it smaller, so the image is brighter there (the
    effect is treated by D. Reshidko and J. Sasian, Opt. Eng. 55, 115105, 2016).

    Parameters
    ----------
    rows, cols : int
        Samples of the used field; the axis passes through its middle.
    tan_per_sample : float
        Sample pitch over focal length.
    distortion : float
        Relative radial displacement at the corner (:mod:`optsim.optics.lens`).

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


def clipped_pupil(rows: int, cols: int, corner_loss: float) -> Doubles:
    """Mechanical vignetting: share of the pupil left open by a lens rim, at each sample's centre.

    Off axis the rim's image shifts over the pupil, in proportion to the distance from the axis. The open part
    is the overlap of two circles (W. J. Smith, *Modern Optical Engineering*, 4th ed., 2008, section 9.6). The
    rim is just large enough to leave the inner half of the field clear: a sensible default, no source.

    Parameters
    ----------
    rows, cols : int
        Samples of the used field; the axis passes through its middle.
    corner_loss : float
        Share lost at its corners, from 0 to 0.9.

    Returns
    -------
    ndarray of shape (rows, cols), float64
        1 on axis.
    """
    if corner_loss == 0:
        return np.ones((rows, cols))
    from scipy.optimize import brentq

    y, x = np.arange(rows) + 0.5 - rows / 2, np.arange(cols) + 0.5 - cols / 2
    place = np.hypot(y[:, None], x) / np.hypot(rows / 2, cols / 2)

    def lost(shift: float) -> float:
        return 1 - float(_overlap(np.array(shift), 1 + _CLEAR_FIELD * shift)) - corner_loss

    shift = cast("float", brentq(lost, 0.0, 4.0))
    return _overlap(shift * place, 1 + _CLEAR_FIELD * shift)


def _overlap(distance: Doubles, radius: float) -> Doubles:
    """Share of a unit circle that lies within one of a larger radius, by the distance of their centres."""
    apart = np.clip(distance, radius - 1 + 1e-12, radius + 1 - 1e-12)
    ours = np.arccos((apart**2 + 1 - radius**2) / (2 * apart))
    theirs = np.arccos((apart**2 + radius**2 - 1) / (2 * apart * radius))
    kite = np.sqrt((1 + radius + apart) * (1 + radius - apart) * (apart + 1 - radius) * (apart - 1 + radius))
    shared = (ours + radius**2 * theirs - kite / 2) / np.pi
    return np.where(distance <= radius - 1, 1, np.clip(shared, 0, 1))


def photons_per_joule(wavelength_m: float = MONO_WAVELENGTH_M) -> float:
    """Photons in a joule of light: wavelength / (h c)."""
    return wavelength_m / (PLANCK_J_S * LIGHT_M_S)
