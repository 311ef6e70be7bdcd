"""Base of metrics of a whole coded frame: of neighbouring pixels, of successive slots, behind a gain."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from optsim.core.config import Part
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bools, Doubles, Floats
from optsim.metrics.classes import Class
from optsim.metrics.pu21 import pu21_encode

SLOTS = 6
"""Slots of a coded frame, evenly spaced, on which costly metrics of pictures are measured."""


@dataclass(frozen=True, eq=False)
class FrameReference:
    """The truth of a coded frame, and what all methods share of it.

    Parameters
    ----------
    luminance_cd_m2 : ndarray of shape (slot, v, u), float32
        Luminance of the coded slots.
    classes : mapping
        Content class -> mask (v, u).
    """

    luminance_cd_m2: Floats
    classes: Mapping[Class, Bools]

    @cached_property
    def pu21(self) -> Doubles:
        """PU21-encoded luminance."""
        return self.encode(self.luminance_cd_m2)

    def encode(self, luminance_cd_m2: Floats | Doubles) -> Doubles:
        """Encode luminance, cd/m^2, on the PU21 scale."""
        return pu21_encode(luminance_cd_m2)

    @cached_property
    def slots(self) -> list[int]:
        """Slots of :data:`SLOTS`: the middles of as many equal parts."""
        n = len(self.luminance_cd_m2)
        return sorted({int((k + 0.5) * n / SLOTS) for k in range(SLOTS)})


@dataclass(frozen=True, eq=False)
class FrameEstimate:
    """An estimate of a coded frame beside its truth.

    Parameters
    ----------
    reference : FrameReference
        The truth.
    luminance_cd_m2 : ndarray of shape (slot, v, u), float32
        Estimate of the coded slots.
    scored : ndarray of shape (v, u), bool
        Pixels to score. The others get the truth, so that they harm no neighbour.
    """

    reference: FrameReference
    luminance_cd_m2: Floats
    scored: Bools

    def __post_init__(self) -> None:
        if self.luminance_cd_m2.shape != self.reference.luminance_cd_m2.shape:
            raise ValueCheckError(
                f"estimate {self.luminance_cd_m2.shape} and reference "
                f"{self.reference.luminance_cd_m2.shape} are not of one size"
            )

    @cached_property
    def pu21(self) -> Doubles:
        """PU21-encoded estimate, the truth where it isn't scored."""
        return np.where(self.scored, self.reference.encode(self.luminance_cd_m2), self.reference.pu21)

    def mean(self, values: Doubles) -> dict[Class, float | None]:
        """Mean over the scored pixels of each class of values (v, u); None without pixels."""
        found: dict[Class, float | None] = {}
        for name, mask in self.reference.classes.items():
            where = mask & self.scored
            found[name] = float(values[where].mean()) if where.any() else None
        return found


class FrameMetric(Part):
    """A score of a coded frame by content class; its name holds all its parameters."""

    unit: ClassVar[str]
    higher_is_better: ClassVar[bool]

    @property
    @abstractmethod
    def name(self) -> str:
        """Name with every parameter that determines the number."""

    @abstractmethod
    def measure(self, frame: FrameEstimate) -> dict[Class, float | None]:
        """Score each class; None where it has no scored pixel, or the score would not be finite."""
