"""The page of a waterfall: one chart that says what costs what."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from optsim.camera.effects import ALL
from optsim.report import plots
from optsim.report.page import Section, listed, table, write_page
from optsim.report.page import plots as side_by_side
from optsim.study.folder import PAGE
from optsim.study.waterfall import chart_rows
from optsim.study.words import REGIONS, assumptions, signed, work_done

HEADS = ("effect", "step, dB", "share, dB", "least step", "most")
Rows = Sequence[dict[str, Any]]
_FIRST = 3


def lines_of(rows: Rows, method: str, region: str) -> list[tuple[str, ...]]:
    """Return the lines of a table, the most expensive effect first, and the total: see :data:`HEADS`."""
    here = sorted(chart_rows(rows, method, region), key=lambda row: row["share_db"])
    lines = [
        (
            row["effect"],
            signed(row["step_db"], row["step_half"]),
            signed(row["share_db"], row["share_half"]),
            signed(row["least_db"]),
            signed(row["most_db"]),
        )
        for row in here
    ]
    if here:
        total = signed(here[0]["total_db"], here[0]["total_half"])
        lines.append(("all together", total, total, "", ""))
    return lines


def lead(record: dict[str, Any]) -> str:
    """Say what costs most in a sentence."""
    rows = record["rows"]
    if not rows:
        return "No order of the effects could be measured: see what was refused."
    method = rows[0]["method"]
    here = sorted(chart_rows(rows, method, "all"), key=lambda row: row["share_db"])
    resolved = [row for row in here if row["share_half"] is not None and -row["share_db"] > row["share_half"]]
    first = ", ".join(
        f"{row['effect']} {signed(row['share_db'], row['share_half'])}" for row in resolved[:_FIRST]
    )
    most = f"most costs: {first}" if resolved else "these seeds tell no effect's share from 0"
    total = signed(here[0]["total_db"], here[0]["total_half"])
    return f"{len(here)} effects together change {method} by {total} dB everywhere; {most}."


def write_waterfall_page(folder: Path, record: dict[str, Any]) -> None:
    """Write the page from the record of a waterfall."""
    rows: Rows = record["rows"]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    sections = [
        Section(
            method,
            [
                "Bars: fair share of each effect in the change from the camera without them to the "
                "nominal one. They add up to the total."
            ],
            [
                side_by_side(
                    [
                        (f"{method}, {where}", _chart(rows, method, region))
                        for region, where in REGIONS.items()
                        if chart_rows(rows, method, region)
                    ]
                ),
                *(
                    table(HEADS, lines_of(rows, method, region), f"{method}, {where}: change of PU21-PSNR")
                    for region, where in REGIONS.items()
                    if chart_rows(rows, method, region)
                ),
            ],
        )
        for method in methods
    ]
    if record["refused"]:
        said = [f"without {off}: {why}" for off, why in record["refused"].items()]
        sections.append(Section("Refused", ["Orders with these cameras are left out."], [listed(said)]))
    about = [
        f"Step: switched on in the order of the table of effects. Share: mean over "
        f"{record['measured_orders']} "
        "orders, each with its reverse; least and most are its steps in single orders.",
        "Intervals are over seeds. They leave out that the orders are a sample.",
        *(f"{name}: {ALL[name].what}." for name in record["plan"]["names"]),
        "Effects that change the light on the panel are left out: they change the target.",
    ]
    rests = Section(
        "What the numbers rest on", (), [listed([*assumptions(record), *about]), work_done(record)]
    )
    title = f"{record['experiment']['name']}: what each effect costs"
    write_page(
        folder / PAGE, kind="optsim waterfall", title=title, lead=lead(record), sections=[*sections, rests]
    )


def bars_of(rows: Rows, method: str, region: str) -> list[tuple[str, float, str]]:
    """Return the shares of all effects, the most expensive first, as rows of bars."""
    here = sorted(chart_rows(rows, method, region), key=lambda row: row["share_db"])
    return [(row["effect"], row["share_db"], signed(row["share_db"], row["share_half"])) for row in here]


def _chart(rows: Rows, method: str, region: str) -> Markup:
    title = f"Shares of {method}, {REGIONS[region]}, dB"
    return plots.signed_bars(bars_of(rows, method, region), title=title)
