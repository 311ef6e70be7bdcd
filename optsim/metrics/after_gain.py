"""PU21-PSNR after one gain for all pixels: what is left when the level of light is forgiven."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np

from optsim.core.quantities import Doubles
from optsim.metrics.classes import Class
from optsim.metrics.frame_metric import SLOTS, FrameEstimate, FrameMetric

_E_CD_M2 = 0.01


class AfterGainPsnr(FrameMetric):
    """PU21-PSNR, peak 256, after the gain of least squares in stops, one for a coded frame.

    The gap to PU21-PSNR is an error of calibration. A gain of least squares in light would be that of the
    window alone.
    """

    kind: Literal["after_gain_psnr"] = "after_gain_psnr"
    unit: ClassVar[str] = "dB"
    higher_is_better: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name with encoding, gain, peak and slots."""
        return f"one-gain PU21-PSNR[banding_glare, peak=256, gain in stops, {SLOTS} slots]"

    def measure(self, frame: FrameEstimate) -> dict[Class, float | None]:
        """Score each class behind the gain of all scored pixels."""
        slots = frame.reference.slots
        estimate = frame.luminance_cd_m2[slots].astype(np.float64)
        if not frame.scored.any():
            return dict.fromkeys(frame.reference.classes)
        gained = frame.reference.encode(estimate * best_gain(frame))
        means = frame.mean(np.square(gained - frame.reference.pu21[slots]).mean(axis=0))
        return {name: 10 * math.log10(256**2 / mean) if mean else None for name, mean in means.items()}


def best_gain(frame: FrameEstimate) -> float:
    """Gain that brings an estimate nearest to its truth, in stops, over its scored pixels."""
    slots = frame.reference.slots

    def stops(luminance: Doubles) -> Doubles:
        return np.log2(np.maximum(luminance[:, frame.scored], 0) + _E_CD_M2)

    theirs = stops(frame.reference.luminance_cd_m2[slots].astype(np.float64))
    ours = stops(frame.luminance_cd_m2[slots].astype(np.float64))
    return float(2 ** np.mean(theirs - ours))
