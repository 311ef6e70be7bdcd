# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""How the panel's image lies on the CCD: shift, rotation, scale, keystone and distortion, by the dots.

The model is the relay's. An orientation such as a mirror image is no misalignment, and is taken out first.
"""

from __future__ import annotations

import numpy as np

from optsim.calibration.pixel_map import MODEL_PX, PixelMap
from optsim.core.quantities import Doubles

NAMES = {
    "shift_y_px": "shift of the panel's image down the CCD, CCD pixels",
    "shift_x_px": "shift of the panel's image to the right, CCD pixels",
    "rotation_rad": "rotation of the panel's image, clockwise in a picture whose rows go down",
    "ccd_per_panel_px": "scale of the panel's image, CCD pixels a panel pixel",
    "keystone_y": "keystone: relative reduction of the last row's image",
    "keystone_x": "keystone: relative reduction of the last column's image",
    "distortion": "distortion: relative growth at the corners",
    "magnification_error": "excess of the magnification over the nominal one",
}
"""The numbers of :func:`misalignment`; the last only where the bench says the nominal scale."""
_SCALE, _FITTED = 3, 7  # place of the scale among the numbers fitted, and their count
_TERMS = 10  # of the map along an axis: its systematic error is shared out over them


def misalignment(
    panel: Doubles, ccd: Doubles, found: PixelMap, ccd_shape: tuple[int, int], nominal: float | None
) -> tuple[dict[str, float], dict[str, float]]:
    """Fit the model to places of panel points on the CCD, each (n, 2): values and standard errors by key."""
    from scipy.optimize import least_squares

    half = np.array(found.panel_shape) / 2
    from_middle = panel - half
    radius_2 = (from_middle**2).sum(axis=1) / (half**2).sum()
    seen = ccd - np.array(ccd_shape) / 2
    # Slopes of an upright image are (1, 0) and (0, 1); misalignments are too small to change the rounding.
    upright = from_middle @ np.rint(found.slope / found.ccd_per_panel_px)

    def off(guess: Doubles) -> Doubles:
        down, right, rotation, scale, key_y, key_x, distortion = guess
        scales = scale * (1 + distortion * radius_2) / (1 + from_middle / half @ np.array([key_y, key_x]))
        y, x = upright.T * scales
        c, s = np.cos(rotation), np.sin(rotation)
        return np.concatenate([c * y + s * x + down - seen[:, 0], c * x - s * y + right - seen[:, 1]])

    fit = least_squares(off, np.eye(_FITTED)[_SCALE] * found.ccd_per_panel_px, x_scale="jac")
    scale, side_px = float(fit.x[_SCALE]), float(half.min())
    variance = float(np.sum(fit.fun**2)) / (len(fit.fun) - _FITTED)
    scatter = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)) * variance)
    # A systematic error of the dots' places, as a shift or at the ends of the shorter side.
    model = MODEL_PX / np.sqrt(_TERMS) / side_px * np.array([scale * side_px] * 2 + [1, scale, 1, 1, 1])
    values = dict(zip(NAMES, fit.x.tolist(), strict=False))
    errors = dict(zip(NAMES, np.hypot(scatter, model).tolist(), strict=False))
    if nominal is not None:
        values["magnification_error"] = scale / nominal - 1
        errors["magnification_error"] = errors["ccd_per_panel_px"] / nominal
    return values, errors
