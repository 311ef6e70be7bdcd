"""What the cameras of a yield share: causes of failures, what halved limits win, and compensators' travel."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from optsim.core.quantities import Doubles
from optsim.metrics.student import CONFIDENCE, quantile
from optsim.study.parameters import ALL

HALVED = "db, half of "
"""Column of a camera's score with one parameter's change halved, before its name."""
SET_TO = "set "
"""Column of what a compensator was set to, before its key."""


def shared_by_failures(
    rows: Sequence[dict[str, Any]], limits: dict[str, tuple[float, float]]
) -> list[dict[str, Any]]:
    """Say of each parameter which way it makes cameras worse, the one that explains most first.

    ``failures`` and ``good`` are mean changes, with their sign, over the sheet's larger limit; correlations
    are of the change, or of its size, with the score. ``worse_at`` follows the stronger of the two.
    """
    names = [name for name, ends in limits.items() if max(ends) > 0]
    found: list[dict[str, Any]] = []
    for name in names:
        limit = ALL[name].shown(max(limits[name]))
        sides = {good: [r[name] / limit for r in rows if r["good"] == good] for good in (True, False)}
        scored = [(r[name], r["db"]) for r in rows if r["db"] is not None]
        signed, size = _correlation(scored), _correlation([(abs(change), db) for change, db in scored])
        strongest = max(abs(signed), abs(size))
        # Chance: one in twenty sheets of parameters that do nothing names any.
        if strongest < _chance(len(scored), 2 * len(names)):
            worse_at = ""
        elif abs(signed) == strongest:
            worse_at = "+" if signed < 0 else "−"
        else:
            worse_at = "both ends" if size < 0 else "the middle"
        found.append(
            {
                "parameter": name,
                "worse_at": worse_at,
                "failures": float(np.mean(sides[False])) if sides[False] else None,
                "good": float(np.mean(sides[True])) if sides[True] else None,
                "correlation": signed,
                "size_correlation": size,
            }
        )
    return sorted(found, key=lambda each: -max(abs(each["correlation"]), abs(each["size_correlation"])))


def _chance(cameras: int, trials: int) -> float:
    """Correlation that one of so many trials exceeds by chance in one of twenty cases (Bonferroni)."""
    if cameras < 3:
        return math.inf
    t = quantile(cameras - 2, 1 - (1 - CONFIDENCE) / 2 / trials)
    return t / math.sqrt(cameras - 2 + t * t)


def _correlation(pairs: Sequence[tuple[float, float]]) -> float:
    """Correlation of pairs; 0 where it has no meaning."""
    table = np.array(pairs, np.float64)
    if len(table) < 3 or not table.std(axis=0).all():
        return 0.0
    matrix: Doubles = np.asarray(np.corrcoef(table.T))
    return float(matrix[0, 1])


def won_by_halving(rows: Sequence[dict[str, Any]], target_db: float | None) -> list[dict[str, Any]]:
    """Say of each parameter how many more cameras are good if its limits are half as wide, most first."""
    columns = [column for column in (rows[0] if rows else ()) if column.startswith(HALVED)]
    found: list[dict[str, Any]] = []
    for column in columns if target_db is not None else ():
        good = [row[column] is not None and row[column] >= target_db for row in rows]
        gained = sum(now and not row["good"] for now, row in zip(good, rows, strict=True))
        lost = sum(row["good"] and not now for now, row in zip(good, rows, strict=True))
        # A. Agresti and Y. Min, Statistics in Medicine 24, 729, 2005, for matched pairs: half a camera
        # is added to each of four counts.
        n, more, less = len(rows) + 2, gained + 0.5, lost + 0.5
        middle, half = (more - less) / n, 1.96 * math.sqrt(more + less - (more - less) ** 2 / n) / n
        found.append(
            {
                "parameter": column.removeprefix(HALVED),
                "good": sum(good),
                "gained": gained,
                "lost": lost,
                "more_yield": (gained - lost) / len(rows),
                "interval": (middle - half, middle + half),
            }
        )
    return sorted(found, key=lambda each: each["lost"] - each["gained"])


def travel_of(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Middle 95 % of the settings of each relay key that a compensator sets, their median and largest."""
    columns = dict.fromkeys(name for row in rows for name in row if name.startswith(f"{SET_TO}relay."))
    found: list[dict[str, Any]] = []
    for column in columns:
        moves: list[float] = [row[column] for row in rows if row.get(column) is not None]
        low, middle, high = (float(np.percentile(moves, share)) for share in (2.5, 50, 97.5))
        key = column.removeprefix(SET_TO)
        ends = {"low": low, "median": middle, "high": high, "largest": max(map(abs, moves))}
        found.append({"key": key, **ends, "cameras": len(moves)})
    return found
