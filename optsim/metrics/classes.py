# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
"""Content classes of a coded frame: what moves, what is dark or bright, the rim of the moving region.

A mean over a whole picture hides a loss in a small part of it, so each class has scores of its own.
"""

from __future__ import annotations

from typing import Final, Literal, cast

import numpy as np
from scipy import ndimage  # type: ignore[import-untyped]

from optsim.core.quantities import Bools, Floats

Class = Literal["all", "moving", "static", "dark", "mid", "bright", "rim"]
CLASSES: Final[tuple[Class, ...]] = ("all", "moving", "static", "dark", "mid", "bright", "rim")
# Half the width of the rim: a decoder blends or switches over about as many pixels.
_RIM_PX = 2


def class_masks(reference_cd_m2: Floats, moving: Bools) -> dict[Class, Bools]:
    """Split a coded frame into its content classes, by the truth alone.

    Parameters
    ----------
    reference_cd_m2 : ndarray of shape (slot, v, u), float32
        Luminance of the truth.
    moving : ndarray of shape (v, u), bool
        The oracle's mask.

    Returns
    -------
    dict
        Class -> mask (v, u). Dark, mid and bright are thirds of the picture by mean luminance. The rim lies
        within two pixels of the border of the moving region.
    """
    mean = reference_cd_m2.mean(axis=0, dtype=np.float64)
    low, high = np.quantile(mean, (1 / 3, 2 / 3))
    square = np.ones((2 * _RIM_PX + 1,) * 2, np.bool_)
    grown = cast("Bools", ndimage.binary_dilation(moving, square))
    # Beyond the edge the picture goes on.
    core = cast("Bools", ndimage.binary_erosion(moving, square, border_value=1))
    return {
        "all": np.ones_like(moving),
        "moving": moving,
        "static": ~moving,
        "dark": mean <= low,
        "mid": (mean > low) & (mean <= high),
        "bright": mean > high,
        "rim": grown & ~core,
    }
