"""Tolerance sheet, waterfall and yield of the demo and of the paper's prototype, a page each.

``make tolerances`` and ``make tolerances-prototype`` write ``reports/tolerances.md`` and
``reports/tolerances_prototype.md``. The studies, with their pages, stay in ``reports/runs/tolerances``; a
stopped one goes on. Limits are those of the HDR mosaic, which is also the code
of the adaptive method where nothing moves: the scatter of the adaptive method itself, over the few seeds that
time allows, is as large as the loss. Waterfall and yield are of the adaptive method. Its sparse decoder takes
every second patch, as the prototype's preset does; the page says by how much that changes the demo's score.
One coded frame is scored. The prototype, sixteen times as many pixels, has fewer parameters and effects, and
knows its true operator instead of a bench's, for time.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.errors import ConfigError
from optsim.core.files import write_text
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.report.plots import write_signed_bars
from optsim.report.words import markdown_table
from optsim.study.comparison import Seeds
from optsim.study.folder import Workplace, chosen_methods
from optsim.study.measurement import measured
from optsim.study.point import Mode, Point
from optsim.study.sheets import MACHINING, read_sheet
from optsim.study.stage import frames_to_score, make_stage, scored_part
from optsim.study.tolerance import TolerancePlan, tolerance
from optsim.study.tolerance_page import HEADS, MODES, lead, notes, sheet, won_back, write_tolerance_page
from optsim.study.waterfall import WaterfallPlan, effects_of, waterfall
from optsim.study.waterfall_page import HEADS as STEPS
from optsim.study.waterfall_page import bars_of, lines_of, write_waterfall_page
from optsim.study.waterfall_page import lead as waterfall_lead
from optsim.study.words import REGIONS
from optsim.study.yields import YieldPlan, yields
from optsim.study.yields_page import write_yield_page

PAGES = {
    "demo": Path("reports") / "tolerances.md",
    "paper_prototype": Path("reports") / "tolerances_prototype.md",
}
KEPT = Path("reports") / "runs" / "tolerances"
PICTURES = Path("reports") / "pictures"
STRIDE = "methods.adaptive.decoder.moving.stride_px=2"
LOSS_DB = 1.0
FRAMES = 1
# The most that is measured of each preset.
_SEEDS = Seeds(4, 4, LOSS_DB / 10)
_STEP_SEEDS = Seeds(8, 8)
_BUDGET = {"demo": 8, "paper_prototype": 2}
# What is done after a camera has drifted: what its calibration knows, and compensators.
_REMEDIES: dict[str, tuple[Mode, tuple[str, ...], str]] = {
    "none": ("unknown", (), "nothing"),
    "quick": ("compensated", ("registration", "focus"), "registration by one frame pair, then focus"),
    "bench": ("compensated", ("bench",), "a whole bench"),
    "all": ("compensated", ("registration", "focus", "bench"), "registration, focus, then a whole bench"),
}
# Cameras of each. Those of the prototype would take as long as all else together.
_DONE = {"demo": {"none": 50, "quick": 50, "bench": 50, "all": 50}, "paper_prototype": {}}
_WORST = 5
# A bench for each camera of the prototype would take too long.
_KNOWN = {"demo": [], "paper_prototype": ["calibration=true"]}
# Of the prototype's: those of the demo's worst that act differently at another ratio, and contrast.
_FEW = ("shift_x", "rotation", "magnification", "defocus", "contrast")
_EFFECTS = ("contrast", "response", "fringing", "relay_blur", "read_noise")


def main(names: list[str]) -> None:
    """Measure what isn't stored yet, and write the page of each preset."""
    for name in names or PAGES:
        write_text(PAGES[name], _HEAD + _of(name))
        print(f"page: {PAGES[name]}")


def _of(name: str) -> str:
    start = time.perf_counter()
    limits, steps = _limits_of(name), _steps_of(name)
    cameras = {remedy: _yield_of(name, remedy) for remedy in _DONE[name]}
    minutes = (time.perf_counter() - start) / 60
    stride = _by_stride(name) if name == "demo" else ""
    return "\n".join(_lines(name, limits, steps, cameras, stride, minutes))


def _base(name: str, method: str) -> Experiment:
    """Return the preset with one method."""
    more = [STRIDE] if method == "adaptive" else []
    return chosen_methods(load_experiment(name, [*more, *_KNOWN[name]]), [method])


def _limits_of(name: str) -> dict[str, Any]:
    """Measure the tolerance sheet."""
    small = name == "demo"
    plan = TolerancePlan(
        loss_db=LOSS_DB,
        regions=("all", "static"),
        known=small,
        draws=_BUDGET[name],
        interactions=small,
        frames=FRAMES,
        seeds=_SEEDS,
        **({} if small else {"names": _FEW, "compensators": ("registration",)}),
    )
    folder = KEPT / f"{name}-tolerance"
    limits = tolerance(_base(name, "hdr_mosaic"), plan, Workplace(folder), _said)
    write_tolerance_page(folder, limits)
    return limits


def _steps_of(name: str) -> dict[str, Any]:
    """Measure the waterfall."""
    # Every camera on the way has its true calibration: benches would take most of the time.
    true = _base(name, "adaptive").model_copy(update={"calibration": "true"})
    effects = effects_of(true) if name == "demo" else effects_of(true, _EFFECTS)
    plan = WaterfallPlan(effects, 2, frames=FRAMES, seeds=_STEP_SEEDS)
    folder = KEPT / f"{name}-waterfall"
    steps = waterfall(true, plan, Workplace(folder), _said)
    write_waterfall_page(folder, steps)
    return steps


