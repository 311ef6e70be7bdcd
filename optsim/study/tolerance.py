"""The tolerance sheet: how much of each misalignment may be, what compensators win, and all together."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from optsim.core.errors import ConfigError, unknown_name
from optsim.core.files import write_text
from optsim.core.progress import Progress, silent
from optsim.core.random_streams import stream
from optsim.experiment.experiment import Experiment
from optsim.metrics.records import REGIONS
from optsim.study.comparison import LIMITS, Compared, Estimate, Seeds, add_work, compare
from optsim.study.compensation import COMPENSATORS
from optsim.study.folder import StudyTask, Workplace, compute, write_result, write_table
from optsim.study.measurement import Key
from optsim.study.parameters import ALL, Tolerated
from optsim.study.point import Mode, Point, changed_only
from optsim.study.search import COSTS, Limit, Loss, largest_change
from optsim.study.stage import Stage, stage_of
from optsim.study.tolerance_rows import allocate, limits_of, of_drawn, rss_db, sorted_rows

ALLOCATION = "allocation.csv"
"""Limits that together lose the loss, for a drawing: operand, min, max, unit."""
_WORST = 5
_ENDS = {-1: "down", 1: "up"}
# Where the bench knows the change, a search goes as far as this, in a bad specimen's changes.
_BAD_SPECIMENS = 3.0


@dataclass(frozen=True)
class TolerancePlan:
    """A tolerance sheet.

    Parameters
    ----------
    loss_db : float
        Largest loss of any decisive score.
    names : tuple of str
        Parameters out of :data:`optsim.study.parameters.ALL`.
    regions : tuple of str
        Regions whose scores decide.
    known : bool
        Whether cameras built with a change and then calibrated are searched too; each needs a bench.
    draws : int
        Cameras drawn within the limits, and as many within those that hold together.
    interactions : bool
        Whether the worst five are measured in pairs.
    compensators : tuple of str
        What is tried against each drift, out of :data:`optsim.study.compensation.COMPENSATORS`.
    frames, seeds
        As of a sweep.
    """

    loss_db: float = 1.0
    names: tuple[str, ...] = tuple(ALL)
    regions: tuple[str, ...] = REGIONS
    known: bool = True
    draws: int = 8
    interactions: bool = True
    compensators: tuple[str, ...] = tuple(COMPENSATORS)
    frames: int = 3
    seeds: Seeds = LIMITS


def tolerance(
    base: Experiment, plan: TolerancePlan, place: Workplace, progress: Progress = silent
) -> dict[str, Any]:
    """Measure a tolerance sheet into a folder.

    Parameters
    ----------
    base : Experiment
        The unchanged experiment.
    plan : TolerancePlan
        The loss and what may cost it.
    place : Workplace
        Folder and workers; the same folder goes on.
    progress : Progress
        Told of each task.

    Returns
    -------
    dict
        The content of study.json.

    Raises
    ------
    ConfigError
        For an unknown parameter, or a loss that is not above 0.
    """
    for name in plan.names:
        if name not in ALL:
            raise unknown_name("parameter", name, ALL)
    for region in plan.regions:
        if region not in REGIONS:
            raise unknown_name("region", region, REGIONS)
    if not plan.names or not math.isfinite(plan.loss_db) or plan.loss_db <= 0:
        raise ConfigError(f"--loss: got {plan.loss_db:g} dB, expected more than 0")
    for name in plan.compensators:
        if name not in COMPENSATORS:
            raise unknown_name("compensator", name, COMPENSATORS)
    said = asdict(plan)
    common = plan.frames, plan.loss_db, list(plan.regions), asdict(plan.seeds)
    modes: tuple[Mode, ...] = ("unknown", "known") if plan.known else ("unknown",)
    tasks = [
        StudyTask(
            f"limits/{name}-{mode}-{_ENDS[sign]}",
            _find_limit,
            (*common, name, mode, sign, list(plan.compensators)),
        )
        for mode in modes
        for name in plan.names
        for sign in ALL[name].signs
    ]
    alone = record = compute("tolerance", base, said, tasks, place, progress)
    rows = sorted_rows([row for result in record["results"].values() for row in result["rows"]])
    share = allocate(rows, plan.loss_db)
    tasks += _together(base, plan, rows, common)
    record = compute("tolerance", base, said, tasks, place, progress)
    # The second call found the tasks of the first.
    work = {**record["work"], "tasks_done_before": alone["work"]["tasks_done_before"]}
    add_work(work, {name: count for name, count in alone["work"].items() if name != "tasks_done_before"})
    found = {
        **record,
        "work": work,
        "seconds": alone["seconds"] + record["seconds"],
        "compensators": [row for result in record["results"].values() for row in result.get("won", ())],
        "interactions": [
            result["pair"] for result in record["results"].values() if result.get("pair") is not None
        ],
        "budget": {"rss_db": rss_db(rows), **of_drawn(record["results"], "budget", plan.loss_db)},
        "allocation": {"share_db": share, **of_drawn(record["results"], "allocation", plan.loss_db)},
        "refusals": [row for result in record["results"].values() for row in result.get("refusals", ())],
    }
    lines = ["operand,min,max,unit"]
    for name, (down, up) in limits_of(rows, "together").items():
        least, most = ALL[name].shown(0.0 - down), ALL[name].shown(up)
        lines.append(f"{name},{least:.4g},{most:.4g},{ALL[name].unit}")
    write_text(place.folder / ALLOCATION, "\n".join([*lines, ""]))
    write_table(place.folder, found, rows)
    return {**found, "rows": rows}


def worst_loss(found: Compared, regions: Sequence[str]) -> tuple[Key, Estimate] | None:
    """Decisive score of a point: the one that loses most."""
    key = found.worst(key for key in found.change_db if key[1] in regions)
    return None if key is None else (key, found.change_db[key])


def deciding(regions: Sequence[str]) -> Callable[[dict[Key, Estimate]], list[Key]]:
    """Return what picks the score whose interval decides on more seeds: the one that loses most."""

    def pick(changes: dict[Key, Estimate]) -> list[Key]:
        known = [key for key in changes if key[1] in regions]
        return [min(known, key=lambda key: changes[key].mean)] if known else []

    return pick


def _together(
    base: Experiment,
    plan: TolerancePlan,
    rows: Sequence[dict[str, Any]],
    common: tuple[Any, ...],
) -> list[StudyTask]:
    """List the tasks of several parameters at once: pairs of the worst, and cameras of the budget."""
    frames, _, regions, seeds = common
    drifts = limits_of(rows)
    tasks: list[StudyTask] = []
    worst = list(dict.fromkeys(row["parameter"] for row in rows if row["mode"] == "unknown"))[:_WORST]
    if plan.interactions:
        for one, two in itertools.combinations(worst, 2):
            # Each towards the side with less room.
            at = {name: _nearer(drifts[name]) for name in (one, two)}
            tasks.append(StudyTask(f"pairs/{one}-{two}", _measure_pair, (frames, regions, seeds, at)))
    for word, limits in (("budget", drifts), ("allocation", limits_of(rows, "together"))):
        rng = stream(base.seed, word)
        for number in range(plan.draws):
            drawn = {name: float(rng.uniform(-down, up)) for name, (down, up) in limits.items()}
            tasks.append(StudyTask(f"{word}/{number:03d}", _measure_draw, (frames, regions, drawn)))
    return tasks


def _nearer(ends: tuple[float, float]) -> float:
    down, up = ends
    return up if down == 0 or 0 < up <= down else -down


def point_at(stage: Stage, changes: dict[str, float], mode: Mode, compensators: Sequence[str] = ()) -> Point:
    """Return the point of some parameters' changes."""
    keys: dict[str, Any] = {}
    for name, change in changes.items():
        keys |= ALL[name].changes(stage.base, change)
    return Point(changed_only(stage.base, keys), mode, tuple(compensators), stage.base.seed)


