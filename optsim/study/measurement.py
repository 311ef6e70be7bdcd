"""Scores of one point, measured once: they are kept in the cache under a hash of all that decides them."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from optsim import metrics
from optsim.core.cache import Arrays, Cache, hash_of
from optsim.core.config import build
from optsim.core.errors import BenchError, ConfigError, GeometryError, StorageError
from optsim.core.quantities import Floats
from optsim.core.random_streams import stream
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import capture, decode, planned
from optsim.metrics.records import REGIONS, Region
from optsim.metrics.scoring import FrameTally, ScoreBoard
from optsim.study.compensation import Values, by_bench, compensated
from optsim.study.point import Point, experiment_at, shares_truth
from optsim.study.stage import Stage, make_stage

DB = next(metric.name for metric in metrics.ALL if metric.unit == "dB")
"""Metric of all losses: PU21-PSNR."""
Key = tuple[str, Region]
"""Method and region of a score."""
# What says that a value cannot be built or calibrated. Full disks and missing files end the study.
_REFUSALS = (ConfigError, GeometryError, BenchError, ValueError)


@dataclass(frozen=True, eq=False)
class PointScores:
    """Scores of one point; the keys of ``db`` and ``stops`` are (method, region)."""

    db: dict[Key, float | None]  # PU21-PSNR, dB, None where nothing is scored.
    stops: dict[Key, float | None]  # Error of the logarithm.
    covered: float  # Share of the samples that all methods hold valid, so that they are scored.
    map_residual_px: float  # Rms distance between map and dots of the calibration, panel pixels.
    values: Values  # What the compensators were set to.
    pictures: Mapping[str, Floats]  # Method, or "truth" -> a slot, (v, u), W m^-2.
    refused: str  # Why the point cannot be; empty for one that can.
    work: dict[str, int]  # What was computed, and what was found: counts.


def measured(stage: Stage, point: Point) -> PointScores:
    """Measure a point, or find what was measured before: by this code, from the same files."""
    key = hash_of("study", stage.key, list(stage.scored), point.as_json())
    made: list[dict[str, int]] = []

    def make() -> Arrays:
        found = _measure_or_refuse(stage, point)
        made.append(found.work)
        return _arrays(found)

    retained = Cache().get(key, make)
    found = _measured_of(retained)
    return replace(found, work=made[0] if made else {"points_found": 1})


def _measure_or_refuse(stage: Stage, point: Point) -> PointScores:
    try:
        return _measure(stage, point)
    except _REFUSALS as error:
        said = " ".join(str(error).split())
        return PointScores({}, {}, 0.0, 0.0, {}, {}, said or type(error).__name__, {"points_refused": 1})


def _measure(stage: Stage, point: Point) -> PointScores:
    experiment = experiment_at(stage.base, point)
    modelled, _ = planned(experiment)
    work = {"points_measured": 1}
    benches = by_bench.cache_info().misses
    if not shares_truth(point):
        # Another lens or scene puts other light on the panel: it has targets and a light level of its own.
        stage = _other_stage(experiment.model_dump_json(), stage.scored)
        work["truths"] = 1
        calibrations = stage.calibrations
    elif point.mode == "known" and point.changes:
        calibrations = by_bench(modelled.model_dump_json())
    else:
        calibrations = stage.calibrations
    camera = modelled.at_work().with_nd(stage.light.nd_transmission)
    values: Values = {}
    if point.mode == "compensated":
        lit = modelled.camera.with_nd(stage.light.nd_transmission)
        as_calibrated = modelled.model_copy(update={"camera": lit})
        noise = partial(stream, stage.base.seed, "compensation")
        camera, calibrations, values = compensated(
            as_calibrated, camera, calibrations, point.compensators, noise
        )
    work["benches"] = by_bench.cache_info().misses - benches
    seeded = modelled.model_copy(update={"seed": point.seed, "n_frames": stage.scored[-1] + 1})
    try:
        seeded.check_methods(calibrations)
    except StorageError as error:
        raise ConfigError(str(error)) from None
    found, made = stage.panel_light.found, stage.panel_light.made
    frames = capture(seeded, camera, stage.truth, calibrations, expose=partial(stage.expose, camera))
    work["exposures"] = stage.panel_light.made - made
    work["exposures_of_known_panel_light"] = stage.panel_light.found - found
    tallies: list[FrameTally] = []
    pictures: dict[str, Floats] = {}
    for decoded in decode(seeded, frames, calibrations, first=stage.scored[0]):
        if decoded.index not in stage.targets:
            continue
        target = stage.targets[decoded.index]
        scored = np.logical_and.reduce([video.valid for video in decoded.videos.values()])
        for name, video in decoded.videos.items():
            tallies.append(stage.board.tally(name, video, target.reference_w_m2, target.moving, scored))
        slot = len(target.reference_w_m2) // 2
        pictures = {"truth": target.reference_w_m2[slot]}
        pictures |= {name: video.irradiance_w_m2[slot] for name, video in decoded.videos.items()}
    choice = experiment.calibration_choice
    return PointScores(
        pooled(stage.board, tallies, DB),
        pooled(stage.board, tallies, next(m.name for m in metrics.ALL if m.unit == "stops")),
        float(sum(t.counts.sum() for t in tallies) / max(1, sum(t.samples.sum() for t in tallies))),
        calibrations[choice].map_residual_px,
        values,
        pictures if point.seed == stage.base.seed else {},
        "",
        work,
    )


@lru_cache(maxsize=1)
def _other_stage(text: str, scored: tuple[int, ...]) -> Stage:
    return make_stage(build(Experiment, json.loads(text), where="point"), scored)


def pooled(board: ScoreBoard, tallies: list[FrameTally], metric: str) -> dict[Key, float | None]:
    """Score of each method and region over the frames that were tallied, by the name of a metric."""
    return {
        (score.method, region): score.value
        for score in board.records(tallies)
        for region in REGIONS
        if score.metric == metric and score.region == region
    }


# --- how it is kept -------------------------------------------------------------------------------------


def _arrays(found: PointScores) -> Arrays:
    text = json.dumps(
        {
            "db": [[*key, value] for key, value in found.db.items()],
            "stops": [[*key, value] for key, value in found.stops.items()],
            "covered": found.covered,
            "map_residual_px": found.map_residual_px,
            "values": found.values,
            "refused": found.refused,
            "pictures": list(found.pictures),
        }
    )
    packed = {"record": np.frombuffer(zlib.compress(text.encode()), np.uint8)}
    return packed | {f"picture{n}": image for n, image in enumerate(found.pictures.values())}


def _measured_of(arrays: Arrays) -> PointScores:
    record: dict[str, Any] = json.loads(zlib.decompress(bytes(arrays["record"])))
    return PointScores(
        {(method, region): value for method, region, value in record["db"]},
        {(method, region): value for method, region, value in record["stops"]},
        record["covered"],
        record["map_residual_px"],
        record["values"],
        {name: np.array(arrays[f"picture{n}"]) for n, name in enumerate(record["pictures"])},
        record["refused"],
        {},
    )
