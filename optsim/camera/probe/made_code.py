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
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bytes, ExposureCode, RadianceVideo
from optsim.optics.fringing import fine_image, whole_cells
from optsim.optics.rims import cell_weights

Schemes = Mapping[str, Scheme]
_SEED = 36
# Side of the panel on which fringing is looked at: more than a tile of 8 x 8, with borders to all sides.
_TILE_PX = 10
# A scheme that is told already does for another trait, if it has so much of the most that any has.
_AS_GOOD = 0.85
# Of slots over the root of slots: far below what shows.
_ROUNDING = 1e-5
# Of the panel, in which the adaptive scheme shows its two codes in turn: both are before what moves.
_STRIPES = 8
# A light of fewer panel pixels doesn't see all exposures of a code.
_FEW_PX = 8


def telling(schemes: Schemes, camera: CodedCamera) -> dict[str, Scheme]:
    """Choose the schemes among which imperfections are largest, by what their codes do in even light.

    Those that let the least light in, of all and of those that open all pixels at once (leaks, and whatever
    blurs: there is less noise), or the most (what lands all over the picture); that change most from slot to
    slot (the panel's response); and whose frames fringing fields change most, in all and beyond what mixing
    neighbours does. Before other light another may suffer several times as much (``README.md`` says where).

    Parameters
    ----------
    schemes : mapping
        Name -> scheme; of schemes that are the same the first one counts.
    camera : CodedCamera
        Of which only slots, how the panel answers and its size matter: the smaller, the faster.

    Returns
    -------
    dict
        One to six of them, the darkest first; the same in whatever order they are given.

    Raises
    ------
    ConfigError
        For a scheme that the slots don't allow, with its name.
    """
    different: dict[str, str] = {}
    for name, scheme in schemes.items():
        different.setdefault(scheme.model_dump_json(), name)
    traits: list[dict[str, tuple[float, str]]] = []
    for record, name in different.items():
        try:
            found = _traits(schemes[name], camera)
        except ConfigError as error:
            raise ConfigError(f"methods, {name!r}: {error}") from None
        traits = traits or [{} for _ in found]
        for of_all, value in zip(traits, found, strict=True):
            if value is not None:
                of_all[name] = value, record
    told: dict[str, Scheme] = {}
    for of_all in traits:
        most = max(of_all.values(), default=None)
        if most is None or any(of_all[name][0] >= _AS_GOOD * most[0] for name in told.keys() & of_all.keys()):
            continue
        name = next(name for name, value in of_all.items() if value == most)
        told[name] = schemes[name]
    return told


def _traits(scheme: Scheme, camera: CodedCamera) -> tuple[float | None, ...]:
    """How dark, evenly dark, bright, changing and fringed a scheme's frames are; None for not at all."""
    code = _levels(scheme, camera).astype(np.float32) / np.float32(255)
    open_share, changing = float(code.mean()), float(np.abs(np.diff(code, axis=0)).sum())
    alike = bool((code == code[:, :1, :1]).all())
    fringed, beyond = (None, None) if alike else _fringed(scheme, camera)
    dark = 1 / max(open_share, 1e-9)
    return dark, dark if alike else None, open_share, changing, fringed, beyond


def _fringed(scheme: Scheme, camera: CodedCamera) -> tuple[float | None, float | None]:
    """Rms of what fringing fields change in even light, and beyond mixing, over the root of the exposure."""
    panel = camera.modulator.model_copy(update={"rim_model": "coarse", "stuck_share": 0.0})
    tile = {"panel_rows": _TILE_PX, "panel_cols": _TILE_PX, "modulator": panel}
    camera = camera.model_copy(update=tile)
    code = ExposureCode(_levels(scheme, camera), np.ones((_TILE_PX, _TILE_PX), np.bool_))
    shutter, _ = camera.shutter(code, None, 1)
    exposure = np.asarray(shutter.weights.sum(axis=0), np.float64)
    mean = float(exposure.mean())
    if shutter.rims is None or not mean:
        return None, None
    seen = cell_weights(shutter.rims, shutter.weights[: camera.coded_slots]).sum(axis=0)
    found: list[float | None] = []
    for without in (whole_cells(exposure, SAMPLES_PER_PITCH), fine_image(exposure, shutter.borders)):
        change = float(np.linalg.norm(seen - without) / np.sqrt(seen.size * mean))
        found.append(change if change > _ROUNDING else None)
    return found[0], found[1]


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