def _find_limit(
    folder: Path,
    text: str,
    frames: int,
    loss_db: float,
    regions: Sequence[str],
    seeds: dict[str, Any],
    name: str,
    mode: Mode,
    sign: int,
    compensators: Sequence[str],
) -> None:
    """Search one end of a parameter in one mode; what drifted is then compensated. In a worker."""
    stage, parameter, pick = stage_of(text, frames), ALL[name], deciding(regions)
    work: dict[str, int] = {}
    seen: dict[float, Compared] = {}
    refusals: list[dict[str, Any]] = []

    def loss(change: float) -> tuple[float, float | None] | None:
        found = compare(stage, point_at(stage, {name: sign * change}, mode), Seeds(**seeds), pick)
        add_work(work, found.work)
        if found.refused:
            refusals.append({"parameter": name, "change": sign * change, "message": found.refused})
            return None
        seen[change] = found
        worst = worst_loss(found, regions)
        return (0.0, None) if worst is None else (-worst[1].mean, worst[1].stated_half)

    limit = search_limit(loss, loss_db, parameter, mode)
    rows = [_row(name, mode, sign, limit, seen, regions, Seeds(**seeds))]
    won: list[dict[str, Any]] = []
    if mode == "unknown" and limit.value > 0:
        drift = {name: sign * limit.value}
        won = _compensate(stage, drift, compensators, regions, Seeds(**seeds), work)
    write_result(folder, work, rows=rows, won=won, refusals=refusals)


