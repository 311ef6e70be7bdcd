"""The rows of a tolerance sheet: their order, the limits in them, and the loss of all at once."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from optsim.metrics.student import half_width
from optsim.study.search import COSTS


def limits_of(rows: Sequence[dict[str, Any]], key: str = "change") -> dict[str, tuple[float, float]]:
    """Return the largest changes downwards and upwards by parameter, of drifts, in the keys' units."""
    found: dict[str, dict[int, float]] = {}
    for row in rows:
        if row["mode"] == "unknown":
            found.setdefault(row["parameter"], {})[row["sign"]] = row[key]
    return {name: (ends.get(-1, 0.0), ends.get(1, 0.0)) for name, ends in found.items()}


def sorted_rows(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Sort by mode, then the worst offenders first: least room over a bad specimen's change."""
    ends: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        ends.setdefault((row["mode"], row["parameter"]), []).append(row)
    parameters = sorted(ends, key=lambda key: (key[0] == "known", room_of(least_room(ends[key])), key[1]))
    return [row for key in parameters for row in ends[key]]


def least_room(ends: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the end of a parameter that fails first: an end that never costs the loss does not."""
    return min(ends, key=room_of)


def room_of(row: dict[str, Any]) -> tuple[bool, float]:
    """Sort by this: ends that cost the loss come before those that do not."""
    return row["status"] not in COSTS, row["room"]


def allocate(rows: Sequence[dict[str, Any]], loss_db: float) -> float:
    """Set ``together`` in rows of drifts: changes within the limits that lose so much by root sum of squares.

    Every end gets the share that is returned, but none more than it costs at its limit.
    """
    drifts = [row for row in rows if row["mode"] == "unknown"]
    low, share = 0.0, loss_db
    if rss_db(drifts) > loss_db:
        for _ in range(60):
            middle = (low + share) / 2
            under = rss_db([{**row, "loss_db": min(row["loss_db"], middle)} for row in drifts]) < loss_db
            low, share = (middle, share) if under else (low, middle)
    for row in drifts:
        # Of the loss by its slope at the limit, or else the square.
        power = row["db_per_unit"] * row["value"] / row["loss_db"] if row["db_per_unit"] else 2.0
        row["together"] = row["change"] * min(1.0, share / max(row["loss_db"], share)) ** (1 / power)
    return share


def rss_db(rows: Sequence[dict[str, Any]]) -> float:
    """Loss of all drifts at their limits by root sum of squares, as OpticStudio's: both ends are averaged."""
    ends: dict[str, list[float]] = {}
    for row in rows:
        if row["mode"] == "unknown":
            ends.setdefault(row["parameter"], []).append(max(row["loss_db"], 0.0))
    return math.sqrt(sum(float(np.mean(np.square(losses))) for losses in ends.values()))


def of_drawn(results: dict[str, Any], name: str, loss_db: float) -> dict[str, Any]:
    """Return the losses of cameras drawn within limits, by the name of their tasks."""
    drawn = [r for task, r in results.items() if task.startswith(f"{name}/")]
    losses = sorted(r["loss_db"] for r in drawn if r["loss_db"] is not None)
    return {
        "draws": len(losses),
        "refused": sum(1 for r in drawn if r["refused"]),
        "mean_db": float(np.mean(losses)) if losses else None,
        "mean_half": half_width(losses),
        "p90_db": float(np.percentile(losses, 90)) if losses else None,
        "worst_db": losses[-1] if losses else None,
        "within_loss": sum(loss <= loss_db for loss in losses),
        "losses_db": losses,
    }
