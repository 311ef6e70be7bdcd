"""The tolerance sheet as a page, and as the text of a drawing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from optsim.report import plots
from optsim.report.page import Section, folded, listed, table, write_page
from optsim.report.page import plots as side_by_side
from optsim.study.folder import PAGE
from optsim.study.parameters import ALL, Tolerated
from optsim.study.search import COSTS
from optsim.study.tolerance_rows import least_room
from optsim.study.words import assumptions, level, shown, signed, work_done

HEADS = ("parameter", "down", "up", "together", "unit", "costs first", "dB a unit", "room")
MODES = {
    "unknown": "Drift after the calibration",
    "known": "Built so, then calibrated",
}
_STATUS = {"not reached": "≥ ", "refused beyond": "≥ "}
Rows = Sequence[dict[str, Any]]


def sheet(rows: Rows, mode: str) -> list[tuple[str, ...]]:
    """Return the lines of the sheet, the worst offender first: cells as :data:`HEADS` names them."""
    lines: list[tuple[str, ...]] = []
    for name in dict.fromkeys(row["parameter"] for row in rows if row["mode"] == mode):
        ends = {row["sign"]: row for row in rows if (row["parameter"], row["mode"]) == (name, mode)}
        least = least_room(list(ends.values()))
        slopes = [row["db_per_unit"] for row in ends.values() if row["db_per_unit"] is not None]
        lines.append(
            (
                name,
                _end(ends.get(-1), "−"),
                _end(ends.get(1), "+"),
                _within(ALL[name], ends),
                ALL[name].unit,
                f"{least['method']}, {least['region']}" if least["status"] in COSTS else "–",
                f"{max(slopes):.3g}" if slopes else "–",
                f"{_STATUS.get(least['status'], '')}{least['room']:.2f}",
            )
        )
    return lines


def notes(rows: Rows) -> list[str]:
    """Say what the marks of a sheet mean, those that occur."""
    said = {row["status"] for row in rows}
    found: list[str] = []
    if "not reached" in said:
        found.append("≥: the largest change tried; it costs less than the loss.")
    if "refused beyond" in said:
        found.append("≥ may also mean that more cannot be built, such as an image that leaves the CCD.")
    if "step" in said:
        found.append("step: the loss jumps between the two changes; each stands with its measured loss.")
    if "not converged" in said:
        found.append("between: the search ended between the two changes; each stands with its measured loss.")
    if any(row["value_least"] is not None for row in rows):
        found.append("In brackets: where the loss's own 95 % interval reaches the loss asked for; ?: never.")
    if any(row["capped"] for row in rows):
        found.append(
            "*: the cap on seeds came before the precision asked for. Fewer than four have no interval."
        )
    found.append(
        "Room is the smaller end over a bad specimen's change, the pessimistic camera of 'optsim list "
        "effects'. Below 1 a bad specimen fails. The worst offender stands first."
    )
    return found


def lead(record: dict[str, Any]) -> str:
    """Say in a sentence which parameter is the worst offender, and what all cost together."""
    lines = sheet(record["rows"], "unknown")
    if not lines:
        return "No drift could be measured."
    name, down, up, _, unit, costs, *_ = lines[0]
    loss = f"A loss of {record['plan']['loss_db']:g} dB"
    if costs == "–":
        said = f"{loss} is reached by no drift alone"
    else:
        ends = " and ".join(end.removesuffix(" *") for end in (down, up) if end != "–")
        said = f"{loss} is reached first by a drift of {name}: {ends} {unit}"
    together = record["budget"]
    if together["mean_db"] is not None:
        said += (
            f". All drifts at once cost {together['rss_db']:.2f} dB by root sum of squares and "
            f"{together['mean_db']:.2f} dB on average in {together['draws']} drawn cameras"
        )
    return f"{said}."


def write_tolerance_page(folder: Path, record: dict[str, Any]) -> None:
    """Write the page from the record of a tolerance sheet."""
    rows: Rows = record["rows"]
    sections: list[Section] = []
    for mode, title in MODES.items():
        lines = sheet(rows, mode)
        if lines:
            loss = f"Largest change that costs at most {record['plan']['loss_db']:g} dB, alone."
            sections.append(Section(title, [loss], [table(HEADS, lines), listed(notes(rows))]))
    if record["compensators"]:
        sections.append(
            Section(
                "What an operator wins back",
                [
                    "Change of the score that costs first, at the drift of the sheet, before and after each "
                    "compensator alone. The bench is a new calibration."
                ],
                [table(*won_back(record["compensators"]), "Change of PU21-PSNR, dB")],
            )
        )
    sections.append(_budget(record))
    if record["interactions"]:
        sections.append(
            Section(
                "Pairs of the worst",
                ["Loss of two drifts together less the sum of both alone, dB. Positive: worse than the sum."],
                [_pairs(record["interactions"])],
            )
        )
    if record["refusals"]:
        said = dict.fromkeys(f"{each['parameter']}: {each['message']}" for each in record["refusals"])
        sections.append(Section("Refused", (), [folded("Changes", listed(list(said)))]))
    names = record["plan"]["names"]
    about = [f"{each.name}: {each.about}." for each in ALL.values() if each.about and each.name in names]
    rests = Section(
        "What the numbers rest on", (), [listed([*assumptions(record), *about]), work_done(record)]
    )
    title = f"{record['experiment']['name']}: tolerances for {record['plan']['loss_db']:g} dB"
    write_page(
        folder / PAGE, kind="optsim tolerance", title=title, lead=lead(record), sections=[*sections, rests]
    )


def _end(row: dict[str, Any] | None, sign: str) -> str:
    if row is None:
        return "–"
    value, capped = f"{sign}{row['value']:.3g}", " *" if row["capped"] else ""
    if row["above"] is not None:
        word = "step" if row["status"] == "step" else "between"
        above = f"{sign}{row['above']:.3g} ({row['above_db']:.2f} dB)"
        below = f"{value} ({row['loss_db']:.2f} dB)".replace("-", "−")
        return f"{word} {below} and {above}{capped}"
    ends = ""
    if row["value_least"] is not None:
        most = "?" if row["value_most"] is None else f"{row['value_most']:.3g}"
        ends = f" ({row['value_least']:.3g} to {most})"
    return f"{_STATUS.get(row['status'], '')}{value}{ends}{capped}"


def _within(parameter: Tolerated, ends: dict[int, dict[str, Any]]) -> str:
    """Write the limits that hold together; only those of drifts are known."""
    limits = [sign * parameter.shown(row["together"]) for sign, row in ends.items() if "together" in row]
    return " to ".join(f"{limit:+.3g}".replace("-", "−") for limit in sorted(limits)) or "–"


def won_back(compensators: Rows) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return heads and lines of what each compensator wins back: changes of the score, dB."""
    names = list(dict.fromkeys(row["compensator"] for row in compensators))
    lines: list[tuple[str, ...]] = []
    for parameter, change in dict.fromkeys((row["parameter"], row["change"]) for row in compensators):
        here = [r for r in compensators if (r["parameter"], r["change"]) == (parameter, change)]
        after = {
            r["compensator"]: "refused" if r["refused"] else signed(r["after_db"], r["after_half"])
            for r in here
        }
        drift = f"{change:+.3g} {here[0]['unit']}".replace("-", "−")
        before = signed(here[0]["before_db"], here[0]["before_half"])
        lines.append((parameter, drift, before, *(after.get(name, "–") for name in names)))
    return ("parameter", "drift", "before", *names), lines


