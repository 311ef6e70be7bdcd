# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""The panel's own edges in the flats, which tell where it lies whatever patterns it showed.

Dots and anchors that are counted from 1, or on a panel said to be larger, agree with each other. Their map is
then shifted by a pixel. The edge of the lit panel is not.
"""

from __future__ import annotations

import numpy as np

from optsim.calibration.bench import Bench
from optsim.calibration.pixel_map import PixelMap
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats

SIDES = ("top", "bottom", "left", "right")
# Points across an edge, panel pixels; a panel pixel that is missing or too many shows as 1.
_ACROSS_PX: Doubles = np.linspace(-6.0, 6.0, 121)
# Ends of each side that are left out, where two edges meet.
_CORNER_PX = 8
# How much of the dark beyond an edge must be on the CCD.
_LEAST_BEYOND_PX = 1.6
# An edge is seen if the light beyond falls below this share of that inside.
_DARK = 0.35
_MOST_OFF_PX = 0.5
# Half the difference of opposite edges is a shift, whatever the shape of an edge: 0.01 on the demo's bench.
_MOST_MOVED_PX = 0.1


def edges_off_px(bench: Bench, found: PixelMap, black_dn: Floats) -> dict[str, float]:
    """Find where the lit panel ends, beyond where the map has its sides, panel pixels outwards."""
    from scipy.ndimage import map_coordinates

    flat = max(bench.flats, key=lambda shot: shot.irradiance_w_m2)
    picture = flat.dn.mean(axis=0, dtype=np.float32) - black_dn
    rows, cols = bench.panel_shape
    off: dict[str, float] = {}
    for side in SIDES:
        along = np.arange(_CORNER_PX, (cols if side in ("top", "bottom") else rows) - _CORNER_PX) + 0.5
        if not along.size:
            continue
        outwards, last = (-1, 0) if side in ("top", "left") else (1, rows if side == "bottom" else cols)
        across, place = np.meshgrid(last + outwards * _ACROSS_PX, along, indexing="ij")
        points = (across, place) if side in ("top", "bottom") else (place, across)
        panel: Doubles = np.stack([each.ravel() for each in points], axis=1).astype(np.float64)
        on_ccd = found.on_ccd(panel) - 0.5
        there = np.asarray(((on_ccd >= 0) & (on_ccd <= np.array(picture.shape) - 1)).all(axis=1))
        lines: Bools = np.asarray(there.reshape(len(_ACROSS_PX), -1).all(axis=1))
        n_seen = int(np.argmin(lines)) if not lines.all() else len(lines)
        if not n_seen or _ACROSS_PX[n_seen - 1] < _LEAST_BEYOND_PX:
            continue
        light = map_coordinates(picture, on_ccd.T, order=1).reshape(across.shape)
        profile = np.median(light, axis=1)[:n_seen]
        inside = float(profile[_ACROSS_PX[:n_seen] < -3].mean())
        if profile[-3:].mean() > _DARK * inside:
            continue
        # First fall below half, between two points.
        dark = int(np.argmax(profile < inside / 2))
        if dark:
            fall = (profile[dark - 1] - inside / 2) / (profile[dark - 1] - profile[dark])
            off[side] = float(_ACROSS_PX[dark - 1] + fall * (_ACROSS_PX[1] - _ACROSS_PX[0]))
    return off


def check_edges(bench: Bench, off_px: dict[str, float]) -> None:
    """Refuse a map whose panel does not end where light does."""
    for (first, last), key, size in zip(
        (("top", "bottom"), ("left", "right")), ("rows", "cols"), bench.panel_shape, strict=True
    ):
        shown = {side: off_px[side] for side in (first, last) if side in off_px}
        moved_px = abs(shown[last] - shown[first]) / 2 if len(shown) == 2 else 0.0
        most_px = max(map(abs, shown.values()), default=0.0)
        if most_px <= _MOST_OFF_PX and moved_px <= _MOST_MOVED_PX:
            continue
        said = ", ".join(f"{each:+.2f} at the {side}" for side, each in shown.items())
        cure = f"the {key} of dots and anchors are shifted: count from 0"
        if len(shown) == 2 and abs(shown[first] + shown[last]) > _MOST_OFF_PX:
            cure = f"panel_shape says {size} {key}: correct it, or the {key} of dots and anchors"
        if most_px <= _MOST_OFF_PX:
            cure = "the camera moved between dots and flats: take the bench again"
        raise BenchError(
            f"{bench.where('dots[0]')}: got a panel that ends {said} pixels beyond where the map of dots has "
            f"its edge, expected {_MOST_OFF_PX:g} at most and a shift of {_MOST_MOVED_PX:g}; cure: {cure}"
        )
