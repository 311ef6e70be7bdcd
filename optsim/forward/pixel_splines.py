# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""Light between fine samples and panel pixels by quadratic B-splines: spread to them, and drawn from them.

What :mod:`optsim.forward.fringing` does with other shares on whole arrays, as compiled loops.
"""

from __future__ import annotations

import numpy as np

from optsim.forward.compiled import compiled
from optsim.forward.tap_blur import Grid, Patch
from optsim.quantities import Doubles, Floats


def splines(pitch: int) -> Doubles:
    """Shares of the pixel before, the pixel itself and the one after in its samples: array (pitch, 3)."""
    place = (np.arange(pitch) + 0.5) / pitch - 0.5
    return np.stack([(0.5 - place) ** 2 / 2, 0.75 - place**2, (0.5 + place) ** 2 / 2], axis=1)


def spread(light: Patch, pitch: int, pixels: Grid) -> Patch:
    """Spread light of fine samples to pixels.

    Parameters
    ----------
    light : Patch
        On fine samples; where it touches the border of the field, it goes on beyond.
    pitch : int
        Fine samples to a pixel.
    pixels : Grid
        Of the field, with a margin of pixels around it.

    Returns
    -------
    Patch
        On the grid of pixels.
    """
    shares, beyond = splines(pitch).astype(np.float32), pixels.margin * pitch
    n, height, width = light.excess.shape
    corner: list[int] = []
    ends: list[tuple[int, int]] = []
    sides = ((light.row, height, pixels.rows), (light.col, width, pixels.cols))
    for first, size, whole in sides:
        at_border = first == 0, first + size == (whole - 2 * pixels.margin) * pitch
        ends.append((beyond if at_border[0] else 0, beyond if at_border[1] else 0))
        corner.append(0 if at_border[0] else first + beyond)
    excess = np.pad(light.excess, [(0, 0), *ends], mode="edge") if np.any(ends) else light.excess
    # One pixel more on every side has a share.
    before = [at // pitch - 1 for at in corner]
    after = [-(-(at + size) // pitch) + 1 for at, size in zip(corner, excess.shape[1:], strict=True)]
    found = np.zeros((n, after[0] - before[0], after[1] - before[1]), np.float32)
    down, across = corner[0] - before[0] * pitch, corner[1] - before[1] * pitch
    _spread(excess, shares, down, across, found)
    return Patch(found, before[0], before[1])


def draw(pixels: Patch, pitch: int, row: int, col: int, fine: Floats) -> None:
    """Fill fine samples, (t, y, x), from pixels.

    Parameters
    ----------
    pixels : Patch
        Light on pixels, its place counted from the beginning of the field; beyond them it is dark.
    pitch : int
        Fine samples to a pixel.
    row, col : int
        Where the fine samples begin in the field.
    fine : ndarray of shape (t, y, x), float32
        Filled.
    """
    shares = splines(pitch).astype(np.float32)
    _draw(pixels.excess, shares, row - pixels.row * pitch, col - pixels.col * pitch, fine)


@compiled(fastmath=True)
def _draw(pixels: Floats, shares: Floats, row: int, col: int, fine: Floats) -> None:
    """Fill fine samples from pixels, beyond which it is dark."""
    n, rows, cols = pixels.shape
    pitch, dark = len(shares), np.zeros(cols, np.float32)
    line, drawn = np.zeros(cols + 2, np.float32), np.empty(cols * pitch, np.float32)
    for t in range(n):
        for y in range(fine.shape[1]):
            v = (row + y) // pitch
            before, own, after = shares[(row + y) % pitch]
            above, below = pixels[t, v - 1] if v > 0 else dark, pixels[t, v + 1] if v < rows - 1 else dark
            here, middle = pixels[t, v], line[1:-1]
            for u in range(cols):
                middle[u] = before * above[u] + own * here[u] + after * below[u]
            for k in range(pitch):
                before, own, after = shares[k]
                for u in range(cols):
                    drawn[u * pitch + k] = before * line[u] + own * line[u + 1] + after * line[u + 2]
            fine[t, y] = drawn[col : col + fine.shape[2]]


@compiled(fastmath=True)
def _spread(fine: Floats, shares: Floats, row: int, col: int, pixels: Floats) -> None:
    """Add light to pixels, the transpose of drawing it; there is one more on every side than it lies in."""
    n, rows, cols = fine.shape
    pitch = len(shares)
    # Of each row of pixels what comes from the fine rows of three, before it is spread across.
    line = np.empty(cols, np.float32)
    for t in range(n):
        for v in range(row // pitch - 1, (row + rows - 1) // pitch + 2):
            line[:] = 0
            for y in range(max((v - 1) * pitch - row, 0), min((v + 2) * pitch - row, rows)):
                own = (row + y) // pitch
                share, light = shares[(row + y) % pitch, v - own + 1], fine[t, y]
                for x in range(cols):
                    line[x] += share * light[x]
            to, u, k = pixels[t, v], col // pitch, col % pitch
            for x in range(cols):
                light_x = line[x]
                to[u - 1] += shares[k, 0] * light_x
                to[u] += shares[k, 1] * light_x
                to[u + 1] += shares[k, 2] * light_x
                k += 1
                if k == pitch:
                    u, k = u + 1, 0
