# pyright: reportUnknownMemberType=false, reportMissingTypeStubs=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Relay operator, panel to CCD: a blur, a ghost, a sparse area overlap, and veiling glare.

    ccd = V A ((1 - h) B + h G) energy,    V image = (1 - g) image + g mean over the CCD of image

B is the relay's PSF on the fine panel grid, which may vary over the field. A is the overlap of each cell's
image with the CCD pixels. G is the ghost: light reflected back from a face, mirrored and far out of focus. g
is the share that veiling glare (ISO 9358) spreads evenly over the CCD: a rank-one term. G is so smooth that
it is computed on panel pixels.

A cell's image is modelled as an upright rectangle around its mapped centre, with the map's local scale. Under
a rotation phi its corners are off by up to half a cell times phi: under 0.001 CCD pixel for 2 mrad, with no
energy gained or lost. Images are stored upright. The order of readout undoes the relay's inversion and the
splitter's mirror flip, so panel row and CCD row increase together.

Not modelled: shading of the relay. Light has one wavelength, and the geometry is for that wavelength.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from optsim.core.compiled import FEW, compiled
from optsim.core.quantities import Bools, Doubles, Ints
from optsim.optics.fringing import add_whole_cells, whole_cells
from optsim.optics.ghost import mirrored
from optsim.optics.integrate import cell_means
from optsim.optics.psf import SomeBlur

_OUTLINE = 101  # points along a side of the panel


@dataclass(frozen=True)
class RelayGeometry:
    """Geometry of the fine panel grid's image on the CCD.

    Parameters
    ----------
    rows, cols : int
        Fine cells on the panel.
    ccd_rows, ccd_cols : int
        CCD pixels; the centre of the panel lands on their centre, plus the shift.
    cell_px : float
        Side of a fine cell's image, CCD pixels.
    magnification : float
        Magnification from the panel to the CCD.
    shift_y_px, shift_x_px : float
        Shift of the image, CCD pixels.
    rotation_rad : float
        Rotation of the image about the shifted centre, from x towards y.
    keystone_y, keystone_x : float
        Relative reduction of the last row's, or column's, image against the middle one: a tilted panel.
    distortion : float
        Relative change of the distance from the centre at the panel's corners, growing with its square:
        positive is a pincushion.
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
    keystone_y: float = 0.0
    keystone_x: float = 0.0
    distortion: float = 0.0

    def place(self, y: Doubles, x: Doubles) -> tuple[Doubles, Doubles]:
        """CCD coordinates (pixel centres at +0.5) of fine coordinates (cell centres at +0.5)."""
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        dy, dx = (y - self.rows / 2) * self.cell_px, (x - self.cols / 2) * self.cell_px
        if self.distortion or self.keystone_y or self.keystone_x:
            half_y, half_x = self.rows / 2 * self.cell_px, self.cols / 2 * self.cell_px
            scale = 1 + self.distortion * (dy**2 + dx**2) / (half_y**2 + half_x**2)
            scale = scale / (1 + self.keystone_y * dy / half_y + self.keystone_x * dx / half_x)
            dy, dx = dy * scale, dx * scale
        return (
            c * dy + s * dx + self.ccd_rows / 2 + self.shift_y_px,
            c * dx - s * dy + self.ccd_cols / 2 + self.shift_x_px,
        )

    def ccd_pixels(self, pitch: int, side: int = 1) -> tuple[Ints, Ints, Bools]:
        """CCD pixel at the centre of each panel pixel, and whether its window is on the CCD; each (v, u).

        Parameters
        ----------
        pitch : int
            Fine cells to a panel pixel.
        side : int
            Side of the readout window, CCD pixels.

        Returns
        -------
        row, col : ndarray, int64
            Clipped to the CCD.
        on_ccd : ndarray, bool
            Whether the whole window is on the CCD.
        """
        y, x = self._pixel_centres(pitch)
        # A centre on a border, within rounding, belongs to the pixel after it.
        row, col = np.floor(y + 1e-9).astype(np.int64), np.floor(x + 1e-9).astype(np.int64)
        half = side // 2
        on_ccd = (row >= half) & (row < self.ccd_rows - half)
        on_ccd &= (col >= half) & (col < self.ccd_cols - half)
        return row.clip(0, self.ccd_rows - 1), col.clip(0, self.ccd_cols - 1), on_ccd

    def offsets_px(self, pitch: int) -> Doubles:
        """Centre of each mapped CCD pixel minus that of its panel pixel: array (v, u, 2), panel pixels."""
        row, col, _ = self.ccd_pixels(pitch)
        y, x = self._pixel_centres(pitch)
        return np.stack([row + 0.5 - y, col + 0.5 - x], axis=-1) / (self.cell_px * pitch)

    def extent(self) -> tuple[float, float, float, float]:
        """Top, bottom, left and right of the panel's image, CCD coordinates."""
        y, x = np.linspace(0, self.rows, _OUTLINE), np.linspace(0, self.cols, _OUTLINE)
        rim_y = np.concatenate([y, y, 0 * x, 0 * x + self.rows])
        rim_x = np.concatenate([0 * y, 0 * y + self.cols, x, x])
        on_y, on_x = self.place(rim_y, rim_x)
        return float(on_y.min()), float(on_y.max()), float(on_x.min()), float(on_x.max())

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
        Geometry of the cells' images.
    transmission : float
        Transmission of a cell's energy onto the CCD.

    Returns
    -------
    sparse.csc_array of shape (ccd_rows * ccd_cols, rows * cols), float64
        J m^-2 to J m^-2: overlap in CCD pixel areas / magnification^2 x transmission. Its transpose is its
        exact adjoint.
    """
    g = geometry
    boxes = _boxes(g)
    # A side s overlaps at most floor(s) + 2 pixels.
    reach = int(np.floor(max(float(boxes[2].max()), float(boxes[3].max())))) + 2
    if g.rows * g.cols < FEW:
        return _small_overlap(g, boxes, reach, transmission)
    counts = np.zeros(g.rows * g.cols + 1, np.int64)
    empty_rows, empty_values = np.empty(0, np.int32), np.empty(0)
    ccd = (g.ccd_rows, g.ccd_cols)
    scale = _scale(g, transmission)
    _overlaps(ccd, boxes, reach, scale, counts, empty_rows, empty_values, False)
    pointers = np.cumsum(counts)
    indices = np.empty(pointers[-1], np.int32)
    # Same precision as its operand, to avoid a conversion at every use.
    values = np.empty(pointers[-1])
    _overlaps(ccd, boxes, reach, scale, pointers, indices, values, True)
    shape = (g.ccd_rows * g.ccd_cols, g.rows * g.cols)
    return sparse.csc_array((values, indices, pointers.astype(np.int32)), shape=shape)


def _scale(geometry: RelayGeometry, transmission: float) -> float:
    """Ratio of a CCD pixel's radiant exposure to that of a cell imaged within it."""
    return transmission * geometry.cell_px**2 / geometry.magnification**2