def _yield_of(name: str, remedy: str) -> dict[str, Any]:
    """Measure how many cameras are good, of those that drifted like bad specimens and were put right so."""
    mode, compensators, _ = _REMEDIES[remedy]
    drawn = YieldPlan(
        sheet=read_sheet(MACHINING),
        draws=_DONE[name][remedy],
        mode=mode,
        compensators=compensators,
        method="adaptive",
        region="all",
        target_db=None,
        loss_db=LOSS_DB,
        frames=FRAMES,
    )
    folder = KEPT / f"{name}-yield-{remedy}"
    cameras = yields(_base(name, "adaptive"), drawn, Workplace(folder), _said)
    write_yield_page(folder, cameras)
    return cameras


def _lines(
    name: str,
    limits: dict[str, Any],
    steps: dict[str, Any],
    cameras: dict[str, dict[str, Any]],
    stride: str,
    minutes: float,
) -> list[str]:
    lines = [f"## {name}", "", lead(limits), ""]
    for mode, title in MODES.items():
        if rows := sheet(limits["rows"], mode):
            lines += [f"{title}:", "", *markdown_table(list(HEADS), [list(row) for row in rows]), ""]
    lines += [
        *(f"- {note}" for note in notes(limits["rows"])),
        "",
        "What an operator wins back of the worst drifts, dB:",
        "",
    ]
    worst = list(dict.fromkeys(row["parameter"] for row in limits["rows"]))[:_WORST]
    here = [row for row in limits["compensators"] if row["parameter"] in worst]
    heads, won = won_back(sorted(here, key=lambda row: worst.index(row["parameter"])))
    lines += [*markdown_table(list(heads), [list(row) for row in won]), "", waterfall_lead(steps), ""]
    picture = PICTURES / f"waterfall_{name}.png"
    write_signed_bars(picture, bars_of(steps["rows"], "adaptive", "all"))
    lines += [f"![What each effect costs, {name}](pictures/{picture.name})", ""]
    lines += [f"*Fair shares of {name}, dB of PU21-PSNR everywhere, adaptive.*", ""]
    rows = lines_of(steps["rows"], "adaptive", "all")
    lines += [*markdown_table(list(STEPS), [list(row) for row in rows]), "", *_yields_lines(cameras), ""]
    lines += [f"{stride}Measured in {minutes:.0f} minutes, without what was kept before.", ""]
    return lines


def _yields_lines(cameras: dict[str, dict[str, Any]]) -> list[str]:
    if not cameras:
        return ["Its yield is not measured, for time."]
    check_alike(cameras)
    record = cameras["none"]
    said = (
        "Cameras whose parts drifted after the calibration, each somewhere within a bad specimen's change: "
        f"so many reach {record['target_db']:.2f} dB, PU21-PSNR of {record['plan']['method']}, "
        f"{REGIONS[record['plan']['region']]} (unchanged: {record['nominal_db']:.2f} dB)."
    )
    rows: list[list[str]] = []
    for remedy, found in cameras.items():
        low, high = found["interval"]
        scores = [row["db"] for row in found["rows"] if row["db"] is not None]
        shared = [f"{each['worse_at']} {each['parameter']}" for each in found["shared"] if each["worse_at"]]
        share = f"{found['good']} of {found['cameras']} ({low:.0%} to {high:.0%})"
        middle = f"{np.median(scores):.2f}, {np.percentile(scores, 10):.2f}"
        refused = str(len(found["rows"]) - len(scores))
        rows.append([_REMEDIES[remedy][2], share, middle, refused, ", ".join(shared) or "–"])
    heads = ["then done", "good", "median, worst tenth, dB", "refused", "failures lie at"]
    return [said, "", *markdown_table(heads, rows)]


def check_alike(cameras: dict[str, dict[str, Any]]) -> None:
    """Refuse yields side by side that are of another method, region, sheet or score to reach."""
    found = {
        json.dumps(
            [*(each["plan"][key] for key in ("method", "region", "frames", "sheet")), each["target_db"]]
        )
        for each in cameras.values()
    }
    if len(found) > 1:
        raise ConfigError(f"yields: got {' and '.join(sorted(found))}, expected one method, region and score")


def _by_stride(name: str) -> str:
    """Say how far the coarser decoder is from the preset's own."""
    values: list[float] = []
    for more in ([], [STRIDE]):
        base = scored_part(chosen_methods(load_experiment(name, more), ["adaptive"]), FRAMES)
        found = measured(make_stage(base, frames_to_score(base, FRAMES)), Point(seed=base.seed))
        values.append(found.db["adaptive", "all"] or 0.0)
    return f"Every second patch instead of each changes the score by {values[1] - values[0]:+.2f} dB. "


def _said(stage: str, done: int, total: int) -> None:
    print(f"{stage}: {done} of {total}", flush=True)


_HEAD = """# What misalignment may be

Written by `make tolerances` for the demo, and by `make tolerances-prototype` for the paper's prototype: how
much of each misalignment costs 1 dB, what each effect costs, and how many cameras would be good if every
part drifted like a bad specimen after its calibration. [prototype.md](prototype.md) says in plain words
what that means for the design. The pages of all studies, with pairs and curves, stand in
`reports/runs/tolerances`.

"""

if __name__ == "__main__":
    main(sys.argv[1:])
