"""Yield: how many of the cameras that a tolerance sheet allows reach a score, and what the others share.

Each camera is drawn within the sheet: every parameter evenly between its two limits, and fixed patterns of
its own. It is built so and calibrated ("known"), drifts so after its calibration ("unknown"), or drifts and
is put right by compensators ("compensated"). The draw of a camera depends on the study's seed and its number
only, so any can be built again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.core.config import Table, read_toml
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Doubles
from optsim.core.random_streams import stream
from optsim.experiment.experiment import Experiment
from optsim.metrics.student import CONFIDENCE, quantile
from optsim.study.comparison import add_work
from optsim.study.folder import STUDY, Piece, Workplace, compute, read_study, write_result, write_table
from optsim.study.measurement import Key, measured
from optsim.study.parameters import ALL
from optsim.study.point import Mode, Point, changed_only
from optsim.study.stage import stage_of
from optsim.study.tolerance_rows import limits_of

# Two standard deviations of the score of failures against passes: what counts as shared.
_AGRESTI = 2.0
_BLOCK = 4
# Cameras from which on a correlation is told from chance.
_FEWEST = 5
MACHINING = "machining"
"""Name of the shipped sheet: a bad specimen's change of every parameter, both ways."""
Sheet = dict[str, tuple[float, float]]
"""Parameter -> largest change down and up, both positive, in the unit of its keys."""


@dataclass(frozen=True)
class YieldPlan:
    """A yield.

    Parameters
    ----------
    sheet : dict
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


def read_sheet(name_or_path: str) -> Sheet:
    """Read a tolerance sheet: the shipped one, a finished tolerance study, or a TOML file.

    A TOML file has a table a parameter, in the units of ``optsim tolerance``: ``[shift_x] plus = 0.3`` and,
    unless it is the same, ``minus = 0.2``.

    Raises
    ------
    ConfigError, StorageError
        For an unknown parameter, a limit that is no number or below 0, or a missing file.
    """
    path = Path(name_or_path).expanduser()
    if name_or_path == MACHINING:
        return {name: each.bad_specimen for name, each in ALL.items()}
    if path.is_dir() or path.name == STUDY:
        return limits_of(read_study(path, "tolerance")["rows"])
    sheet: Sheet = {}
    for name, limits in read_toml(path).items():
        if name not in ALL:
            raise unknown_name(f"parameter in {path}", name, ALL)
        held = cast("Table", limits) if isinstance(limits, dict) else {"plus": limits}
        ends: list[Any] = [held.get("minus", held.get("plus")), held.get("plus", held.get("minus"))]
        if set(held) - {"plus", "minus"} or not all(_is_limit(end) for end in ends):
            raise ConfigError(
                f"{path}: {name}: got {limits!r}, expected plus and minus in {ALL[name].unit}, 0 or more"
            )
        down, up = (float(end) * ALL[name].per_unit for end in ends)
        sheet[name] = (down, up)
    if not sheet:
        raise ConfigError(f"{path}: got no parameter, expected tables such as [shift_x] with plus = 0.3")
    return sheet


def _is_limit(value: object) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return math.isfinite(value) and value >= 0


def drawn(base: Experiment, sheet: Sheet, camera: int) -> tuple[dict[str, float], int]:
    """Return the changes of a camera, in the units of their keys, and its serial number."""
    rng = stream(base.seed, "yield", camera)
    changes = {name: float(rng.uniform(-down, up)) for name, (down, up) in sheet.items()}
    return changes, base.camera.serial_number + camera


def point_of(base: Experiment, sheet: Sheet, mode: Mode, compensators: tuple[str, ...], camera: int) -> Point:
    """Return the point of a drawn camera.

    Its fixed patterns are known to its calibration, so that only the mode "known" can have its own: a bench
    is needed to learn them.
    """
    changes, serial_number = drawn(base, sheet, camera)
    keys: dict[str, Any] = {}
    for name, change in changes.items():
        for key, value in ALL[name].changes(base, change).items():
            # Two parameters may change the same key.
            keys[key] = keys[key] + value - ALL[name].changes(base, 0.0)[key] if key in keys else value
    if mode == "known":
        keys["camera.serial_number"] = serial_number
    return Point(changed_only(base, keys), mode, compensators, base.seed + camera)


def assignments_of(base: Experiment, plan: YieldPlan, camera: int) -> list[str]:
    """Return the overrides that build a drawn camera again, for ``--set``."""
    point = point_of(base, plan.sheet, plan.mode, plan.compensators, camera)
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
        "sheet": {name: list(ends) for name, ends in plan.sheet.items()},
        "mode": plan.mode,
        "compensators": list(plan.compensators),
        "method": plan.method,
        "region": plan.region,
    }
    pieces = [
        Piece(
            f"cameras/{first:05d}",
            _measure_cameras,
            (plan.frames, drawing, first, min(first + _BLOCK, plan.draws)),
        )
        for first in range(0, plan.draws, _BLOCK)
    ]
    record = compute("yield", base, said, pieces, place, progress)
    results = list(record["results"].values())
    rows = [row for result in results for row in result["rows"]]
    nominal = next((result["nominal_db"] for result in results if result["nominal_db"] is not None), None)
    target = plan.target_db
    if target is None:
        target = None if nominal is None else nominal - plan.loss_db
    for row in rows:
        # A camera that cannot be built or calibrated is no good one.
        row["good"] = target is not None and row["db"] is not None and row["db"] >= target
        row["set"] = " ".join(f"--set {each}" for each in assignments_of(base, plan, row["camera"]))
    found = {
        **record,
        "nominal_db": nominal,
        "target_db": target,
        "good": sum(row["good"] for row in rows),
        "cameras": len(rows),
        "interval": binomial_interval(sum(row["good"] for row in rows), len(rows)),
        "shared": shared_by_failures(rows, plan.sheet),
    }
    write_table(place.folder, found, rows)
    return {**found, "rows": rows}


def binomial_interval(good: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a share by A. Agresti and B. A. Coull (The American Statistician 52, 1998).

    Two successes and two failures are added to what was counted.
    """
    n = of + 2 * _AGRESTI
    share = (good + _AGRESTI) / n
    half = 1.96 * math.sqrt(share * (1 - share) / n)
    return max(0.0, share - half), min(1.0, share + half)


