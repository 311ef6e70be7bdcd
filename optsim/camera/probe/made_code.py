"""What the panels of probes show: codes of the experiment's own schemes.

How much of a frame's noise an imperfection is depends on the code by more than a decade: a panel that is open
for a twelfth of a frame lets a leak in for the rest, and has less light whose noise would hide it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optsim.camera.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.coding import MotionAdaptive, Scheme
from optsim.coding.tiles import TiledCode
from optsim.core.quantities import Bytes, ExposureCode, RadianceVideo

Schemes = Mapping[str, Scheme]
_SEED = 36
# Of the panel, in which the adaptive scheme shows its two codes in turn: both are before what moves.
_STRIPES = 8
# A light of fewer panel pixels doesn't see all exposures of a code.
_FEW_PX = 8


def made_code(scheme: Scheme, camera: CodedCamera, radiance: RadianceVideo, lamp_px: float) -> ExposureCode:
    """Code that a scheme shows in its first frame; before a light of few pixels one of its exposures.

    That is the longest, which is there in some frame of a sequence, if the light really is of few pixels
    (``lamp_px``), or else the one nearest to the mean.
    """
    levels = levels_of(scheme, camera)
    bright = radiance.load(0).start > radiance.white_w_m2_sr
    cells = camera.panel_rows, SAMPLES_PER_PITCH, camera.panel_cols, SAMPLES_PER_PITCH
    lit = bright.reshape(cells).any(axis=(1, 3))
    if lit.sum() < _FEW_PX:
        pixels = levels.reshape(len(levels), -1)
        opened = pixels.sum(axis=0, dtype=np.int64)
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
    return TiledCode(tiles, (camera.panel_rows, camera.panel_cols)).levels(0)
