"""The comparison of the paper's figure 4: all schemes, same scenes, same camera, by region and phase.

``make figure4`` runs the preset ``figure4`` on each scene (half an hour on two cores, minutes when the
truth is in the cache) and writes ``reports/figure4.md``. Nothing is asserted: what was registered before
measuring (:mod:`optsim.metrics.hypothesis`) is printed with its verdict, whichever it is. The priors
were trained on none of these scenes; ``half_moving`` shares some textures with the training scene, the
others do not but for stripes.
"""

from __future__ import annotations

import sys
from pathlib import Path

from optsim.experiment import load_experiment
from optsim.files import write_text
from optsim.job import execute, run_folder
from optsim.report.headline import Row, table
from optsim.report.schema import Phase, Results

SCENES = ("window_room", "half_moving", "night_street")
OUT = Path("reports") / "figure4.md"
_METRICS = (("PU21-PSNR", "dB"), ("log-RMSE", "stops"))
_REGIONS = ("moving", "static", "all")
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
        folder = run_folder(experiment, Path("reports") / "runs" / f"figure4-{name}")
        results = execute(experiment, folder, command="make figure4", progress=_say)
        parts.append(section(results))
    write_text(OUT, "\n".join(parts))
    print(f"tables: {OUT}")


def section(results: Results) -> str:
    """Tables of one run as Markdown."""
    scene = results["scene"]
    lines = [f"## {scene['name']}", "", f"{scene['description']}. Photoelectrons a pixel and frame, mean:"]
    lines += [", ".join(f"{row['method']} {row['mean_e']:.0f}" for row in results["photons"]) + "."]
    lines += ["", f"Run {results['finished_utc']}, optsim {results['versions']['optsim']}.", ""]
    for phase, words in _PHASES:
        heads = [f"{region}, {unit}" for _, unit in _METRICS for region in _REGIONS]
        lines += [f"**{words}**", "", "| method | " + " | ".join(heads) + " |"]
        lines += ["| --- " * (1 + len(heads)) + "|"]
        rows = table(results, phase)
        chosen = [
            next(row for row in rows if row.metric.startswith(metric) and row.region == region)
            for metric, _ in _METRICS
            for region in _REGIONS
        ]
        for place, method in enumerate(results["methods"]):
            cells = " | ".join(_cell(row, place) for row in chosen)
            lines.append(f"| {method} | {cells} |")
        lines.append("")
    lines.append("What was registered before measuring:")
    lines.append("")
    for verdict in results["hypothesis"]:
        word = {True: "holds", False: "fails", None: "not measured"}[verdict["passed"]]
        lines.append(f"- {verdict['claim']}: **{word}**, {verdict['measured']}.")
    return "\n".join([*lines, ""])


def _cell(row: Row, place: int) -> str:
    score = row.scores[place]
    if score is None or score["value"] is None:
        return "-"
    text = f"{score['value']:.2f}"
    return f"**{text}**" if score["value"] == row.best else text


def _say(stage: str, done: int, total: int) -> None:
    if done == total:
        print(f"{stage}: done", flush=True)


_HEAD = """# All schemes on the same scenes

Written by `make figure4`. One camera (nominal, as a bench calibrates it), one f-number, density and gain
for all schemes; 160 x 120 panel pixels, ten coded frames of 36 slots, a hypothetical latency of one
frame. PU21-PSNR in dB, the more the better, and the error of the logarithm in stops, the less the
better; both on pixels that all methods hold valid, where the truth moves, where it doesn't, and on all.
Bold: the best. Decoders are those of the preset `figure4`: `adaptive_mean` and `random_mean` average
dictionary and mixture, `random_union` has the adaptive scheme's decoder without its codes; the flutter
shutter is decoded with the mixture, which was better here than `motion_deblurring`, its natural decoder
(by 0.9 dB where window_room moves).
"""

if __name__ == "__main__":
    main(sys.argv[1:])
