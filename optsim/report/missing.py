"""Scores of two sides by row, seed and frame, and which of them the second side lacks."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

from optsim.metrics.tolerances import MEMORY, TIME
from optsim.report.baseline import Scored

RUN = "whole run"
"""Method and region of readings of the bench and of costs."""
_LEAST = 1e-9


@dataclass(frozen=True)
class Key:
    """A row of a comparison."""

    case: str
    method: str
    metric: str
    region: str


Unit = tuple[int, int]
"""Seed and coded frame."""
Units = Mapping[Key, Mapping[Unit, float]]


def units_of(scored: Scored) -> Units:
    """Scores by row, seed and frame; relative ones as 100 times their logarithm."""
    found: dict[Key, dict[Unit, float]] = {}
    for run in scored.runs:
        for name, value in run.readings.items():
            units = found.setdefault(Key(run.case, RUN, name, RUN), {})
            # An ideal calibration has a crosstalk of 0.
            relative = scored.metrics[name].relative
            units[run.seed, 0] = 100 * math.log(max(value, _LEAST)) if relative else value
        for metric, methods in run.scores.items():
            for method, regions in methods.items():
                for region, values in regions.items():
                    units = found.setdefault(Key(run.case, method, metric, region), {})
                    pairs = zip(run.frames, values, strict=True)
                    units |= {(run.seed, frame): value for frame, value in pairs if value is not None}
    return {key: units for key, units in found.items() if units}


def missing_scores(before: Scored, after: Scored) -> list[str]:
    """Name what the first side has and the second lacks, in as few lines as say it."""
    ours, theirs = units_of(before), units_of(after)
    found: list[str] = []
    for case in dict.fromkeys(run.case for run in before.runs):
        rows = {key: units for key, units in ours.items() if key.case == case}
        seeds, others = ({run.seed for run in side.runs if run.case == case} for side in (before, after))
        gone = seeds - others if seeds & others or not others else set[int]()
        if gone:
            found.append(f"{case}: {_numbers('seed', gone)}")
        wanted = {key: _wanted(units, seeds, others) for key, units in rows.items()}
        # A faster machine has no cost of a stage below half a second; no cost at all is a loss.
        costs = any(key.case == case and key.metric.startswith((TIME, MEMORY)) for key in theirs)
        lost = {
            key: units.difference(theirs.get(key, ()))
            for key, units in wanted.items()
            if not (costs and key.metric.startswith((TIME, MEMORY)))
        }
        found += _lines(case, wanted, lost)
    return found


def _wanted(units: Collection[Unit], seeds: Collection[int], others: Collection[int]) -> frozenset[Unit]:
    """Units that the second side must have; without a common seed its own at the first one's frames."""
    if common := set(seeds) & set(others):
        return frozenset(unit for unit in units if unit[0] in common)
    own, frames = {seed for seed, _ in units}, {frame for _, frame in units}
    steady = {frame for frame in frames if all((seed, frame) in units for seed in own)}
    return frozenset((seed, frame) for seed in others for frame in steady or frames)


def _lines(
    case: str, wanted: Mapping[Key, frozenset[Unit]], lost: Mapping[Key, frozenset[Unit]]
) -> list[str]:
    """Group rows that lost the same units, and methods that lost the same rows."""
    methods: dict[tuple[str, str], list[str]] = {}
    for method in dict.fromkeys(key.method for key in wanted):
        rows = [key for key in wanted if key.method == method]
        for units in dict.fromkeys(lost[key] for key in rows if lost.get(key)):
            here = [key for key in rows if lost.get(key) == units]
            what = "all scores" if here == rows else _rows(here, rows)
            where = _units(units, frozenset[Unit]().union(*(wanted[key] for key in here)))
            methods.setdefault((what, where), []).append(method)
    return [f"{case}, {', '.join(who)}: {what}{where}" for (what, where), who in methods.items()]


def _rows(here: Iterable[Key], rows: Collection[Key]) -> str:
    """Name metrics with their regions, those of the same regions together."""
    regions: dict[str, list[str]] = {}
    for key in here:
        regions.setdefault(key.metric, []).append(key.region)
    metrics: dict[tuple[str, ...], list[str]] = {}
    for metric, names in regions.items():
        metrics.setdefault(tuple(names), []).append(metric)
    every = len({key.metric for key in rows})
    return "; ".join(
        ("all metrics" if len(which) == every else ", ".join(which))
        + ("" if names == (RUN,) else f" ({', '.join(names)})")
        for names, which in metrics.items()
    )


def _units(lost: Collection[Unit], wanted: Collection[Unit]) -> str:
    """Say which seeds and frames were lost; nothing where all were."""
    if lost == wanted:
        return ""
    seeds: dict[tuple[int, ...], list[int]] = {}
    for seed in sorted({s for s, _ in lost}):
        frames = tuple(sorted(f for s, f in lost if s == seed))
        whole = set(frames) == {f for s, f in wanted if s == seed}
        seeds.setdefault(() if whole else frames, []).append(seed)
    return "".join(
        f", {_numbers('seed', which)}" + (f" {_numbers('frame', frames)}" if frames else "")
        for frames, which in seeds.items()
    )


def _numbers(word: str, numbers: Collection[int]) -> str:
    some = sorted(numbers)
    if len(some) > 2 and some[-1] - some[0] == len(some) - 1:
        return f"{word}s {some[0]} to {some[-1]}"
    return f"{word}{'s' if len(some) > 1 else ''} {', '.join(map(str, some))}"
