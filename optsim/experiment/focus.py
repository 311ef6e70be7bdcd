"""Effect of the objective's focus and distortion on a scene, in closed form and without rendering."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from optsim.camera.camera import CodedCamera
from optsim.core.quantities import View
from optsim.optics.lens import blur_tan, corner_tan
from optsim.render.lens import focus_depth_m
from optsim.scene import Scene
from optsim.scene.depths import depth_range_m

# Diameter in fine samples: such a disc takes 0.3 % of the contrast of the finest stripes that samples
# resolve, 1 - 2 J1(x) / x at x = pi/2 times this (J. W. Goodman, Introduction to Fourier Optics, section
# 6.4).
NEGLIGIBLE_SAMPLES = 0.1


@dataclass(frozen=True)
class Focus:
    """Focus and distortion of a camera's lens for a scene."""

    choice: str  # "modelled" by a thin lens, "skipped" as too small to see, or "everywhere" if requested.
    aperture_m: float  # Diameter of the lens.
    focus_m: float  # Depth in focus.
    near_m: float  # Depth range of the image; far is infinite where a surface reflects or is clear.
    far_m: float
    near_px: float  # Diameter of the circle of confusion there, panel pixels, like ``far_px``.
    far_px: float
    corner_px: float  # Displacement by distortion at the panel's corner, panel pixels; negative inwards.

    def text(self) -> str:
        """Describe it in a sentence."""
        far = "infinity" if np.isinf(self.far_m) else f"{self.far_m:.3g} m"
        blur = (
            f"focused at {self.focus_m:.3g} m through {self.aperture_m * 1e3:.3g} mm, which spreads a point "
            f"at {self.near_m:.3g} m over {self.near_px:.2g} and at {far} over {self.far_px:.2g} panel pixels"
        )
        said = {
            "modelled": blur,
            "skipped": f"{blur}: too little to see, so a pinhole renders it",
            "everywhere": "in focus everywhere",
        }
        return f"{said[self.choice]}; distortion moves the corners by {self.corner_px:.2g} panel pixels"

    def record(self) -> dict[str, Any]:
        """Convert it to JSON values: infinity is null."""
        return asdict(self) | {"far_m": self.far_m if np.isfinite(self.far_m) else None}


def focus_on(scene: Scene, camera: CodedCamera, duration_s: float, tolerance: float) -> Focus:
    """Compute the effect of a lens on a scene, and whether its depth of field is worth rendering."""
    view, lens = camera.view, camera.objective
    focus_m = focus_depth_m(scene.camera, view)
    ratio = view.rows / view.cols
    # The extra view of barrel distortion and of defocus lies almost entirely within a tenth.
    near_m, far_m = depth_range_m(scene, 1.1 * view.tan_half_width, ratio, duration_s)
    pixel_tan = camera.modulator.pitch_m * lens.tan_per_metre()
    near_px, far_px = blur_tan(view.aperture_m, focus_m, np.array([near_m, far_m])) / pixel_tan
    corner_px = view.distortion * corner_tan(view.rows, view.cols, view.tan_half_width) / pixel_tan
    choice = "modelled"
    if not view.aperture_m:
        choice = "everywhere"
    elif tolerance > 0 and max(near_px, far_px) * view.samples_per_pitch < NEGLIGIBLE_SAMPLES:
        choice = "skipped"
    found = (lens.aperture_m, focus_m, near_m, far_m, float(near_px), float(far_px), corner_px)
    return Focus(choice, *found)


def seen_through(view: View, focus: Focus) -> View:
    """Return the view for rendering the truth: a pinhole where the lens isn't modelled."""
    return view if focus.choice == "modelled" else replace(view, aperture_m=0.0)
