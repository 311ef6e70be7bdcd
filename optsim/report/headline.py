"""The first screen of a report: the best method for each metric, and its lead."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from optsim.metrics.records import Phase, Region, Score
from optsim.report.schema import Results

PHASES: tuple[Phase, ...] = ("steady", "merging", "warm-up")
REGIONS: tuple[tuple[Region, str], ...] = (
    ("moving", "Where it moves"),
    ("static", "Where it is static"),
    ("all", "Everywhere"),
)


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

    def position(self, value: float) -> float:
        """Place of a value on an axis from the worst, 0, to the best, 1."""
        values = [each for _, each in self.ranked]
        best, worst = values[0], values[-1]
        return (value - worst) / (best - worst) if best != worst else 1.0


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


def cards(results: Results, phase: Phase) -> list[Row]:
    """One row a region with scores, each with the metric of the registered claims there."""
    wanted = {verdict.region: verdict.metric for verdict in results.claims}
    known = [row for row in table(results.scores, results.methods, phase) if row.ranked]
    chosen: list[Row] = []
    for region, _ in REGIONS:
        of_region = [row for row in known if row.region == region]
        chosen += [row for row in of_region if row.metric == wanted.get(region)][:1] or of_region[:1]
    return chosen


def style_of(methods: Sequence[str], name: str) -> str:
    """CSS class of a method, the same everywhere."""
    return f"s{list(methods).index(name)}" if name in methods else "noise"


def ceilings(results: Results, phase: Phase) -> dict[tuple[Region, str], float]:
    """Best certifiable score of the truth in a phase, by region and metric."""
    return {
        (s.region, s.metric): s.value
        for s in results.noise_ceiling
        if s.phase == phase and s.value is not None
    }
