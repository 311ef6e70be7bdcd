"""The answer of a run in its first screen: who is best where, and by how much."""

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
    def best(self) -> float | None:
        """The best value."""
        values = [s.value for s in self.scores if s is not None and s.value is not None]
        if not values:
            return None
        return max(values) if self.higher_is_better else min(values)


@dataclass(frozen=True)
class Contestant:
    """One method on a card: where its dot stands on the card's axis, 0 (worst) to 1 (best)."""

    name: str
    value: float
    position: float
    style: str


@dataclass(frozen=True)
class Card:
    """The answer for one region: contestants, best first."""

    where: str
    metric: str
    unit: str
    contestants: tuple[Contestant, ...]

    @property
    def lead(self) -> float | None:
        """How far the best is ahead of the second, in the unit."""
        if len(self.contestants) < 2:
            return None
        return abs(self.contestants[0].value - self.contestants[1].value)


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


def cards(results: Results, phase: Phase) -> list[Card]:
    """One card a region, each with the metric that the registered claims use there."""
    wanted = {verdict.region: verdict.metric for verdict in results.claims}
    rows = table(results.scores, results.methods, phase)
    chosen: list[Card] = []
    for region, where in REGIONS:
        of_region = [row for row in rows if row.region == region]
        row = next((r for r in of_region if r.metric == wanted.get(region)), None) or next(
            iter(of_region), None
        )
        if row is not None and row.best is not None:
            chosen.append(Card(where, row.metric, row.unit, _contestants(row, list(results.methods))))
    return chosen


def _contestants(row: Row, methods: Sequence[str]) -> tuple[Contestant, ...]:
    pairs = [
        (name, s.value, style_of(methods, name))
        for name, s in zip(methods, row.scores, strict=True)
        if s is not None and s.value is not None
    ]
    pairs.sort(key=lambda pair: pair[1], reverse=row.higher_is_better)
    best, worst = pairs[0][1], pairs[-1][1]
    span = (best - worst) or 1.0
    return tuple(Contestant(name, v, (v - worst) / span if best != worst else 1.0, s) for name, v, s in pairs)


def style_of(methods: Sequence[str], name: str) -> str:
    """CSS class of a method: the same colour wherever it appears."""
    return f"s{list(methods).index(name)}" if name in methods else "noise"


def ceilings(results: Results, phase: Phase) -> dict[tuple[Region, str], float]:
    """Best score that the truth can certify in a phase, by region and metric."""
    return {
        (s.region, s.metric): s.value
        for s in results.noise_ceiling
        if s.phase == phase and s.value is not None
    }
