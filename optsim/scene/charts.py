"""Test charts as textures: their content is known exactly, so that pictures can be measured.

All are reflectances (0 .. 1) with row 0 at the lower edge. Sharp boundaries are smoothed by one texel, so
that they match their formula to a small part of a texel.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from optsim.core.quantities import Doubles

PAPER = 0.9
"""Reflectance of the targets' white."""
# ISO 12233:2014, annex E: 144 there, 36 for pictures of a few hundred pixels.
STAR_CYCLES = 36
"""Cycles round the Siemens star."""
STAR_RADIUS = 0.47
"""Radius of the star, in widths of its texture."""
EDGE_RAD = float(np.deg2rad(5.0))
"""Angle of the slanted edges to the vertical and to the horizontal."""
WEDGE_STEPS = 11
"""Steps of the wedge, each half as bright as the one before."""
# The ColorChecker's neutral row: McCamy, Marcus, Davidson, "A color-rendition chart", J. Appl. Photogr. Eng.
# 2 (1976) 95, nominal densities as stated by its maker.
GREY_DENSITIES = (0.05, 0.23, 0.44, 0.70, 1.05, 1.50)
"""Densities of the grey steps."""


def _grid(rows: int, cols: int) -> tuple[Doubles, Doubles]:
    """Texel centres (x, y) in texture widths and heights."""
    y, x = np.indices((rows, cols)) + 0.5
    return x / cols, y / rows


def _inside(distance_texels: Doubles) -> Doubles:
    """Share of a texel that lies inside a straight boundary, from its signed distance (positive inside)."""
    return np.clip(distance_texels + 0.5, 0, 1)


def siemens_star() -> Doubles:
    """Sinusoidal Siemens star of modulation 0.8: 36 / (2 pi r) cycles per pixel at a radius of r pixels."""
    n = 1024
    x, y = _grid(n, n)
    radius, angle = np.hypot(x - 0.5, y - 0.5), np.arctan2(y - 0.5, x - 0.5)
    # Flat grey in the centre, where a cycle is shorter than 8 texels, and outside the disc.
    within = _inside((STAR_RADIUS - radius) * n) * _inside((radius - 8 * STAR_CYCLES / (2 * np.pi * n)) * n)
    return 0.5 + 0.4 * np.cos(STAR_CYCLES * angle) * within


def slanted_edge() -> Doubles:
    """Dark square (0.15) on light (0.6), turned by 5 degrees: near-vertical and near-horizontal edges."""
    n = 512
    x, y = _grid(n, n)
    across = (x - 0.5) * np.cos(EDGE_RAD) + (y - 0.5) * np.sin(EDGE_RAD)
    up = (y - 0.5) * np.cos(EDGE_RAD) - (x - 0.5) * np.sin(EDGE_RAD)
    share = _inside((0.3 - np.abs(across)) * n) * _inside((0.3 - np.abs(up)) * n)
    # ISO 12233:2014 (annex D): contrast 4 : 1, low enough that nothing clips.
    return 0.6 + (0.15 - 0.6) * share


def step_wedge() -> Doubles:
    """Eleven upright fields, left to right: reflectance 0.9 / 2^k, densities 0.046 + 0.301 k, 1024 : 1."""
    # Coarse transmission tablets step by 0.301, a stop. The last fields (0.00088) are darker than paint.
    x, _ = _grid(64, 64 * WEDGE_STEPS)
    return PAPER / 2.0 ** np.floor(x * WEDGE_STEPS)


def grey_steps() -> Doubles:
    """Six grey fields from left to right, of the densities :data:`GREY_DENSITIES`."""
    x, _ = _grid(64, 64 * len(GREY_DENSITIES))
    return 10.0 ** -np.asarray(GREY_DENSITIES)[np.floor(x * len(GREY_DENSITIES)).astype(int)]


def bars() -> Doubles:
    """One period (the material's ``tile_m``) of upright bars: left half dark (0.09), right light (0.9)."""
    x, _ = _grid(16, 128)
    return np.where(x < 0.5, PAPER / 10, PAPER)


def fiducial() -> Doubles:
    """Quartered disc (bow tie), dark 0.05 on 0.9: its centre, a saddle point, is located to sub-pixels."""
    n = 256
    x, y = _grid(n, n)
    disc = _inside((0.45 - np.hypot(x - 0.5, y - 0.5)) * n)
    dark = np.where((x < 0.5) == (y < 0.5), 1.0, 0.0)
    return PAPER + (0.05 - PAPER) * disc * dark


CHARTS: dict[str, Callable[[], Doubles]] = {
    "bars": bars,
    "fiducial": fiducial,
    "grey_steps": grey_steps,
    "siemens_star": siemens_star,
    "slanted_edge": slanted_edge,
    "step_wedge": step_wedge,
}
