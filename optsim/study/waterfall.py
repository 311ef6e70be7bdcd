"""What each effect costs on the way from an ideal camera to the nominal one, one by one and as fair shares.

The waterfall switches effects on in one order. An effect's step depends on those that are on already, so
its fair share is the mean of its steps over all orders (L. S. Shapley, "A value for n-person games", 1953).
Orders are sampled, each with its reverse. The steps of any order add up to the total, and so do the shares.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from optsim.camera.effects import ALL, ITSELF
from optsim.core.config import flat
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.progress import Progress, silent
from optsim.core.random_streams import stream
from optsim.experiment.experiment import Experiment
from optsim.study.comparison import LIMITS, Seeds, add_work, student
from optsim.study.folder import StudyTask, Workplace, compute, write_result, write_table
from optsim.study.measurement import PointScores, measured
from optsim.study.point import Point, changed_only, shares_truth
from optsim.study.stage import stage_of


@dataclass(frozen=True)
class WaterfallPlan:
    """A waterfall.

    Parameters
    ----------
    names : tuple of str
        Effects, in the order of the waterfall.
    orders : int
        Sampled orders for the shares: the waterfall's own first, its reverse, then drawn ones with theirs.
    frames : int
        Coded frames to score.
    seeds : Seeds
        ``least`` seeds are measured; no more are added.
    """

    names: tuple[str, ...]
    orders: int = 2
    frames: int = 3
    seeds: Seeds = LIMITS


def effects_of(base: Experiment, names: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the effects that a waterfall of an experiment has, of all or of those named.

    Left out are effects that the camera has none of, and those that change the light on the panel: their
    target is another.

    Raises
    ------
    ConfigError
        For an unknown name, one that does not fit, or when none is left.
    """
    for name in names:
        if name not in ALL:
            raise unknown_name("effect", name, ALL)
    fitting = [name for name in ALL if fits(base, name)]
    for name in names:
        if name not in fitting:
            raise ConfigError(
                f"--effects: {name} can be no step: the camera has none of it, it acts before the panel, or "
                f"it is a drift; expected some of {', '.join(fitting)}"
            )
    chosen = tuple(name for name in fitting if not names or name in names)
    if not chosen:
        raise ConfigError("--effects: this camera has no effect that could be switched on")
    return chosen


def fits(base: Experiment, name: str) -> bool:
    """Whether an effect can be a step: there is some of it, and the light on the panel stays."""
    effect = ALL[name]
    if effect.drifts or effect.in_scene or ITSELF in effect.ideal:
        return False
    off = switched_off(base, [name])
    return bool(off) and shares_truth(Point(off))


def switched_off(base: Experiment, names: Sequence[str]) -> tuple[tuple[str, Any], ...]:
    """Return the changes of an experiment that make some of its effects ideal."""
    changes: dict[str, Any] = {}
    for name in names:
        for part, fields in ALL[name].ideal.items():
            changes |= {f"camera.{part}.{key}": value for key, value in flat(fields).items()}
    # Lists as JSON has them, so that they equal those of the experiment.
    return changed_only(base, json.loads(json.dumps(changes)))


def sampled_orders(names: Sequence[str], count: int, seed: int) -> list[tuple[str, ...]]:
    """Return orders of the effects, each drawn one followed by its reverse."""
    rng = stream(seed, "orders")
    found: list[tuple[str, ...]] = [tuple(names)]
    while len(found) < count:
        if len(found) % 2:
            found.append(found[-1][::-1])
        else:
            drawn: list[int] = rng.permutation(len(names)).tolist()
            found.append(tuple(names[place] for place in drawn))
    return found


def waterfall(
    base: Experiment, plan: WaterfallPlan, place: Workplace, progress: Progress = silent
) -> dict[str, Any]:
    """Measure a waterfall into a folder.

    Parameters
    ----------
    base : Experiment
        The nominal experiment.
    plan : WaterfallPlan
        Effects and orders.
    place : Workplace
        Folder and workers; the same folder goes on.
    progress : Progress
        Told of each task.

    Returns
    -------
    dict
        The content of study.json.
    """
    orders = sampled_orders(plan.names, plan.orders, base.seed)
    # A place in an order is the set of effects that are still off there; the same set is measured once.
    sets = {frozenset(order[on:]) for order in orders for on in range(len(order) + 1)}
    n_seeds = plan.seeds.least
    tasks = [
        StudyTask(f"sets/{at:04d}", _measure_set, (plan.frames, n_seeds, sorted(off)))
        for at, off in enumerate(sorted(sets, key=lambda off: (len(off), sorted(off))))
    ]
    said = {**asdict(plan), "orders": [list(order) for order in orders]}
    record = compute("waterfall", base, said, tasks, place, progress)
    levels = {frozenset(result["off"]): result for result in record["results"].values()}
    refused = {result["key"]: result["refused"] for result in levels.values() if result["refused"]}
    rows = steps_of(levels, orders, n_seeds)
    found = {**record, "refused": refused, "measured_orders": len(measured_orders(levels, orders))}
    write_table(place.folder, found, rows)
    return {**found, "rows": rows}


