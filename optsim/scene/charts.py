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
STAR_CYCLES = 36
"""Cycles round the Siemens star."""
STAR_RADIUS = 0.47
"""Radius of the star, in widths of its texture."""
EDGE_RAD = float(np.deg2rad(5.0))
"""Angle of the slanted edges to the vertical and to the horizontal."""
WEDGE_STEPS = 11
"""Steps of the wedge, each half as bright as the one before."""
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
    """Sinusoidal Siemens star: reflectance = mean + amplitude cos(36 angle) within a disc on grey.

    At a radius r (pixels of the picture) the local frequency is 36 / (2 pi r) cycles per pixel. The
    modulation before the camera is 0.8 (0.9 to 0.1). The centre is flat grey where a cycle is shorter than 8
    texels.

    Source: the sine-based Siemens star of ISO 12233:2014 (annex E; there 144 cycles, here 36, as for pictures
    of a few hundred pixels).
    """
    n = 1024
    x, y = _grid(n, n)
    radius, angle = np.hypot(x - 0.5, y - 0.5), np.arctan2(y - 0.5, x - 0.5)
    within = _inside((STAR_RADIUS - radius) * n) * _inside((radius - 8 * STAR_CYCLES / (2 * np.pi * n)) * n)
    return 0.5 + 0.4 * np.cos(STAR_CYCLES * angle) * within


def slanted_edge() -> Doubles:
    """Dark square (0.15) on light (0.6), turned by 5 degrees: two near-vertical, two near-horizontal edges.

    Source: slanted-edge method of ISO 12233:2014 (annex D): an edge at 5 degrees of contrast 4 : 1, low
    enough that nothing clips. Side of the square: 0.6 of the texture.
    """
    n = 512
    x, y = _grid(n, n)
    across = (x - 0.5) * np.cos(EDGE_RAD) + (y - 0.5) * np.sin(EDGE_RAD)
    up = (y - 0.5) * np.cos(EDGE_RAD) - (x - 0.5) * np.sin(EDGE_RAD)
    share = _inside((0.3 - np.abs(across)) * n) * _inside((0.3 - np.abs(up)) * n)
    return 0.6 + (0.15 - 0.6) * share


def step_wedge() -> Doubles:
    """Eleven upright fields from left to right, reflectance 0.9 / 2^k: densities 0.046 + 0.301 k, 1024 : 1.

    The step of 0.301 in density (one photographic stop) is that of coarse transmission step tablets. As
    reflectances the last ones (down to 0.00088) are darker than any paint. So one evenly lit plane gives the
    whole range.
    """
    x, _ = _grid(64, 64 * WEDGE_STEPS)
    return PAPER / 2.0 ** np.floor(x * WEDGE_STEPS)


def grey_steps() -> Doubles:
    """Six grey fields from left to right, of densities 0.05, 0.23, 0.44, 0.70, 1.05 and 1.50.

    Source: nominal densities of the neutral row of the ColorChecker (McCamy, Marcus, Davidson, "A
    color-rendition chart", J. Appl. Photogr. Eng. 2 (1976) 95, as stated by its maker).
    """
    x, _ = _grid(64, 64 * len(GREY_DENSITIES))
    return 10.0 ** -np.asarray(GREY_DENSITIES)[np.floor(x * len(GREY_DENSITIES)).astype(int)]


def bars() -> Doubles:
    """One period of upright square-wave bars: the left half dark (0.09), the right half light (0.9).

    Modulation 0.82 (10 : 1); ``tile_m`` of the material sets the period. Own definition.
    """
    x, _ = _grid(16, 128)
    return np.where(x < 0.5, PAPER / 10, PAPER)


def fiducial() -> Doubles:
    """Make a mark with a known centre: a quartered disc (bow tie), dark 0.05 on 0.9.

    The centre is a saddle point, to be located to a small part of a pixel. Own definition.
    """
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
