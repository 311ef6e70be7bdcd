"""What the panels of probes show: codes of the experiment's own schemes.

How much of a frame's noise an imperfection is depends on the code by more than a decade: a panel that is open
for a twelfth of a frame lets a leak in for the rest, and has less light whose noise would hide it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from optsim.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.coding import MotionAdaptive, Scheme
from optsim.coding.tiles import TiledCode
from optsim.errors import ConfigError
from optsim.quantities import Bytes, ExposureCode, Floats, RadianceVideo

Schemes = Mapping[str, Scheme]
_SEED = 36
# Of the panel, in which the adaptive scheme shows its two codes in turn: both are before what moves.
_STRIPES = 8
# A light of fewer panel pixels doesn't see all exposures of a code.
_FEW_PX = 8


def telling(schemes: Schemes, camera: CodedCamera) -> dict[str, Scheme]:
    """Choose the schemes among which imperfections are largest.

    Those that let the least light in (leaks, and whatever blurs: there is less noise), or the most (what
    lands all over the picture); that change most from slot to slot (the panel's response), and whose
    neighbours differ most in a frame (its fringing).

    Parameters
    ----------
    schemes : mapping
        Name -> scheme; of schemes that are the same the first one counts.
    camera : CodedCamera
        Of which only slots and the panel's size matter: the smaller, the faster.

    Returns
    -------
    dict
        One to four of them, the darkest first.

    Raises
    ------
    ConfigError
        For a scheme that the slots don't allow, with its name.
    """
    different: dict[str, str] = {}
    for name, scheme in schemes.items():
        different.setdefault(scheme.model_dump_json(), name)
    traits: dict[str, tuple[float, ...]] = {}
    for name in different.values():
        try:
            traits[name] = _traits(_levels(schemes[name], camera).astype(np.float32) / np.float32(255))
        except ConfigError as error:
            raise ConfigError(f"methods, {name!r}: {error}") from None
    best = [max(traits, key=lambda name, k=k: traits[name][k]) for k in range(4)]
    return {name: schemes[name] for name in dict.fromkeys(best)}


def _traits(code: Floats) -> tuple[float, ...]:
    """How dark, bright, changing and uneven a code is; fringing counts relative to the light's noise."""
    exposure, open_share = code.sum(axis=0), float(code.mean())
    changing = float(np.abs(np.diff(code, axis=0)).sum())
    uneven = sum(float(np.abs(np.diff(exposure, axis=axis)).sum()) for axis in (0, 1))
    return -open_share, open_share, changing, uneven / max(open_share, 1e-9) ** 0.5


def made_code(scheme: Scheme, camera: CodedCamera, radiance: RadianceVideo, lamp_px: float) -> ExposureCode:
    """Code that a scheme shows in its first frame; before a light of few pixels one of its exposures.

    That is the longest, which is there in some frame of a sequence, if the light really is of few pixels
    (``lamp_px``), or else the one nearest to the mean.
    """
    levels = _levels(scheme, camera)
    bright = radiance.load(0).start > radiance.white_w_m2_sr
    cells = camera.panel_rows, SAMPLES_PER_PITCH, camera.panel_cols, SAMPLES_PER_PITCH
    lit = bright.reshape(cells).any(axis=(1, 3))
    if lit.sum() < _FEW_PX:
        pixels = levels.reshape(len(levels), -1)
        opened = pixels.sum(axis=0, dtype=np.int64)
        wanted = opened.max() if lamp_px < _FEW_PX else opened.mean()
        levels[:, lit] = pixels[:, [np.abs(opened - wanted).argmin()]]
    return ExposureCode(levels, np.ones(lit.shape, np.bool_))


def _levels(scheme: Scheme, camera: CodedCamera) -> Bytes:
    """Drive levels of a scheme's first frame, (slot, v, u)."""
    if isinstance(scheme, MotionAdaptive):
        static, moving = (_levels(each, camera) for each in (scheme.static, scheme.moving))
        stripe = np.arange(camera.panel_cols) * _STRIPES // camera.panel_cols
        return np.where(stripe % 2 == 0, static, moving)
    tiles = scheme.tiles(camera.slots_per_frame, camera.coded_slots, np.random.default_rng(_SEED))
    return TiledCode(tiles, (camera.panel_rows, camera.panel_cols)).levels(0)
