"""The paper's figure 4 and the registered claims, measured over seeds and phases of motion.

``make claims`` takes hours: six draws a scene of all methods of figure 4, at two latencies. It renders each
scene once for long enough and cuts windows of ten coded frames out of it. Each has its own seed for bench,
codes and photons, and begins at least a coded frame before or after any other of the same motion;
:mod:`optsim.metrics.claims` judges by the six. The pages are ``reports/claims.md`` and
``reports/figure4.md``, the verdicts' numbers ``reports/figures/claims.json``. What a draw found is kept until
the code changes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any, cast

from kept import kept
from single_pixel import SINGLE_PIXEL, with_single_pixel

from optsim.coding import PeriodicScheme
from optsim.core.files import write_json, write_text
from optsim.core.quantities import RadianceVideo, Reconstruction
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import Result, capture, decode, run
from optsim.experiment.scoring import no_rivals, scorer_of
from optsim.experiment.truth import render_truth
from optsim.metrics import judge_claims, measured
from optsim.metrics.claims import CLAIMS, Claim
from optsim.metrics.pairs import advantage
from optsim.metrics.records import AREAS, PairRecord, Verdict
from optsim.metrics.student import half_width
from optsim.report.words import markdown_table

REPORTS = Path("reports")
OUT, FIGURE4, FIGURES = REPORTS / "claims.md", REPORTS / "figure4.md", REPORTS / "figures" / "claims.json"
KEPT = Path("reports") / "runs" / "claims"
FRAMES = 10
LATENCIES = {3: "the hardware's", 1: "the demo's"}
"""Coded frames until a frame decides codes; verdicts at the first are the headline."""
_APART = tuple(("main", start) for start in (0, 5, 10, 15, 20, 25))
# Variation of the scene and first coded frame of each draw. A car crosses night_street in two seconds, one
# way or the other: later draws would see none in their steady phase.
DRAWS = {
    "window_room": _APART,
    "half_moving": _APART,
    "night_street": tuple((way, start) for way in ("main", "away") for start in (0, 1, 2)),
}
_FORMS = {"moving": "+.2f", "static": "+.2f", "all": "+.3f"}
_VERDICTS = "holds", "undecided", "fails"
Found = dict[int, dict[str, Any]]
"""Latency -> scene -> verdicts and draws."""


def main(names: list[str]) -> None:
    """Measure the scenes named, or all, and write the page."""
    found: Found = {latency: {} for latency in LATENCIES}
    for name in names or DRAWS:
        draws = [_draw(name, number) for number in range(len(DRAWS[name]))]
        for latency in LATENCIES:
            found[latency][name] = judged([draw[str(latency)] for draw in draws])
        write_text(OUT, page(found))
        write_text(FIGURE4, figure4(found))
        write_json(FIGURES, all_figures(found))
    print(f"pages: {OUT}, {FIGURE4}")


def judged(draws: list[dict[str, Any]]) -> dict[str, Any]:
    """Judge the claims by the draws of a scene."""
    return {"verdicts": judge_claims([_pairs(draw) for draw in draws], draws[0]["no_rivals"]), "draws": draws}


def _draw(name: str, number: int) -> dict[str, Any]:
    """Take one draw: by latency its pairs, and how much of its picture moves."""
    way, start = DRAWS[name][number]
    last = max(first for each, first in DRAWS[name] if each == way)
    headline = next(iter(LATENCIES))
    whole = experiment_of(name, way, headline, last + FRAMES)
    one = experiment_of(name, way, headline, FRAMES).model_copy(update={"seed": number + 1})
    return kept(KEPT / f"{name}-{number + 1}.json", one, partial(_measure, whole, one, start))


def experiment_of(name: str, variation: str, latency: int, n_frames: int) -> Experiment:
    """Return figure 4 on a scene: all its methods are rivals."""
    keys = [f"scene.name={name}", f"scene.variation={variation}", f"camera.latency_frames={latency}"]
    loaded = load_experiment("figure4", [*keys, f"n_frames={n_frames}"])
    return loaded.model_copy(update={"save_reconstructions": ()})


def _measure(whole: Experiment, one: Experiment, start: int) -> dict[str, Any]:
    truth = excerpt(render_truth(whole, progress=_say), start, one.timing.n_slots, one)
    result = with_single_pixel(run(one, truth))
    found = {str(latency): _found(at_latency(result, latency), start) for latency in LATENCIES}
    print(f"{one.scene}, seed {one.seed}: done", flush=True)
    return found


def at_latency(result: Result, latency: int) -> Result:
    """Run those methods again that learn from arrived frames; the codes of the others know no latency."""
    if result.camera.latency_frames == latency:
        return result
    late = {"latency_frames": latency}
    camera = result.camera.model_copy(update=late)
    whole = result.experiment
    whole = whole.model_copy(update={"camera": whole.camera.model_copy(update=late)})
    learning = [each for each in whole.methods if not isinstance(each.scheme, PeriodicScheme)]
    part = whole.model_copy(update={"methods": tuple(learning)})
    frames = capture(part, camera, result.truth, result.calibrations)
    videos: dict[str, tuple[Reconstruction, ...]] = {each.name: () for each in learning}
    for decoded in decode(part, frames, result.calibrations):
        for name, video in decoded.videos.items():
            videos[name] += (video,)
    return replace(
        result,
        experiment=whole,
        camera=camera,
        frames=result.frames | frames,
        reconstructions=result.reconstructions | videos,
    )


def _found(result: Result, start: int) -> dict[str, Any]:
    """Score a draw."""
    one, scorer = result.experiment, scorer_of(result)
    masks = scorer.masks(result.frames)["pooled_masks"]
    steady = next(row for row in masks if row.phase == "steady")
    return {
        "seed": one.seed,
        "variation": one.scene.variation if one.scene else "",
        "first_frame": start,
        "moves": steady.moves,
        "pairs": [each.as_json() for each in scorer.pair_records()],
        # It has another sensor, and the claims were registered without it.
        "no_rivals": [*no_rivals(one), SINGLE_PIXEL],
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


def all_figures(found: Found) -> dict[str, Any]:
    """Arrange all verdicts by latency and scene, with the sentences of the headline's latency."""
    arranged = {
        f"latency_{latency}": {name: figures(each) for name, each in scenes.items()}
        for latency, scenes in found.items()
    }
    return arranged | {"sentences": sentences(arranged[f"latency_{next(iter(LATENCIES))}"])}