def _small_overlap(
    geometry: RelayGeometry, boxes: Doubles, reach: int, transmission: float
) -> sparse.csc_array:
    """As :func:`overlap_operator`, for all cells together: each pixel that a cell may reach."""
    top, left, height, width = boxes.reshape(4, -1)
    found: list[tuple[Doubles, Ints, Ints]] = []
    for down in range(reach):
        y = np.floor(top) + down
        high = np.minimum(top + height, y + 1) - np.maximum(top, y)
        for right in range(reach):
            x = np.floor(left) + right
            wide = np.minimum(left + width, x + 1) - np.maximum(left, x)
            # Less than a billionth of a pixel is rounding, not overlap.
            met = (high >= 1e-9) & (wide >= 1e-9)
            cell = np.flatnonzero(
                met & (y >= 0) & (y < geometry.ccd_rows) & (x >= 0) & (x < geometry.ccd_cols)
            )
            pixel = (y[cell] * geometry.ccd_cols + x[cell]).astype(np.int64)
            found.append(((high * wide / (height * width))[cell], pixel, cell))
    shares, pixels, cells = (np.concatenate(each) for each in zip(*found, strict=True))
    values = shares * _scale(geometry, transmission)
    shape = (geometry.ccd_rows * geometry.ccd_cols, geometry.rows * geometry.cols)
    return sparse.csc_array((values, (pixels, cells)), shape=shape)


def _boxes(geometry: RelayGeometry) -> Doubles:
    """Top, left, height and width of each cell's image, CCD pixels: array (4, row, col)."""
    y = (np.arange(geometry.rows) + 0.5)[:, None]
    x = np.arange(geometry.cols) + 0.5
    sides: list[Doubles] = []
    for step_y, step_x in ((0.5, 0.0), (0.0, 0.5)):
        ahead = geometry.place(y + step_y + 0 * x, x + step_x + 0 * y)
        behind = geometry.place(y - step_y + 0 * x, x - step_x + 0 * y)
        sides.append(np.hypot(ahead[0] - behind[0], ahead[1] - behind[1]))
    centre_y, centre_x = geometry.place(y + 0 * x, x + 0 * y)
    return np.stack([centre_y - sides[0] / 2, centre_x - sides[1] / 2, *sides])