Levels = dict[frozenset[str], Any]
"""Effects that are off -> what was measured."""


def measured_orders(levels: Levels, orders: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the orders all of whose cameras could be measured."""
    return [
        order
        for order in orders
        if all(
            (off := frozenset(order[on:])) in levels and not levels[off]["refused"]
            for on in range(len(order) + 1)
        )
    ]


def steps_of(levels: Levels, orders: Sequence[tuple[str, ...]], n_seeds: int) -> list[dict[str, Any]]:
    """Return the waterfall's steps and the fair shares, a row a method, region and effect."""
    retained = measured_orders(levels, orders)
    if not retained:
        return []
    names, rows = orders[0], list[dict[str, Any]]()
    keys = [(method, region) for method, region, value in levels[frozenset()]["db"][0] if value is not None]
    for key in keys:
        db = {off: _of_key(result["db"], key) for off, result in levels.items() if not result["refused"]}
        if any(None in values for values in db.values()):
            continue
        steps: dict[str, list[list[float]]] = {name: [] for name in names}
        for order in retained:
            places = [db[frozenset(order[on:])] for on in range(len(order) + 1)]
            for name, (before, after) in zip(order, pairwise(places), strict=True):
                steps[name].append([b - a for a, b in zip(before, after, strict=True)])
        ideal, nominal = db[frozenset(names)], db[frozenset()]
        total = student([b - a for a, b in zip(ideal, nominal, strict=True)])
        for at, name in enumerate(names):
            # Over seeds, the mean over orders of each: seeds are independent, orders of one seed are not.
            share = student(
                [sum(each[seed] for each in steps[name]) / len(retained) for seed in range(n_seeds)]
            )
            step = student(steps[name][0]) if retained[0] == orders[0] else None
            over_orders = [sum(each) / n_seeds for each in steps[name]]
            rows.append(
                {
                    "method": key[0],
                    "region": key[1],
                    "effect": name,
                    "place": at,
                    "step_db": step.mean if step else None,
                    "step_half": step.stated_half if step else None,
                    "share_db": share.mean,
                    "share_half": share.stated_half,
                    "least_db": min(over_orders),
                    "most_db": max(over_orders),
                    "orders": len(retained),
                    "seeds": n_seeds,
                    "ideal_db": sum(ideal) / n_seeds,
                    "nominal_db": sum(nominal) / n_seeds,
                    "total_db": total.mean,
                    "total_half": total.stated_half,
                }
            )
    return rows


def _of_key(db: Sequence[Sequence[Sequence[Any]]], key: tuple[str, str]) -> list[Any]:
    """Return a score over the seeds."""
    return [next((value for m, r, value in seed if (m, r) == key), None) for seed in db]


def _measure_set(folder: Path, text: str, frames: int, n_seeds: int, off: Sequence[str]) -> None:
    """Measure the camera with some effects off over the seeds, in a worker."""
    stage = stage_of(text, frames)
    changes = switched_off(stage.base, off)
    work: dict[str, int] = {}
    found: list[PointScores] = []
    for seed in range(n_seeds):
        found.append(measured(stage, Point(changes, seed=stage.base.seed + seed)))
        add_work(work, found[-1].work)
        if found[-1].refused:
            break
    write_result(
        folder,
        work,
        off=list(off),
        key=", ".join(off) or "nothing",
        refused=found[-1].refused,
        db=[[[*key, value] for key, value in each.db.items()] for each in found],
    )


def chart_rows(rows: Sequence[dict[str, Any]], method: str, region: str) -> list[dict[str, Any]]:
    """Rows of one score, in the order of the waterfall."""
    here = [row for row in rows if (row["method"], row["region"]) == (method, region)]
    return sorted(here, key=lambda row: row["place"])
