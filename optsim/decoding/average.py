"""Mean of two videos of the same coded image."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import tee
from typing import Literal

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import CodedFrame
from optsim.decoding.partial import Partial, PartialDecoder
from optsim.decoding.partial_decoders import GaussianMixture, SparseCoding


class Average(PartialDecoder):
    """Mean of sparse coding and Gaussian mixture: their errors are of similar size and partly independent.

    Parameters
    ----------
    sparse, mixture : decoder
        The two decoders, with their keys.
    """

    kind: Literal["average"] = "average"
    sparse: SparseCoding = SparseCoding()
    mixture: GaussianMixture = GaussianMixture(stride_px=1)

    def partials(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Partial]:
        """Decode as :meth:`decode`, with the blend weights of the union."""
        one, other = tee(frames)
        pairs = zip(
            self.sparse.partials(one, calibration), self.mixture.partials(other, calibration), strict=True
        )
        for a, b in pairs:
            yield replace(
                a,
                irradiance_w_m2=(a.irradiance_w_m2 + b.irradiance_w_m2) / 2,
                blend_weight=(a.blend_weight + b.blend_weight) / 2,
            )
