"""HDR mosaic: four exposures in every 2 x 2 block, fixed or shifting between frames (eq. 5 of the paper)."""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar, Literal

import numpy as np
from pydantic import field_validator

from optsim.coding.periodic import PeriodicScheme, bump
from optsim.core.quantities import Bytes


class HdrMosaic(PeriodicScheme):
    """Pixel (v, u) of frame f has exposure e_((2v + u + f) mod 4): equation (5), x = u and y = v.

    Every 2 x 2 block holds all four exposures, and every pixel has all four within four frames. An exposure
    is one run of open slots in the middle of the coded slots, so that all four have the same mean time. An
    exposure longer than the coded slots gets all of them.

    Parameters
    ----------
    open_slots : tuple of int
        Open slots of e_0 < e_1 < e_2 < e_3. The paper gives no densities; (1, 3, 11, 36) is the geometric
        series of ratio 3.3 that 36 slots allow (a sensible default, no source).
    shifts : bool
        Whether exposures shift from frame to frame. False is the fixed mask of Nayar and Mitsunaga, "High
        dynamic range imaging: spatially varying pixel exposures", CVPR 2000 (doi:10.1109/CVPR.2000.855857):
        e_0 e_1 over e_2 e_3 in all frames. A pixel's other exposures are then those of its neighbours.
    """

    TEMPORAL: ClassVar[bool] = False
    kind: Literal["hdr_mosaic"] = "hdr_mosaic"
    open_slots: tuple[int, int, int, int] = (1, 3, 11, 36)
    shifts: bool = True

    @field_validator("open_slots")
    @classmethod
    def _ascending(cls, counts: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
        if counts[0] < 1 or any(a >= b for a, b in pairwise(counts)):
            raise ValueError("expected four ascending numbers of open slots, the first at least 1")
        return counts

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """Four frames of a tile of 2 rows and 4 columns; one of 2 x 2 for the fixed mosaic."""
        del rng
        lengths = [min(n, coded_slots) for n in self.open_slots]
        runs = np.stack([bump(slots, (coded_slots - n) // 2, n) for n in lengths])
        frame, y, x = np.ogrid[:4, :2, :4] if self.shifts else np.ogrid[:1, :2, :2]
        return np.moveaxis(runs[(2 * y + x + frame) % 4], -1, 1)
