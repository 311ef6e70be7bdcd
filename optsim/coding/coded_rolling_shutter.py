"""Coded rolling shutter (Gu et al.): groups of rows open one after the other."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.coding.periodic import PeriodicScheme, check_fits, turns
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bytes


class CodedRollingShutter(PeriodicScheme):
    """Rows k, k + K, k + 2 K ... are one sub-image; the K sub-images are exposed one after the other.

    The interlaced readout of Gu, Hitomi, Mitsunaga and Nayar, "Coded rolling shutter photography: flexible
    space-time sampling", ICCP 2010. On their sensor the rows of a sub-image also open one after the other.
    Behind a panel they open together, without that skew.

    Parameters
    ----------
    group_rows : int
        Rows of a group, K; 4 is a sensible default (no source).
    open_slots : int or None
        Slots for which each row is open; with more than its share rows overlap. None is its share of the
        coded slots, rounded up.
    """

    TEMPORAL: ClassVar[bool] = True
    kind: Literal["coded_rolling_shutter"] = "coded_rolling_shutter"
    group_rows: int = Field(default=4, ge=2, le=64)
    open_slots: int | None = Field(default=None, ge=1)

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """One frame of a tile of one column.

        Raises
        ------
        ConfigError
            When the rows of a group cannot begin in different coded slots.
        """
        del rng
        length = self.open_slots or 1
        check_fits("open_slots", length, coded_slots)
        if self.group_rows > coded_slots - length + 1:
            raise ConfigError(
                f"group_rows: got {self.group_rows}, expected at most {coded_slots - length + 1}, the "
                f"different starts of exposures in {coded_slots} coded slots; lower it, or open_slots"
            )
        rows = turns(self.group_rows, slots, coded_slots, self.open_slots)
        return rows.T.reshape(1, slots, self.group_rows, 1)
