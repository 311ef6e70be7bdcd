"""A decoder, a metric, a part and a mover of a package outside optsim."""

from collections.abc import Iterable, Iterator
from typing import ClassVar, Literal

import numpy as np

from optsim.camera.parts import Relay
from optsim.decoding import PartialDecoder
from optsim.decoding.coded_images import coded_images
from optsim.decoding.partial import Partial
from optsim.metrics import Metric
from optsim.scene.movers import Card


class Flat(PartialDecoder):
    """Each slot as bright as the whole coded frame."""

    kind: Literal["sketch_flat"] = "sketch_flat"

    def partials(self, frames: Iterable, calibration) -> Iterator[Partial]:
        """Divide each pixel's signal by its exposure."""
        for frame, image in coded_images(frames, calibration, "undone"):
            mean = np.maximum(image.signal / np.maximum(image.exposure, np.float32(1e-6)), 0)
            whole, none = np.ones(mean.shape, np.float32), np.zeros(mean.shape, np.bool_)
            yield Partial(
                frame.index, mean[None], whole, image.usable, none, frame.code.moving, len(frame.code.levels)
            )


class MeanError(Metric):
    """Mean absolute error over the white of the scene."""

    kind: Literal["sketch_error"] = "sketch_error"
    unit: ClassVar[str] = "ratio"
    higher_is_better: ClassVar[bool] = False
    name: ClassVar[str] = "mean-error[white]"

    def encode(self, luminance_cd_m2, white_cd_m2):
        """Relative to white."""
        return luminance_cd_m2 / white_cd_m2

    def errors(self, estimate_cd_m2, reference_cd_m2, white_cd_m2):
        """Absolute differences."""
        return np.abs(estimate_cd_m2 - reference_cd_m2) / white_cd_m2

    def finish(self, total, count):
        """Mean; None of nothing."""
        return total / count if count else None


class DustyRelay(Relay):
    """A relay that loses a share of its light to dust."""

    kind: Literal["sketch_dusty"] = "sketch_dusty"
    dust_share: float = 0.1

    def accepted_share(self, panel_f_number: float) -> float:
        """Less the dust."""
        return (1 - self.dust_share) * super().accepted_share(panel_f_number)


class Flag(Card):
    """A card that sinks."""

    kind: Literal["sketch_flag"] = "sketch_flag"
    sinks_m_s: float = 0.2

    def vertices(self, time_s: float) -> np.ndarray:
        """Positions (n, 3), m."""
        return super().vertices(time_s) - np.array([0, 0, self.sinks_m_s * time_s])