def sentences(scenes: dict[str, Any]) -> dict[str, str]:
    """Say of each region in which scenes its claim holds, is undecided and fails, with the advantages."""
    found: dict[str, dict[str, list[str]]] = {}
    for name, regions in scenes.items():
        for region, form in _FORMS.items():
            for area, each in regions.get(region, {}).items():
                place = f"`{name}`" if area == "room" else f"the window of `{name}`"
                said = f"{place} ({each['advantage']:{form}})"
                found.setdefault(region, {}).setdefault(each["verdict"], []).append(said)
    return {
        region: "; ".join(f"{verdict} in {', '.join(by[verdict])}" for verdict in _VERDICTS if verdict in by)
        for region, by in found.items()
    }


def figures(scene: dict[str, Any]) -> dict[str, Any]:
    """Arrange a scene's verdicts by region and area, for prose to quote."""
    of_region: dict[str, Any] = {}
    for verdict in cast("list[Verdict]", scene["verdicts"]):
        more = {"behind": -(verdict.advantage or 0.0), "said": verdict.said, "measured": measured(verdict)}
        of_region.setdefault(verdict.region, {})[verdict.area] = verdict.as_json() | more
    moves = [draw["moves"] for draw in scene["draws"]]
    pairs = [pair for draw in scene["draws"] for pair in _pairs(draw)]
    in_window = behind_adaptive([pair for pair in pairs if pair.area == "window"])
    return {
        **of_region,
        "behind_adaptive": behind_adaptive([pair for pair in pairs if pair.area == "room"]),
        **({"behind_adaptive_in_window": in_window} if in_window else {}),
        "moves": sum(moves) / len(moves),
        "draws": len(moves),
    }


def behind_adaptive(pairs: Sequence[PairRecord]) -> dict[str, dict[str, float]]:
    """Mean over the draws of the adaptive scheme's advantage, by rival and the claims' regions."""
    found: dict[str, dict[str, float]] = {}
    for rival in dict.fromkeys(pair.rival for pair in pairs):
        for claim in CLAIMS:
            if ahead := _advantages(_of_claim(pairs, rival, claim)):
                found.setdefault(rival, {})[claim.region] = fmean(ahead)
    return found


def _of_claim(pairs: Sequence[PairRecord], rival: str, claim: Claim) -> list[PairRecord]:
    wanted = (rival, claim.metric, claim.region)
    return [each for each in pairs if (each.rival, each.metric, each.region) == wanted]


def _advantages(pairs: Sequence[PairRecord]) -> list[float]:
    return [gain for each in pairs if (gain := advantage(each)) is not None]


def page(found: Found) -> str:
    """Write the verdicts, and the draws behind them, as Markdown."""
    parts = [_HEAD]
    for latency, scenes in found.items():
        parts += [f"## Latency {latency}, {LATENCIES[latency]}", ""]
        for name, scene in scenes.items():
            parts += _of_scene(name, scene["verdicts"], scene["draws"])
    return "\n".join(parts)


