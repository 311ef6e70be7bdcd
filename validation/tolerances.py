"""Tolerance sheet, waterfall and yield of the demo and of the paper's prototype.

``make tolerances`` writes ``reports/tolerances.md`` and keeps the studies, with their pages, in
``reports/runs/tolerances``; stopped, it goes on. Limits are those of the HDR mosaic, which is also the code
of the adaptive method where nothing moves: the scatter of the adaptive method itself, over the few seeds that
time allows, is as large as the loss. Waterfall and yield are of the adaptive method. Its sparse decoder takes
every second patch, as the prototype's preset does; the page says by how much that changes the demo's score.
One coded frame is scored. The prototype, sixteen times as many pixels, has fewer parameters, effects and
cameras, and knows its true operator instead of a bench's, for time.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

from optsim.core.files import write_text
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.report.markdown import markdown_table
from optsim.study.comparison import Seeds
from optsim.study.folder import Workplace, chosen_methods
from optsim.study.measurement import measured
from optsim.study.point import Point
from optsim.study.stage import frames_to_score, make_stage
from optsim.study.tolerance import TolerancePlan, tolerance
from optsim.study.tolerance_page import HEADS, MODES, lead, notes, sheet, write_tolerance_page
from optsim.study.waterfall import WaterfallPlan, effects_of, waterfall
from optsim.study.waterfall_page import HEADS as STEPS
from optsim.study.waterfall_page import lead as waterfall_lead
from optsim.study.waterfall_page import lines_of, write_waterfall_page
from optsim.study.yields import MACHINING, YieldPlan, read_sheet, yields
from optsim.study.yields_page import SHARED, shared_lines, write_yield_page
from optsim.study.yields_page import lead as yield_lead

OUT = Path("reports") / "tolerances.md"
KEPT = Path("reports") / "runs" / "tolerances"
PRESETS = ("demo", "paper_prototype")
STRIDE = "methods.adaptive.decoder.moving.stride_px=2"
LOSS_DB = 1.0
FRAMES = 1
# The most that is measured of each preset.
_SEEDS = {"demo": Seeds(2, 3, LOSS_DB / 10), "paper_prototype": Seeds(2, 2, LOSS_DB / 10)}
_DRAWS = {"demo": 100, "paper_prototype": 30}
_BUDGET = {"demo": 8, "paper_prototype": 4}
# Of the prototype's: those that its relay decides.
_FEW = ("shift_x", "rotation", "magnification", "defocus")
_EFFECTS = ("contrast", "response", "relay_blur", "read_noise")


def main(names: list[str]) -> None:
    """Measure what isn't kept yet, and write the page."""
    parts: list[str] = []
    for name in names or PRESETS:
        parts.append(_of(name))
        write_text(OUT, _HEAD + "\n".join(parts))
    print(f"page: {OUT}")


def _of(name: str) -> str:
    start = time.perf_counter()
    small = name == "demo"
    operator = [] if small else ["calibration=true"]
    base = chosen_methods(load_experiment(name, [STRIDE, *operator]), ["adaptive"])
    plan = TolerancePlan(
        loss_db=LOSS_DB,
        regions=("all", "static"),
        known=False,
        draws=_BUDGET[name],
        interactions=small,
        frames=FRAMES,
        seeds=_SEEDS[name],
        **({} if small else {"names": _FEW, "compensators": ("registration",)}),
    )
    mosaic = chosen_methods(load_experiment(name, operator), ["hdr_mosaic"])
    limits = tolerance(mosaic, plan, Workplace(KEPT / f"{name}-tolerance"), _said)
    write_tolerance_page(KEPT / f"{name}-tolerance", limits)
    # Every camera on the way has its true calibration: benches would take most of the time.
    true = base.model_copy(update={"calibration": "true"})
    effects = effects_of(true) if small else effects_of(true, _EFFECTS)
    steps = waterfall(
        true,
        WaterfallPlan(effects, 2, frames=FRAMES, seeds=Seeds(2, 2)),
        Workplace(KEPT / f"{name}-waterfall"),
        _said,
    )
    write_waterfall_page(KEPT / f"{name}-waterfall", steps)
    drawn = YieldPlan(
        read_sheet(MACHINING), _DRAWS[name], "unknown", (), "adaptive", "all", None, LOSS_DB, FRAMES
    )
    cameras = yields(base, drawn, Workplace(KEPT / f"{name}-yield"), _said)
    write_yield_page(KEPT / f"{name}-yield", cameras)
    minutes = (time.perf_counter() - start) / 60
    stride = _by_stride(name) if small else ""
    return "\n".join(_lines(name, limits, steps, cameras, stride, minutes))


def _lines(
    name: str,
    limits: dict[str, Any],
    steps: dict[str, Any],
    cameras: dict[str, Any],
    stride: str,
    minutes: float,
) -> list[str]:
    lines = [f"## {name}", "", lead(limits), ""]
    for mode, title in MODES.items():
        if rows := sheet(limits["rows"], mode):
            lines += [f"{title}:", "", *markdown_table(list(HEADS), [list(row) for row in rows]), ""]
    lines += [*notes(limits["rows"]), "", waterfall_lead(steps), ""]
    rows = lines_of(steps["rows"], "adaptive", "all")
    lines += [*markdown_table(list(STEPS), [list(row) for row in rows]), "", yield_lead(cameras), ""]
    shared = [[str(cell) for cell in row] for row in shared_lines(cameras)[:5]]
    lines += [*markdown_table(list(SHARED), shared), ""]
    lines += [f"{stride}Measured in {minutes:.0f} minutes by this call; what was kept before took none.", ""]
    return lines


def _by_stride(name: str) -> str:
    """Say how far the coarser decoder is from the preset's own."""
    values: list[float] = []
    for more in ([], [STRIDE]):
        base: Experiment = chosen_methods(load_experiment(name, more), ["adaptive"])
        found = measured(make_stage(base, frames_to_score(base, 1)), Point(seed=base.seed))
        values.append(found.db["adaptive", "all"] or 0.0)
    return f"Every second patch instead of each changes the score by {values[1] - values[0]:+.2f} dB. "


def _said(stage: str, done: int, total: int) -> None:
    print(f"{stage}: {done} of {total}", flush=True)


_HEAD = """# What misalignment may be

Written by `make tolerances`: for the demo and the paper's prototype, how much of each misalignment costs 1
dB, what each effect costs, and how many cameras would be good if every part drifted like a bad specimen
after its calibration. The pages of all studies, with pairs, compensators and curves, stand in
`reports/runs/tolerances`.

"""

if __name__ == "__main__":
    main(sys.argv[1:])
