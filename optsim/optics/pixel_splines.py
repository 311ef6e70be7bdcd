"""Quadratic B-splines that move light from fine samples to panel pixels and back.

These are compiled loops; :mod:`optsim.optics.fringing` does the same with other shares on whole arrays. A
kernel between pixels, together with the splines, replaces one between samples.
"""

from __future__ import annotations

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Doubles, Floats
from optsim.optics.tap_blur import Grid, Patch

# Pixels beyond a kernel's own after which its spline coefficients hardly oscillate.
_SWINGS = 4


def splines(pitch: int) -> Doubles:
    """Shares of the pixel before, the pixel itself and the one after in its samples: array (pitch, 3)."""
    place = (np.arange(pitch) + 0.5) / pitch - 0.5
    return np.stack([(0.5 - place) ** 2 / 2, 0.75 - place**2, (0.5 + place) ** 2 / 2], axis=1)


def spline_kernel(kernel: Doubles, pitch: int) -> Doubles:
    """Kernel between pixels that best replaces one between fine samples, with splines at both ends.

    Least squares over all positions within a pixel: the optimal influence function of R. W. Hockney and J. W.
    Eastwood, *Computer Simulation Using Particles*, 1988, chapter 8, in closed form.
    """
    half = len(kernel) // 2
    reach = -(-half // pitch) + _SWINGS
    n = 2 * reach + 1
    wide = np.zeros((n * pitch, n * pitch))
    at = np.arange(-half, half + 1) % len(wide)
    wide[np.ix_(at, at)] = kernel
    # The spline of the pixel at the origin, on the samples around it.
    line = np.zeros(len(wide))
    line[np.arange(3 * pitch) - 3 * pitch // 2] = splines(pitch)[:, ::-1].T.ravel()
    passed = np.square(np.abs(np.fft.fft(line)) / pitch)
    both = passed[:, None] * passed

    def folded(spectrum: Doubles) -> Doubles:
        return spectrum.reshape(pitch, n, pitch, n).sum(axis=(0, 2))

    best = folded(both * np.fft.fft2(wide).real) / folded(both**2)
    found = np.fft.fftshift(np.fft.ifft2(best).real)
    far = np.abs(np.arange(-reach, reach + 1)) * pitch
    # Beyond the original kernel it would oscillate slightly about 0.
    beyond = np.maximum(far[:, None], far) > half
    found[beyond] = np.maximum(found[beyond], 0)
    return found * (kernel.sum() / found.sum())


def spread(light: Patch, pitch: int, pixels: Grid) -> Patch:
    """Spread light of fine samples to pixels."""
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
    """Fill fine samples, (t, y, x), from pixels."""
    shares = splines(pitch).astype(np.float32)
    _draw(pixels.excess, shares, row - pixels.row * pitch, col - pixels.col * pitch, fine)


@compiled(fastmath=True, makes_arrays=False)
def draw_row(line: Floats | Doubles, shares: Floats | Doubles, drawn: Floats | Doubles) -> None:
    """Fill a row of fine samples from a row of pixels, which has one more on either side."""
    pitch = np.uint64(shares.shape[0])
    for k in range(pitch):
        before, own, after = shares[k, 0], shares[k, 1], shares[k, 2]
        for u in range(np.uint64(line.shape[0] - 2)):
            drawn[u * pitch + k] = (
                before * line[u] + own * line[u + np.uint64(1)] + after * line[u + np.uint64(2)]
            )


@compiled(fastmath=True)
def _draw(pixels: Floats, shares: Floats, row: int, col: int, fine: Floats) -> None:
    """Fill fine samples from pixels, beyond which it is dark."""
    n, cols, pitch = pixels.shape[0], pixels.shape[2], len(shares)
    line, drawn = np.zeros(cols + 2, np.float32), np.empty(cols * pitch, np.float32)
    for t in range(n):
        for y in range(fine.shape[1]):
            _rows_between(pixels, t, (row + y) // pitch, shares, (row + y) % pitch, line)
            draw_row(line, shares, drawn)
            _copy(drawn, col, fine, t, y)


@compiled(fastmath=True, makes_arrays=False)
def _rows_between(pixels: Floats, t: int, v: int, shares: Floats, k: int, line: Floats) -> None:
    """Fill a row of pixels at fine row k within pixel row v."""
    rows, cols, own = pixels.shape[1], np.uint64(pixels.shape[2]), np.uint64(v)
    above, below = np.uint64(max(v - 1, 0)), np.uint64(min(v + 1, rows - 1))
    from_above = shares[k, 0] if v > 0 else np.float32(0)
    from_below = shares[k, 2] if v < rows - 1 else np.float32(0)
    share, instant = shares[k, 1], np.uint64(t)
    for u in range(cols):
        line[u + np.uint64(1)] = (
            from_above * pixels[instant, above, u]
            + share * pixels[instant, own, u]
            + from_below * pixels[instant, below, u]
        )


@compiled(makes_arrays=False)
def _copy(drawn: Floats, first: int, fine: Floats, t: int, y: int) -> None:
    instant, row = np.uint64(t), np.uint64(y)
    for x in range(np.uint64(fine.shape[2])):
        fine[instant, row, x] = drawn[np.uint64(first) + x]


@compiled(fastmath=True)
def _spread(fine: Floats, shares: Floats, row: int, col: int, pixels: Floats) -> None:
    """Add light to pixels, the transpose of ``_draw``; the array has one pixel more on every side."""
    n, rows, cols = fine.shape
    pitch = len(shares)
    # Sum for a row of pixels over the fine rows of three, before spreading along the row.
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
