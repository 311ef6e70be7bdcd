# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false
"""From the panel to the CCD: one sparse area-overlap operator, a blur before it and a veil behind it.

    ccd = (1 - g) A B energy + g mean over the CCD of (A B energy)

B is the relay's PSF on the fine panel grid, A the overlap of each cell's image with the CCD pixels, and
g the share of the light that veiling glare (ISO 9358) spreads evenly over the CCD: a rank-one term.

A cell's image is taken as an upright square around its warped centre. Under a rotation phi its corners
are off by up to half a cell times phi: under 0.001 CCD pixel for 2 mrad, with no energy gained or lost.
Images are stored upright: the inversion by the relay and the mirror flip by the splitter are undone by
the order of readout, so panel row and CCD row increase together.

Not modelled: distortion, keystone, ghosts, shading of the relay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import sparse

from optsim.forward.psf import Blur
from optsim.quantities import Bools, Doubles, Floats, Ints


@dataclass(frozen=True)
class RelayGeometry:
    """Where the fine panel grid lands on the CCD.

    Parameters
    ----------
    rows, cols : int
        Fine cells on the panel.
    ccd_rows, ccd_cols : int
        CCD pixels; the centre of the panel lands on their centre, plus the shift.
    cell_px : float
        Side of a fine cell's image, CCD pixels.
    magnification : float
        From the panel to the CCD.
    shift_y_px, shift_x_px : float
        Shift of the image, CCD pixels.
    rotation_rad : float
        Rotation of the image about the shifted centre, from x towards y.
    """

    rows: int
    cols: int
    ccd_rows: int
    ccd_cols: int
    cell_px: float
    magnification: float
    shift_y_px: float = 0.0
    shift_x_px: float = 0.0
    rotation_rad: float = 0.0

    def place(self, y: Doubles, x: Doubles) -> tuple[Doubles, Doubles]:
        """CCD coordinates (pixel centres at +0.5) of fine coordinates (cell centres at +0.5)."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        dy, dx = (y - self.rows / 2) * self.cell_px, (x - self.cols / 2) * self.cell_px
        return (
            c * dy + s * dx + self.ccd_rows / 2 + self.shift_y_px,
            c * dx - s * dy + self.ccd_cols / 2 + self.shift_x_px,
        )

    def picks(self, pitch: int) -> tuple[Ints, Ints, Bools]:
        """CCD pixel at the centre of each panel pixel, and whether the CCD has it; each (v, u).

        Parameters
        ----------
        pitch : int
            Fine cells to a panel pixel.

        Returns
        -------
        row, col : ndarray, int64
            Moved onto the CCD where they are not on it.
        on_ccd : ndarray, bool
            Whether they are.
        """
        y, x = self._pixel_centres(pitch)
        # A centre on a border, or rounded to just beside it, belongs to the pixel after it.
        row, col = np.floor(y + 1e-9).astype(np.int64), np.floor(x + 1e-9).astype(np.int64)
        on_ccd = (row >= 0) & (row < self.ccd_rows) & (col >= 0) & (col < self.ccd_cols)
        return row.clip(0, self.ccd_rows - 1), col.clip(0, self.ccd_cols - 1), on_ccd

    def pick_offsets_px(self, pitch: int) -> Doubles:
        """Centre of each picked CCD pixel less that of its panel pixel: array (v, u, 2), panel pixels."""
        row, col, _ = self.picks(pitch)
        y, x = self._pixel_centres(pitch)
        return np.stack([row + 0.5 - y, col + 0.5 - x], axis=-1) / (self.cell_px * pitch)

    def _pixel_centres(self, pitch: int) -> tuple[Doubles, Doubles]:
        """CCD coordinates of the centres of the panel pixels, each (v, u)."""
        v = (np.arange(self.rows // pitch) + 0.5)[:, None] * pitch
        u = (np.arange(self.cols // pitch) + 0.5) * pitch
        return self.place(v + 0 * u, u + 0 * v)


def overlap_operator(geometry: RelayGeometry, transmission: float) -> sparse.csc_array:
    """Sparse operator from radiant exposure on the panel to radiant exposure on the CCD.

    Parameters
    ----------
    geometry : RelayGeometry
        Where each cell lands.
    transmission : float
        Share of a cell's energy that arrives, if it lands on the CCD.

    Returns
    -------
    sparse.csc_array of shape (ccd_rows * ccd_cols, rows * cols), float32
        J m^-2 to J m^-2: overlap in CCD pixel areas / magnification^2 x transmission. Its transpose is
        its exact adjoint.
    """
    g = geometry
    # A square of side s overlaps at most floor(s) + 2 pixels along an axis.
    reach = int(np.floor(g.cell_px)) + 2
    warp = np.array([np.cos(g.rotation_rad), np.sin(g.rotation_rad)]) * g.cell_px
    centre = np.array([g.ccd_rows / 2 + g.shift_y_px, g.ccd_cols / 2 + g.shift_x_px])
    counts = np.zeros(g.rows * g.cols + 1, np.int64)
    empty_rows, empty_values = np.empty(0, np.int32), np.empty(0, np.float32)
    size = (g.rows, g.cols, g.ccd_rows, g.ccd_cols)
    scale = transmission / g.magnification**2
    _overlaps(size, g.cell_px, warp, centre, reach, scale, counts, empty_rows, empty_values, False)
    pointers = np.cumsum(counts)
    indices = np.empty(pointers[-1], np.int32)
    values = np.empty(pointers[-1], np.float32)
    _overlaps(size, g.cell_px, warp, centre, reach, scale, pointers, indices, values, True)
    shape = (g.ccd_rows * g.ccd_cols, g.rows * g.cols)
    return sparse.csc_array((values, indices, pointers.astype(np.int32)), shape=shape)


@njit(nogil=True, cache=True)
def _overlaps(
    size: tuple[int, int, int, int],
    side: float,
    warp: Doubles,
    centre: Doubles,
    reach: int,
    scale: float,
    pointers: Ints,
    indices: NDArray[np.int32],
    values: Floats,
    fill: bool,
) -> None:
    """Count the entries of every column (fill False), or write them from their pointers on."""
    rows, cols, ccd_rows, ccd_cols = size
    for row in range(rows):
        for col in range(cols):
            dy, dx = row + 0.5 - rows / 2, col + 0.5 - cols / 2
            top = warp[0] * dy + warp[1] * dx + centre[0] - side / 2
            left = warp[0] * dx - warp[1] * dy + centre[1] - side / 2
            first_y, first_x = int(np.floor(top)), int(np.floor(left))
            column = row * cols + col
            at = pointers[column]
            for y in range(max(first_y, 0), min(first_y + reach, ccd_rows)):
                high = min(top + side, y + 1.0) - max(top, float(y))
                # Less than a billionth of a pixel is rounding, not overlap.
                if high < 1e-9:
                    continue
                for x in range(max(first_x, 0), min(first_x + reach, ccd_cols)):
                    wide = min(left + side, x + 1.0) - max(left, float(x))
                    if wide < 1e-9:
                        continue
                    if fill:
                        indices[at] = y * ccd_cols + x
                        values[at] = high * wide * scale
                        at += 1
                    else:
                        pointers[column + 1] += 1


@dataclass(frozen=True, eq=False)
class RelayOperator:
    """The whole way from the fine panel grid to the CCD, with its exact adjoint.

    Parameters
    ----------
    blur : Blur
        PSF on the fine panel grid.
    overlap : sparse.csc_array
        From :func:`overlap_operator`.
    glare_share : float
        Share of the light on the CCD that is spread evenly over it.
    ccd_shape : tuple of int
        CCD rows and columns.
    """

    blur: Blur
    overlap: sparse.csc_array
    glare_share: float
    ccd_shape: tuple[int, int]

    def apply(self, energy: NDArray[np.floating]) -> Doubles:
        """Radiant exposure on the CCD, (y, x) of its pixels, from that on the panel, (y, x) fine; J m^-2."""
        return self._veil(self.project(self.blur.apply(energy)))

    def project(self, energy: Doubles) -> Doubles:
        """Area overlap alone: no blur, no veil."""
        image: Doubles = (self.overlap @ energy.ravel()).reshape(self.ccd_shape)
        return image

    def adjoint(self, image: NDArray[np.floating]) -> Doubles:
        """Transpose of :meth:`apply`: from the CCD's grid to the fine panel grid."""
        back = self.overlap.T @ self._veil(image.astype(np.float64)).ravel()
        return self.blur.apply(back.reshape(self.blur.shape))

    def _veil(self, image: Doubles) -> Doubles:
        return (1 - self.glare_share) * image + self.glare_share * image.mean()
