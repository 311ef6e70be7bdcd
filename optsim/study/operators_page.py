"""The page of a comparison of operators: what knowing less costs, and what the frames themselves win back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from optsim.report import plots
from optsim.report.page import Section, listed, table, write_page
from optsim.report.page import plots as side_by_side
from optsim.study.crops import SAID, cropped
from optsim.study.folder import PAGE
from optsim.study.operators import DIFFERENCES, OPERATORS
from optsim.study.words import REGIONS, assumptions, level, signed, work_done

HEADS = ("", *REGIONS.values())
FOUND = (
    "method",
    "seed",
    "shift y, x, CCD px",
    "rotation, mrad",
    "residual",
    "fell by",
    "verdict",
)
SHORT = (0, 1, 2, 3, 6)
"""Columns of :data:`FOUND` that a terminal has room for."""
Rows = Sequence[dict[str, Any]]


def lines_of(rows: Rows, method: str) -> list[tuple[str, ...]]:
    """Return the lines of a method's table, operators first, then differences: see :data:`HEADS`."""
    at = {(row["what"], row["region"]): row for row in rows if row["method"] == method}
    lines: list[tuple[str, ...]] = []
    for name in (*OPERATORS, *DIFFERENCES):
        cells = [at.get((name, region)) for region in REGIONS]
        said = f"{name} ({' − '.join(DIFFERENCES[name])})" if name in DIFFERENCES else name
        lines.append((said, *(_cell(row) for row in cells)))
    return lines


def _cell(row: dict[str, Any] | None) -> str:
    if row is None:
        return "–"
    if row["what"] in DIFFERENCES:
        return signed(row["db"], row["db_half"]) + (" (not told from noise)" if row["below_noise"] else "")
    return level(row["db"], row["db_half"])


def found_lines(record: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return what was found blind, and in brackets what had moved: see :data:`FOUND`."""
    lines: list[tuple[str, ...]] = []
    for row in record["registrations"]:

        def both(key: str, unit: float, digits: int, of: dict[str, Any] = row) -> str:
            return f"{of[key] / unit:+.{digits}f} ({of[f'true_{key}'] / unit:+.{digits}f})".replace("-", "−")

        lines.append(
            (
                row["method"],
                str(row["seed"]),
                f"{both('shift_y_px', 1, 2)}, {both('shift_x_px', 1, 2)}",
                both("rotation_rad", 1e-3, 2),
                f"{row['before']:.3f} to {row['after']:.3f}",
                f"{row['sigmas']:.1f} standard errors" if row["before"] else "–",
                row["why"] or "moved back",
            )
        )
    return lines


def lead(record: dict[str, Any]) -> str:
    """Say the three differences of the first method in a sentence."""
    rows = [row for row in record["rows"] if row["region"] == "all"]
    if not rows:
        return "No seed could be measured: see what was put aside."
    method = rows[0]["method"]
    found = {row["what"]: row for row in rows if row["method"] == method}
    said = ", ".join(
        f"{name} {signed(found[name]['db'], found[name]['db_half'])} dB"
        for name in DIFFERENCES
        if name in found
    )
    return f"{method}, everywhere: {said}."


def write_operators_page(folder: Path, record: dict[str, Any]) -> None:
    """Write the page and its pictures from the record of a comparison."""
    rows: Rows = record["rows"]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    pictures = [found for task in record["results"] if (found := cropped(folder, task)) is not None]
    sections = [
        Section(
            "What the decoder knows",
            ["Of every method the same frames are decoded. Only the operator differs."],
            [listed([f"{name}: {what}." for name, what in OPERATORS.items()])],
        ),
        *(Section(method, (), [_chart(rows, method), _table(rows, method)]) for method in methods),
        Section(
            "What the frames told themselves",
            [
                "Found by the blind registration, and in brackets what had moved since the calibration. It "
                "searches every other frame. It is believed where the residual of the frames between falls "
                "by more than three of its standard errors. Else the frames stay as they are."
            ],
            [table(FOUND, found_lines(record))],
        ),
        *([Section("How it looks", [SAID], pictures)] if pictures else []),
        Section(
            "What the numbers rest on",
            (),
            [
                listed(
                    [
                        *assumptions(record),
                        "Scored are the pixels that all operators and methods hold valid.",
                        "Codes were chosen by what the calibration knows: an adaptive method codes worse "
                        "after a drift, and no operator repairs that afterwards.",
                    ]
                ),
                work_done(record),
            ],
        ),
    ]
    title = f"{record['experiment']['name']}: what the decoder knows"
    write_page(folder / PAGE, kind="optsim operators", title=title, lead=lead(record), sections=sections)


def _chart(rows: Rows, method: str) -> Markup:
    drawn: list[tuple[str, Markup]] = []
    for region, where in REGIONS.items():
        at = {row["what"]: row for row in rows if (row["method"], row["region"]) == (method, region)}
        bars = [(name, max(at[name]["db"], 0.0), f"{_cell(at[name])} dB") for name in OPERATORS if name in at]
        if bars:
            drawn.append(
                (f"{method}, {where}", plots.bar_plot(bars, title=f"PU21-PSNR of {method}, {where}"))
            )
    return side_by_side(drawn)


def _table(rows: Rows, method: str) -> Markup:
    return table(HEADS, lines_of(rows, method), f"{method}: PU21-PSNR, dB")