def _pairs(interactions: Rows) -> Markup:
    names = list(dict.fromkeys(name for pair in interactions for name in pair["names"]))
    at = {
        frozenset(pair["names"]): signed(pair["interaction_db"], pair["half"])
        for pair in interactions
        if "interaction_db" in pair
    }
    lines = [[one, *(at.get(frozenset((one, two)), "") for two in names)] for one in names]
    return table(("", *names), lines)


def _budget(record: dict[str, Any]) -> Section:
    together, loss = record["budget"], record["plan"]["loss_db"]
    rows: list[tuple[str, float, str]] = [
        ("root sum of squares", together["rss_db"], f"{together['rss_db']:.2f} dB")
    ]
    for name, key in (("drawn, mean", "mean_db"), ("drawn, 90 %", "p90_db"), ("drawn, worst", "worst_db")):
        if together[key] is not None:
            rows.append((name, max(together[key], 0.0), f"{together[key]:.2f} dB"))
    text = [
        "Every drift somewhere within its tolerance, evenly drawn: root sum of squares leaves out how drifts "
        "add to each other, drawn cameras have it but give no single tolerance."
    ]
    if together["draws"]:
        text.append(
            f"{together['within_loss']} of {together['draws']} drawn cameras lose at most {shown(loss)} dB."
        )
    within = record["allocation"]
    held = (
        f"The column 'together' gives each drift {within['share_db']:.2f} dB, {shown(loss)} dB by that sum."
    )
    measured = "No camera was drawn within them: their loss is not measured."
    if within["mean_db"] is not None:
        mean = level(within["mean_db"], within["mean_half"])
        measured = f"{within['draws']} cameras drawn within them lose {mean} dB on average."
        if within["mean_half"] is not None and abs(within["mean_db"] - loss) > within["mean_half"]:
            measured += f" That is not {shown(loss)} dB: the sum does not hold for this camera."
    text.append(f"{held} {measured}")
    drawn = plots.bar_plot(rows, title="Loss of all tolerances together")
    return Section("All together", text, [side_by_side([("Loss of all tolerances together", drawn)])])
