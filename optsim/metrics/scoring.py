"""Scores of a run: one small tally a coded frame, pooled afterwards by method, region and phase.

Pooling is exact (``math.fsum``), so the order of the frames cannot change a result.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Bools, Doubles, Floats, Ints, Reconstruction
from optsim.metrics.metric import Metric
from optsim.metrics.photometry import PhotometricScale
from optsim.metrics.records import PHASES, REGIONS, Coverage, Phase, Region, Score, Series
from optsim.metrics.student import CONFIDENCE, quantile

TRUTH_NOISE = "truth noise"
"""Method name of the tallies that say what the truth's own noise can certify."""


def phase_of(index: int, latency_frames: int) -> Phase:
    """Phase of a coded frame: until two frames have arrived, until four mosaic frames exist, steady."""
    if index < latency_frames + 1:
        return "warm-up"
    return "merging" if index < first_steady(latency_frames) else "steady"


def first_steady(latency_frames: int) -> int:
    """First coded frame of the steady phase, counted from 0."""
    return latency_frames + 4


@dataclass(frozen=True, eq=False)
class FrameTally:
    """Sums of one method's errors in one coded frame; region 0 moves, region 1 is static.

    Parameters
    ----------
    method : str
        Method of the reconstruction.
    index : int
        Coded-frame index.
    sums : ndarray of shape (metric, region, slot), float64
        Sums of squared errors.
    counts, covered, interpolated, samples : ndarray of shape (region, slot), int64
        Samples scored, samples that the method itself holds valid, those of them filled from neighbours,
        and all samples.
    clamped : ndarray of shape (metric, region), int64
        Scored samples whose reference lies outside the metric's range.
    """

    method: str
    index: int
    sums: Doubles
    counts: Ints
    covered: Ints
    interpolated: Ints
    samples: Ints
    clamped: Ints


class Tally(Protocol):
    """Sums of one method over one coded frame."""

    @property
    def method(self) -> str:
        """Name of the method."""
        ...

    @property
    def index(self) -> int:
        """Coded frame."""
        ...


_Tally = TypeVar("_Tally", bound=Tally)


def by_method_and_phase(
    tallies: Iterable[_Tally], latency_frames: int
) -> dict[tuple[str, Phase], list[_Tally]]:
    """Group tallies, the phases in their order."""
    groups: dict[tuple[str, Phase], list[_Tally]] = {}
    for tally in tallies:
        groups.setdefault((tally.method, phase_of(tally.index, latency_frames)), []).append(tally)
    return dict(sorted(groups.items(), key=lambda item: PHASES.index(item[0][1])))


