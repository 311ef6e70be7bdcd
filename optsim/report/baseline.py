"""Scores of runs, frame by frame, in the small form that a comparison takes and that a baseline stores.

A baseline is a JSON file below ``reports/baselines/``, which ``optsim accept`` writes and nothing else. It
holds the scores of each coded frame and seed, so that a later run is compared with it unit by unit.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, model_validator

from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_record, write_text
from optsim.metrics.records import ClassSeries, Reading, Record, Series
from optsim.metrics.scoring import phase_of
from optsim.metrics.tolerances import MEMORY, READING, TIME
from optsim.report.schema import RESULTS, Results, check_results

BASELINES = Path("reports") / "baselines"
FORMAT = "optsim baseline 1"
YARDSTICK = "yardstick"
"""Stage of fixed work in a run, in whose time the others are stated."""
_DIGITS, _LEAST_S = 6, 0.5


class Facts(Record):
    """Unit and direction of a metric."""

    unit: str
    higher_is_better: bool
    either_way: bool = False  # It has one right value: any change is a loss.
    relative: bool = False  # It is compared in per cent.


Values = list[float | None]
"""A score a coded frame; None where there is none."""
Scores = dict[str, dict[str, dict[str, Values]]]
"""Values by metric, method and region."""


class Run(Record):
    """One run: its case, its seed, and the coded frames of its values; ``readings`` are single numbers."""

    case: str
    seed: int
    frames: list[int]
    readings: dict[str, float] = Field(default_factory=dict[str, float])
    scores: Scores

    @model_validator(mode="after")
    def _aligned(self) -> Run:
        rows = [each for methods in self.scores.values() for each in methods.values()]
        if any(len(values) != len(self.frames) for each in rows for values in each.values()):
            raise ValueError(f"got a score without {len(self.frames)} values, expected one a frame")
        return self


class Scored(Record):
    """Scores of several runs; ``experiments`` are the settings of each case without their seed."""

    format: Literal["optsim baseline 1"]
    name: str
    made_utc: str
    versions: dict[str, str]
    metrics: dict[str, Facts]
    experiments: dict[str, dict[str, Any]]
    runs: list[Run]


def baseline_path(name: str) -> Path:
    """Place of a baseline: a bare name is one of :data:`BASELINES`, anything else a path."""
    return Path(name) if "/" in name or name.endswith(".json") else BASELINES / f"{name}.json"


def new_baseline_path(name: str) -> Path:
    """Place of a baseline to be written: a bare name, or the path of a JSON file; else a ConfigError."""
    path = baseline_path(name)
    if path.suffix != ".json" or not re.fullmatch(r"[^\W_][\w .-]*", path.stem):
        raise ConfigError(
            f"--name: got {name!r}, expected a bare name, or a path that ends with .json; cure: --name demo"
        )
    return path


def run_folders(place: Path) -> list[Path]:
    """Find the finished runs in a folder, at least one: the folder itself, or all below it."""
    if (place / RESULTS).is_file():
        return [place]
    found = sorted(path.parent for path in place.rglob(RESULTS)) if place.is_dir() else []
    if not found:
        raise StorageError(
            f"{place}: got no {RESULTS} there, expected the folder of a finished run, or of several; "
            "cure: optsim run EXPERIMENT --out DIR"
        )
    return found


def scored_runs(place: Path) -> Scored:
    """Read the scores of a run's folder, or of all runs below a folder, which must differ."""
    read = [check_results(read_record(folder / RESULTS), folder / RESULTS) for folder in run_folders(place)]
    runs = [_run(results) for results in read]
    names = [(run.case, run.seed) for run in runs]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        case, seed = twice[0]
        raise ConfigError(
            f"{place}: got several runs of {case!r} with seed {seed}, expected one each; cure: compare them "
            "one by one"
        )
    return Scored(
        format=FORMAT,
        name=read[0].title if len({run.case for run in runs}) == 1 else place.resolve().name,
        made_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        versions=read[0].versions,
        metrics={name: facts for results in read for name, facts in _facts(results).items()},
        experiments={
            run.case: {key: value for key, value in results.experiment.items() if key != "seed"}
            for run, results in zip(runs, read, strict=True)
        },
        runs=runs,
    )


