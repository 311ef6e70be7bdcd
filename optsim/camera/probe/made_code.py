"""Codes for the panels of probes, from the experiment's own schemes.

The size of an imperfection in a frame's noise depends on the code by more than a decade. A panel that is open
for a twelfth of a frame leaks for the rest of it, and has less light whose noise would hide the leak.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optsim.camera.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.coding import MotionAdaptive, Scheme
from optsim.coding.periodic import PeriodicCode
from optsim.core.quantities import Bytes, ExposureCode, RadianceVideo

Schemes = Mapping[str, Scheme]
_SEED = 36
# Stripes of the panel in which the adaptive scheme alternates its two codes: both lie before the moving
# patch.
_STRIPES = 8
# A light on fewer panel pixels does not meet all exposures of a code.
_FEW_PX = 8


def made_code(scheme: Scheme, camera: CodedCamera, radiance: RadianceVideo, lamp_px: float) -> ExposureCode:
    """Code of a scheme's first frame; before a light of few pixels (``lamp_px``) one of its exposures."""
    levels = levels_of(scheme, camera)
    bright = radiance.load(0).start > radiance.white_w_m2_sr
    cells = camera.panel_rows, SAMPLES_PER_PITCH, camera.panel_cols, SAMPLES_PER_PITCH
    lit = bright.reshape(cells).any(axis=(1, 3))
    if lit.sum() < _FEW_PX:
        pixels = levels.reshape(len(levels), -1)
        opened = pixels.sum(axis=0, dtype=np.int64)
        # Some frame of a sequence has the longest; for many pixels the mean is typical.
        wanted = opened.max() if lamp_px < _FEW_PX else opened.mean()
        levels[:, lit] = pixels[:, [np.abs(opened - wanted).argmin()]]
    return ExposureCode(levels, np.ones(lit.shape, np.bool_))


def levels_of(scheme: Scheme, camera: CodedCamera) -> Bytes:
    """Drive levels of a scheme's first frame, (slot, v, u)."""
    if isinstance(scheme, MotionAdaptive):
        static, moving = (levels_of(each, camera) for each in (scheme.static, scheme.moving))
        stripe = np.arange(camera.panel_cols) * _STRIPES // camera.panel_cols
        return np.where(stripe % 2 == 0, static, moving)
    tiles = scheme.tiles(camera.slots_per_frame, camera.coded_slots, np.random.default_rng(_SEED))
    return PeriodicCode(tiles, (camera.panel_rows, camera.panel_cols)).levels(0)
