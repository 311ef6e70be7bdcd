"""Comparison of runs with a baseline or with other runs: a verdict a scene, method, region and metric.

Every row has its interval, and all intervals hold together. A row fails that is worse significantly and
beyond its metric's tolerance. The smallest loss that would fail is stated beside.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, cast

import numpy as np
from pydantic import Field

from optsim.core.config import flat
from optsim.core.errors import ConfigError, unknown_name
from optsim.metrics.comparison import Advantage, Alarm, Change, estimate, judge, row_level
from optsim.metrics.records import Record
from optsim.metrics.student import CONFIDENCE
from optsim.metrics.tolerances import tolerance_of
from optsim.report.baseline import Facts, Scored
from optsim.report.missing import Key, missing_scores, units_of

ALL_CASES = "all scenes"
"""Case of the rows that take the mean over all cases."""
Outcome = Literal["pass", "regression", "cannot compare"]
_TRUTH = ("scene", "source", "camera.panel_rows", "camera.panel_cols", "camera.slots_per_frame")


class Delta(Record):
    """One row: scores before and after, and the advantage of after; below 0 it is worse."""

    case: str
    method: str
    metric: str
    unit: str
    region: str
    before: float
    after: float
    advantage: float
    low: float | None  # Bounds of the advantage, like ``high``; None without an interval.
    high: float | None
    tolerance: float | None
    detectable: float | None  # Loss that fails with a probability of 90 %.
    verdict: Change
    alarm: Alarm
    why: str
    scatter: float | None
    seeds: int
    units: int  # Coded frames times ``seeds``; seeds alone if not ``paired``.
    paired: bool


class Detectable(Record):
    """Smallest loss of a metric that fails with a probability of 90 %: best, median and worst of its rows."""

    metric: str
    unit: str
    tolerance: float
    best: float
    median: float
    worst: float


class Setting(Record):
    """A setting or version that differs between the sides; a dash where a side has none."""

    case: str
    key: str
    before: str
    after: str


class Kept(Record):
    """Picture of a method that failed, below the comparison's folder."""

    file: str
    side: Literal["before", "after"]
    case: str
    method: str
    label: str


class Comparison(Record):
    """All content of a comparison; ``confidence`` is that of all intervals together."""

    before: str
    after: str
    made_utc: str
    outcome: Outcome
    confidence: float
    judged: int
    detectable: list[Detectable]
    deltas: list[Delta]
    settings: list[Setting]
    notes: list[str]
    missing: list[str]
    pictures: list[Kept] = Field(default_factory=list[Kept])


def compare(before: Scored, after: Scored, made_utc: str) -> Comparison:
    """Compare the scores of two sides; they cannot be where the second lacks any score of the first."""
    after = _matched(before, after)
    notes: list[str] = []
    found, missing = _estimates(before, after), missing_scores(before, after)
    found |= _over_cases(found)
    metrics = {**after.metrics, **before.metrics}
    tolerances = {name: tolerance_of(name) for name in metrics}
    judged = [k for k, e in found.items() if e.error is not None and tolerances[k.metric] is not None]
    level = row_level(len(judged))
    deltas = [_delta(key, each, metrics, tolerances, level) for key, each in found.items()]
    if any(not delta.paired for delta in deltas):
        notes.append("no seed is in both: the scores of seeds are compared by their means")
    elif all(delta.seeds == 1 for delta in deltas):
        notes.append("one seed: intervals hold the scatter of coded frames, not that of benches and codes")
    outcome: Outcome = "pass" if judged else "cannot compare"
    if missing:
        outcome = "cannot compare"
    elif any(delta.alarm == "fail" for delta in deltas):
        outcome = "regression"
    return Comparison(
        before=before.name,
        after=after.name,
        made_utc=made_utc,
        outcome=outcome,
        confidence=CONFIDENCE,
        judged=len(judged),
        detectable=_detectable(deltas),
        deltas=deltas,
        settings=_differences(before, after),
        notes=notes,
        missing=missing,
    )


def between_methods(scored: Scored, before: str, after: str) -> tuple[Scored, Scored]:
    """Take two methods of the same runs as the two sides of a comparison."""
    names = {name for run in scored.runs for methods in run.scores.values() for name in methods}
    label = f"{after} over {before}"
    sides: list[Scored] = []
    for wanted in (before, after):
        if wanted not in names:
            raise unknown_name("method", wanted, names)
        runs = [
            run.model_copy(
                update={
                    "scores": {m: {label: rows[wanted]} for m, rows in run.scores.items() if wanted in rows}
                }
            )
            for run in scored.runs
        ]
        about = {case: _of_method(each, wanted, label) for case, each in scored.experiments.items()}
        labels = {"runs": runs, "name": f"{wanted} of {scored.name}", "experiments": about}
        sides.append(scored.model_copy(update=labels))
    return sides[0], sides[1]


def _of_method(experiment: Mapping[str, Any], name: str, label: str) -> dict[str, Any]:
    """Take the settings of one method only, under the name of both."""
    methods = [{**each, "name": label} for each in experiment.get("methods", ()) if each["name"] == name]
    return {**experiment, "methods": methods}


