"""Panel to CCD at a ratio of 2.88, shifted, turned, tilted and distorted, against counting points."""

from __future__ import annotations

import numpy as np

from optsim.optics.relay import RelayGeometry, overlap_operator

CLAIM = "each fine cell's energy lands on the CCD pixels that its warped square covers"
ORACLE = (
    "240 x 240 points a cell, each carried by barrel, keystone and similarity and counted in its CCD pixel; "
    "numpy only"
)
SOURCE = "area overlap of warped squares; the operator overlaps upright boxes as large as the map makes them"
TOLERANCE = 0.008
REASON = (
    "At 2 mrad a corner of a box moves by 0.1 % of its side, and a keystone of 2 % over 10 cells shears "
    "it by another 0.2 %: shares within 4e-3. Points on a grid miss a border by half of 1/240 of a side, "
    "along each of two borders: 4e-3."
)
FILES = ("optsim/optics/relay.py",)

_POINTS = 240
_CELL_PX, _ROTATION = 2.88 / 3, 2e-3
_SHIFT = (0.37, -0.81)
_KEYSTONE, _BARREL = 0.02, -0.01
_PANEL, _CCD = (21, 27), (26, 32)


def _geometry(shift_y_px: float) -> RelayGeometry:
    return RelayGeometry(
        rows=_PANEL[0],
        cols=_PANEL[1],
        ccd_rows=_CCD[0],
        ccd_cols=_CCD[1],
        cell_px=_CELL_PX,
        magnification=1.0,
        shift_y_px=shift_y_px,
        shift_x_px=_SHIFT[1],
        rotation_rad=_ROTATION,
        keystone_y=_KEYSTONE,
        distortion=_BARREL,
    )


def _counted() -> np.ndarray:
    """Share of each cell in each CCD pixel times the cell's area in pixels: (ccd pixel, cell)."""
    inside = (np.arange(_POINTS) + 0.5) / _POINTS
    shares = np.zeros((_CCD[0] * _CCD[1], _PANEL[0] * _PANEL[1]))
    c, s = np.cos(_ROTATION), np.sin(_ROTATION)
    for row in range(_PANEL[0]):
        for col in range(_PANEL[1]):
            dy, dx = np.meshgrid(row + inside - _PANEL[0] / 2, col + inside - _PANEL[1] / 2, indexing="ij")
            squared = (dy**2 + dx**2) / ((_PANEL[0] / 2) ** 2 + (_PANEL[1] / 2) ** 2)
            scale = (1 + _BARREL * squared) / (1 + _KEYSTONE * dy / (_PANEL[0] / 2))
            dy, dx = scale * dy, scale * dx
            y = np.floor(_CELL_PX * (c * dy + s * dx) + _CCD[0] / 2 + _SHIFT[0]).astype(int)
            x = np.floor(_CELL_PX * (c * dx - s * dy) + _CCD[1] / 2 + _SHIFT[1]).astype(int)
            pixel = (y * _CCD[1] + x).ravel()
            np.add.at(shares[:, row * _PANEL[1] + col], pixel, _CELL_PX**2 / _POINTS**2)
    return shares


def _worst(shift_y_px: float) -> float:
    error = overlap_operator(_geometry(shift_y_px), 1.0).toarray() - _counted()
    return float(error.ravel()[np.abs(error).argmax()])


def measure() -> float:
    """Find the largest deviation of an overlap, CCD pixel areas."""
    return _worst(_SHIFT[0])


def perturbed() -> float:
    """Shift the operator by half a CCD pixel more: the usual pixel-centre mistake."""
    return _worst(_SHIFT[0] + 0.5)
