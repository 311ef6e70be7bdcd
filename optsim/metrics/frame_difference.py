"""PSNR of the changes from slot to slot: flicker and judder, which no single picture shows."""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np

from optsim.metrics.classes import Class
from optsim.metrics.frame_metric import FrameEstimate, FrameMetric


class FrameDifferencePsnr(FrameMetric):
    """PSNR of the difference of successive slots, PU21-encoded, peak 256; a constant error costs nothing."""

    kind: Literal["frame_difference_psnr"] = "frame_difference_psnr"
    unit: ClassVar[str] = "dB"
    higher_is_better: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """Name with encoding and peak."""
        return "difference-PSNR[slot to slot, PU21 banding_glare, peak=256]"

    def measure(self, frame: FrameEstimate) -> dict[Class, float | None]:
        """Score each class."""
        if len(frame.pu21) < 2:
            return dict.fromkeys(frame.reference.classes)
        error = np.diff(frame.pu21 - frame.reference.pu21, axis=0)
        means = frame.mean(np.square(error).mean(axis=0))
        return {name: 10 * math.log10(256**2 / mean) if mean else None for name, mean in means.items()}
