# pyright: reportMissingTypeStubs=false
"""Partial reconstructions, which a union joins, and the decoders that return them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import erfcx

from optsim.calibration.calibration import Calibration
from optsim.core.config import Part
from optsim.core.quantities import Bools, CodedFrame, Floats, Reconstruction

# Beyond so many standard deviations from zero the cut-off moves the mean by less than 1e-8 of one.
_FAR = 6.0


@dataclass(frozen=True, eq=False)
class Partial:
    """Reconstruction of one coded frame by one decoder, before a union joins it with another."""

    # Masks as in :class:`~optsim.core.quantities.Reconstruction`.

    index: int  # Of the coded frame.
    irradiance_w_m2: Floats  # (slot, v, u), mean of each slot, or (1, v, u) for all; never negative.
    blend_weight: Floats  # (v, u), its share of the joined image, 0..1.
    valid: Bools
    interpolated: Bools
    moving: Bools
    slots: int  # Of the frame's period.
    uncertainty_w_m2: Floats | None = None  # Standard deviation as the decoder predicts it; None if unknown.
    # (v, u), squared error of each sample's mean light as the others predict it; NaN without a sample.
    held_out: Floats | None = None

    def finished(self) -> Reconstruction:
        """Convert it to a reconstruction of all slots."""
        video = self.irradiance_w_m2
        shape = (self.slots, *video.shape[1:])
        spread = self.uncertainty_w_m2
        return Reconstruction(
            self.index,
            np.broadcast_to(video, shape),
            self.valid,
            self.interpolated,
            self.moving,
            None if spread is None else np.broadcast_to(spread, shape),
        )


def positive_mean(mean: Floats, variance: Floats) -> Floats:
    """Mean of a Gaussian cut off at zero: the expected light given that it isn't negative."""
    # Noise puts dark pixels below zero as often as above; clipping would bias them.
    sigma = np.broadcast_to(np.sqrt(np.maximum(variance, 1e-30)), mean.shape)
    result = mean.copy()
    near = mean < _FAR * sigma
    x, s = mean[near].astype(np.float64), sigma[near].astype(np.float64)
    # Far below zero these two cancel up to rounding.
    result[near] = np.maximum(x + s * np.sqrt(2 / np.pi) / erfcx(-x / s / np.sqrt(2)), 0)
    return result


class PartialDecoder(Part, ABC):
    """A decoder whose partial reconstructions a union can join."""

    @abstractmethod
    def partials(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Partial]:
        """Decode frame by frame, with blend weights for the union; a new decoder defines only this."""

    def decode(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Reconstruction]:
        """Decode frame by frame; each uses itself and those before, which give saturated pixels."""
        for partial in self.partials(frames, calibration):
            yield partial.finished()
