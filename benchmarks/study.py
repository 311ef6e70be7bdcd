"""Time of studies of the demo: a sweep against runs, and drawn cameras a minute.

``study.sweep_9`` varies the relay's rotation over nine values, three curves, all four methods and at least
two seeds a point. Its peer is three runs of the demo without their render: what a user would allow a sweep to
take. ``study.yield_200`` draws cameras that drift within the shipped sheet, with one worker and with two; a
few draws stand for two hundred, since each takes as long. All start from an empty cache but for the truth.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import Any

from optsim.core.progress import Progress, silent
from optsim.core.threads import CORES
from optsim.experiment import job
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.truth import render_truth
from optsim.study.folder import Workplace, chosen_methods
from optsim.study.point import parse_axis
from optsim.study.sheets import read_sheet
from optsim.study.sweep import SweepPlan, sweep
from optsim.study.yields import YieldPlan, yields

_VARY = "relay.rotation_rad=-2e-3:2e-3:9"
_RUNS = 3
_DRAWS = 8


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Measure one record.

    Parameters
    ----------
    name : str
        ``study.sweep_9`` or ``study.yield_200``.
    progress : Progress
        Told of each piece of work.
    """
    base = load_experiment("demo")
    with tempfile.TemporaryDirectory(prefix="optsim-study-") as folder:
        before = os.environ.get("OPTSIM_CACHE")
        os.environ["OPTSIM_CACHE"] = f"{folder}/cache"
        try:
            render_truth(base, progress=progress)
            kind = _sweep if name == "study.sweep_9" else _yield
            return {"name": name, **kind(base, Path(folder), progress)}
        finally:
            if before is None:
                del os.environ["OPTSIM_CACHE"]
            else:
                os.environ["OPTSIM_CACHE"] = before


def _sweep(base: Experiment, folder: Path, progress: Progress) -> dict[str, Any]:
    # Another seed has another bench, so that neither finds the other's.
    other = base.model_copy(update={"seed": base.seed + 1, "save_reconstructions": ()})
    results = job.execute(other, folder / "run", progress=progress)
    run_s = sum(stage.wall_s for stage in results.timings if stage.stage != "render")
    start = time.perf_counter()
    plan = SweepPlan((parse_axis(base, _VARY),))
    record = sweep(chosen_methods(base, ()), plan, Workplace(folder / "sweep"), progress)
    seconds = time.perf_counter() - start
    return {
        "value": seconds,
        "unit": "s",
        "peer": f"{_RUNS} runs without render",
        "peer_value": _RUNS * run_s,
        "ratio": _RUNS * run_s / seconds,
        "conditions": {
            "vary": _VARY,
            "curves": list(plan.modes),
            "methods": [method.name for method in base.methods],
            "scored_frames": plan.frames,
            "seeds": f"{plan.seeds.least} to {plan.seeds.most}",
            "cores": CORES,
            "work": record["work"],
        },
    }


def _yield(base: Experiment, folder: Path, progress: Progress) -> dict[str, Any]:
    chosen = chosen_methods(base, ["adaptive"])
    a_minute: dict[int, float] = {}
    for workers in (1, 2):
        plan = YieldPlan(
            sheet=read_sheet("machining"),
            draws=_DRAWS,
            mode="unknown",
            compensators=(),
            method="adaptive",
            region="all",
            target_db=None,
        )
        # Other seeds draw other cameras.
        drawn = chosen.model_copy(update={"seed": base.seed + 10 * workers})
        start = time.perf_counter()
        yields(drawn, plan, Workplace(folder / f"yield{workers}", workers), progress)
        a_minute[workers] = 60 * _DRAWS / (time.perf_counter() - start)
    return {
        "value": a_minute[2],
        "unit": "draws/min",
        "peer": "one worker",
        "peer_value": a_minute[1],
        "ratio": a_minute[2] / a_minute[1],
        "conditions": {
            "draws": _DRAWS,
            "methods": ["adaptive"],
            "calibration": "unknown",
            "cores": CORES,
            "note": "the bench of the unchanged camera and the start of the workers are in it",
        },
    }
