"""The slanted edge of ISO 12233: a picture of one, exact over cells, and the MTF of an image of it.

The edge is nearly upright. Rows are projected along it into bins of a quarter of a pixel, the mean in each is
the edge spread function; its derivative, windowed, is the line spread function, whose Fourier transform is
the MTF. What bins and differences take away is put back. What the window takes away can't be: it cuts wings,
which raises all frequencies but zero. So an MTF to compare with goes through the same window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

_BINS = 4  # a pixel
_FIT_PX = 16  # half width of the window in which rows look for the edge
# Bins of a line spread function that is made of an MTF: so many that its wings don't fold back.
_MADE_OF = 1 << 15


@dataclass(frozen=True)
class Edge:
    """An edge x = x_0 + slope (y - y_0), bright on its left, and how much of it is looked at.

    Parameters
    ----------
    row, col : float
        A point of it, y_0 and x_0, as shares of the picture.
    slope : float
        Columns a row.
    rows : int
        Rows looked at, around that point.
    reach : int
        Columns looked at on both of its sides.
    """

    row: float
    col: float
    slope: float
    rows: int
    reach: int


def picture(edge: Edge, shape: tuple[int, int], bright: float, dark: float) -> np.ndarray:
    """Mean of the edge over each cell of a picture: exact, for slopes above zero."""
    y, x = np.arange(shape[0])[:, None], np.arange(shape[1])
    start = edge.col * shape[1] + edge.slope * (y - edge.row * shape[0]) - x
    # The share of a row of the cell is a ramp of where the edge crosses it; this is its mean over the rows.
    share = (_ramp_integral(start + edge.slope) - _ramp_integral(start)) / edge.slope
    return dark + (bright - dark) * share


def _ramp_integral(t: np.ndarray) -> np.ndarray:
    return np.where(t < 1, np.maximum(t, 0) ** 2 / 2, t - 0.5)


def mtf(image: np.ndarray, edge: Edge, frequencies: np.ndarray) -> np.ndarray:
    """MTF at frequencies in cycles a pixel, across the edge; where it runs is found in the image."""
    top = int(edge.row * image.shape[0]) - edge.rows // 2
    part = image[top : top + edge.rows]
    y, x = np.arange(edge.rows) + 0.5, np.arange(image.shape[1]) + 0.5
    offset, slope = _line(part, x, y, edge)
    distance = (x - offset - slope * y[:, None]) / np.hypot(1, slope)
    bins = np.floor(distance * _BINS + 0.5).astype(int) + edge.reach * _BINS
    seen = (bins >= 0) & (bins <= 2 * edge.reach * _BINS)
    spread = np.bincount(bins[seen], part[seen]) / np.bincount(bins[seen])
    line = spread[:-2] - spread[2:]
    place = (np.arange(line.size) - line.size // 2) / _BINS
    # A bin is a quarter of a pixel wide, and the difference reaches over half a pixel.
    lost = np.sinc(frequencies / _BINS) * np.sinc(2 * frequencies / _BINS)
    return _spectrum(line, place, edge, frequencies) / lost


def windowed(transfer: Callable[[np.ndarray], np.ndarray], edge: Edge, frequencies: np.ndarray) -> np.ndarray:
    """Say what :func:`mtf` finds of an image whose MTF is known, a function of cycles a pixel."""
    line = np.fft.fftshift(np.fft.irfft(transfer(np.fft.rfftfreq(_MADE_OF, 1 / _BINS))))
    place = (np.arange(_MADE_OF) - _MADE_OF // 2) / _BINS
    seen = np.abs(place) <= edge.reach
    return _spectrum(line[seen], place[seen], edge, frequencies)


def _spectrum(line: np.ndarray, place: np.ndarray, edge: Edge, frequencies: np.ndarray) -> np.ndarray:
    """Transform a line spread function in a Hamming window; 1 at frequency 0."""
    line = line * (0.54 + 0.46 * np.cos(np.pi * place / edge.reach))
    return np.abs(np.exp(-2j * np.pi * np.outer(frequencies, place)) @ line) / line.sum()


def _line(part: np.ndarray, x: np.ndarray, y: np.ndarray, edge: Edge) -> tuple[float, float]:
    """Offset and slope of the line through the rows' centroids of the derivative."""
    between, steps = x[:-1] + 0.5, part[:, :-1] - part[:, 1:]
    offset, slope = edge.col * x.size - edge.slope * edge.rows / 2, edge.slope
    for _ in range(3):
        away = between - offset - slope * y[:, None]
        weights = steps * np.where(np.abs(away) < _FIT_PX, np.cos(np.pi * away / 2 / _FIT_PX) ** 2, 0)
        centroids = (weights * between).sum(axis=1) / weights.sum(axis=1)
        slope, offset = np.polyfit(y, centroids, 1)
    return float(offset), float(slope)