@compiled()
def _overlaps(
    ccd: tuple[int, int],
    boxes: Doubles,
    reach: int,
    scale: float,
    pointers: Ints,
    indices: NDArray[np.int32],
    values: Doubles,
    fill: bool,
) -> None:
    """Count the entries of every column (fill False), or write them at their pointers."""
    ccd_rows, ccd_cols = ccd
    _, rows, cols = boxes.shape
    for row in range(rows):
        for col in range(cols):
            top, left, height, width = boxes[:, row, col]
            first_y, first_x = int(np.floor(top)), int(np.floor(left))
            column = row * cols + col
            at = pointers[column]
            for y in range(max(first_y, 0), min(first_y + reach, ccd_rows)):
                high = min(top + height, y + 1.0) - max(top, float(y))
                # Less than a billionth of a pixel is rounding, not overlap.
                if high < 1e-9:
                    continue
                for x in range(max(first_x, 0), min(first_x + reach, ccd_cols)):
                    wide = min(left + width, x + 1.0) - max(left, float(x))
                    if wide < 1e-9:
                        continue
                    if fill:
                        indices[at] = y * ccd_cols + x
                        values[at] = high * wide / (height * width) * scale
                        at += 1
                    else:
                        pointers[column + 1] += 1


@dataclass(frozen=True)
class Ghost:
    """Ghost image, mirrored through the axis and out of focus; its own adjoint.

    Parameters
    ----------
    share : float
        Share of the light.
    blur_px : float
        Standard deviation of its blur, panel pixels.
    pitch : int
        Fine cells to a panel pixel.
    """

    share: float
    blur_px: float
    pitch: int

    def apply(self, energy: NDArray[np.floating]) -> Doubles:
        """Image of the fine panel grid on itself, (y, x)."""
        return whole_cells(self.on_pixels(energy), self.pitch)

    def on_pixels(self, energy: NDArray[np.floating]) -> Doubles:
        """Compute the same image on panel pixels, (v, u), where it is smooth."""
        return mirrored(cell_means(energy, self.pitch), self.blur_px)


@dataclass(frozen=True, eq=False)
class RelayOperator:
    """The whole operator from the fine panel grid to the CCD, with its exact adjoint.

    Parameters
    ----------
    blur : Blur, FieldBlur or TailedBlur
        PSF on the fine panel grid.
    overlap : sparse.csc_array
        From :func:`overlap_operator`.
    glare_share : float
        Share of the light on the CCD that is spread evenly over it.
    ccd_shape : tuple of int
        CCD rows and columns.
    ghost : Ghost, optional
        Mirrored light.
    """

    blur: SomeBlur
    overlap: sparse.csc_array
    glare_share: float
    ccd_shape: tuple[int, int]
    ghost: Ghost | None = None

    def apply(self, energy: NDArray[np.floating]) -> Doubles:
        """Radiant exposure on the CCD, (y, x) of its pixels, from that on the panel, (y, x) fine; J m^-2."""
        return self._veil(self.project(self._with_ghost(self.blur.apply(energy), energy)))

    def project(self, energy: Doubles) -> Doubles:
        """Area overlap alone: no blur, no veil."""
        image: Doubles = (self.overlap @ energy.ravel()).reshape(self.ccd_shape)
        return image

    def adjoint(self, image: NDArray[np.floating]) -> Doubles:
        """Transpose of :meth:`apply`: from the CCD's grid to the fine panel grid."""
        back = (self.overlap.T @ self._veil(image.astype(np.float64)).ravel()).reshape(self.blur.shape)
        return self._with_ghost(self.blur.adjoint(back), back)

    def _with_ghost(self, direct: Doubles, energy: NDArray[np.floating]) -> Doubles:
        """Subtract the ghost's share from the direct light and add the ghost, which is its own adjoint."""
        if self.ghost is None or self.ghost.share == 0:
            return direct
        direct *= 1 - self.ghost.share
        add_whole_cells(direct, self.ghost.share * self.ghost.on_pixels(energy))
        return direct

    def _veil(self, image: Doubles) -> Doubles:
        return (1 - self.glare_share) * image + self.glare_share * image.mean()
