"""The lens before the grid: aperture, focus, and distortion of the pinhole's picture.

All positions in the picture are on the *ideal grid*: samples of the same width without distortion, with a
margin where a barrel shows more. The view's own samples are looked up on it. Defocus spreads light around
these positions.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from optsim.core.quantities import Bools, Doubles, Ints, View
from optsim.optics.lens import blur_tan, corner_tan, image_scale, object_scale
from optsim.scene.camera_pose import CameraPose


def focus_depth_m(camera: CameraPose, view: View) -> float:
    """Depth in focus, m: the view's, or the distance of the camera's target, minus the focus error."""
    wanted = camera.distance_m if view.focus_m is None else view.focus_m
    return 1 / (1 / wanted + view.defocus_per_m)


def sample_tan(view: View) -> float:
    """Width of a sample on the axis, as a tangent of field angle."""
    return 2 * view.tan_half_width / view.cols


def blur_px(depth_m: Doubles, camera: CameraPose, view: View) -> Doubles:
    """Diameter of the circle of confusion at depths, fine samples; 0 for a pinhole, NaN for NaN depth."""
    if not view.aperture_m:
        return np.zeros_like(depth_m)
    return blur_tan(view.aperture_m, focus_depth_m(camera, view), depth_m) / sample_tan(view)


def margin_px(view: View) -> int:
    """Margin of the ideal grid on each side, samples."""
    more = float(object_scale(1.0, view.distortion)) - 1
    return int(np.ceil(max(more, 0.0) * max(view.rows, view.cols) / 2))


def ideal(view: View) -> View:
    """Ideal grid of a view, with its aperture."""
    rows, cols = view.rows + 2 * margin_px(view), view.cols + 2 * margin_px(view)
    tan_half_width = view.tan_half_width * cols / view.cols
    return replace(view, rows=rows, cols=cols, tan_half_width=tan_half_width, distortion=0.0)


def undistorted(row: Any, col: Any, view: View) -> tuple[Any, Any]:
    """Map places in the view to the ideal image; both count from the view's first sample."""
    down, across = row - view.rows / 2, col - view.cols / 2
    scale = object_scale((down * down + across * across) * _per_squared_px(view), view.distortion)
    return view.rows / 2 + scale * down, view.cols / 2 + scale * across


def distorted(row: Doubles, col: Doubles, view: View) -> tuple[Doubles, Doubles]:
    """Map places in the ideal image to the view."""
    down, across = row - view.rows / 2, col - view.cols / 2
    scale = image_scale((down * down + across * across) * _per_squared_px(view), view.distortion)
    return view.rows / 2 + scale * down, view.cols / 2 + scale * across


def radial_k1(view: View) -> float:
    """Distortion as OpenCV's k1, for squared tangents of the field angle."""
    return view.distortion / corner_tan(view.rows, view.cols, view.tan_half_width) ** 2


def on_view(image: np.ndarray, view: View) -> np.ndarray:
    """Resample a picture from the ideal grid, (y, x), to the view's by the nearest sample."""
    return image[_nearest(view)] if view.distortion else image


def touched(mask: Bools, view: View) -> Bools:
    """Resample a mask from the ideal grid to the view's, slightly too large: neighbours count too."""
    if not view.distortion:
        return mask
    wide = np.pad(mask, 1)
    tall = wide[:-2] | wide[1:-1] | wide[2:]
    return on_view(tall[:, :-2] | tall[:, 1:-1] | tall[:, 2:], view)


@lru_cache(maxsize=4)
def _nearest(view: View) -> tuple[Ints, Ints]:
    row, col = np.indices((view.rows, view.cols)) + 0.5
    row, col = undistorted(row, col, view)
    margin = margin_px(view)
    return np.floor(row + margin).astype(np.intp), np.floor(col + margin).astype(np.intp)


def _per_squared_px(view: View) -> float:
    return 4 / (view.rows**2 + view.cols**2)
