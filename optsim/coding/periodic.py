"""Periodic codes: a small tile of drive levels, repeated over the panel and over the frames."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.core.config import Part
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bools, Bytes, CodedFrame, ExposureCode, Ints

OPEN = 255


@dataclass(frozen=True, eq=False)
class PeriodicCode:
    """State of a static scheme: its tiles and the panel's size.

    Parameters
    ----------
    tiles : ndarray of shape (frame, slot, y, x), uint8
        Drive levels; coded frame f shows ``tiles[f mod len(tiles)]``, repeated from panel pixel (0, 0).
    shape : tuple of int
        Panel pixels (v, u).
    """

    tiles: Bytes
    shape: tuple[int, int]

    def levels(self, index: int) -> Bytes:
        """Drive levels of a coded frame: array of shape (slot, v, u), uint8."""
        tile = self.tiles[index % len(self.tiles)]
        rows = np.arange(self.shape[0]) % tile.shape[1]
        cols = np.arange(self.shape[1]) % tile.shape[2]
        return tile[:, rows[:, None], cols]


class PeriodicScheme(Part, ABC):
    """A scheme whose code does not depend on the scene; a subclass gives its tiles.

    ``TEMPORAL`` marks schemes whose pixels need the sparse decoder.
    """

    TEMPORAL: ClassVar[bool]

    @abstractmethod
    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """Levels of shape (frame, slot, y, x), dark in slots >= coded_slots."""

    def init(self, calibration: Calibration, rng: np.random.Generator) -> PeriodicCode:
        """Choose the tiles once; all randomness of the scheme is here."""
        tiles = self.tiles(calibration.slots_per_frame, calibration.coded_slots, rng)
        return PeriodicCode(tiles, calibration.shape)

    def next(
        self, index: int, arrived: Sequence[CodedFrame], state: PeriodicCode
    ) -> tuple[ExposureCode, PeriodicCode]:
        """Code of frame ``index``, independent of the frames that have arrived."""
        del arrived
        moving: Bools = np.full(state.shape, self.TEMPORAL)
        return ExposureCode(state.levels(index), moving), state


def bump(slots: int, first: int, length: int) -> Bytes:
    """Levels of one pixel, open in slots first .. first + length - 1: array of shape (slot,)."""
    levels = np.zeros(slots, np.uint8)
    levels[first : first + length] = OPEN
    return levels


def bumps(slots: int, firsts: Ints, lengths: Ints) -> Bytes:
    """Levels of pixels with one :func:`bump` each: array of shape (pixel, slot), or (v, u, slot)."""
    slot = np.arange(slots)
    return ((slot >= firsts[..., None]) & (slot < (firsts + lengths)[..., None])) * np.uint8(OPEN)


def even_starts(n: int, length: int, coded_slots: int) -> Ints:
    """First slots of n bumps, evenly spread so that the first bump begins the frame and the last ends it."""
    return np.rint(np.linspace(0, coded_slots - length, n)).astype(np.int64)


def turns(n: int, slots: int, coded_slots: int, length: int | None = None) -> Bytes:
    """Levels of n pixels that open one after the other: array of shape (pixel, slot)."""
    length = length or -(-coded_slots // n)
    return bumps(slots, even_starts(n, length, coded_slots), np.full(n, length))


def square(levels: Bytes) -> Bytes:
    """Tiles (1, slot, y, x) of one frame, from levels (pixel, slot) of a square's pixels row by row."""
    side = math.isqrt(len(levels))
    return levels.T.reshape(1, -1, side, side)


def check_fits(key: str, length: int, coded_slots: int) -> None:
    """Refuse an exposure longer than the coded slots."""
    if length > coded_slots:
        raise ConfigError(f"{key}: got {length}, expected at most the {coded_slots} coded slots; lower it")
