"""A plain camera: every pixel open at the same time."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from optsim.coding.periodic import PeriodicScheme, bump, check_fits
from optsim.core.quantities import Bytes


class NormalPhotography(PeriodicScheme):
    """All pixels open, in all coded slots or in the first few.

    Parameters
    ----------
    open_slots : int or None
        Slots open from the start of the frame; None is all coded slots. The paper does not state the exposure
        of its comparison (figure 4).
    """

    TEMPORAL: ClassVar[bool] = False
    kind: Literal["normal_photography"] = "normal_photography"
    open_slots: int | None = Field(default=None, ge=1)

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """One pixel, the same in all frames.

        Raises
        ------
        ConfigError
            When more slots are to be open than are coded.
        """
        del rng
        length = self.open_slots or coded_slots
        check_fits("open_slots", length, coded_slots)
        return bump(slots, 0, length).reshape(1, slots, 1, 1)
