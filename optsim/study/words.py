"""What all pages of studies say in the same words."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from optsim.report.page import table
from optsim.report.words import seconds

_COUNTS = {
    "points_measured": "points measured now, a seed each",
    "points_found": "points found in the cache",
    "points_refused": "points refused",
    "benches": "benches measured and calibrated",
    "exposures": "exposures computed from the panel on",
    "exposures_of_known_panel_light": "exposures computed from the relay on",
    "truths": "truths and light levels of other lenses or scenes",
    "tasks_done_before": "tasks that were done before",
}


REGIONS = {"all": "everywhere", "moving": "where it moves", "static": "where it is static"}
"""Regions of scores, in words."""


def level(db: float, half: float | None) -> str:
    """Write a score in dB with its interval."""
    return f"{db:.2f}" if half is None else f"{db:.2f} ± {half:.2f}"


def signed(value: float | None, half: float | None = None) -> str:
    """Write a change in dB with its interval."""
    if value is None:
        return "–"
    text = f"{value:+.2f}".replace("-", "−")
    return text if half is None else f"{text} ± {half:.2f}"


def shown(value: object) -> str:
    """Write a parameter's value."""
    return f"{value:.4g}" if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def assumptions(record: dict[str, Any]) -> list[str]:
    """Say what the figures of a study rest on."""
    plan, experiment = record["plan"], record["experiment"]
    seeds = plan["seeds"]
    over, added = f"{seeds['most']} seed{'s' if seeds['most'] > 1 else ''}", ""
    if seeds["least"] < seeds["most"]:
        over = f"{seeds['least']} to {over}"
        added = f" Seeds are added until half of its 95 % interval is {seeds['wanted_db']:g} dB."
    said = [
        f"Scores are PU21-PSNR of {plan['frames']} coded frame{'s' if plan['frames'] > 1 else ''} of the "
        "steady phase, on the pixels that all methods hold valid, against the light on the panel.",
        f"A change is the mean over {over} of codes and photons, each against the unchanged camera at the "
        f"same seed.{added}",
        f"The bench has one seed, {experiment['seed']}: intervals leave its noise out.",
        "The light level is that of the unchanged camera, unless the lens or the scene changes.",
    ]
    if experiment["n_frames"] < 5 + experiment["camera"]["latency_frames"]:
        said.append("The experiment is too short to reach the steady phase.")
    return said


def work_done(record: dict[str, Any]) -> Markup:
    """Tabulate what was computed, and what was not because it was known; with the command and its --set."""
    work = record["work"]
    rows: list[tuple[str, object]] = [
        (words, work[name]) for name, words in _COUNTS.items() if work.get(name)
    ]
    rows.append(("time of this call", seconds(record["seconds"])))
    command = Markup("<p>Command: <code>{}</code></p>").format(
        record["command"] or "none: called from Python"
    )
    return command + table(("work", "count"), rows, "The truth was rendered, or found, once.")