@dataclass(frozen=True)
class ScoreBoard:
    """Scoring rules of a run: metrics, photometric scale, and the phases of its frames.

    Parameters
    ----------
    metrics : sequence of Metric
        Usually ``optsim.metrics.ALL``.
    scale : PhotometricScale
        The scene's stated scale.
    latency_frames : int
        Latency of the loop, for the phases.
    coded_slots : int
        Slots of a frame that are coded and therefore scored; the others count as not covered.
    """

    metrics: Sequence[Metric]
    scale: PhotometricScale
    latency_frames: int
    coded_slots: int

    def phase(self, index: int) -> Phase:
        """Phase of a coded frame, as in :func:`phase_of`."""
        return phase_of(index, self.latency_frames)

    def tally(
        self,
        method: str,
        reconstruction: Reconstruction,
        reference_w_m2: Floats,
        moving: Bools,
        scored: Bools | None = None,
    ) -> FrameTally:
        """Sum the errors of one reconstruction.

        Parameters
        ----------
        method : str
            Name for the scores.
        reconstruction : Reconstruction
            The estimate; its invalid pixels are not scored, but counted.
        reference_w_m2 : ndarray of shape (slot, v, u), float32
            Truth of the same coded frame, W/m^2.
        moving : ndarray of shape (v, u), bool
            The oracle's mask: the same for all methods.
        scored : ndarray of shape (v, u), bool, optional
            Pixels to score, for example those that all methods hold valid: a method must not gain by
            rejecting hard ones. By default those that this method holds valid.
        """
        r = reconstruction
        return self._tally(
            method,
            r.index,
            r.irradiance_w_m2,
            reference_w_m2,
            moving,
            r.valid,
            r.valid if scored is None else r.valid & scored,
            r.interpolated,
        )

    def tally_noise(
        self, index: int, reference_w_m2: Floats, half_difference_w_m2: Floats, moving: Bools
    ) -> FrameTally:
        """Sum the errors of the truth's own Monte-Carlo noise: no score above theirs can be certified.

        Parameters
        ----------
        index : int
            Coded-frame index.
        reference_w_m2, half_difference_w_m2 : ndarray of shape (slot, v, u), float32
            Slot means of the truth and of (half A - half B) / 2 of two independent renders, whose
            variance is that of the noise of their mean. For the linear PSNR the result is
            -10 log10(mean d^2 / white^2) exactly.
        moving : ndarray of shape (v, u), bool
            The oracle's mask.
        """
        noisy = (reference_w_m2 + half_difference_w_m2).astype(np.float32)
        everywhere, nowhere = np.ones(moving.shape, np.bool_), np.zeros(moving.shape, np.bool_)
        return self._tally(TRUTH_NOISE, index, noisy, reference_w_m2, moving, everywhere, everywhere, nowhere)

    def _tally(
        self,
        method: str,
        index: int,
        estimate_w_m2: Floats,
        reference_w_m2: Floats,
        moving: Bools,
        valid: Bools,
        scored: Bools,
        interpolated: Bools,
    ) -> FrameTally:
        slots = reference_w_m2.shape[0]
        if estimate_w_m2.shape != reference_w_m2.shape or moving.shape != reference_w_m2.shape[1:]:
            raise ValueCheckError(
                f"{method}, frame {index}: estimate {estimate_w_m2.shape}, reference "
                f"{reference_w_m2.shape} and mask {moving.shape} are not of one size"
            )
        regions = (moving, ~moving)
        sums = np.zeros((len(self.metrics), 2, slots))
        clamped = np.zeros((len(self.metrics), 2), np.int64)
        counts, covered, interpolated_counts, samples = (np.zeros((2, slots), np.int64) for _ in range(4))
        for r, region in enumerate(regions):
            samples[r] = np.count_nonzero(region)
            counts[r, : self.coded_slots] = np.count_nonzero(region & scored)
            covered[r, : self.coded_slots] = np.count_nonzero(region & valid)
            interpolated_counts[r, : self.coded_slots] = np.count_nonzero(region & valid & interpolated)
        white = self.scale.white_cd_m2
        for slot in range(min(slots, self.coded_slots)):
            # One slot at a time stays in the processor's cache for all metrics and regions.
            estimate = self.scale.luminance_cd_m2(estimate_w_m2[slot : slot + 1])
            reference = self.scale.luminance_cd_m2(reference_w_m2[slot : slot + 1])
            for r, region in enumerate(regions):
                where = region & scored
                theirs = reference[0][where].astype(np.float64)
                for m, metric in enumerate(self.metrics):
                    sums[m, r, slot] = metric.sum_errors(estimate, reference, where, white)[0]
                    clamped[m, r] += metric.clamped(theirs)
        return FrameTally(method, index, sums, counts, covered, interpolated_counts, samples, clamped)

    def records(self, tallies: Iterable[FrameTally]) -> list[Score]:
        """Scores by method, phase, metric and region, JSON-able; phases without frames are left out."""
        found: list[Score] = []
        for (method, phase), group in by_method_and_phase(tallies, self.latency_frames).items():
            for m, metric in enumerate(self.metrics):
                for region in REGIONS:
                    value, flag, n = self._pooled(group, m, region, None)
                    frames = [self._pooled([tally], m, region, None)[0] for tally in group]
                    low, high = _interval(value, [each for each in frames if each is not None])
                    clamped = sum(int(t.clamped[m, rows_of(region)].sum()) for t in group)
                    found.append(
                        Score(
                            method=method,
                            metric=metric.name,
                            unit=metric.unit,
                            region=region,
                            phase=phase,
                            value=value,
                            flag=flag,
                            n=n,
                            higher_is_better=metric.higher_is_better,
                            clamped_share=clamped / n if n else 0.0,
                            low=low,
                            high=high,
                        )
                    )
        return found

    def coverage(self, tallies: Iterable[FrameTally]) -> list[Coverage]:
        """Share of each region that was scored, by method and phase."""
        found: list[Coverage] = []
        for (method, phase), group in by_method_and_phase(tallies, self.latency_frames).items():
            for region in REGIONS:
                rows = rows_of(region)
                samples, counts, filled = (
                    sum(int(getattr(t, name)[rows].sum()) for t in group)
                    for name in ("samples", "covered", "interpolated")
                )
                found.append(
                    Coverage(
                        method=method,
                        region=region,
                        phase=phase,
                        valid=counts / samples if samples else 0.0,
                        interpolated=filled / counts if counts else 0.0,
                    )
                )
        return found

    def frame_series(self, tallies: Iterable[FrameTally]) -> list[Series]:
        """Score of each coded frame, by method, metric and region."""
        groups: dict[str, list[FrameTally]] = {}
        for tally in sorted(tallies, key=lambda t: t.index):
            groups.setdefault(tally.method, []).append(tally)
        return [
            Series(
                method=method,
                metric=metric.name,
                unit=metric.unit,
                region=region,
                x=[t.index for t in group],
                values=[self._pooled([t], m, region, None)[0] for t in group],
            )
            for method, group in groups.items()
            for m, metric in enumerate(self.metrics)
            for region in REGIONS
        ]

    def slot_series(self, tallies: Iterable[FrameTally], phase: Phase = "steady") -> list[Series]:
        """Score of each slot inside a coded frame, pooled over a phase: shows code-synchronous flicker."""
        slots = range(self.coded_slots)
        return [
            Series(
                method=method,
                metric=metric.name,
                unit=metric.unit,
                region=region,
                x=list(slots),
                values=[self._pooled(group, m, region, slot)[0] for slot in slots],
            )
            for (method, found), group in by_method_and_phase(tallies, self.latency_frames).items()
            if found == phase
            for m, metric in enumerate(self.metrics)
            for region in REGIONS
        ]

    def _pooled(
        self, group: Sequence[FrameTally], m: int, region: Region, slot: int | None
    ) -> tuple[float | None, str, int]:
        rows, slots = rows_of(region), slice(None) if slot is None else slice(slot, slot + 1)
        total = math.fsum(float(x) for t in group for x in t.sums[m, rows, slots].flat)
        count = sum(int(t.counts[rows, slots].sum()) for t in group)
        flag = "empty" if not count else "identical" if total == 0 else ""
        return self.metrics[m].finish(total, count), flag, count


def _interval(value: float | None, frames: Sequence[float]) -> tuple[float | None, float | None]:
    """Student's interval of 95 % around a pooled score, from the scores of its frames."""
    n = len(frames)
    if value is None or n < 2:
        return None, None
    mean = math.fsum(frames) / n
    # Exact sums: the order of the frames cannot change a result.
    error = math.sqrt(math.fsum((each - mean) ** 2 for each in frames) / (n - 1) / n)
    half = quantile(n - 1, (1 + CONFIDENCE) / 2) * error
    return value - half, value + half


def rows_of(region: Region) -> slice:
    """Rows of a tally that form a region: moving and static add up to all."""
    return {"all": slice(0, 2), "moving": slice(0, 1), "static": slice(1, 2)}[region]
