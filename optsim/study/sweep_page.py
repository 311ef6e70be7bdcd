"""The page of a sweep: curves with their bands, crops at marked values, and what the figures rest on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from optsim.report import plots
from optsim.report.page import Section, folded, listed, table, write_page
from optsim.report.page import plots as side_by_side
from optsim.study.crops import SAID, cropped
from optsim.study.folder import PAGE
from optsim.study.sweep import labels
from optsim.study.words import REGIONS, assumptions, level, shown, signed, work_done

MODES = {
    "known": "calibrated with the change",
    "unknown": "drifted after the calibration",
    "compensated": "drifted, then shift and rotation put back from one frame pair",
}
_STYLES = {"known": "s0", "unknown": "s1", "compensated": "s2"}
Rows = Sequence[dict[str, Any]]


def write_sweep_page(folder: Path, record: dict[str, Any]) -> None:
    """Write the page and its pictures from the record of a sweep."""
    names = labels(record["plan"])
    rows = [row for row in record["rows"] if not row.get("refused")]
    refused = [row for row in record["rows"] if row.get("refused")]
    methods = list(dict.fromkeys(row["method"] for row in rows))
    in_words = any(not isinstance(row[names[0]], int | float) for row in rows)
    if in_words:
        drawn = [_words(rows, names, method) for method in methods]
    else:
        drawn = [_curves(rows, names[0], method) for method in methods] if len(names) == 1 else []
    if len(names) == 1 and not in_words:
        _write_files(folder, rows, names[0], methods)
    sections = [
        Section(
            "What it costs",
            [
                *(f"{mode.capitalize()}: {MODES[mode]}." for mode in record["plan"]["modes"]),
                "Bands are 95 % intervals over paired seeds, with the scatter of the whole curve.",
            ],
            drawn if drawn else [_grids(rows, names, methods)],
        ),
        *_crops(folder, record, names[0]),
        Section("All values", (), [folded("Table", _table(rows, names))]),
    ]
    if refused:
        said = [f"{_where(row, names)}, {row['mode']}: {row['refused']}" for row in refused]
        sections.append(Section("Refused", ["These points cannot be built or calibrated."], [listed(said)]))
    sections.append(Section("What the numbers rest on", (), [listed(assumptions(record)), work_done(record)]))
    title = f"{record['experiment']['name']}: {' and '.join(names)}"
    write_page(folder / PAGE, kind="optsim sweep", title=title, lead=lead(record), sections=sections)


def lead(record: dict[str, Any]) -> str:
    """Say the largest loss of each curve in a sentence."""
    names = labels(record["plan"])
    said: list[str] = []
    for mode in record["plan"]["modes"]:
        rows = [row for row in record["rows"] if (row["mode"], row.get("region")) == (mode, "all")]
        worst = min(rows, key=lambda row: row["change_db"], default=None)
        if worst is not None and worst["change_db"] >= 0:
            said.append(f"{mode} no loss")
        elif worst is not None:
            change = signed(worst["change_db"], worst["change_half"])
            said.append(f"{mode} {change} ({worst['method']} at {_where(worst, names)})")
    return f"Largest change of PU21-PSNR: {'; '.join(said)}." if said else "No point could be measured."


def _where(row: dict[str, Any], names: Sequence[str]) -> str:
    return ", ".join(f"{name} = {shown(row[name])}" for name in names)


def _lines(rows: Rows, name: str, method: str, region: str) -> tuple[list[plots.Line], list[plots.Spread]]:
    lines: list[plots.Line] = []
    spreads: list[plots.Spread] = []
    for mode, style in _STYLES.items():
        here = [r for r in rows if (r["mode"], r["method"], r["region"]) == (mode, method, region)]
        here = sorted((r for r in here if isinstance(r[name], int | float)), key=lambda r: r[name])
        if not here:
            continue
        lines.append((mode, style, [r[name] for r in here], [r["change_db"] for r in here]))
        spreads.append(
            [
                None
                if r["change_half"] is None
                else (r["change_db"] - r["change_half"], r["change_db"] + r["change_half"])
                for r in here
            ]
        )
    return lines, spreads


def _curves(rows: Rows, name: str, method: str) -> Markup:
    drawn: list[tuple[str, Markup]] = []
    for region, where in REGIONS.items():
        lines, spreads = _lines(rows, name, method, region)
        plot = plots.line_plot(
            lines,
            title=f"Change of PU21-PSNR of {method}, {where}, against {name}",
            x_label=name,
            y_label="change, dB",
            spreads=spreads,
            whole_x=False,
        )
        drawn.append((f"{method}, {where}", plot))
    return side_by_side(drawn)


def _words(rows: Rows, names: Sequence[str], method: str) -> Markup:
    """Draw bars and a table for values that are words: operators, for example."""
    here = [row for row in rows if row["method"] == method]
    bars: list[tuple[str, float, str]] = []
    lines: dict[str, dict[str, str]] = {}
    for row in here:
        where = f"{', '.join(shown(row[name]) for name in names)}, {row['mode']}"
        scored = level(row["db"], row["db_half"])
        lines.setdefault(where, {})[row["region"]] = (
            f"{scored} ({signed(row['change_db'], row['change_half'])})"
        )
        if row["region"] == "all":
            bars.append((where, max(row["db"], 0.0), f"{scored} dB"))
    cells = [[where, *(found.get(region, "–") for region in REGIONS)] for where, found in lines.items()]
    caption = f"{method}: PU21-PSNR in dB, and in brackets the change against the unchanged experiment"
    plot = plots.bar_plot(bars, title=f"PU21-PSNR of {method}, everywhere")
    return side_by_side([(f"{method}, everywhere", plot)]) + table(
        (" and ".join(names), *REGIONS.values()), cells, caption
    )


def _write_files(folder: Path, rows: Rows, name: str, methods: Sequence[str]) -> None:
    for method in methods:
        lines, spreads = _lines(rows, name, method, "all")
        for suffix in ("svg", "png"):
            plots.write_line_plot(
                folder / f"curves-{method}.{suffix}",
                lines,
                x_label=name,
                y_label=f"{method}: change, dB",
                spreads=spreads,
            )


def _grids(rows: Rows, names: Sequence[str], methods: Sequence[str]) -> Markup:
    """Draw a table of changes a mode and method for a pair of parameters."""
    found = Markup("")
    for mode in dict.fromkeys(row["mode"] for row in rows):
        for method in methods:
            here = [r for r in rows if (r["mode"], r["method"], r["region"]) == (mode, method, "all")]
            across = list(dict.fromkeys(r[names[0]] for r in here))
            down = list(dict.fromkeys(r[names[1]] for r in here))
            at = {(r[names[0]], r[names[1]]): signed(r["change_db"], r["change_half"]) for r in here}
            heads = [f"{names[1]} \\ {names[0]}", *map(shown, across)]
            cells = [[shown(y), *(at.get((x, y), "–") for x in across)] for y in down]
            found += table(heads, cells, f"{method}, {mode}: change of PU21-PSNR everywhere, dB")
    return found


def _table(rows: Rows, names: Sequence[str]) -> Markup:
    heads = [
        *names,
        "mode",
        "method",
        "region",
        "dB",
        "change",
        "seeds",
        "map residual, px",
        "told from noise",
    ]
    cells = [
        [
            *(shown(row[name]) for name in names),
            row["mode"],
            row["method"],
            row["region"],
            f"{row['db']:.2f}",
            signed(row["change_db"], row["change_half"]),
            row["seeds"],
            f"{row['map_residual_px']:.4f}",
            "no" if row["below_noise"] else "yes",
        ]
        for row in rows
    ]
    return table(heads, cells)


def _crops(folder: Path, record: dict[str, Any], name: str) -> list[Section]:
    """Show reconstructions at the marked values, in the window where the modes differ most."""
    parts: list[Markup] = []
    for task, result in record["results"].items():
        shown_here = cropped(folder, task)
        if shown_here is not None:
            parts += [Markup("<h3>{} = {}</h3>").format(name, shown(result["values"][0])), shown_here]
    return [Section("How it looks", [SAID], parts)] if parts else []
