"""The first lines of a report: which method is best and how surely, then its faults with their places."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

from optsim.metrics.log_error import LogRmse
from optsim.metrics.records import Phase
from optsim.report import headline, words
from optsim.report.headline import Lead, Row
from optsim.report.schema import Results

# A frame or slot counts as a fault where its error exceeds the others' median by this share.
_WORSE_BY = 0.1
LEAST_SAMPLES = 1000
"""A luminance is plotted, or named as a fault, if so many samples have it."""


@dataclass(frozen=True)
class Line:
    """Verdict on one region: the leading methods, and whether their lead is certain."""

    row: Row
    winners: tuple[str, ...]
    certain: bool
    text: str


@dataclass(frozen=True)
class Fault:
    """One fault in words, and the state of the viewer that shows it; empty where none does."""

    text: str
    show: str = ""


def verdict(results: Results, phase: Phase) -> list[Line]:
    """Judge each region by its headline metric, everywhere first."""
    rows = headline.headline_rows(results, phase)
    return [_line(row, headline.leads(results, row, phase)) for row in rows]


def _line(row: Row, leads: Sequence[Lead]) -> Line:
    best, unit = row.ranked[0][0].method, row.unit
    if not leads:
        return Line(row, (best,), False, "is the only method")
    nearest, level = leads[0], [lead for lead in leads if not lead.certain]
    shown = (level or leads)[0]
    lead = " ".join(filter(None, [words.score(shown.mean, unit), words.plus_minus(shown.half, unit), unit]))
    if not level:
        return Line(row, (best,), True, f"is best, {lead} better than {nearest.other}")
    if all(each.half is None for each in level):
        return Line(row, (best,), False, f"leads {shown.other} by {lead}, from too few coded frames to tell")
    names = (best, *(each.other for each in level))
    return Line(row, names, False, f"not told apart ({lead})")


def subject(results: Results, phase: Phase) -> str:
    """Name the method whose faults are listed: the best everywhere."""
    lines = verdict(results, phase)
    return lines[0].winners[0] if lines else next(iter(results.methods), "")


def quality(results: Results, phase: Phase) -> str:
    """Say how large the relative error of the best method is, and how sure the truth is."""
    name, metric = subject(results, phase), LogRmse().name
    found = [
        s for s in results.scores if (s.method, s.metric, s.region, s.phase) == (name, metric, "all", phase)
    ]
    score = next(iter(found), None)
    if score is None or score.value is None:
        return ""
    value, half = score.value, words.plus_minus(score.half, "stops")
    said = " ".join(filter(None, [f"errs by {words.score(value, 'stops')}", half, "stops"]))
    said += f" ({words.per_cent_of_stops(value)})"
    sure = headline.ceilings(results, phase).get(("all", metric))
    return said + ("" if sure is None else f"; truth sure to {words.score(sure, 'stops')}")


def faults(results: Results, phase: Phase) -> list[Fault]:
    """List the faults of the best method, each with its place."""
    name = subject(results, phase)
    found = [
        _worst_place(results, name),
        _regions(results, name, phase),
        _luminance(results, name),
        _worst_frame(results, name, phase),
        _worst_slot(results, name),
        _given_up(results, name, phase),
        _saturated(results, name),
    ]
    return [fault for fault in found if fault is not None]


def state(results: Results, **wanted: object) -> str:
    """Write a state of the viewer as JSON; empty when it lacks that coded frame."""
    shown = [frame.index for frame in results.viewer.frames]
    return json.dumps(wanted) if wanted.get("frame", shown[0]) in shown else ""


def _worst_place(results: Results, name: str) -> Fault | None:
    place = next((p for p in results.worst_places if p.method == name), None)
    if place is None:
        return None
    last = place.row + place.height - 1, place.col + place.width - 1
    sign = "too bright" if place.bias_stops > 0 else "too dark"
    tendency = f", {sign} on average" if abs(place.bias_stops) > place.rms_stops / 3 else ""
    return Fault(
        f"It errs most at rows {place.row} to {last[0]}, columns {place.col} to {last[1]}: "
        f"{words.score(place.rms_stops, 'stops')} stops{tendency}.",
        state(
            results,
            frame=place.frame,
            slot=place.slot,
            left=name,
            right="",
            view="difference",
            box=[place.row, place.col, place.height, place.width],
        ),
    )


def _regions(results: Results, name: str, phase: Phase) -> Fault | None:
    values = {
        s.region: s.value
        for s in results.scores
        if (s.method, s.metric, s.phase) == (name, LogRmse().name, phase) and s.value is not None
    }
    if "moving" not in values or "static" not in values:
        return None
    worse, other = ("moving", "static") if values["moving"] > values["static"] else ("static", "moving")
    said = {"moving": "Where it moves", "static": "Where it is static"}[worse]
    return Fault(
        f"{said} it errs by {words.score(values[worse], 'stops')} stops, elsewhere by "
        f"{words.score(values[other], 'stops')}.",
        state(results, left=name, right="", view="difference"),
    )


def _luminance(results: Results, name: str) -> Fault | None:
    bins = [b for b in results.by_luminance if b.method == name and b.n >= LEAST_SAMPLES]
    if len(bins) < 2:
        return None
    worst = max(bins, key=lambda b: b.rms_stops)
    sign = "too bright" if worst.bias_stops > 0 else "too dark"
    return Fault(
        f"Between {words.number(worst.low_cd_m2)} and {words.number(worst.high_cd_m2)} cd/m² it errs by "
        f"{words.score(worst.rms_stops, 'stops')} stops, {words.score(abs(worst.bias_stops), 'stops')} "
        f"{sign} on average.",
        state(results, left=name, right="", view="blink", white=worst.high_cd_m2),
    )


def _worst_frame(results: Results, name: str, phase: Phase) -> Fault | None:
    errors = headline.by_frame(results, LogRmse().name, "all", name, phase)
    return _outlier(
        errors,
        "Coded frame",
        lambda index: state(results, frame=index, left=name, right="", view="difference"),
    )


def _worst_slot(results: Results, name: str) -> Fault | None:
    errors = {
        slot: value
        for s in results.slot_series
        if (s.method, s.metric, s.region) == (name, LogRmse().name, "all")
        for slot, value in zip(s.x, s.values, strict=True)
        if value is not None
    }
    return _outlier(
        errors, "Slot", lambda slot: state(results, slot=slot, left=name, right="", view="difference")
    )


def _outlier(errors: dict[int, float], what: str, show: Callable[[int], str]) -> Fault | None:
    """Report the largest error, if it lies clearly above the others."""
    if len(errors) < 3:
        return None
    worst = max(errors, key=lambda index: errors[index])
    usual = median(errors.values())
    if errors[worst] < (1 + _WORSE_BY) * usual:
        return None
    return Fault(
        f"{what} {worst} errs by {words.score(errors[worst], 'stops')} stops; half of them err by at most "
        f"{words.score(usual, 'stops')}.",
        show(worst),
    )


def _given_up(results: Results, name: str, phase: Phase) -> Fault | None:
    share = next(
        (c.valid for c in results.coverage if (c.method, c.region, c.phase) == (name, "all", phase)), 1.0
    )
    if share > 0.999:
        return None
    return Fault(
        f"It gives up {words.share(1 - share)} of the pixels; these are not scored.",
        state(results, left=name, right="", view="left", mark="given up"),
    )


def _saturated(results: Results, name: str) -> Fault | None:
    share = next((p.saturated_share for p in results.photons if p.method == name), 0.0)
    if share < 0.001:
        return None
    return Fault(f"{words.share(share)} of its CCD pixels saturate.")
