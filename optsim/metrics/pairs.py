"""The adaptive method against a rival on their common valid pixels, window and room separately.

Scores of a run cover the pixels that all its methods hold valid, so they depend on the list of methods.
A pair depends on its two methods only. The few pixels of a bright window can hold most of a squared error, so
they are separate.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.metrics.metric import Metric
from optsim.metrics.photometry import PhotometricScale
from optsim.metrics.records import AREAS, REGIONS, PairRecord
from optsim.metrics.scoring import phase_of, rows_of


@dataclass(frozen=True, eq=False)
class PixelErrors:
    """Errors of one reconstruction in one coded frame, pixel by pixel.

    Parameters
    ----------
    sums : ndarray of shape (metric, v, u), float64
        Sums over the coded slots.
    valid : ndarray of shape (v, u), bool
        Pixels that the method holds valid.
    """

    sums: Doubles
    valid: Bools


@dataclass(frozen=True, eq=False)
class PairTally:
    """Errors of the adaptive method and of a rival in one coded frame.

    Parameters
    ----------
    method : str
        The rival.
    index : int
        Coded frame.
    sums : ndarray of shape (scope, side, metric, area, region), float64
        Sums of squared errors. Scopes are the common valid pixels, and all; sides are the adaptive
        method and the rival; areas are room and window; region 0 moves, region 1 is static.
    counts : ndarray of shape (scope, area, region), int64
        Number of pixels in them.
    """

    method: str
    index: int
    sums: Doubles
    counts: Ints


def pixel_errors(
    metrics: Sequence[Metric],
    scale: PhotometricScale,
    irradiance_w_m2: Floats,
    reference_w_m2: Floats,
    valid: Bools,
    coded_slots: int,
) -> PixelErrors:
    """Sum errors over the coded slots, pixel by pixel.

    Parameters
    ----------
    metrics : sequence of Metric
        Metrics in the order of the sums.
    scale : PhotometricScale
        The scene's stated scale.
    irradiance_w_m2, reference_w_m2 : ndarray of shape (slot, v, u), float32
        Reconstruction and truth, W/m^2.
    valid : ndarray of shape (v, u), bool
        Pixels that the method holds valid.
    coded_slots : int
        Scored slots, from the first.
    """
    sums = np.zeros((len(metrics), *valid.shape))
    for slot in range(min(coded_slots, reference_w_m2.shape[0])):
        ours, truth = (
            scale.luminance_cd_m2(light[slot]).astype(np.float64)
            for light in (irradiance_w_m2, reference_w_m2)
        )
        for m, metric in enumerate(metrics):
            sums[m] += metric.errors(ours, truth, scale.white_cd_m2)
    return PixelErrors(sums, valid)


def tally_pair(
    rival: str, index: int, ours: PixelErrors, theirs: PixelErrors, moving: Bools, window: Bools
) -> PairTally:
    """Compare two methods in one coded frame.

    Parameters
    ----------
    rival : str
        Name of the other method.
    index : int
        Coded frame.
    ours, theirs : PixelErrors
        Errors of the adaptive method and of the rival.
    moving, window : ndarray of shape (v, u), bool
        The oracle's mask, and pixels that show any of the bright outside.
    """
    both = ours.valid & theirs.valid
    sums = np.zeros((2, 2, ours.sums.shape[0], len(AREAS), 2))
    counts = np.zeros((2, len(AREAS), 2), np.int64)
    for s, scope in enumerate((both, np.ones_like(both))):
        for a, area in enumerate((~window, window)):
            for r, region in enumerate((moving, ~moving)):
                where = scope & area & region
                counts[s, a, r] = np.count_nonzero(where)
                for side, errors in enumerate((ours, theirs)):
                    sums[s, side, :, a, r] = errors.sums[:, where].sum(axis=1)
    return PairTally(rival, index, sums, counts)


def pair_records(
    metrics: Sequence[Metric], tallies: Iterable[PairTally], coded_slots: int, latency_frames: int
) -> list[PairRecord]:
    """Pool the steady frames of each pair; areas and regions without pixels are left out."""
    groups: dict[str, list[PairTally]] = {}
    for tally in tallies:
        if phase_of(tally.index, latency_frames) == "steady":
            groups.setdefault(tally.method, []).append(tally)
    found: list[PairRecord] = []
    for rival, group in groups.items():
        sums, counts = np.stack([t.sums for t in group]), np.stack([t.counts for t in group])
        for m, metric in enumerate(metrics):
            for a, area in enumerate(AREAS):
                for region in REGIONS:
                    rows = rows_of(region)
                    n = [int(counts[:, scope, a, rows].sum()) for scope in (0, 1)]
                    if not n[1]:
                        continue
                    ours, theirs, ours_of_all, theirs_of_all = (
                        metric.finish(
                            math.fsum(sums[:, scope, side, m, a, rows].flat), n[scope] * coded_slots
                        )
                        for scope in (0, 1)
                        for side in (0, 1)
                    )
                    found.append(
                        PairRecord(
                            rival=rival,
                            metric=metric.name,
                            unit=metric.unit,
                            higher_is_better=metric.higher_is_better,
                            area=area,
                            region=region,
                            ours=ours,
                            theirs=theirs,
                            excluded=1 - n[0] / n[1],
                            ours_of_all=ours_of_all,
                            theirs_of_all=theirs_of_all,
                        )
                    )
    return found


def advantage(record: PairRecord, *, of_all: bool = False) -> float | None:
    """Advantage of the adaptive method over the rival, in the metric's unit; below 0 it is worse."""
    ours, theirs = (record.ours_of_all, record.theirs_of_all) if of_all else (record.ours, record.theirs)
    if ours is None or theirs is None:
        return None
    return (ours - theirs) * (1 if record.higher_is_better else -1)
