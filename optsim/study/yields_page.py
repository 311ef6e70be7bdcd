"""The page of a yield: how many cameras are good, how their scores spread, and what failures share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from optsim.report import plots
from optsim.report.page import Section, folded, listed, table, write_page
from optsim.report.page import plots as side_by_side
from optsim.study.folder import PAGE
from optsim.study.parameters import ALL
from optsim.study.words import REGIONS, assumptions, signed, work_done

SHARED = ("parameter", "worse at", "failures", "good", "correlation with dB", "of its size")
WON = ("limits half as wide", "good", "gained", "lost", "more yield")
TRAVEL = ("set", "from", "median", "to", "farthest", "unit")
_SCREWS = {"m": (1e3, "mm"), "rad": (1e3, "mrad"), "px": (1.0, "CCD px")}
_BINS = 12
_NAMED = 3
Rows = Sequence[dict[str, Any]]


def lead(record: dict[str, Any]) -> str:
    """Say the yield in a sentence."""
    if record["target_db"] is None or not record["cameras"]:
        return f"No camera could be measured.{_not_built(record)}"
    low, high = record["interval"]
    share = record["good"] / record["cameras"]
    plan = record["plan"]
    target = f"{record['target_db']:.2f} dB, PU21-PSNR of {plan['method']}, {REGIONS[plan['region']]}"
    return (
        f"{share:.0%} ({low:.0%} to {high:.0%}) of built cameras reach {target}: "
        f"{record['good']} of {record['cameras']}, calibration {plan['mode']}. "
        f"The unchanged camera has {record['nominal_db']:.2f} dB.{_blamed(record)}{_not_built(record)}"
    )


def _blamed(record: dict[str, Any]) -> str:
    """Say where failures lie, if there are any and that is no chance."""
    worse = [f"{each['worse_at']} {each['parameter']}" for each in record["shared"] if each["worse_at"]]
    if not worse or record["good"] == record["cameras"]:
        return ""
    return f" Failures lie at {', '.join(worse[:_NAMED])}."


def _not_built(record: dict[str, Any]) -> str:
    """Say how many draws could not be built, if any."""
    draws, cameras = record["not_built"]["draws"], record["not_built"]["cameras"]
    left_out = f", in vain for {cameras} cameras, which are left out" if cameras else ""
    return f" {draws} draws could not be built and were drawn again{left_out}." if draws else ""


def shared_lines(record: dict[str, Any]) -> list[tuple[object, ...]]:
    """Return the table of what failures share: see :data:`SHARED`."""
    numbers = ("failures", "good", "correlation", "size_correlation")
    return [
        (each["parameter"], each["worse_at"] or "–", *(signed(each[name]) for name in numbers))
        for each in record["shared"]
    ]


def write_yield_page(folder: Path, record: dict[str, Any]) -> None:
    """Write the page from the record of a yield."""
    rows: Rows = record["rows"]
    scores = [row["db"] for row in rows if row["db"] is not None]
    parts = [_spread(scores)] if scores else []
    sections = [
        Section("How the scores spread", _quantiles(scores), parts),
        Section(
            "What failures share",
            [
                "Mean of each change over its larger limit, with its sign, of failures and of good cameras. "
                "Correlations are of the change and of its size with the score of all cameras that have one. "
                "The stronger says where cameras are worse. A dash may be chance: one in twenty sheets of "
                "parameters that do nothing names any."
            ],
            [table(SHARED, shared_lines(record))],
        ),
        *_remedies(record),
        Section("Sheet", _drawn_how(record["plan"]["sheet"]), [_sheet(record["plan"]["sheet"])]),
        Section(
            "All cameras",
            ["The last column builds a camera again: optsim run with these overrides."],
            [folded("Table", _cameras(rows))],
        ),
    ]
    refused = [f"camera {row['camera']}: {row['refused']}" for row in rows if row["refused"]]
    if refused:
        text = [f"{len(refused)} of {len(rows)} cameras cannot be calibrated or decoded: they are failures."]
        sections.append(Section("Refused", text, [folded("Cameras", listed(refused))]))
    if reasons := record["not_built"]["reasons"]:
        said = listed([f"{count} x {why}" for why, count in reasons.items()])
        text = [f"{_not_built(record).strip()} The yield is of cameras that can be built."]
        sections.append(Section("Not built", text, [folded("Reasons", said)]))
    about = [
        "The interval is that of a share by Agresti and Coull, 95 %.",
        "A camera has one seed of codes and photons, its own.",
        *(f"{name}: {ALL[name].about}." for name in record["plan"]["sheet"]["limits"] if ALL[name].about),
    ]
    # A yield has no pairs of seeds.
    rests = Section(
        "What the numbers rest on",
        (),
        [listed([assumptions(record)[0], assumptions(record)[3], *about]), work_done(record)],
    )
    title = f"{record['experiment']['name']}: yield of {record['cameras']} cameras"
    write_page(
        folder / PAGE, kind="optsim yield", title=title, lead=lead(record), sections=[*sections, rests]
    )


def won_lines(record: dict[str, Any]) -> list[tuple[object, ...]]:
    """Return the table of what halved limits win: see :data:`WON`."""
    lines: list[tuple[object, ...]] = []
    for each in record["won_by_halving"]:
        low, high = each["interval"]
        ends = f"{each['more_yield']:+.0%} ({low:+.0%} to {high:+.0%})"
        lines.append((each["parameter"], each["good"], each["gained"], each["lost"], ends))
    return lines


def travel_lines(record: dict[str, Any]) -> list[tuple[object, ...]]:
    """Return the table of compensators' travel: see :data:`TRAVEL`."""
    lines: list[tuple[object, ...]] = []
    for each in record["travel"]:
        factor, unit = _SCREWS.get(each["key"].rpartition("_")[2], (1.0, ""))
        ends = [f"{factor * each[end]:+.3g}" for end in ("low", "median", "high")]
        lines.append((each["key"], *ends, f"{factor * each['largest']:.3g}", unit))
    return lines