def _matched(before: Scored, after: Scored) -> Scored:
    """Give the only case of the candidate the name of the baseline's only case."""
    cases = [sorted(side.experiments) for side in (before, after)]
    if len(cases[0]) == len(cases[1]) == 1 and cases[0] != cases[1]:
        (old,), (new,) = cases
        runs = [run.model_copy(update={"case": old}) for run in after.runs]
        after = after.model_copy(update={"runs": runs, "experiments": {old: after.experiments[new]}})
    common = before.experiments.keys() & after.experiments.keys()
    if not common:
        raise ConfigError(
            f"nothing to compare: got {', '.join(cases[1])}, expected an experiment of the baseline: "
            f"{', '.join(cases[0])}; cure: run that one, or 'optsim accept' the new one"
        )
    for case in sorted(common):
        ours, theirs = (_of_truth(side.experiments[case]) for side in (before, after))
        changed = [key for key in {**ours, **theirs} if ours.get(key) != theirs.get(key)]
        if changed:
            key = changed[0]
            raise ConfigError(
                f"{case}: {key}: got {theirs.get(key)!r}, expected {ours.get(key)!r} as in the baseline: "
                "scores of different truths cannot be compared; cure: the same scene, panel and slots"
            )
    return after


def _of_truth(experiment: Mapping[str, Any]) -> dict[str, object]:
    keys = flat(experiment)
    return {key: keys[key] for key in keys if key.startswith(_TRUTH)}


def _differences(before: Scored, after: Scored) -> list[Setting]:
    """List what differs in settings and versions; a setting that differs alike in all cases once."""
    changes: dict[tuple[str, str, str], list[str]] = {}
    common = sorted(before.experiments.keys() & after.experiments.keys())
    for case in common:
        tables = [
            {**_settings(side.experiments[case]), **{f"version of {k}": v for k, v in side.versions.items()}}
            for side in (before, after)
        ]
        for key in sorted({**tables[0], **tables[1]}):
            was, now = (table.get(key, "–") for table in tables)
            if was != now:
                changes.setdefault((key, str(was), str(now)), []).append(case)
    return [
        Setting(case=case, key=key, before=was, after=now)
        for (key, was, now), cases in changes.items()
        for case in ([ALL_CASES] if len(cases) == len(common) > 1 else cases)
    ]


def _settings(experiment: Mapping[str, Any]) -> dict[str, object]:
    table = {key: value for key, value in experiment.items() if key not in ("methods", "description", "name")}
    for method in cast("Sequence[Mapping[str, Any]]", experiment.get("methods", ())):
        table[f"methods.{method['name']}"] = dict(method)
    return flat(table)


def _estimates(before: Scored, after: Scored) -> dict[Key, Advantage]:
    """Estimate all common rows."""
    theirs, metrics = units_of(after), {**after.metrics, **before.metrics}
    found: dict[Key, Advantage] = {}
    for key, units in units_of(before).items():
        each = estimate(units, theirs.get(key, {}), metrics[key.metric].higher_is_better)
        if each is not None:
            found[key] = each
    return found


def _over_cases(found: Mapping[Key, Advantage]) -> dict[Key, Advantage]:
    """Mean of each row over the cases that have it, where there are several."""
    groups: dict[Key, list[Advantage]] = {}
    for key, each in found.items():
        groups.setdefault(Key(ALL_CASES, key.method, key.metric, key.region), []).append(each)
    return {key: _mean(group) for key, group in groups.items() if len(group) > 1}


def _mean(group: Sequence[Advantage]) -> Advantage:
    """Mean of estimates of independent cases (degrees of freedom by Satterthwaite)."""
    n = len(group)
    errors = [each.error for each in group if each.error is not None]
    total = math.fsum(error**2 for error in errors)
    parts = [e.error**4 / e.freedom for e in group if e.error is not None]
    return Advantage(
        before=float(np.mean([e.before for e in group])),
        after=float(np.mean([e.after for e in group])),
        advantage=float(np.mean([e.advantage for e in group])),
        error=math.sqrt(total) / n if len(errors) == n else None,
        freedom=total**2 / math.fsum(parts) if total else sum(e.freedom for e in group),
        seeds=min(e.seeds for e in group),
        units=sum(e.units for e in group),
        paired=all(e.paired for e in group),
        scatter=None,
        scatter_p=1.0,
    )


def _delta(
    key: Key,
    each: Advantage,
    metrics: Mapping[str, Facts],
    tolerances: Mapping[str, float | None],
    level: float,
) -> Delta:
    tolerance, facts = tolerances[key.metric], metrics[key.metric]
    judged = judge(each, tolerance, level, either_way=facts.either_way)
    before, after = each.before, each.after
    if facts.relative:
        before, after = (math.exp(value / 100) for value in (before, after))
    return Delta(
        case=key.case,
        method=key.method,
        metric=key.metric,
        unit="%" if facts.relative else facts.unit,
        region=key.region,
        before=before,
        after=after,
        advantage=each.advantage,
        low=judged.low,
        high=judged.high,
        tolerance=tolerance,
        detectable=judged.detectable,
        verdict=judged.verdict,
        alarm=judged.alarm,
        why=judged.why,
        scatter=each.scatter,
        seeds=each.seeds,
        units=each.units,
        paired=each.paired,
    )


def _detectable(deltas: Sequence[Delta]) -> list[Detectable]:
    found: list[Detectable] = []
    for metric in dict.fromkeys(delta.metric for delta in deltas):
        rows = [d for d in deltas if d.metric == metric and d.detectable is not None]
        sizes = [d.detectable for d in rows if d.detectable is not None]
        if sizes:
            found.append(
                Detectable(
                    metric=metric,
                    unit=rows[0].unit,
                    tolerance=rows[0].tolerance or 0.0,
                    best=min(sizes),
                    median=float(np.median(sizes)),
                    worst=max(sizes),
                )
            )
    return found
