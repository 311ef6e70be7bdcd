"""Benchmarks: each record measures optsim against a peer in the same run; a ratio above 1 is better.

One file a family; :data:`ALL` lists the records. A missing peer is null and the conditions name the
extra that brings it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, cast

from optsim.core.errors import unknown_name
from optsim.core.progress import Progress, silent

Record = dict[str, Any]

# Record name -> module in this folder that measures it; modules load only when asked for.
ALL: dict[str, str] = {
    "calibrate.full_frame": "calibrate",
    "capture.paper_20_percent": "capture",
    "capture.paper_all_moving": "capture",
    "dataset.sequence": "dataset",
    "dataset.two_workers": "dataset",
    "dataset.plan_error": "dataset",
    "gmm.36x256": "gmm",
    "mask.speed_latency": "mask",
    "omp.k2000": "omp",
    "omp.k5000": "omp",
    "omp.k10000": "omp",
    "reconstruct.moving_share": "reconstruct",
    "reconstruct.photographs": "photographs",
    "reconstruct.photographs_misregistered": "photographs",
    "reconstruct.photographs_contrast_20": "photographs",
    "reconstruct.quality": "quality",
    "render.window_room": "render",
    "render.half_moving": "render",
    "render.moving_camera": "render",
    "render.wheel": "render",
    "render.glossy_floor": "render",
    "render.flicker_lamp": "render",
    "render.night_street": "render",
    "render.chart": "render",
    "render.mesh_scene": "render",
    "render.own_world": "render",
    "render.own_world_walking": "render",
    "render.colour": "colour",
    "study.sweep_9": "study",
    "study.yield_200": "study",
}


def measure_all(names: Sequence[str], progress: Progress = silent) -> list[Record]:
    """Measure the named records or families (all when none is named), one after the other.

    Returns
    -------
    list of dict
        ``{name, value, unit, peer, peer_value, ratio, conditions}``.

    Raises
    ------
    ConfigError
        For a name that is no record.
    """
    chosen: list[str] = []
    for name in names or ALL:
        family = [record for record in ALL if record.startswith(f"{name}.")]
        if name not in ALL and not family:
            raise unknown_name("benchmark", name, ALL)
        chosen += family or [name]
    out: list[Record] = []
    for done, name in enumerate(chosen):
        progress(f"benchmark {name}", done, len(chosen))
        module = import_module(f"benchmarks.{ALL[name]}")
        out.append(cast("Callable[[str, Progress], Record]", module.measure)(name, progress))
    progress("benchmark", len(chosen), len(chosen))
    return out


def pictures(records: Sequence[Record]) -> dict[str, str]:
    """Draw the records that have something to draw: SVG by file name."""
    from benchmarks.curve import time_against_error
    from benchmarks.mask_curve import mask_against_lag
    from benchmarks.quality_curve import quality_against_time

    drawn: dict[str, str] = {}
    if any("curve" in record["conditions"] for record in records):
        drawn["time_against_error.svg"] = time_against_error(records)
    for record in records:
        if "quality" in record["conditions"]:
            drawn["quality_against_time.svg"] = quality_against_time(record)
        if "mask" in record["conditions"]:
            drawn["mask_against_lag.svg"] = mask_against_lag(record)
    return drawn
