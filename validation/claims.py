"""The registered claims, measured over seeds and phases of motion.

``make claims`` (about an hour and a half on two cores, half of it when the truth is in the cache) renders
each scene once for long enough and takes six windows of ten coded frames out of it. Each has its own seed for
bench, codes and photons; :mod:`optsim.metrics.claims` judges by the six. The page is
``reports/claims.md``, its numbers ``reports/figures/claims.json``. What a draw found is kept until the code
changes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

from kept import kept

from optsim.core.files import write_json, write_text
from optsim.core.quantities import RadianceVideo
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import run
from optsim.experiment.scoring import no_rivals, scorer_of
from optsim.experiment.truth import render_truth
from optsim.metrics import judge_claims, measured
from optsim.metrics.pairs import advantage
from optsim.metrics.records import PairRecord, Verdict
from optsim.report.markdown import markdown_table

OUT, FIGURES = Path("reports") / "claims.md", Path("reports") / "figures" / "claims.json"
KEPT = Path("reports") / "runs" / "claims"
FRAMES = 10
# First coded frame of each draw. A car crosses night_street in two seconds: its draws begin close together.
STARTS = {
    "window_room": (0, 5, 10, 15, 20, 25),
    "half_moving": (0, 5, 10, 15, 20, 25),
    "night_street": (0, 1, 2, 0, 1, 2),
}
METHODS = ("adaptive", "hdr_mosaic", "random", "random_union")


def main(names: list[str]) -> None:
    """Measure the scenes named, or all, and write the page."""
    found: dict[str, Any] = {}
    for name in names or STARTS:
        draws = [_draw(name, number) for number in range(len(STARTS[name]))]
        found[name] = {
            "verdicts": judge_claims([_pairs(draw) for draw in draws], draws[0]["no_rivals"]),
            "draws": draws,
        }
        write_text(OUT, page(found))
        write_json(FIGURES, {scene: figures(each) for scene, each in found.items()})
    print(f"page: {OUT}")


def _draw(name: str, number: int) -> dict[str, Any]:
    """Take one draw: its pairs, and how much of its picture moves."""
    start, frames = STARTS[name][number], max(STARTS[name]) + FRAMES
    whole = _experiment(name, frames)
    one = _experiment(name, FRAMES).model_copy(update={"seed": number + 1})
    path = KEPT / f"{name}-{number + 1}.json"
    return kept(path, one, partial(_measure, whole, one, start))


def _experiment(name: str, n_frames: int) -> Experiment:
    loaded = load_experiment("figure4", [f"scene.name={name}", f"n_frames={n_frames}"])
    methods = tuple(method for method in loaded.methods if method.name in METHODS)
    return loaded.model_copy(update={"methods": methods, "save_reconstructions": ()})


def _measure(whole: Experiment, one: Experiment, start: int) -> dict[str, Any]:
    result = run(one, excerpt(render_truth(whole, progress=_say), start, one.timing.n_slots, one))
    scorer = scorer_of(result)
    masks = scorer.masks(result.frames)["pooled_masks"]
    steady = next(row for row in masks if row.phase == "steady")
    print(f"{one.scene}, seed {one.seed}: done", flush=True)
    return {
        "seed": one.seed,
        "first_frame": start,
        "moves": steady.moves,
        "pairs": [each.as_json() for each in scorer.pair_records()],
        "no_rivals": no_rivals(one),
    }


def excerpt(video: RadianceVideo, first_frame: int, n_slots: int, experiment: Experiment) -> RadianceVideo:
    """Cut some coded frames out of a longer truth, its noise too."""
    first = first_frame * experiment.timing.slots_per_frame // video.slots_per_segment
    half = video.half_difference
    return replace(
        video,
        n_slots=n_slots,
        load=lambda index: video.load(first + index),
        half_difference=None if half is None else excerpt(half, first_frame, n_slots, experiment),
    )


def figures(scene: dict[str, Any]) -> dict[str, Any]:
    """Arrange a scene's verdicts by region and area, for prose to quote."""
    of_region: dict[str, Any] = {}
    for verdict in cast("list[Verdict]", scene["verdicts"]):
        said = {**verdict.as_json(), "behind": -(verdict.advantage or 0.0), "measured": measured(verdict)}
        of_region.setdefault(verdict.region, {})[verdict.area] = said
    moves = [draw["moves"] for draw in scene["draws"]]
    return {**of_region, "moves": sum(moves) / len(moves), "draws": len(moves)}


def page(found: dict[str, Any]) -> str:
    """Write the verdicts, and the draws behind them, as Markdown."""
    parts = [_HEAD]
    for name, scene in found.items():
        verdicts, draws = (
            cast("list[Verdict]", scene["verdicts"]),
            cast("list[dict[str, Any]]", scene["draws"]),
        )
        share = sum(draw["moves"] for draw in draws) / len(draws)
        parts += [f"## {name}", "", f"{share:.0%} of the picture moves.", ""]
        rows = [[v.claim, v.area, f"**{v.said}**", measured(v)] for v in verdicts]
        parts += [*markdown_table(("claim", "area", "verdict", "the adaptive scheme is ahead by"), rows), ""]
        parts += ["Draw by draw, over the nearest rival:", ""]
        heads = ["seed", "first frame", "moves", *(f"{_short(v)}, {v.unit}" for v in verdicts)]
        parts += [*markdown_table(heads, [_row(draw, verdicts) for draw in draws]), ""]
    return "\n".join(parts)


def _short(verdict: Verdict) -> str:
    return f"{verdict.region}, {verdict.area}"


def _row(draw: dict[str, Any], verdicts: Sequence[Verdict]) -> list[str]:
    cells = [str(draw["seed"]), str(draw["first_frame"]), f"{draw['moves']:.1%}"]
    for v in verdicts:
        wanted = (v.metric, v.region, v.area, v.rival)
        values = [advantage(r) for r in _pairs(draw) if (r.metric, r.region, r.area, r.rival) == wanted]
        value = values[0] if values else None
        cells.append("-" if value is None else f"{value:+.3f}")
    return cells


def _pairs(draw: dict[str, Any]) -> list[PairRecord]:
    return [PairRecord(**each) for each in draw["pairs"]]


def _say(stage: str, done: int, total: int) -> None:
    if done == total:
        print(f"{stage}: done", flush=True)


_HEAD = """# The registered claims

Written by `make claims`. The claims and how they are judged stand in `optsim/metrics/claims.py`, where they
were registered in this form before these draws were taken. One camera (nominal, as a bench calibrates it),
one f-number for all; 160 x 120 panel pixels, ten coded frames a draw, the steady phase of them. Each draw has
its own seed, for bench, codes and photons, and begins at another moment of the motion.

The intervals are of 95 %. Every score is of the pixels that both methods of a pair hold valid. The window is
the bright outside with the pixels that see any of it; a scene without one is all room.

"""

if __name__ == "__main__":
    main(sys.argv[1:])
