"""PSF tails: coarse in space, and for moving light on straight lines in time.

A PSF window wide enough for the tails of a bright window is far larger than the detail of the fine grid. So
tails work on panel pixels, before and behind the panel. Those of the relay are uniform within a pixel. This
misplaces a share of them by less than two pixels; the share is smaller the farther from the centre they
begin.

Such a window is also far larger than the movers that cross it, and would cost time in every instant. So
moving blocks get the PSF core in each instant. They get the tails only along the straight line in time that
fits the block best within its segment. The error is the tails' share of the deviation from that line. It is
zero for light that changes evenly, and zero in the mean over the segment. The line of a flash may go below
zero in the dark around it. There light begins or ends at zero instead, with the same mean. Core and tails
blend smoothly, so that splines on pixels can represent the tails. There are two rings. The outer one has
cells of several panel pixels: relative to its distance no coarser than the inner.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from optsim.core.compiled import FEW, compiled
from optsim.core.quantities import Doubles, Floats, Segment
from optsim.core.threads import in_bands, side_by_side
from optsim.optics.field_blur import FieldPsf
from optsim.optics.fringing import add_whole_cells, fine_image_adjoint
from optsim.optics.integrate import cell_means
from optsim.optics.pixel_splines import spline_kernel, splines, spread
from optsim.optics.psf import Blur, SomeBlur, extend, make_blur
from optsim.optics.tap_blur import Grid, Patch

# Tails of moving light, panel pixels: inner radius of the outer ring, side of its cells, margin for splines.
_RING_HALF, _CELL, _ROOM = 40, 4, 8
# Share of a core's half width within which it has the whole PSF, and cells from the varying part to its edge.
# The error of a sharp cut is four times as large, that of uniform pixels nine times.
_WHOLE, _SOFT_CELLS = 0.6, 6


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


def moving_ends(segment: Segment) -> Floats:
    """Fit straight lines in time to the moving light of a segment: their ends, array (2, y, x), float32."""
    ends = np.zeros((2, *segment.start.shape), np.float32)
    lines = line_ends(segment.n_instants).astype(np.float32)
    for block in segment.blocks:
        _, height, width = block.excess.shape
        found = ends[:, block.row : block.row + height, block.col : block.col + width]
        if block.excess.size < FEW:
            found += np.tensordot(lines, block.excess, 1)
        else:
            in_bands(height, partial(_add_lines, found, block.excess, lines))
    return ends


# Not BLAS: after a product its threads spin at full speed and slow all others.
@compiled(fastmath=True)
def _add_lines(ends: Floats, excess: Floats, lines: Floats, top: int, bottom: int) -> None:
    width = excess.shape[2]
    start, stop = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(top, bottom):
        start[:], stop[:] = 0, 0
        for t in range(excess.shape[0]):
            for x in range(width):
                start[x] += lines[0, t] * excess[t, y, x]
                stop[x] += lines[1, t] * excess[t, y, x]
        for x in range(width):
            ends[0, y, x] += start[x]
            ends[1, y, x] += stop[x]


def keep_above_zero(start: Floats, stop: Floats) -> None:
    """Raise negative ends of straight lines to zero; the mean is kept, if positive.

    Parameters
    ----------
    start, stop : ndarray of shape (y, x), float32
        Light at the ends of a segment, changed in place.
    """
    both = np.maximum(start + stop, 0)
    first, last = start < 0, stop < 0
    start[last], stop[first] = both[last], both[first]
    start[first], stop[last] = 0, 0


@dataclass(frozen=True, eq=False)
class Ring:
    """A ring of PSF tails, prepared for moving light that continues beyond the panel's edge.

    Parameters
    ----------
    blur : Blur
        Blur on cells, of the field and a margin of ``reach``.
    reach : int
        Half width of the ring, cells.
    cell : int
        Side of a cell, panel pixels.
    """

    blur: Blur
    reach: int
    cell: int

    def light(self, images: Doubles) -> Doubles:
        """Light in this ring of images on panel pixels, (n, v, u)."""
        rows, cols = images.shape[1:]
        whole = np.pad(images, ((0, 0), (0, -rows % self.cell), (0, -cols % self.cell)), mode="edge")
        cells = np.stack([extend(cell_means(image, self.cell), self.reach) for image in whole])
        # In double precision: rounding in single precision would give negative light far from a very bright
        # lamp.
        inner = slice(self.reach, -self.reach)
        found = self.blur.apply(cells)[:, inner, inner]
        return found.repeat(self.cell, axis=1)[:, :rows].repeat(self.cell, axis=2)[:, :, :cols]


def cut_softly(psf: FieldPsf, half: int) -> tuple[FieldPsf, Doubles]:
    """Cut a PSF into a core and tails that add up to it.

    Parameters
    ----------
    psf : FieldPsf
        PSF with which each point collects.
    half : int
        Half width of the core, cells. It is larger if the PSF varies farther out, and the whole PSF if that
        is no wider.

    Returns
    -------
    core : FieldPsf
        Core, falling to zero towards its edge.
    tails : ndarray of shape (2 h + 1, 2 h + 1), float64
        Tails, the same everywhere.
    """
    half = max(half, psf.core_half + _SOFT_CELLS)
    if half >= psf.half:
        return psf, np.zeros_like(psf.kernel)
    core = psf.middle(half)
    whole = max(_WHOLE * half, psf.core_half)
    far = np.abs(np.arange(-half, half + 1))
    fall = np.clip((np.maximum(far[:, None], far) - whole) / (half + 1 - whole), 0, 1)
    kept = core.kernel * np.cos(np.pi / 2 * fall) ** 2
    tails = psf.kernel.copy()
    inner = slice(psf.half - half, psf.half + half + 1)
    tails[inner, inner] -= kept
    return FieldPsf(kept, core.cores), tails


def make_tails(tails: Doubles, pitch: int, shape: tuple[int, int]) -> tuple[Ring, ...]:
    """Prepare PSF tails for moving light on a fine grid of one shape; empty if there are none.

    Parameters
    ----------
    tails : ndarray of shape (2 h + 1, 2 h + 1), float64
        From :func:`cut_softly`.
    pitch : int
        Fine samples to a panel pixel.
    shape : tuple of int
        Rows and columns of the fine grid.
    """
    if not tails.any():
        return ()
    coarse = coarse_kernel(tails, pitch)
    outer = _coarse_tails(coarse, min(_RING_HALF, len(coarse) // 2), _CELL)
    # Splines reach a little farther than the tails they represent.
    half, room = len(tails) // 2, (_RING_HALF + _ROOM) * pitch
    near = slice(max(half - room, 0), half + room + 1)
    inner = spline_kernel(tails[near, near], pitch)
    beyond = max(len(inner) // 2 - _RING_HALF, 0)
    inner = inner[beyond : len(inner) - beyond, beyond : len(inner) - beyond]
    parts = [(inner, 1)] if outer is None else [(inner, 1), (outer, _CELL)]
    inner *= (tails.sum() - sum(part.sum() for part, _ in parts[1:])) / inner.sum()
    rings: list[Ring] = []
    for part, cell in parts:
        reach = len(part) // 2
        rows, cols = (-(-side // pitch // cell) + 2 * reach for side in shape)
        rings.append(Ring(make_blur(part, (rows, cols), wraps=True), reach, cell))
    return tuple(rings)


def _coarse_tails(kernel: Doubles, core_half: int, pitch: int) -> Doubles | None:
    tails, half = kernel.copy(), len(kernel) // 2
    tails[half - core_half : half + core_half + 1, half - core_half : half + core_half + 1] = 0
    return coarse_kernel(tails, pitch) if tails.any() else None


def far_light(ends: Floats, tails: tuple[Ring, ...], pitch: int) -> Doubles:
    """PSF tails of the moving light's straight lines, as splines of panel pixels: array (2, v, u).

    Parameters
    ----------
    ends : ndarray of shape (2, y, x), float32
        From :func:`moving_ends`.
    tails : tuple of Ring
        From :func:`make_tails`, at least one.
    pitch : int
        Fine samples to a panel pixel.
    """
    panel = np.stack(side_by_side(partial(_spline_means, end, pitch) for end in ends))
    return sum((ring.light(panel) for ring in tails[1:]), tails[0].light(panel))


def _spline_means(image: Floats, pitch: int) -> Doubles:
    """Mean of an image under the spline of each panel pixel, (v, u); the border's values continue beyond."""
    if image.size < FEW:
        return fine_image_adjoint(image.astype(np.float64), splines(pitch)) / pitch**2
    around = Grid(image.shape[0] // pitch + 2, image.shape[1] // pitch + 2, 1)
    found = spread(Patch(image[None], 0, 0), pitch, around).excess[0, 2:-2, 2:-2]
    return found.astype(np.float64) / pitch**2


@dataclass(frozen=True, eq=False)
class TailedBlur:
    """Blur on a fine grid, dark outside, with PSF tails on panel pixels and an exact adjoint."""

    near: SomeBlur  # Without the tails.
    far: Blur  # By the tails, on panel pixels.
    pitch: int  # Fine cells to a panel pixel.

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
        """Transpose of :meth:`apply`, for images (..., y, x); the tails are self-adjoint."""
        light = self.near.adjoint(image)
        for part, given in zip(light.reshape(-1, *self.shape), image.reshape(-1, *self.shape), strict=True):
            self._add_far(part, given)
        return light

    def _add_far(self, light: Doubles, image: NDArray[np.floating]) -> None:
        add_whole_cells(light, self.far.apply(cell_means(image, self.pitch)))


def near_half(kernel: Doubles, least: int, share: float) -> int:
    """Half width, ``least`` or more, beyond which kernels, (..., y, x), have at most a share."""
    half = kernel.shape[-1] // 2
    near = min(least, half)

    def beyond(reach: int) -> float:
        inner = slice(half - reach, half + reach + 1)
        return float((kernel.sum(axis=(-2, -1)) - kernel[..., inner, inner].sum(axis=(-2, -1))).max())

    while near < half and beyond(near) > share:
        near = min(half, near + max(1, near // 4))
    return near


def with_tails(near: SomeBlur, kernel: Doubles, near_half: int, pitch: int) -> SomeBlur:
    """Add a kernel's tails, all but its centre of (2 near_half + 1)^2, to a blur by that centre.

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
    coarse = _coarse_tails(kernel, near_half, pitch)
    if coarse is None:
        return near
    return TailedBlur(near, make_blur(coarse, (near.shape[0] // pitch, near.shape[1] // pitch)), pitch)
