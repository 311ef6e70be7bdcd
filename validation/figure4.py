"""The comparison of the paper's figure 4: all schemes, same scenes, same camera, by region and phase.

``make figure4`` runs the preset ``figure4`` on each scene (about an hour on two cores, half of it when the
truth is in the cache) and writes ``reports/figure4.md``: first all schemes at one f-number, then each at its
own (:mod:`optsim.study.own_f_number`). Stopped, the same command goes on: what a scene gave is kept until
the code changes. Nothing is judged: one draw decides no claim (``make claims``). The priors were trained on
none of these scenes; ``half_moving`` shares some textures with the training scene, the others do not but for
stripes.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from kept import kept

from optsim.core.files import write_text
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.job import execute, run_folder
from optsim.experiment.truth import render_truth
from optsim.metrics.records import Phase, Score
from optsim.report.headline import Row, table
from optsim.report.markdown import markdown_table
from optsim.report.schema import Results, check_results
from optsim.study.own_f_number import OwnLight, compare

SCENES = ("window_room", "half_moving", "night_street")
OUT, RUNS = Path("reports") / "figure4.md", Path("reports") / "runs"
_METRICS = (("PU21-PSNR", "dB"), ("log-RMSE", "stops"))
_REGIONS = ("moving", "static", "all")
_HEADS = tuple(f"{region}, {unit}" for _, unit in _METRICS for region in _REGIONS)
_PHASES: tuple[tuple[Phase, str], ...] = (
    ("steady", "Steady"),
    ("merging", "Merging: fewer than four frames of a mosaic"),
    ("warm-up", "Warm-up: no motion known yet"),
)


def main(names: list[str]) -> None:
    """Run the scenes named, or all, and write the tables."""
    parts = [_HEAD]
    for name in names or SCENES:
        experiment = load_experiment("figure4", [f"scene.name={name}"])
        folder = RUNS / f"figure4-{name}"
        results = kept(RUNS / f"{folder.name}.json", experiment, partial(_run, experiment, folder))
        own = kept(RUNS / f"{folder.name}-own.json", experiment, partial(_compare, experiment))
        parts += [
            section(check_results(results)),
            own_section(_own_light(own)),
        ]
        write_text(OUT, "\n".join(parts))
    print(f"tables: {OUT}")


def _run(experiment: Experiment, folder: Path) -> dict[str, Any]:
    return execute(
        experiment, run_folder(experiment, folder), command="make figure4", progress=_say
    ).as_json()


def _own_light(own: dict[str, Any]) -> OwnLight:
    return OwnLight(**{**own, "scores": [Score(**each) for each in own["scores"]]})


def _compare(experiment: Experiment) -> dict[str, Any]:
    own = compare(experiment, render_truth(experiment), progress=_say)
    return {**asdict(own), "scores": [each.as_json() for each in own.scores]}


def section(results: Results) -> str:
    """Tables of one run as Markdown."""
    scene = results.scene
    lines = [f"## {scene.name}", "", f"{scene.description}. Photoelectrons a pixel and frame, mean:"]
    lines += [", ".join(f"{row.method} {row.mean_e:.0f}" for row in results.photons) + "."]
    lines += ["", f"Run {results.finished_utc}, optsim {results.versions['optsim']}.", ""]
    for phase, words in _PHASES:
        cells = _cells(results.scores, list(results.methods), phase)
        lines += [f"**{words}**", "", *markdown_table(("method", *_HEADS), _named(cells)), ""]
    return "\n".join([*lines, ""])


def own_section(own: OwnLight) -> str:
    """Steady phase of the methods each at its own f-number, as Markdown."""
    facts = {
        name: [
            f"f/{own.f_numbers[name]:.2g}",
            f"{own.open_shares[name]:.0%}",
            f"{own.filled[name]:.0%}",
            f"{own.mean_e[name]:.0f}",
        ]
        for name in own.f_numbers
    }
    scores = _cells(own.scores, list(facts), "steady")
    heads = ("method", "f-number", "open", "fills", "electrons", *_HEADS)
    return "\n".join(
        [
            "### Each at its own f-number",
            "",
            "**Steady**",
            "",
            *markdown_table(heads, _named({name: facts[name] + scores[name] for name in facts})),
            "",
        ]
    )


def _named(cells: Mapping[str, Sequence[str]]) -> list[list[str]]:
    return [[name, *row] for name, row in cells.items()]


def _cells(scores: Sequence[Score], methods: Sequence[str], phase: Phase) -> dict[str, list[str]]:
    """Scores of each method in a phase; the best of them bold."""
    rows = table(scores, methods, phase)
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


_HEAD = """# All schemes on the same scenes

Written by `make figure4`. One camera (nominal, as a bench calibrates it), one f-number, density and gain
for all schemes, and then, under its own heading, each scheme at its own; 160 x 120 panel pixels, ten coded
frames of 36 slots, a hypothetical latency of one frame. PU21-PSNR in dB, the more the better, and the error
of the logarithm in stops, the less the better; both on pixels that all methods hold valid, where the truth
moves, where it doesn't, and on all. Bold: the best.

Decoders are those of the preset `figure4`: `adaptive_mean` and `random_mean` average dictionary and mixture,
`random_union` has the adaptive scheme's decoder without its codes; the flutter shutter is decoded with the
mixture, which was better here than `motion_deblurring`, its natural decoder (by 0.9 dB where window_room
moves).

No prior was trained on any of these scenes, but two numbers of the adaptive scheme and its decoder were
chosen on `window_room` and `half_moving` (`least_change`, `fade_px`), and some textures of `half_moving` are
on other things in what priors learned from, as are the stripes of the other two. On `night_street` nothing
was chosen.

Each at its own f-number: the lens opens, by third stops to f/1.4, until a scheme's own fullest exposure
(open: its share of one that is on for ever) does what the rule asks of the all-on code, fills 80 % of the
well at the interior's 90th percentile; a density takes what is over, and nothing is stopped down. The relay
opens with the lens. Faster lenses are taken to be as well corrected, in waves, as the nominal one, which
favours schemes that open pixels briefly and is not validated; all see the scene with the shared aperture's
depth of field. Regions are those of the shared camera; pixels those that all hold valid.
"""

if __name__ == "__main__":
    main(sys.argv[1:])
