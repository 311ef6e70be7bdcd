"""Yield: how many of the cameras that a tolerance sheet allows reach a score, and what the others share.

Each camera is drawn within the sheet, anew until it can be built, and has fixed patterns of its own. It is
built so and calibrated ("known"), drifts so after its calibration ("unknown"), or drifts and is put right by
compensators ("compensated"). The draw of a camera depends on the study's seed and its number only, so any
can be built again.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from optsim.core.errors import ConfigError, GeometryError
from optsim.core.progress import Progress, silent
from optsim.core.random_streams import stream
from optsim.experiment.experiment import Experiment
from optsim.study.comparison import add_work
from optsim.study.folder import StudyTask, Workplace, compute, write_result, write_table
from optsim.study.measurement import Key, measured
from optsim.study.parameters import ALL
from optsim.study.point import Mode, Point, changed_only, experiment_at
from optsim.study.sheets import Sheet
from optsim.study.stage import stage_of
from optsim.study.yield_causes import HALVED, SET_TO, shared_by_failures, travel_of, won_by_halving

# Successes, and failures, added to what was counted.
_AGRESTI = 2.0
_BLOCK = 4
# Draws of one camera until it can be built.
_MOST_DRAWS = 50


@dataclass(frozen=True)
class YieldPlan:
    """A yield.

    Parameters
    ----------
    sheet : Sheet
        What cameras are drawn within.
    draws : int
        Cameras.
    mode : Mode
        What their calibrations know.
    compensators : tuple of str
        Of the mode "compensated".
    method, region : str
        Score that counts.
    target_db : float or None
        Score that a camera must reach; by default that of the unchanged camera less ``loss_db``.
    loss_db : float
        See ``target_db``.
    frames : int
        Coded frames to score.
    halve : bool
        Whether each camera is measured again with each parameter's change halved.
    """

    sheet: Sheet
    draws: int
    mode: Mode
    compensators: tuple[str, ...]
    method: str
    region: str
    target_db: float | None
    loss_db: float = 1.0
    frames: int = 3
    halve: bool = False


@dataclass(frozen=True)
class Drawn:
    """A camera of a yield: changes in the units of their keys, and why earlier draws were refused."""

    changes: dict[str, float]
    serial_number: int
    # None where no draw could be built.
    point: Point | None
    refused: tuple[str, ...]


def drawn(base: Experiment, sheet: Sheet, mode: Mode, compensators: tuple[str, ...], camera: int) -> Drawn:
    """Draw a camera by its number, anew until it can be built."""
    rng = stream(base.seed, "yield", camera)
    # To learn its own fixed patterns takes a bench, which only the mode "known" has.
    serial_number = base.camera.serial_number + (camera if mode == "known" else 0)
    refused: list[str] = []
    changes: dict[str, float] = {}
    while len(refused) < _MOST_DRAWS:
        changes = sheet.draw(rng)
        point = _point(base, changes, mode, compensators, camera)
        try:
            experiment_at(base, point)
        except (ConfigError, GeometryError, ValueError) as error:
            refused.append(" ".join(str(error).split()))
            continue
        return Drawn(changes, serial_number, point, tuple(refused))
    return Drawn(changes, serial_number, None, tuple(refused))


def _point(
    base: Experiment, changes: dict[str, float], mode: Mode, compensators: tuple[str, ...], camera: int
) -> Point:
    keys: dict[str, Any] = {}
    for name, change in changes.items():
        for key, value in ALL[name].changes(base, change).items():
            # Two parameters may change the same key.
            keys[key] = keys[key] + value - ALL[name].changes(base, 0.0)[key] if key in keys else value
    if mode == "known":
        keys["camera.serial_number"] = base.camera.serial_number + camera
    return Point(changed_only(base, keys), mode, compensators, base.seed + camera)


def assignments_of(base: Experiment, plan: YieldPlan, camera: int) -> list[str]:
    """Return the overrides that build a drawn camera again, for ``--set``."""
    found = drawn(base, plan.sheet, plan.mode, plan.compensators, camera)
    point = found.point
    if point is None:
        raise ConfigError(
            f"--sheet: got no camera {camera} that can be built in {_MOST_DRAWS} draws, expected limits of "
            f"cameras that can; fix: narrow them. The last draw: {found.refused[-1]}"
        )
    place = "camera." if plan.mode == "known" else "drift."
    changes = [f"{place}{key.removeprefix('camera.')}={value!r}" for key, value in point.changes]
    return [f"seed={point.seed}", *changes]


def yields(
    base: Experiment, plan: YieldPlan, place: Workplace, progress: Progress = silent
) -> dict[str, Any]:
    """Measure a yield into a folder.

    Parameters
    ----------
    base : Experiment
        The unchanged experiment.
    plan : YieldPlan
        The sheet, and what counts as a good camera.
    place : Workplace
        Folder and workers; the same folder goes on.
    progress : Progress
        Told of each task, a few cameras each.

    Returns
    -------
    dict
        The content of study.json.
    """
    said = {**asdict(plan), "seeds": {"least": 1, "most": 1, "wanted_db": 0.0}}
    # What decides a camera's score; the target only says which are good.
    drawing = {
        "sheet": asdict(plan.sheet),
        "mode": plan.mode,
        "compensators": list(plan.compensators),
        "method": plan.method,
        "region": plan.region,
        "halve": plan.halve,
    }
    tasks = [
        StudyTask(
            f"cameras/{first:05d}",
            _measure_cameras,
            (plan.frames, drawing, first, min(first + _BLOCK, plan.draws)),
        )
        for first in range(0, plan.draws, _BLOCK)
    ]
    record = compute("yield", base, said, tasks, place, progress)
    results = list(record["results"].values())
    rows = [row for result in results for row in result["rows"]]
    nominal = next((result["nominal_db"] for result in results if result["nominal_db"] is not None), None)
    target = plan.target_db
    if target is None:
        target = None if nominal is None else nominal - plan.loss_db
    unbuilt = [each for result in results for each in result["unbuilt"]]
    again = [why for row in rows for why in row.pop("drawn_again")]
    again += [why for each in unbuilt for why in each["drawn_again"]]
    for row in rows:
        # A camera that cannot be calibrated is no good one.
        row["good"] = target is not None and row["db"] is not None and row["db"] >= target
        row["set"] = " ".join(f"--set {each}" for each in assignments_of(base, plan, row["camera"]))
    found = {
        **record,
        "nominal_db": nominal,
        "target_db": target,
        "good": sum(row["good"] for row in rows),
        "cameras": len(rows),
        "interval": binomial_interval(sum(row["good"] for row in rows), len(rows)),
        "not_built": {"draws": len(again), "cameras": len(unbuilt), "reasons": dict(Counter(again))},
        "shared": shared_by_failures(rows, plan.sheet.limits),
        "won_by_halving": won_by_halving(rows, target),
        "travel": travel_of(rows),
    }
    write_table(place.folder, found, rows)
    return {**found, "rows": rows}


def binomial_interval(good: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a share: A. Agresti, B. A. Coull, The American Statistician 52 (1998)."""
    n = of + 2 * _AGRESTI
    share = (good + _AGRESTI) / n
    half = 1.96 * math.sqrt(share * (1 - share) / n)
    return max(0.0, share - half), min(1.0, share + half)


