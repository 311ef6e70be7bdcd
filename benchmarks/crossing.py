# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false
"""A made scene whose motion is one number: a textured disc that crosses a textured ground that stands still.

Both are dead leaves as in :mod:`benchmarks.made_film`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from benchmarks.made_film import dead_leaves, looked_up
from optsim.core.quantities import Floats

# Samples of a pixel's side; the disc moves at most one of them between the instants of a slot.
_FINE = 2
_GROUND_PX = 256


@dataclass(frozen=True, eq=False)
class Crossing:
    """A disc on its way along the rows of a panel.

    Parameters
    ----------
    rows, cols : int
        Panel pixels.
    radius_px : float
        Of the disc.
    speed_px : float
        Panel pixels a slot.
    start_px : float
        Column of its middle at time 0; its row is the panel's middle.
    slots : int
        Slots of a frame.
    seed : int
        Of the textures: the same disc and ground at any speed, on any panel.
    """

    rows: int
    cols: int
    radius_px: float
    speed_px: float
    start_px: float
    slots: int
    seed: int

    def frame(self, index: int) -> Floats:
        """Light of one frame, from 0.05 to 1: slot means of shape (slot, v, u), float32."""
        still = _pixels(self._ground)
        film = np.repeat(still[None], self.slots, axis=0)
        instants = max(1, int(np.ceil(self.speed_px * _FINE)))
        for slot in range(self.slots):
            for instant in range(instants):
                time = index * self.slots + slot + (instant + 0.5) / instants
                middle = self.start_px + self.speed_px * time
                first, last = np.clip(
                    [int(middle - self.radius_px) - 1, int(middle + self.radius_px) + 2], 0, self.cols
                )
                if first < last:
                    part = self._with_disc(middle, slice(first * _FINE, last * _FINE))
                    film[slot, :, first:last] += (_pixels(part) - still[:, first:last]) / instants
        return film

    def _with_disc(self, middle: float, near: slice) -> Floats:
        u = (np.arange(near.start, near.stop) + 0.5) / _FINE - middle
        v = (np.arange(self.rows * _FINE)[:, None] + 0.5) / _FINE - self.rows / 2
        skin = looked_up(self._skin, v + 2 * self.radius_px, u + 2 * self.radius_px)
        return np.where(v**2 + u**2 < self.radius_px**2, skin, self._ground[:, near]).astype(np.float32)

    @cached_property
    def _ground(self) -> Floats:
        v = (np.arange(self.rows * _FINE)[:, None] + 0.5) / _FINE
        texture = dead_leaves(_GROUND_PX, np.random.default_rng([self.seed, 0]))
        return looked_up(texture, v, (np.arange(self.cols * _FINE) + 0.5) / _FINE)

    @cached_property
    def _skin(self) -> Floats:
        return dead_leaves(int(4 * self.radius_px), np.random.default_rng([self.seed, 1]))


def _pixels(fine: Floats) -> Floats:
    """Means over the samples of each pixel."""
    rows, cols = fine.shape[0] // _FINE, fine.shape[1] // _FINE
    return fine.reshape(rows, _FINE, cols, _FINE).mean(axis=(1, 3))
