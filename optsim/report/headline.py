"""The scores of a report: a row a metric and region, intervals from coded frames, the best and its lead."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from optsim.metrics import student
from optsim.metrics.records import Phase, Region, Score
from optsim.metrics.scoring import phase_of
from optsim.report.schema import Results

PHASES: tuple[Phase, ...] = ("steady", "merging", "warm-up")
REGIONS: tuple[tuple[Region, str], ...] = (
    ("moving", "Where it moves"),
    ("static", "Where it is static"),
    ("all", "Everywhere"),
)
_LEAST_FRAMES = 3


@dataclass(frozen=True)
class Row:
    """One metric in one region: a score a method, in the order of the methods."""

    region: Region
    where: str
    metric: str
    unit: str
    higher_is_better: bool
    scores: tuple[Score | None, ...]

    @property
    def ranked(self) -> list[tuple[Score, float]]:
        """Scores that have a value, with it, best first."""
        known = [(s, s.value) for s in self.scores if s is not None and s.value is not None]
        return sorted(known, key=lambda pair: pair[1], reverse=self.higher_is_better)

    @property
    def best(self) -> float | None:
        """The best value."""
        return next((value for _, value in self.ranked), None)

    @property
    def lead(self) -> float | None:
        """Lead of the best over the second, in the unit."""
        values = [value for _, value in self.ranked]
        return abs(values[0] - values[1]) if len(values) > 1 else None


def phases_reached(results: Results) -> list[Phase]:
    """Phases that have scores, the one for the headline first: steady, else the latest reached."""
    reached = {score.phase for score in results.scores}
    return [phase for phase in PHASES if phase in reached]


def table(scores: Sequence[Score], methods: Iterable[str], phase: Phase) -> list[Row]:
    """Scores of a phase, a row for each region and metric."""
    names, scores = list(methods), [s for s in scores if s.phase == phase]
    first = {s.metric: s for s in reversed(scores)}
    metrics = list(dict.fromkeys(s.metric for s in scores))
    found = {(s.region, s.metric, s.method): s for s in scores}
    return [
        Row(
            region,
            where,
            metric,
            first[metric].unit,
            first[metric].higher_is_better,
            tuple(found.get((region, metric, method)) for method in names),
        )
        for region, where in REGIONS
        for metric in metrics
    ]


def headline_rows(results: Results, phase: Phase) -> list[Row]:
    """One row a region with scores, everywhere first, each with the metric of the registered claims there."""
    wanted = {verdict.region: verdict.metric for verdict in results.claims}
    known = [row for row in table(results.scores, results.methods, phase) if row.ranked]
    chosen: list[Row] = []
    for region, _ in REGIONS:
        of_region = [row for row in known if row.region == region]
        chosen += [row for row in of_region if row.metric == wanted.get(region)][:1] or of_region[:1]
    return sorted(chosen, key=lambda row: row.region != "all")


def by_frame(results: Results, metric: str, region: Region, method: str, phase: Phase) -> dict[int, float]:
    """Scores of the coded frames of a phase that have one."""
    series = (s for s in results.frame_series if (s.metric, s.region, s.method) == (metric, region, method))
    return {
        index: value
        for s in series
        for index, value in zip(s.x, s.values, strict=True)
        if value is not None and phase_of(index, results.latency.frames) == phase
    }


def half_width(values: Sequence[float]) -> float | None:
    """Half of the 95 % interval of a mean, by Student's distribution; None for fewer than three values."""
    return None if len(values) < _LEAST_FRAMES else student.half_width(values)


@dataclass(frozen=True)
class Lead:
    """Lead of the best method over another, in the metric's unit: a mean over their common coded frames."""

    best: str
    other: str
    mean: float
    half: float | None

    @property
    def certain(self) -> bool:
        """Whether the interval keeps clear of zero."""
        return self.half is not None and self.mean > self.half


def leads(results: Results, row: Row, phase: Phase) -> list[Lead]:
    """Lead of the best method over each other one, the nearest first."""
    names = [score.method for score, _ in row.ranked]
    if not names:
        return []
    sign = 1 if row.higher_is_better else -1
    ours = by_frame(results, row.metric, row.region, names[0], phase)
    found: list[Lead] = []
    for (score, value), name in zip(row.ranked[1:], names[1:], strict=True):
        theirs = by_frame(results, row.metric, row.region, score.method, phase)
        gains = [sign * (ours[k] - theirs[k]) for k in ours.keys() & theirs.keys()]
        mean = float(np.mean(gains)) if gains else sign * (row.ranked[0][1] - value)
        found.append(Lead(names[0], name, mean, half_width(gains)))
    return found


def style_of(methods: Sequence[str], name: str) -> str:
    """CSS class of a method, the same everywhere; there are six."""
    return f"s{list(methods).index(name) % 6}" if name in methods else "noise"


def ceilings(results: Results, phase: Phase) -> dict[tuple[Region, str], float]:
    """Best certifiable score of the truth in a phase, by region and metric."""
    return {
        (s.region, s.metric): s.value
        for s in results.noise_ceiling
        if s.phase == phase and s.value is not None
    }