def _measure_cameras(
    folder: Path, text: str, frames: int, drawing: dict[str, Any], first: int, end: int
) -> None:
    """Measure some cameras, in a worker."""
    stage = stage_of(text, frames)
    sheet, mode, compensators = Sheet(**drawing["sheet"]), drawing["mode"], tuple(drawing["compensators"])
    key: Key = drawing["method"], drawing["region"]
    nominal = measured(stage, Point(seed=stage.base.seed))
    work = dict(nominal.work)
    rows: list[dict[str, Any]] = []
    unbuilt: list[dict[str, Any]] = []
    for camera in range(first, end):
        made = drawn(stage.base, sheet, mode, compensators, camera)
        if made.point is None:
            unbuilt.append({"camera": camera, "drawn_again": made.refused})
            continue
        found = measured(stage, made.point)
        add_work(work, found.work)
        halved: dict[str, float | None] = {}
        for name in [name for name, change in made.changes.items() if change and drawing["halve"]]:
            changes = {**made.changes, name: made.changes[name] / 2}
            less = measured(stage, _point(stage.base, changes, mode, compensators, camera))
            add_work(work, less.work)
            halved[HALVED + name] = less.db.get(key)
        rows.append(
            {
                "camera": camera,
                "db": found.db.get(key),
                "map_residual_px": found.map_residual_px,
                "serial_number": made.serial_number,
                **{name: ALL[name].shown(change) for name, change in made.changes.items()},
                **halved,
                **{SET_TO + name: value for name, value in found.values.items()},
                "refused": found.refused,
                "drawn_again": made.refused,
            }
        )
    write_result(folder, work, rows=rows, unbuilt=unbuilt, nominal_db=nominal.db.get(key))