def search_limit(loss: Loss, loss_db: float, parameter: Tolerated, mode: Mode) -> Limit:
    """Search the limit of a parameter in one direction."""
    if mode != "known":
        return largest_change(loss, loss_db, parameter.first, parameter.most)
    first, most = parameter.usual, _BAD_SPECIMENS * parameter.usual
    if parameter.period is None:
        return largest_change(loss, loss_db, first, most)
    # Whole periods cost nothing, so the loss is largest at half of one.
    half = parameter.period / 2
    limit = largest_change(loss, loss_db, half / 2, half)
    return replace(limit, value=min(limit.value, half) if limit.status in COSTS else most)


def _row(
    name: str,
    mode: str,
    sign: int,
    limit: Limit,
    seen: dict[float, Compared],
    regions: Sequence[str],
    seeds: Seeds,
) -> dict[str, Any]:
    parameter = ALL[name]
    nearest = min(seen, key=lambda change: abs(change - limit.value), default=None)
    worst = None if nearest is None else worst_loss(seen[nearest], regions)
    ends = [None if end is None else parameter.shown(end) for end in limit.ends or (None, None)]
    half = worst[1].stated_half if worst else None
    return {
        "parameter": name,
        "mode": mode,
        "sign": sign,
        "value": parameter.shown(limit.value),
        "value_least": ends[0],
        "value_most": ends[1],
        "unit": parameter.unit,
        "status": limit.status,
        "loss_db": limit.loss,
        "loss_half": half,
        "above": parameter.shown(limit.above[0]) if limit.above else None,
        "above_db": limit.above[1] if limit.above else None,
        "method": worst[0][0] if worst else "",
        "region": worst[0][1] if worst else "",
        "seeds": worst[1].n if worst else 0,
        "capped": bool(worst) and (half is None or half > seeds.wanted_db),
        "below_noise": worst[1].below_noise if worst else True,
        "db_per_unit": None if limit.slope is None else limit.slope * parameter.per_unit,
        "room": limit.value / parameter.usual,
        "change": limit.value,
        "keys": " ".join(parameter.keys),
        "measurements": limit.steps,
    }


def _compensate(
    stage: Stage,
    drift: dict[str, float],
    compensators: Sequence[str],
    regions: Sequence[str],
    seeds: Seeds,
    work: dict[str, int],
) -> list[dict[str, Any]]:
    """Measure what each compensator wins back of a parameter's drift."""
    ((name, change),) = drift.items()
    pick = deciding(regions)
    before = compare(stage, point_at(stage, {name: change}, "unknown"), seeds, pick)
    add_work(work, before.work)
    worst = worst_loss(before, regions)
    if worst is None:
        return []
    rows: list[dict[str, Any]] = []
    for compensator in compensators:
        point = point_at(stage, {name: change}, "compensated", (compensator,))
        after = compare(stage, point, seeds, pick)
        add_work(work, after.work)
        left = after.change_db.get(worst[0])
        rows.append(
            {
                "parameter": name,
                "change": ALL[name].shown(change),
                "unit": ALL[name].unit,
                "compensator": compensator,
                "set_to": after.first.values,
                "method": worst[0][0],
                "region": worst[0][1],
                "before_db": worst[1].mean,
                "before_half": worst[1].stated_half,
                "after_db": left.mean if left else None,
                "after_half": left.stated_half if left else None,
                "refused": after.refused,
            }
        )
    return rows


def _measure_pair(
    folder: Path,
    text: str,
    frames: int,
    regions: Sequence[str],
    seeds: dict[str, Any],
    at: dict[str, float],
) -> None:
    """Measure two parameters alone and together, in a worker."""
    stage, pick = stage_of(text, frames), deciding(regions)
    work: dict[str, int] = {}
    losses = [
        compare(stage, point_at(stage, {name: at[name]}, "unknown"), Seeds(**seeds), pick).change_db
        for name in at
    ]
    both = compare(stage, point_at(stage, at, "unknown"), Seeds(**seeds), pick)
    add_work(work, both.work)
    worst = worst_loss(both, regions)
    pair: dict[str, Any] = {"names": list(at), "refused": both.refused}
    if worst and all(worst[0] in each for each in losses):
        alone = [-each[worst[0]].mean for each in losses]
        pair |= {
            "method": worst[0][0],
            "region": worst[0][1],
            "alone_db": alone,
            "together_db": -worst[1].mean,
            "half": worst[1].stated_half,
            "interaction_db": -worst[1].mean - sum(alone),
        }
    write_result(folder, work, rows=[], pair=pair)


def _measure_draw(
    folder: Path, text: str, frames: int, regions: Sequence[str], drawn: dict[str, float]
) -> None:
    """Measure a camera that drifted by all parameters at once, in a worker."""
    stage = stage_of(text, frames)
    found = compare(stage, point_at(stage, drawn, "unknown"), Seeds(1, 1))
    worst = worst_loss(found, regions)
    write_result(
        folder,
        found.work,
        rows=[],
        drawn={name: ALL[name].shown(change) for name, change in drawn.items()},
        loss_db=-worst[1].mean if worst else None,
        refused=found.refused,
    )
