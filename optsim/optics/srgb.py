"""The transfer function of sRGB (IEC 61966-2-1): from coded values to linear light, and back."""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Doubles


def srgb_to_linear(coded: Doubles) -> Doubles:
    """Return linear light of coded values, both 0..1."""
    return np.where(coded <= 0.04045, coded / 12.92, ((coded + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(light: Doubles) -> Doubles:
    """Return coded values of linear light, both 0..1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
