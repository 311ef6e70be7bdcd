"""Check of stated uncertainties: errors in units of the decoders' standard deviations.

For Gaussian errors and correct deviations, 68.3 % lie within one, 95.4 % within two, and the rms
is one. A greater share within one means that the deviations are too large, a smaller one too small.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from optsim.core.quantities import Bools, Doubles, Floats, Ints, Reconstruction
from optsim.metrics.records import REGIONS, Uncertainty
from optsim.metrics.scoring import by_method_and_phase, rows_of

_WITHIN = (1.0, 2.0)


@dataclass(frozen=True, eq=False)
class UncertaintyTally:
    """Sums of one method's relative errors in one coded frame; region 0 moves, region 1 is static.

    Parameters
    ----------
    method : str
        Method of the reconstruction.
    index : int
        Coded-frame index.
    squares : ndarray of shape (region,), float64
        Sums of squared errors over stated variances.
    within : ndarray of shape (region, 2), int64
        Samples whose error is at most one deviation, and at most two.
    counts : ndarray of shape (region,), int64
        Samples whose deviation is known and above zero.
    """

    method: str
    index: int
    squares: Doubles
    within: Ints
    counts: Ints


def tally_uncertainty(
    method: str, video: Reconstruction, reference_w_m2: Floats, moving: Bools, scored: Bools, coded_slots: int
) -> UncertaintyTally | None:
    """Sum the errors of one reconstruction over its own uncertainty; None where it states none.

    Parameters
    ----------
    method : str
        Name for the scores.
    video : Reconstruction
        The estimate.
    reference_w_m2 : ndarray of shape (slot, v, u), float32
        Truth of the same coded frame, W m^-2.
    moving, scored : ndarray of shape (v, u), bool
        The oracle's mask, and pixels to score.
    coded_slots : int
        Slots that are scored.
    """
    if video.uncertainty_w_m2 is None:
        return None
    squares, within, counts = np.zeros(2), np.zeros((2, 2), np.int64), np.zeros(2, np.int64)
    for slot in range(min(coded_slots, len(reference_w_m2))):
        spread = video.uncertainty_w_m2[slot].astype(np.float64)
        error = np.abs(video.irradiance_w_m2[slot].astype(np.float64) - reference_w_m2[slot])
        for row, region in enumerate((moving, ~moving)):
            where = region & scored & (spread > 0)
            relative = error[where] / spread[where]
            squares[row] += np.square(relative).sum()
            within[row] += [np.count_nonzero(relative <= limit) for limit in _WITHIN]
            counts[row] += relative.size
    return UncertaintyTally(method, video.index, squares, within, counts)


def uncertainty_records(tallies: Iterable[UncertaintyTally], latency_frames: int) -> list[Uncertainty]:
    """Pool tallies by method, phase and region; phases without frames are left out."""
    found: list[Uncertainty] = []
    for (method, phase), group in by_method_and_phase(tallies, latency_frames).items():
        for region in REGIONS:
            rows = rows_of(region)
            n = sum(int(t.counts[rows].sum()) for t in group)
            one, two = (sum(int(t.within[rows, limit].sum()) for t in group) for limit in (0, 1))
            square = math.fsum(float(each) for t in group for each in t.squares[rows])
            found.append(
                Uncertainty(
                    method=method,
                    region=region,
                    phase=phase,
                    n=n,
                    within_one=one / n if n else None,
                    within_two=two / n if n else None,
                    rms=math.sqrt(square / n) if n else None,
                )
            )
    return found
