"""Points against the unchanged camera, over paired seeds: each change of a score with its interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from optsim.metrics.student import CONFIDENCE, half_width, quantile
from optsim.study.measurement import Key, PointScores, measured
from optsim.study.point import Point
from optsim.study.stage import Stage


@dataclass(frozen=True)
class Seeds:
    """How many seeds a point gets.

    Parameters
    ----------
    least, most : int
        Seeds that are always measured, and the cap.
    wanted_db : float
        Half width of the interval at which no more are added, dB.
    """

    least: int = 2
    most: int = 4
    wanted_db: float = 0.1


LIMITS = Seeds(4, 6)
"""Seeds of a limit: from four on it has an interval."""
PAIR = Seeds(2, 2)
"""Seeds of a point whose curve knows the scatter, see :func:`pool_scatter`."""


@dataclass(frozen=True)
class Estimate:
    """A mean over seeds and half of its 95 % interval by Student; None for a single seed."""

    mean: float
    half: float | None
    n: int

    @property
    def ends(self) -> tuple[float | None, float | None]:
        """Both ends of the interval."""
        return (None, None) if self.half is None else (self.mean - self.half, self.mean + self.half)

    @property
    def stated_half(self) -> float | None:
        """Half of the interval from four seeds on: with two it is nine standard deviations."""
        return self.half if self.n >= LIMITS.least else None

    @property
    def below_noise(self) -> bool:
        """Whether the seeds cannot tell the mean from zero."""
        return self.half is None or abs(self.mean) <= self.half


def student(values: Sequence[float]) -> Estimate:
    """Mean of independent values and half of its 95 % interval."""
    return Estimate(float(np.mean(values)), half_width(values), len(values))


@dataclass(frozen=True, eq=False)
class Compared:
    """A point over its seeds; the keys are (method, region)."""

    point: Point  # Without its seed.
    db: dict[Key, Estimate]
    change_db: dict[Key, Estimate]  # Against the unchanged camera at the same seed.
    stops: dict[Key, float]  # Error of the logarithm, mean over the seeds.
    first: PointScores  # Of the experiment's own seed.
    refused: str  # Why the point cannot be; empty for one that can.
    work: dict[str, int] = field(default_factory=dict[str, int])  # Counts of what was computed.

    def worst(self, keys: Iterable[Key]) -> Key | None:
        """Score that loses most."""
        known = [key for key in keys if key in self.change_db]
        return min(known, key=lambda key: self.change_db[key].mean, default=None)


Decides = Callable[[dict[Key, Estimate]], Iterable[Key]]
"""From the changes so far: scores whose interval decides whether more seeds are added."""


def compare(stage: Stage, point: Point, seeds: Seeds, decides: Decides = list) -> Compared:
    """Measure a point and the unchanged camera over paired seeds, until the interval is small enough."""
    measurements: list[tuple[PointScores, PointScores]] = []
    work: dict[str, int] = {}
    while True:
        seed = stage.base.seed + len(measurements)
        pair = (
            measured(stage, Point(seed=seed)),
            measured(stage, replace(point, seed=seed)),
        )
        for each in pair if point.changes else pair[:1]:
            add_work(work, each.work)
        refused = pair[0].refused or pair[1].refused
        if refused:
            return Compared(point, {}, {}, {}, pair[1], refused, work)
        measurements.append(pair)
        changes = {
            key: student(values)
            for key, values in _by_key(measurements, lambda base, here: _difference(base, here)).items()
        }
        if len(measurements) < seeds.least:
            continue
        halves = [changes[key].half for key in decides(changes) if key in changes]
        if len(measurements) >= seeds.most or all(
            half is not None and half <= seeds.wanted_db for half in halves
        ):
            break
    levels = _by_key(measurements, lambda base, here: here.db)
    stops = _by_key(measurements, lambda base, here: here.stops)
    return Compared(
        replace(point, seed=stage.base.seed),
        {key: student(values) for key, values in levels.items()},
        changes,
        {key: float(np.mean(values)) for key, values in stops.items()},
        measurements[0][1],
        "",
        work,
    )


def add_work(total: dict[str, int], more: dict[str, int]) -> None:
    """Add counts to counts."""
    for name, count in more.items():
        total[name] = total.get(name, 0) + count


def rows_of(compared: Compared, **about: Any) -> list[dict[str, Any]]:
    """One row a method and region, tidy; a refused point has a single row that says why."""
    head = {**about, "mode": compared.point.mode, "compensators": " ".join(compared.point.compensators)}
    if compared.refused:
        return [{**head, "refused": compared.refused}]
    rows: list[dict[str, Any]] = []
    for key, level in compared.db.items():
        change = compared.change_db[key]
        rows.append(
            {
                **head,
                "method": key[0],
                "region": key[1],
                "db": level.mean,
                "db_half": level.half,
                "change_db": change.mean,
                "change_half": change.half,
                "seeds": change.n,
                "below_noise": change.below_noise,
                "stops": compared.stops.get(key),
                "covered": compared.first.covered,
                "map_residual_px": compared.first.map_residual_px,
                "refused": "",
            }
        )
    return rows


def pool_scatter(rows: Iterable[dict[str, Any]]) -> None:
    """Set the intervals of tidy rows anew: the scatter over seeds is that of the whole curve.

    Two seeds alone have an interval nine standard deviations wide. The standard deviation is taken to be the
    same along a curve (a mode, method and region); the unchanged camera has none against itself.
    """
    curves: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for row in rows:
        if not row["refused"]:
            curves.setdefault((row["mode"], row["method"], row["region"]), []).append(row)
    for curve in curves.values():
        for half in ("db_half", "change_half"):
            known = [row for row in curve if row[half]]
            freedom = sum(row["seeds"] - 1 for row in known)
            if freedom:
                variance = sum((row["seeds"] - 1) * _variance(row[half], row["seeds"]) for row in known)
                times = quantile(freedom, (1 + CONFIDENCE) / 2) * math.sqrt(variance / freedom)
                for row in known:
                    row[half] = times / math.sqrt(row["seeds"])
        for row in curve:
            row["below_noise"] = row["change_half"] is None or abs(row["change_db"]) <= row["change_half"]


def _variance(half: float, n: int) -> float:
    """Variance of values whose mean has this half of a Student interval."""
    return n * (half / quantile(n - 1, (1 + CONFIDENCE) / 2)) ** 2


def _difference(base: PointScores, here: PointScores) -> dict[Key, float | None]:
    """Change of every score that both have."""
    found: dict[Key, float | None] = {}
    for key, value in here.db.items():
        before = base.db.get(key)
        found[key] = None if value is None or before is None else value - before
    return found


def _by_key(
    pairs: Sequence[tuple[PointScores, PointScores]],
    read: Callable[[PointScores, PointScores], dict[Key, float | None]],
) -> dict[Key, list[float]]:
    """Values over the seeds, of the scores that all of them have."""
    records = [read(*pair) for pair in pairs]
    keys = [key for key in records[0] if all(record.get(key) is not None for record in records)]
    return {key: [value for record in records if (value := record[key]) is not None] for key in keys}