def shared_by_failures(rows: Sequence[dict[str, Any]], sheet: Sheet) -> list[dict[str, Any]]:
    """Say of each parameter which way it makes cameras worse, the one that explains most first.

    ``failures`` and ``good`` are mean changes, with their sign, over the sheet's larger limit.
    ``correlation`` is that of the change with the score, and ``size_correlation`` that of its size.
    ``worse_at`` follows the stronger of the two. It is empty where that may be chance: one in twenty sheets
    of parameters that do nothing names any.
    """
    names = [name for name, ends in sheet.items() if max(ends) > 0]
    found: list[dict[str, Any]] = []
    for name in names:
        limit = ALL[name].shown(max(sheet[name]))
        sides = {good: [r[name] / limit for r in rows if r["good"] == good] for good in (True, False)}
        scored = [(r[name], r["db"]) for r in rows if r["db"] is not None]
        signed, size = _correlation(scored), _correlation([(abs(change), db) for change, db in scored])
        strongest = max(abs(signed), abs(size))
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
    if cameras < _FEWEST:
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


def _measure_cameras(
    folder: Path, text: str, frames: int, drawing: dict[str, Any], first: int, end: int
) -> None:
    """Measure some cameras, in a worker."""
    stage = stage_of(text, frames)
    sheet: Sheet = {name: (ends[0], ends[1]) for name, ends in drawing["sheet"].items()}
    mode: Mode = drawing["mode"]
    compensators = tuple(drawing["compensators"])
    key: Key = drawing["method"], drawing["region"]
    nominal = measured(stage, Point(seed=stage.base.seed))
    work = dict(nominal.work)
    rows: list[dict[str, Any]] = []
    for camera in range(first, end):
        changes, serial_number = drawn(stage.base, sheet, camera)
        found = measured(stage, point_of(stage.base, sheet, mode, compensators, camera))
        add_work(work, found.work)
        rows.append(
            {
                "camera": camera,
                "db": found.db.get(key),
                "map_residual_px": found.map_residual_px,
                "serial_number": serial_number if mode == "known" else stage.base.camera.serial_number,
                **{name: ALL[name].shown(change) for name, change in changes.items()},
                "refused": found.refused,
            }
        )
    write_result(folder, work, rows=rows, nominal_db=nominal.db.get(key))
