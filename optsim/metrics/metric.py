"""Base of every metric: a sum of errors that can be streamed, and a final number from it."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, cast

import numpy as np

from optsim.core.config import Part
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bools, Doubles, Floats, checked


class Metric(Part):
    """A mean over samples of an error, usually squared in some encoding; its name holds all its parameters.

    Errors are summed frame by frame, so that no whole video is in memory. The sums of disjoint
    regions add up to the sum of their union.
    """

    unit: ClassVar[str]
    higher_is_better: ClassVar[bool]

    @property
    @abstractmethod
    def name(self) -> str:
        """Name with every parameter that determines the number."""

    @abstractmethod
    def encode(self, luminance_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Encode luminance, cd/m^2, on the scale on which differences are squared."""

    def errors(self, estimate_cd_m2: Doubles, reference_cd_m2: Doubles, white_cd_m2: float) -> Doubles:
        """Error of each sample, here the squared difference in the metric's encoding."""
        return (self.encode(estimate_cd_m2, white_cd_m2) - self.encode(reference_cd_m2, white_cd_m2)) ** 2

    @abstractmethod
    def finish(self, total: float, count: int) -> float | None:
        """Convert a sum over ``count`` samples to the metric; None where it would not be a finite number."""

    def clamped(self, luminance_cd_m2: Doubles) -> int:
        """Count samples outside the range in which this metric distinguishes luminances."""
        return 0

    def sum_errors(
        self, estimate_cd_m2: Floats, reference_cd_m2: Floats, where: Bools, white_cd_m2: float
    ) -> tuple[float, int]:
        """Sum errors over the samples of a mask.

        Parameters
        ----------
        estimate_cd_m2, reference_cd_m2 : ndarray of shape (slot, v, u), float32
            Luminance, cd/m^2. A reference may be below zero (unbiased Monte Carlo).
        where : ndarray of shape (slot, v, u) or (v, u), bool
            Samples to sum.
        white_cd_m2 : float
            Luminance of the scene's declared white.

        Returns
        -------
        total : float
            Sum in float64.
        count : int
            Number of samples.

        Raises
        ------
        ValueCheckError
            For a non-finite sample, inside the mask or outside, with its place; for other shapes.
        """
        axes = ("slot", "v", "u")
        estimate = checked(
            "estimate", estimate_cd_m2, axes=axes, dtype=np.float32, unit="cd/m^2", nonnegative=False
        )
        reference = checked(
            "reference", reference_cd_m2, axes=axes, dtype=np.float32, unit="cd/m^2", nonnegative=False
        )
        if estimate.shape != reference.shape or where.shape not in (estimate.shape, estimate.shape[1:]):
            raise ValueCheckError(
                f"{self.name}: estimate {estimate.shape}, reference {reference.shape} and mask {where.shape} "
                "are not of one size"
            )
        total, count = 0.0, 0
        for slot in range(estimate.shape[0]):
            mask = where if where.ndim == 2 else where[slot]
            theirs = cast("Floats", reference[slot])[mask].astype(np.float64)
            ours = cast("Floats", estimate[slot])[mask].astype(np.float64)
            # Not a dot product of BLAS, whose threads would wait for the next one at full speed.
            total += float(np.sum(self.errors(ours, theirs, white_cd_m2)))
            count += ours.size
        return total, count
