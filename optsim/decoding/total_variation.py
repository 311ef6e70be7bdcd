"""Video from one coded image by alternating projection and total variation: no training, any code."""

from __future__ import annotations

from typing import Literal

import numpy as np

from optsim.core.quantities import Floats
from optsim.decoding.coded_images import CodedImage
from optsim.decoding.projected_video import ProjectedVideo


class TotalVariation(ProjectedVideo):
    """Generalised alternating projection with total variation (GAP-TV).

    X. Yuan, "Generalized alternating projection based total variation minimization for compressive sensing",
    ICIP 2016, doi:10.1109/ICIP.2016.7532817, in its accelerated form. Two steps alternate: the video is
    projected onto the measurements minus the error so far, and its total variation is lowered
    (:func:`~optsim.decoding.tv_smoothing.smoothed`). A pixel's noise loosens its measurement as for light of
    unit variance.

    Parameters
    ----------
    weight : float
        Weight of the total variation, for light whose brighter parts are about 1.
    time_weight : float or None
        Weight of a difference from slot to slot against one from pixel to pixel. At 0 each slot is smoothed
        by itself, as in the paper. None: a 24th of the number of slots, at most 1, since shorter slots differ
        less. These are choices (no source). On synthetic films through half-open codes of 8 slots, 0.35 beat
        0 by 0.1 dB for motion by pixels a slot and by 1.3 dB for motion by parts of one (1: -1.7 and +2.5
        dB). With 36 slots 1 was best for such codes and for bumps of three.
    rounds, inner_rounds : int
        Projections, and steps of the smoothing in each.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    """

    kind: Literal["total_variation"] = "total_variation"

    def _video(self, image: CodedImage, start: Floats, white: np.float32) -> Floats:
        return self._alternated(image, start, white)