def figure4(found: Found) -> str:
    """Write every method's scores, and the adaptive scheme's advantage over it, as Markdown."""
    parts = [_FIGURE4]
    for latency, scenes in found.items():
        parts += [f"## Latency {latency}, {LATENCIES[latency]}", ""]
        for name, scene in scenes.items():
            pairs = [pair for draw in scene["draws"] for pair in _pairs(draw)]
            for area in (each for each in AREAS if any(pair.area == each for pair in pairs)):
                parts += [f"### {name}, {area}", "", *_of_area([p for p in pairs if p.area == area]), ""]
    return "\n".join(parts)


def _of_area(pairs: Sequence[PairRecord]) -> list[str]:
    """Tabulate the means over the draws of each rival's pair, in each claim's region and metric."""
    heads = [f"{claim.region}, {claim.unit}" for claim in CLAIMS]
    rows: list[list[str]] = []
    for rival in dict.fromkeys(pair.rival for pair in pairs):
        cells: list[str] = []
        for claim in CLAIMS:
            of_claim = _of_claim(pairs, rival, claim)
            theirs = [p.theirs for p in of_claim if p.theirs is not None]
            ahead = _advantages(of_claim)
            digits = 2 if claim.unit == "dB" else 3
            half = half_width(ahead)
            around = "" if half is None else f" ± {half:.{digits}f}"
            cells.append(f"{fmean(theirs):.{digits}f}" if theirs else "-")
            cells.append(f"{fmean(ahead):+.{digits}f}{around}" if ahead else "-")
        rows.append([rival, *cells])
    return markdown_table(("rival", *(cell for head in heads for cell in (head, "adaptive ahead by"))), rows)


def _of_scene(name: str, verdicts: Sequence[Verdict], draws: Sequence[dict[str, Any]]) -> list[str]:
    share = sum(draw["moves"] for draw in draws) / len(draws)
    rows = [[v.claim, v.area, f"**{v.said}**", measured(v)] for v in verdicts]
    heads = ["seed", "variation", "first frame", "moves", *(f"{_short(v)}, {v.unit}" for v in verdicts)]
    return [
        *(f"### {name}", "", f"{share:.0%} of the picture moves.", ""),
        *markdown_table(("claim", "area", "verdict", "the adaptive scheme is ahead by"), rows),
        *("", "Draw by draw, over the best rival:", ""),
        *markdown_table(heads, [_row(draw, verdicts) for draw in draws]),
        "",
    ]


def _short(verdict: Verdict) -> str:
    return f"{verdict.region}, {verdict.area}"


def _row(draw: dict[str, Any], verdicts: Sequence[Verdict]) -> list[str]:
    cells = [str(draw["seed"]), draw["variation"], str(draw["first_frame"]), f"{draw['moves']:.1%}"]
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
its own seed, for bench, codes and photons, and begins at another moment of the motion. Rivals are all schemes
of [figure 4](figure4.md) that this camera can run; the best of them is named.

The intervals are of 95 %, for so many rivals together as each states. Every score is of the pixels that both
methods of a pair hold valid. The window is the bright outside with the pixels that see any of it; a scene
without one is all room.

"""

_FIGURE4 = """# All schemes on the same scenes

Written by `make claims`, from the draws behind the [registered claims](claims.md). One camera (nominal, as a
bench calibrates it), one f-number, density and gain for all schemes; 160 x 120 panel pixels, ten coded frames
of 36 slots a draw, the steady phase of them. [Each at its own f-number](own_f_number.md) has its own page.

PU21-PSNR in dB, the more the better, and the error of the logarithm in stops, the less the better. Each
scheme is compared with the adaptive one on the pixels that both hold valid, so these differ from row to row.
The advantage is the mean over the draws with its 95 % interval (Student), each by itself. Where a scene has
a bright outside, the window is the outside with the pixels that see any of it; all else is the room.

`random_union` has the adaptive scheme's decoder without its codes. `adaptive_paper` is the adaptive scheme
without `growth`, as in the paper: its mask stays where the mover was when a frame arrived. The flutter
shutter is decoded with the mixture, which was better here than `motion_deblurring`, its natural decoder.
`single_pixel` (Wakin et al.) is hypothetical: a photodiode in the CCD's place, read once a slot. No claim is
judged by `adaptive_paper` and `single_pixel`.

No prior was trained on any of these scenes, but two numbers of the adaptive scheme and its decoder were
chosen on `window_room` and `half_moving` (`least_change`, `fade_px`), and some textures of `half_moving` are
on other things in what priors learned from, as are the stripes of the other two. That `growth` joins what
changed and covers half of its way was chosen on one draw of `night_street`, of its first motion.

"""

if __name__ == "__main__":
    main(sys.argv[1:])
