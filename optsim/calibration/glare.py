"""Stray light beyond the crosstalk kernel: PSF tails, the relay's ghost, and veiling glare."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Doubles, Floats
from optsim.optics.crosstalk import REACH
from optsim.optics.ghost import mirrored
from optsim.optics.psf import Blur, make_blur

RINGS_PX = (0.0, 7.0, 14.0, 28.0, 56.0)
"""Radii of the rings with one strength of PSF tails each, panel pixels."""


@dataclass(frozen=True)
class Glare:
    """Shares of the light that land beyond the crosstalk kernel.

    Parameters
    ----------
    veil : float
        Spread evenly over the CCD: veiling glare (ISO 9358).
    ghost : float
        Mirrored through the centre of the panel.
    ghost_blur_px : float
        Standard deviation of the ghost's blur, panel pixels.
    wings : tuple of float
        Strength of the PSF tails in each ring of :data:`RINGS_PX`. A reading r panel pixels away gets the
        share strength / r^3 of a pixel's light. For the mean of an Airy pattern it is lambda N / (pi^3 pitch)
        in all rings (Born and Wolf, *Principles of Optics*, 8.5.2).

    Raises
    ------
    ValueCheckError
        When shares are negative or too large, or the blur is none.
    """

    veil: float = 0.0
    ghost: float = 0.0
    ghost_blur_px: float = 20.0
    wings: tuple[float, ...] = (0.0,) * (len(RINGS_PX) - 1)

    def __post_init__(self) -> None:
        if (
            len(self.wings) != len(RINGS_PX) - 1
            or min(self.veil, self.ghost, *self.wings) < 0
            or max(self.veil + self.ghost, *self.wings) >= 1
            or self.ghost_blur_px <= 0
        ):
            raise ValueCheckError(
                f"glare: got veil {self.veil:.3g}, ghost {self.ghost:.3g} of {self.ghost_blur_px:.3g} "
                f"pixels, wings {self.wings}, expected shares and strengths from 0 to below 1, veil and "
                f"ghost together too, {len(RINGS_PX) - 1} wings, and a blur of more than 0"
            )

    def share(self, reach: int) -> float:
        """Share of a pixel's light in glare, far from the edges, with tails that begin beyond ``reach``."""
        return self.veil + self.ghost + float(_kernel(self.wings, reach).sum())

    def light(self, arrived: Floats | Doubles, reach: int) -> Doubles:
        """Compute the glare at each pixel.

        Parameters
        ----------
        arrived : ndarray of shape (v, u)
            All light at its own pixel, in a unit of the CCD such as DN; dark beyond the panel.
        reach : int
            Half width of the crosstalk kernel, panel pixels, where the tails begin.

        Returns
        -------
        ndarray of shape (v, u), float64
        """
        stray = np.full(arrived.shape, self.veil * np.mean(arrived, dtype=np.float64))
        if self.ghost > 0:
            stray += self.ghost * mirrored(arrived, self.ghost_blur_px)
        if any(self.wings):
            stray += tails_blur(self.wings, reach, (arrived.shape[0], arrived.shape[1])).apply(arrived)
        return stray


NO_GLARE = Glare()


def ring_strengths(answer: Doubles, row: int, col: int) -> tuple[float, ...]:
    """Strength of the PSF tails in each ring, from all readings of one lit pixel beyond its kernel.

    Parameters
    ----------
    answer : ndarray of shape (v, u), float64
        Shares of its light.
    row, col : int
        The lit pixel.
    """
    dy: Doubles = np.arange(answer.shape[0], dtype=np.float64)[:, None] - row
    dx: Doubles = np.arange(answer.shape[1], dtype=np.float64) - col
    strengths: list[float] = []
    for falling in _falling(dy, dx, REACH):
        whole = float(falling.sum())
        strengths.append(max(float(answer[falling > 0].sum()) / whole, 0.0) if whole else 0.0)
    return tuple(strengths)


def _falling(dy: Doubles, dx: Doubles, reach: int) -> list[Doubles]:
    """Tails of strength 1 in each ring, by distance from the centre: 1 / r^3 beyond ``reach``, else 0."""
    distance = np.hypot(dy, dx)
    beyond = np.maximum(np.abs(dy), np.abs(dx)) > reach
    cubed = np.maximum(distance, 1) ** 3
    return [
        np.where(beyond & (distance >= inner) & (distance < outer), 1 / cubed, 0)
        for inner, outer in pairwise(RINGS_PX)
    ]


@lru_cache(maxsize=16)
def _kernel(strengths: tuple[float, ...], reach: int) -> Doubles:
    """Shares of the surrounding pixels' light, out to the last ring of nonzero strength."""
    half = max([reach, *(int(outer) for outer, lit in zip(RINGS_PX[1:], strengths, strict=True) if lit)])
    place: Doubles = np.arange(-half, half + 1, dtype=np.float64)
    rings = zip(strengths, _falling(place[:, None], place, reach), strict=True)
    return sum((strength * falling for strength, falling in rings), np.zeros((len(place), len(place))))


@lru_cache(maxsize=16)
def tails_blur(strengths: tuple[float, ...], reach: int, shape: tuple[int, int]) -> Blur:
    """Prepare PSF tails of these strengths, beyond ``reach`` panel pixels, for images of a shape."""
    return make_blur(_kernel(strengths, reach), shape)