def _remedies(record: dict[str, Any]) -> list[Section]:
    """Say what halved limits win, and how far compensators go, if that was measured."""
    found: list[Section] = []
    if record["won_by_halving"]:
        text = "The same cameras with one parameter's change halved; the interval is of matched pairs, 95 %."
        found.append(Section("What limits half as wide win", [text], [table(WON, won_lines(record))]))
    if record["travel"]:
        text = "Settings of the compensators: the middle 95 % of the cameras, their median, the farthest one."
        found.append(Section("Travel of the compensators", [text], [table(TRAVEL, travel_lines(record))]))
    return found


def _quantiles(scores: Sequence[float]) -> list[str]:
    if not scores:
        return ["No camera could be measured."]
    low, middle, high = np.percentile(scores, (10, 50, 90))
    ends = f"{low:.2f} to {high:.2f} dB"
    return [f"Median {middle:.2f} dB, the middle 80 % at {ends}, the worst {min(scores):.2f} dB."]


def _spread(scores: Sequence[float]) -> Markup:
    counts, edges = np.histogram(scores, bins=min(_BINS, max(1, len(scores) // 2)))
    rows = [
        (f"{low:.2f} to {high:.2f} dB", float(count), f"{count}")
        for count, low, high in zip(counts.tolist(), edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    ]
    return side_by_side([("Cameras by their score", plots.bar_plot(rows, title="Cameras by their score"))])


def _drawn_how(sheet: dict[str, Any]) -> list[str]:
    """Say how cameras are drawn between the limits, and what these are of."""
    said = ["Cameras are drawn between these limits, about their middle."]
    if {"normal", "truncated"} & set(sheet["distributions"].values()):
        said.append("Limits of a normal one are two standard deviations away; a truncated one is cut there.")
    if sheet["mounts"]:
        said.append("Parameters of one mount lie at the same share of their limits.")
    return [*said, f"The limits are of {sheet['of']}."] if sheet["of"] else said


def _sheet(sheet: dict[str, Any]) -> Markup:
    mounts = {name: mount for mount, names in sheet["mounts"].items() for name in names}
    rows = [
        (
            name,
            f"−{ALL[name].shown(ends[0]):.3g}",
            f"+{ALL[name].shown(ends[1]):.3g}",
            ALL[name].unit,
            sheet["distributions"].get(name, "uniform"),
            mounts.get(name, "–"),
        )
        for name, ends in sheet["limits"].items()
    ]
    return table(("parameter", "down", "up", "unit", "drawn", "mount"), rows)


def _cameras(rows: Rows) -> Markup:
    lines = [
        (
            row["camera"],
            "–" if row["db"] is None else f"{row['db']:.2f}",
            "yes" if row["good"] else "no",
            row["set"],
        )
        for row in rows
    ]
    return table(("camera", "dB", "good", "overrides"), lines)
