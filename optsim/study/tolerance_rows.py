"""The rows of a tolerance sheet: their order, the limits in them, and the loss of all at once."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from optsim.study.search import COSTS


def limits_of(rows: Sequence[dict[str, Any]], mode: str = "unknown") -> dict[str, tuple[float, float]]:
    """Return the largest changes downwards and upwards by parameter, of one mode, in the keys' units."""
    found: dict[str, dict[int, float]] = {}
    for row in rows:
        if row["mode"] == mode:
            found.setdefault(row["parameter"], {})[row["sign"]] = row["change"]
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


def budget(rows: Sequence[dict[str, Any]], results: dict[str, Any], loss_db: float) -> dict[str, Any]:
    """Return the loss of all tolerances at once: by root sum of squares, and by Monte Carlo.

    The first is that of OpticStudio: squares of both ends are averaged, and summed over the tolerances.
    """
    ends: dict[str, list[float]] = {}
    for row in rows:
        if row["mode"] == "unknown":
            ends.setdefault(row["parameter"], []).append(max(row["loss_db"], 0.0))
    squares = [float(np.mean(np.square(losses))) for losses in ends.values()]
    drawn = [r for name, r in results.items() if name.startswith("budget/")]
    losses = sorted(r["loss_db"] for r in drawn if r["loss_db"] is not None)
    return {
        "rss_db": math.sqrt(sum(squares)),
        "draws": len(losses),
        "refused": sum(1 for r in drawn if r["refused"]),
        "mean_db": float(np.mean(losses)) if losses else None,
        "p90_db": float(np.percentile(losses, 90)) if losses else None,
        "worst_db": losses[-1] if losses else None,
        "within_loss": sum(loss <= loss_db for loss in losses),
        "losses_db": losses,
    }
