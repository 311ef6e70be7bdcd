# pyright: reportMissingTypeStubs=false
"""Neyman's optimal allocation of samples to pixels, from the statistics of earlier poses.

For a given mean squared relative error the cost is least if the number of samples is proportional to the
standard deviation of one sample over the pixel's radiance, and to one over the square root of a sample's cost
(J. Neyman, J. R. Stat. Soc. 97, 558-625, 1934). These come from *other* random numbers than those then spent
(a pilot, or the pose before), so the estimate stays unbiased.

Statistics are kept by tile, since a pixel has too few samples. Sample counts are powers of two.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from optsim.core.quantities import Doubles, Floats, Ints

TILE_PX = 4
# Lower limit of a tile's statistics, as a share of the picture's mean: paths may meet a mover in a tile where
# none did so far. By experiment on window_room; it changes the cost little.
_DOUBT = 0.1
# Default limit of samples a pixel and half (no source).
MOST = 128.0
# Weight of older statistics for each newer pose (no source).
_MEMORY = np.float32(0.8)


@dataclass(frozen=True, eq=False)
class Statistics:
    """Sample statistics: sums over each tile's pixels, (ty, tx), passed from one pose to the next."""

    variance: Floats  # Sum of estimates of the variance of one sample, (W m^-2 sr^-1)^2.
    radiance: Floats  # Sum of estimates of the radiance, W m^-2 sr^-1.
    count: Floats  # Pixels in these sums.

    def and_then(self, later: Statistics) -> Statistics:
        """Pool with a later pose's statistics; older ones count less."""
        return Statistics.of(_MEMORY * self.arrays() + later.arrays())

    def arrays(self) -> Floats:
        """Stack for the cache: (3, ty, tx)."""
        return np.stack([self.variance, self.radiance, self.count])

    @staticmethod
    def of(arrays: Floats) -> Statistics:
        """Unstack the result of :meth:`arrays`."""
        return Statistics(*np.asarray(arrays))


def tally(shape: tuple[int, int], pixels: Ints, variance: Doubles, radiance: Doubles) -> Statistics:
    """Sum pixel statistics by tile."""
    rows, cols = -(-shape[0] // TILE_PX), -(-shape[1] // TILE_PX)
    tile = pixels // shape[1] // TILE_PX * cols + pixels % shape[1] // TILE_PX

    def summed(values: Doubles) -> Floats:
        return np.bincount(tile, values, rows * cols).reshape(rows, cols).astype(np.float32)

    return Statistics(summed(variance), summed(radiance), summed(np.ones(len(pixels))))


def relative_deviation(statistics: Statistics, shape: tuple[int, int], floor_w_m2_sr: float) -> Floats:
    """Predict the standard deviation of one sample over (radiance + floor) a pixel, from tiles."""
    variance, radiance, count = (
        _blurred(x) for x in (statistics.variance, statistics.radiance, statistics.count)
    )
    known = count > 1e-6
    per = np.where(known, count, 1)
    squared = variance / per / (np.maximum(radiance / per, 0) + floor_w_m2_sr) ** 2
    mean = float(squared[known].mean()) if known.any() else 1.0
    squared = np.where(known, squared, mean)
    return _spread(np.sqrt((1 - _DOUBT) * squared + _DOUBT * mean), shape)


def smoothed(shape: tuple[int, int], values: Doubles) -> Floats:
    """Average a quantity known in every pixel over neighbouring tiles, (y, x)."""
    statistics = tally(shape, np.arange(shape[0] * shape[1]), values.ravel(), values.ravel())
    return _spread(_blurred(statistics.variance) / _blurred(statistics.count), shape)


def _blurred(image: Floats) -> Floats:
    return cast("Floats", ndimage.uniform_filter(image, 3, mode="constant"))  # type: ignore[no-untyped-call]


def _spread(statistics: Floats, shape: tuple[int, int]) -> Floats:
    fine = np.repeat(np.repeat(statistics, TILE_PX, 0), TILE_PX, 1)
    return fine[: shape[0], : shape[1]].astype(np.float32)


def allocate(
    deviation: Floats,
    target: float,
    *,
    least: float,
    most: Floats | float = MOST,
    cost: Floats | None = None,
) -> Floats:
    """Allocate samples for a root mean square error of ``target`` in the mean of both halves."""
    if deviation.size == 0:
        return np.zeros(0, np.float32)
    r = np.maximum(deviation.astype(np.float64), 1e-9)
    worth = r if cost is None else r / np.sqrt(cost)

    def counts(factor: float) -> Doubles:
        return np.clip(2.0 ** np.rint(np.log2(factor * worth)), least, np.maximum(most, least))

    low, high = np.log(1e-6), np.log(1e9)
    for _ in range(26):  # to 1e-6 of the factor
        middle = (low + high) / 2
        enough = np.mean(r**2 / (2 * counts(float(np.exp(middle))))) <= target**2
        low, high = (low, middle) if enough else (middle, high)
    return counts(float(np.exp(high))).astype(np.float32)
