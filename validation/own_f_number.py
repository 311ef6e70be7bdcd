"""All schemes on the same scenes, each at its own f-number (:mod:`optsim.study.own_f_number`).

``make own-f-number`` runs the preset ``figure4`` on each scene (half an hour on two cores) and writes
``reports/own_f_number.md``. Stopped, the same command goes on: what a scene gave is kept until the code
changes. One draw decides nothing; ``make claims`` has intervals, at one f-number for all.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from kept import kept

from optsim.core.files import write_text
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.truth import render_truth
from optsim.metrics.records import Score
from optsim.report.headline import Row, table
from optsim.report.words import markdown_table
from optsim.study.own_f_number import OwnLight, compare

SCENES = ("window_room", "half_moving", "night_street")
OUT, RUNS = Path("reports") / "own_f_number.md", Path("reports") / "runs"
_METRICS = (("PU21-PSNR", "dB"), ("log-RMSE", "stops"))
_REGIONS = ("moving", "static", "all")
_HEADS = tuple(f"{region}, {unit}" for _, unit in _METRICS for region in _REGIONS)


def main(names: list[str]) -> None:
    """Run the scenes named, or all, and write the tables."""
    parts = [_HEAD]
    for name in names or SCENES:
        experiment = load_experiment("figure4", [f"scene.name={name}"])
        own = kept(RUNS / f"own-f-number-{name}.json", experiment, partial(_compare, experiment))
        parts.append(section(name, _own_light(own)))
        write_text(OUT, "\n".join(parts))
    print(f"tables: {OUT}")


def _own_light(own: dict[str, Any]) -> OwnLight:
    return OwnLight(**{**own, "scores": [Score(**each) for each in own["scores"]]})


def _compare(experiment: Experiment) -> dict[str, Any]:
    own = compare(experiment, render_truth(experiment), progress=_say)
    return {**asdict(own), "scores": [each.as_json() for each in own.scores]}


def section(name: str, own: OwnLight) -> str:
    """Steady phase of a scene's methods, as Markdown."""
    facts = {
        name: [
            f"f/{own.f_numbers[name]:.2g}",
            f"{own.open_shares[name]:.0%}",
            f"{own.filled[name]:.0%}",
            f"{own.mean_e[name]:.0f}",
        ]
        for name in own.f_numbers
    }
    scores = _cells(own.scores, list(facts))
    heads = ("method", "f-number", "open", "fills", "electrons", *_HEADS)
    return "\n".join(
        [
            f"## {name}",
            "",
            *markdown_table(heads, [[method, *facts[method], *scores[method]] for method in facts]),
            "",
        ]
    )


def _cells(scores: Sequence[Score], methods: Sequence[str]) -> dict[str, list[str]]:
    """Scores of each method in the steady phase; the best of them bold."""
    rows = table(scores, methods, "steady")
    chosen = [
        next(row for row in rows if row.metric.startswith(metric) and row.region == region)
        for metric, _ in _METRICS
        for region in _REGIONS
    ]
    return {name: [_cell(row, place) for row in chosen] for place, name in enumerate(methods)}


def _cell(row: Row, place: int) -> str:
    score = row.scores[place]
    if score is None or score.value is None:
        return "-"
    text = f"{score.value:.2f}"
    return f"**{text}**" if score.value == row.best else text


def _say(stage: str, done: int, total: int) -> None:
    if done == total:
        print(f"{stage}: done", flush=True)


_HEAD = """# Each scheme at its own f-number

Written by `make own-f-number`. [All schemes](figure4.md) of figure 4 in one draw a scene, each at its own
f-number, with a latency of one coded frame. PU21-PSNR in dB and the error of the logarithm in stops, steady
phase, on pixels that all methods hold valid. Bold: the best.

The lens opens, by third stops to f/1.4, until a scheme's own fullest exposure (open: its share of one that is
on for ever) does what the rule asks of the all-on code: fills 80 % of the well at the interior's 90th
percentile. A density takes what is over, and nothing is stopped down. The relay opens with the lens. Faster
lenses are taken to be as well corrected, in waves, as the nominal one. That favours schemes that open pixels
briefly and is not validated. All see the scene with the shared aperture's depth of field. Regions are those
of the shared camera.
"""

if __name__ == "__main__":
    main(sys.argv[1:])