def _run(results: Results) -> Run:
    """Take the steady frames of a run, or those of the last phase reached."""
    frames, scores = last_phase(results.class_series or results.frame_series, results.latency.frames)
    return Run(
        case=str(results.experiment.get("name", results.title)),
        seed=int(results.experiment.get("seed", 0)),
        frames=frames,
        readings=_readings(results),
        scores=scores,
    )


def last_phase(
    series: Sequence[Series] | Sequence[ClassSeries], latency_frames: int
) -> tuple[list[int], Scores]:
    """Coded frames of the last phase of some series, which may lack some, and their scores there."""
    x = {frame for each in series for frame in each.x}
    last = phase_of(max(x, default=0), latency_frames)
    frames = sorted(frame for frame in x if phase_of(frame, latency_frames) == last)
    scores: Scores = {}
    for each in series:
        known = dict(zip(each.x, each.values, strict=False))
        values = [_rounded(known.get(frame)) for frame in frames]
        scores.setdefault(each.metric, {}).setdefault(each.method, {})[each.region] = values
    return frames, scores


def _readings(results: Results) -> dict[str, float]:
    """Take readings of the bench and, where a yardstick was timed beside the stages, their cost."""
    found = {READING + each.name: each.value for each in results.readings}
    yardstick = next((t.cpu_s for t in results.timings if t.stage == YARDSTICK), None)
    if yardstick:
        for each in results.timings:
            # Rendering takes what is in the cache, and short stages have no steady time.
            if each.stage not in (YARDSTICK, "render") and each.cpu_s > _LEAST_S:
                found[TIME + each.stage] = each.cpu_s / yardstick
                if each.peak_is_of_this_stage:
                    found[MEMORY + each.stage] = each.peak_rss_mb
    return {name: float(f"{value:.{_DIGITS}g}") for name, value in found.items()}


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.{_DIGITS}g}")


def _facts(results: Results) -> dict[str, Facts]:
    known = [*results.scores, *results.class_series]
    facts = {s.metric: Facts(unit=s.unit, higher_is_better=s.higher_is_better) for s in known}
    facts |= {READING + each.name: reading_facts(each) for each in results.readings}
    for name in _readings(results):
        if not name.startswith(READING):
            unit = "yardsticks" if name.startswith(TIME) else "MB"
            facts[name] = Facts(unit=unit, higher_is_better=False, relative=True)
    return facts


def reading_facts(reading: Reading) -> Facts:
    """Say how a reading is compared: places in pixels, all else in per cent."""
    return Facts(unit=reading.unit, higher_is_better=True, either_way=True, relative=reading.unit != "px")


def read_baseline(path: Path) -> Scored:
    """Read a baseline; refuse a file that is none."""
    try:
        return Scored.model_validate(read_record(path))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise StorageError(
            f"{path}: {place}: {first['msg']}; expected a baseline; cure: optsim accept RUN"
        ) from None


def write_baseline(path: Path, scored: Scored) -> None:
    """Write a baseline, a metric and method a line."""
    record = scored.as_json()
    runs = [_lines(run) for run in record.pop("runs")]
    head = json.dumps(record, indent=1, allow_nan=False)
    write_text(path, f'{head[:-2]},\n "runs": [\n' + ",\n".join(runs) + "\n ]\n}\n")


def _lines(run: dict[str, Any]) -> str:
    scores = [
        f"  {json.dumps(metric)}: {{\n"
        + ",\n".join(f"   {json.dumps(name)}: {json.dumps(rows)}" for name, rows in methods.items())
        + "}"
        for metric, methods in run.pop("scores").items()
    ]
    return f'  {json.dumps(run)[:-1]}, "scores": {{\n' + ",\n".join(scores) + "}}"
