# pyright: reportUnknownMemberType=false
"""The far wings of a PSF: coarse in space, and on moving light a straight line in time.

A PSF window wide enough for a bright window's wings is far larger than all that changes from one fine sample
to the next. So wings work on panel pixels, behind the panel as before it: within a pixel they are even, which
misplaces a share of them by less than two pixels, the smaller the farther from the middle they begin.

Such a window is also far larger than the movers that cross it, and would be paid for in every instant. So
moving blocks get the PSF's core in each instant, and its wings on the straight line in time that fits the
block best within its segment. What is left out is the wings' share of what deviates from that line: nothing
for light that comes and goes evenly, and nothing at all in the mean over the segment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optsim.forward.integrate import cell_means
from optsim.forward.psf import Blur, SomeBlur, extend, make_blur
from optsim.quantities import Doubles, Segment


def coarse_kernel(kernel: Doubles, pitch: int) -> Doubles:
    """Kernel between cells of pitch x pitch samples: mean over both, (odd, odd), of the same sum."""
    triangle = (pitch - np.abs(np.arange(1 - pitch, pitch))) / pitch
    half = kernel.shape[0] // 2
    reach = -(-(half + pitch - 1) // pitch)
    # Sample k of the padded kernel lies k - reach * pitch - (pitch - 1) samples from its centre.
    wide = np.pad(kernel, reach * pitch + pitch - 1 - half)
    n = len(wide) - 2 * (pitch - 1)
    down = sum((part * wide[k : k + n] for k, part in enumerate(triangle)), np.zeros((n, len(wide))))
    both = sum((part * down[:, k : k + n] for k, part in enumerate(triangle)), np.zeros((n, n)))
    return np.ascontiguousarray(both[::pitch, ::pitch])


def line_ends(n: int) -> Doubles:
    """Weights of n instants in the two ends of the least-squares line through them: array (2, n)."""
    if n == 1:
        return np.ones((2, 1))
    a = (np.arange(n) + 0.5) / n - 0.5
    slope = a / (a @ a) / 2
    return np.stack([1 / n - slope, 1 / n + slope])


def moving_ends(segment: Segment) -> Doubles:
    """Find the ends of straight lines through all moving light of a segment: array (2, y, x), float64."""
    ends = np.zeros((2, *segment.start.shape))
    lines = line_ends(segment.n_instants).astype(np.float32)
    for block in segment.blocks:
        n, height, width = block.excess.shape
        line = (lines @ block.excess.reshape(n, -1)).reshape(2, height, width)
        ends[:, block.row : block.row + height, block.col : block.col + width] += line
    return ends


def make_wings(kernel: Doubles, core_half: int, pitch: int, shape: tuple[int, int]) -> Blur | None:
    """Prepare a PSF's wings for moving light on a fine grid of one shape; None if there are none.

    Parameters
    ----------
    kernel : ndarray of shape (2 h + 1, 2 h + 1), float64
        The whole PSF, of which the wings are all but the middle, (2 core_half + 1)^2.
    core_half : int
        At most h.
    pitch : int
        Fine samples to a panel pixel.
    shape : tuple of int
        Rows and columns of the fine grid.
    """
    coarse = _coarse_wings(kernel, core_half, pitch)
    if coarse is None:
        return None
    reach = coarse.shape[0] // 2
    wide = (shape[0] // pitch + 2 * reach, shape[1] // pitch + 2 * reach)
    return make_blur(coarse, wide, wraps=True)


def _coarse_wings(kernel: Doubles, core_half: int, pitch: int) -> Doubles | None:
    wings, half = kernel.copy(), len(kernel) // 2
    wings[half - core_half : half + core_half + 1, half - core_half : half + core_half + 1] = 0
    return coarse_kernel(wings, pitch) if wings.any() else None


def far_light(ends: Doubles, wings: Blur, pitch: int) -> Doubles:
    """Light in the wings of the moving light's straight lines, on panel pixels: array (2, v, u).

    Parameters
    ----------
    ends : ndarray of shape (2, y, x), float64
        From :func:`moving_ends`.
    wings : Blur
        From :func:`make_wings`.
    pitch : int
        Fine samples to a panel pixel.
    """
    rows, cols = ends.shape[1] // pitch, ends.shape[2] // pitch
    reach = (wings.shape[0] - rows) // 2
    coarse = [extend(cell_means(end, pitch), reach) for end in ends]
    # In double precision: the noise of single one would be negative light far from a very bright lamp.
    return wings.apply(np.stack(coarse))[:, reach : reach + rows, reach : reach + cols]


@dataclass(frozen=True, eq=False)
class Winged:
    """Blur on a fine grid, dark outside, whose far wings work on panel pixels; with its exact adjoint.

    Parameters
    ----------
    near : Blur or FieldBlur
        All but the wings.
    far : Blur
        The wings, on panel pixels.
    pitch : int
        Fine cells to a panel pixel.
    """

    near: SomeBlur
    far: Blur
    pitch: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the fine grid."""
        return self.near.shape

    def apply(self, image: NDArray[np.floating]) -> Doubles:
        """Spread the light of an image."""
        light = self.near.apply(image)
        self._add_far(light, image)
        return light

    def adjoint(self, image: NDArray[np.floating]) -> Doubles:
        """Transpose of :meth:`apply`, for images (..., y, x): the wings are their own."""
        light = self.near.adjoint(image)
        for part, given in zip(light.reshape(-1, *self.shape), image.reshape(-1, *self.shape), strict=True):
            self._add_far(part, given)
        return light

    def _add_far(self, light: Doubles, image: NDArray[np.floating]) -> None:
        far = self.far.apply(cell_means(image, self.pitch)).repeat(self.pitch, axis=1)
        for y in range(self.pitch):
            light[y :: self.pitch] += far


def near_half(kernel: Doubles, least: int, share: float) -> int:
    """Half width, ``least`` or more, of a kernel's middle that all but a share of its light lies in."""
    half = len(kernel) // 2
    near = min(least, half)

    def within(reach: int) -> float:
        inner = slice(half - reach, half + reach + 1)
        return float(kernel[inner, inner].sum())

    while near < half and within(near) < 1 - share:
        near = min(half, near + max(1, near // 4))
    return near


def winged(near: SomeBlur, kernel: Doubles, near_half: int, pitch: int) -> SomeBlur:
    """Add a kernel's wings, all but its middle, (2 near_half + 1)^2, to a blur that has the rest.

    Parameters
    ----------
    near : Blur or FieldBlur
        On the fine grid.
    kernel : ndarray of shape (2 h + 1, 2 h + 1), float64
        The whole PSF, symmetric about its centre.
    near_half : int
        At most h.
    pitch : int
        Fine cells to a panel pixel.
    """
    coarse = _coarse_wings(kernel, near_half, pitch)
    if coarse is None:
        return near
    return Winged(near, make_blur(coarse, (near.shape[0] // pitch, near.shape[1] // pitch)), pitch)
