"""Scores by content class: means over coded frames with intervals, a row a metric and class."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from optsim.metrics import student
from optsim.metrics.classes import CLASSES, Class
from optsim.metrics.records import ClassSeries
from optsim.report.schema import Results

_WHERE: dict[Class, str] = {
    "all": "everywhere",
    "moving": "where it moves",
    "static": "where it is static",
    "dark": "darkest third",
    "mid": "middle third",
    "bright": "brightest third",
    "rim": "rim of what moves",
}


@dataclass(frozen=True)
class Mean:
    """Mean of the scores of coded frames, and half of its interval."""

    value: float
    half: float | None


@dataclass(frozen=True)
class ClassRow:
    """One metric in one class: a mean a method, in the order of the methods."""

    metric: str
    unit: str
    higher_is_better: bool
    where: str
    means: tuple[Mean | None, ...]

    @property
    def best(self) -> float | None:
        """The best mean."""
        choose = max if self.higher_is_better else min
        return choose((mean.value for mean in self.means if mean), default=None)


def class_rows(results: Results) -> list[ClassRow]:
    """Rows of all metrics and classes that have a score, metric by metric."""
    found = {(s.metric, s.region, s.method): s for s in results.class_series}
    about = {s.metric: (s.unit, s.higher_is_better) for s in results.class_series}
    rows = [
        ClassRow(
            metric,
            *about[metric],
            _WHERE[region],
            tuple(_mean(found.get((metric, region, method))) for method in results.methods),
        )
        for metric in about
        for region in CLASSES
    ]
    return [row for row in rows if any(row.means)]


def frames_of(series: Sequence[ClassSeries]) -> list[int]:
    """Coded frames that have scores by class."""
    return sorted({index for each in series for index in each.x})


def _mean(series: ClassSeries | None) -> Mean | None:
    if series is None:
        return None
    values = [value for value in series.values if value is not None]
    return Mean(math.fsum(values) / len(values), student.half_width(values)) if values else None
