"""A comparison as text for a terminal, as Markdown for a pull request, as JUnit XML for a build server."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

from optsim.metrics.tolerances import short_name
from optsim.report import words
from optsim.report.comparison import ALL_CASES, Comparison, Delta

COLUMNS = ("verdict", "scene", "method", "region", "metric", "change", "interval", "before", "after")
_MOST_ROWS, _MOST_NOTES = 40, 12
_RANK = {"fail": 0, "warn": 1, "": 2}


def detectable_lines(found: Comparison) -> list[str]:
    """Smallest loss that would fail, a line a metric."""
    return [
        f"{each.metric}: {words.score(each.median, each.unit)} {each.unit} in the median row "
        f"({words.score(each.best, each.unit)} to {words.score(each.worst, each.unit)}), "
        f"tolerance {each.tolerance:g}"
        for each in found.detectable
    ]


def headline(found: Comparison) -> str:
    """Outcome in a line."""
    fails, warns = (sum(d.alarm == alarm for d in found.deltas) for alarm in ("fail", "warn"))
    lost = ", scores are missing" if found.missing else ""
    return (
        f"{found.outcome}: {fails} of {found.judged} judged rows fail, {warns} warn{lost} "
        f"({found.confidence:.0%} for all intervals together)"
    )


def ranked(deltas: Sequence[Delta]) -> list[Delta]:
    """Order rows by alarm, then by their loss in units of the tolerance."""
    return sorted(deltas, key=lambda d: (_RANK[d.alarm], d.advantage / (d.tolerance or 1e9)))


def shown(found: Comparison) -> list[Delta]:
    """Rows for a short table: all alarms, then judged rows of whole pictures."""
    alarms = [d for d in ranked(found.deltas) if d.alarm]
    several = any(d.case == ALL_CASES for d in found.deltas)
    whole = [
        d
        for d in found.deltas
        if not d.alarm and d.region == "all" and d.tolerance and (d.case == ALL_CASES or not several)
    ]
    return [*alarms[:_MOST_ROWS], *whole[: max(0, _MOST_ROWS - len(alarms))]]


def cells(delta: Delta) -> list[str]:
    """Cells of a row under :data:`COLUMNS`; the change is an advantage, below 0 it is worse."""
    number, unit = _signed(delta.advantage, delta.unit), delta.unit
    interval = (
        "one sample" if delta.low is None else f"{_signed(delta.low, unit)} to {_signed(delta.high, unit)}"
    )
    verdict = f"{delta.verdict}: {delta.why}" if delta.why else delta.verdict
    mark = {"fail": "FAIL ", "warn": "warn ", "": ""}[delta.alarm]
    return [
        *(mark + verdict, delta.case, delta.method, delta.region, short_name(delta.metric)),
        *(f"{number} {unit}", interval, words.score(delta.before, unit), words.score(delta.after, unit)),
    ]


def _signed(value: float | None, unit: str) -> str:
    text = words.score(value, unit)
    return text if value is None or text.startswith("−") else f"+{text}"


def as_text(found: Comparison) -> str:
    """Text for a terminal: what is missing, smallest detectable losses, outcome, alarms, notes."""
    # Scores before and after would make the lines too long.
    rows = [cells(delta)[:-2] for delta in shown(found)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
    return "\n".join(
        [
            f"{found.after} against {found.before}",
            *_some("missing", found.missing),
            "Smallest loss that fails with 90 % probability:",
            *(f"  {line}" for line in detectable_lines(found) or ["none: nothing has an interval"]),
            headline(found),
            *lines,
            *further_lines(found),
        ]
    )


def further_lines(found: Comparison) -> list[str]:
    """Say what differs."""
    settings = [f"{each.case}: {each.key} was {each.before} and is {each.after}" for each in found.settings]
    return [*_some("differs", settings), *_some("note", found.notes)]


def _some(word: str, said: Sequence[str]) -> list[str]:
    more = len(said) - _MOST_NOTES
    lines = [f"{word}: {line}" for line in said[:_MOST_NOTES]]
    return [*lines, f"{word}: {more} more, on the page"] if more > 0 else lines


def as_markdown(found: Comparison) -> str:
    """Text of a comment in a pull request: headline, alarms and whole pictures, the rest folded."""
    rest = [d for d in ranked(found.deltas) if d.tolerance is not None]
    return "\n".join(
        [
            f"### {found.after} against {found.before}: {found.outcome}",
            "",
            headline(found),
            "",
            *(f"- {line}" for line in _some("missing", found.missing)),
            "",
            "Smallest loss that fails with 90 % probability:",
            "",
            *(f"- {line}" for line in detectable_lines(found) or ["none: nothing has an interval"]),
            "",
            *words.markdown_table(COLUMNS, [cells(d) for d in shown(found)]),
            "",
            *(f"- {line}" for line in further_lines(found)),
            "",
            f"<details><summary>All {len(rest)} judged rows</summary>",
            "",
            *words.markdown_table(COLUMNS, [cells(d) for d in rest]),
            "",
            "</details>",
            "",
        ]
    )


def as_junit(found: Comparison) -> str:
    """JUnit XML: a suite a scene, a case a row; warnings are standard output, what is missing an error."""
    root = ElementTree.Element("testsuites", name=f"{found.after} against {found.before}")
    judged = [d for d in found.deltas if d.tolerance is not None]
    for case in dict.fromkeys(d.case for d in judged):
        rows = [d for d in judged if d.case == case]
        fails = sum(d.alarm == "fail" for d in rows)
        suite = _element(root, "testsuite", name=case, tests=len(rows), failures=fails, errors=0)
        for delta in rows:
            name = f"{delta.method}, {delta.region}, {delta.metric}"
            row = _element(suite, "testcase", classname=f"{case}.{delta.method}", name=name)
            said = ", ".join([cells(delta)[0], *cells(delta)[5:]])
            if delta.alarm == "fail":
                _element(row, "failure", message=said)
            elif delta.low is None:
                _element(row, "skipped", message=said)
            else:
                _element(row, "system-out").text = said
    if found.missing or not judged:
        lost = found.missing or ["nothing was compared"]
        suite = _element(root, "testsuite", name="missing", tests=len(lost), failures=0, errors=len(lost))
        for line in lost:
            _element(_element(suite, "testcase", classname="missing", name=line), "error", message=line)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _element(parent: ElementTree.Element, tag: str, **attributes: object) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, {key: str(value) for key, value in attributes.items()})
