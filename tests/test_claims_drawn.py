"""How ``make claims`` draws and writes: rivals, latencies, moments, and what its files hold."""

import itertools
import json
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from programs import program
from scipy import stats
from small_experiment import COLS, ROWS, moving_bar

from optsim.experiment.experiment import load_experiment
from optsim.experiment.loop import Result, run
from optsim.experiment.scoring import scorer_of
from optsim.metrics.claims import CLAIMS, LEAST_DRAWS
from optsim.metrics.records import PairRecord, Verdict

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def claims() -> ModuleType:
    return program("claims")


def test_draws_of_one_motion_begin_a_coded_frame_apart(claims: ModuleType) -> None:
    for name, draws in claims.DRAWS.items():
        assert len(draws) == LEAST_DRAWS, name
        for (one, first), (other, second) in itertools.combinations(draws, 2):
            assert one != other or abs(first - second) >= 1, name


def test_rivals_are_all_of_figure_4_at_the_hardwares_latency_first(claims: ModuleType) -> None:
    hardware = load_experiment("paper_prototype").camera.latency_frames
    assert list(claims.LATENCIES) == [hardware, load_experiment("demo").camera.latency_frames]
    found = claims.experiment_of("night_street", "away", hardware, 5)
    assert [m.name for m in found.methods] == [m.name for m in load_experiment("figure4").methods]
    assert found.scene is not None
    assert (found.camera.latency_frames, found.n_frames, found.scene.variation) == (hardware, 5, "away")


def made_up(number: int, near: float) -> dict[str, object]:
    """A draw: every rival of every claim, of which ``flutter`` is the nearest."""
    pairs = [
        PairRecord(
            rival=rival,
            metric=claim.metric,
            unit=claim.unit,
            higher_is_better=claim.unit == "dB",
            area="room",
            region=claim.region,
            ours=20.0,
            theirs=20.0 - (1 if claim.unit == "dB" else -1) * (near + far),
            excluded=0.0,
            ours_of_all=20.0,
            theirs_of_all=20.0,
        ).as_json()
        for claim in CLAIMS
        for rival, far in (("flutter", 0.0), ("random", 1.0), ("grid", 2.0), ("adaptive_mean", -9.0))
    ]
    about = {"seed": number + 1, "variation": "main", "first_frame": number, "moves": 0.25}
    return {**about, "pairs": pairs, "no_rivals": ["adaptive_mean"]}


@pytest.mark.slow
def test_a_draw_at_another_latency_is_a_run_at_it(claims: ModuleType) -> None:
    """Codes that know no latency are not taken again, and nothing else changes."""

    def taken(latency: int) -> Result:
        keys = [
            "n_frames=6",
            f"camera.panel_rows={ROWS}",
            f"camera.panel_cols={COLS}",
            f"camera.sensor.rows={3 * ROWS + 8}",
            f"camera.sensor.cols={3 * COLS + 8}",
            f"camera.latency_frames={latency}",
            "camera.relay.field_error=0.2",
            "calibration=true",
        ]
        experiment = load_experiment("figure4", keys)
        methods = [m for m in experiment.methods if m.name in ("adaptive", "hdr_mosaic", "closed_loop")]
        experiment = experiment.model_copy(update={"methods": tuple(methods)})
        return run(experiment, moving_bar(experiment, 1.0))

    late, early = taken(2), taken(1)
    again = claims.at_latency(late, 1)
    assert again.experiment == early.experiment
    for name, frames in early.frames.items():
        for one, other in zip(frames, again.frames[name], strict=True):
            np.testing.assert_array_equal(one.dn, other.dn)
    arrived = zip(late.frames["adaptive"], early.frames["adaptive"], strict=True)
    assert any((one.dn != other.dn).any() for one, other in arrived)
    pairs = scorer_of(early).pair_records()
    assert pairs
    assert scorer_of(again).pair_records() == pairs


def test_page_and_figures_hold_the_draws_verdicts(claims: ModuleType) -> None:
    near = [-3.6, -4.1, -3.2, -3.9]
    found = {3: {"night_street": claims.judged([made_up(k, each) for k, each in enumerate(near)])}}
    figures = claims.all_figures(found)["latency_3"]["night_street"]
    said = figures["moving"]["room"]
    assert (said["said"], said["rival"], said["rivals"]) == ("too few draws (4 of 6): fails", "flutter", 3)
    half = stats.t.ppf(1 - 0.025 / 3, 3) * stats.sem(near)
    mean = sum(near) / 4
    assert (said["low"], said["high"]) == pytest.approx((mean - half, mean + half))
    behind = figures["behind_adaptive"]
    assert behind["grid"] == pytest.approx(dict.fromkeys(("moving", "static", "all"), mean + 2))
    assert behind["adaptive_mean"]["all"] == pytest.approx(mean - 9), "those that are no rivals, too"
    page = claims.page(found)
    assert "## Latency 3, the hardware's" in page
    assert f"| **too few draws (4 of 6): fails** | {mean:+.2f} dB over flutter" in page
    assert "4 draws, 95 % for 3 rivals together (Bonferroni))" in page
    assert "| 2 | main | 1 | 25.0% | -4.100 |" in page


def test_each_claim_has_the_bound_that_was_registered(claims: ModuleType) -> None:
    """A loss of 0.05 is a sixth of the 0.3 dB that are allowed, and five times the 0.01 stops."""
    near = [-0.051, -0.049, -0.05, -0.05, -0.052, -0.048]
    verdicts = claims.judged([made_up(k, each) for k, each in enumerate(near)])["verdicts"]
    assert [(v.unit, v.verdict) for v in verdicts] == [("dB", "holds"), ("dB", "holds"), ("stops", "fails")]
    near = [-0.35 + each for each in (0.001, -0.001, 0, 0, 0.002, -0.002)]
    verdicts = claims.judged([made_up(k, each) for k, each in enumerate(near)])["verdicts"]
    assert [v.verdict for v in verdicts] == ["fails"] * 3


def test_figure_4_compares_each_rival_on_its_own_pixels(claims: ModuleType) -> None:
    near = [-3.6, -4.1, -3.2, -3.9]
    page = claims.figure4({1: {"half_moving": claims.judged([made_up(k, v) for k, v in enumerate(near)])}})
    mean, half = sum(near) / 4, stats.t.ppf(0.975, 3) * stats.sem(near)
    assert "## Latency 1, the demo's\n\n### half_moving, room" in page
    static = f"{20 - mean:.2f} | {mean:+.2f} ± {half:.2f}"
    row = f"| flutter | {static} | {static} | {20 + mean:.3f} | {mean:+.3f} ± {half:.3f} |"
    assert row in page
    assert f"| grid | {20 - mean - 2:.2f} | {mean + 2:+.2f} ± {half:.2f} |" in page


def test_stored_verdicts_follow_from_their_intervals() -> None:
    """By other code than that which wrote them."""
    stored = json.loads((ROOT / "reports" / "figures" / "claims.json").read_text())
    page = (ROOT / "reports" / "claims.md").read_text()
    found, headline = 0, stored["latency_3"]
    for region, sentence in stored.pop("sentences").items():
        for part in sentence.split("; "):
            verdict, _, places = part.partition(" in ")
            for place in places.split("), "):
                name, advantage = re.findall(r"`(\w+)` \(([-+.\d]+)", place)[0]
                said = headline[name][region]["window" if place.startswith("the window") else "room"]
                assert said["verdict"] == verdict
                assert said["advantage"] == pytest.approx(float(advantage), abs=0.005)
                found += 1
    assert found == sum(
        len(scene.get(r, {})) for scene in headline.values() for r in ("moving", "static", "all")
    )
    for scene in (scene for scenes in stored.values() for scene in scenes.values()):
        for region in ("moving", "static", "all"):
            for said in scene.get(region, {}).values():
                low, high, margin = said["low"], said["high"], said["margin"]
                keeps = "fails" if high < -margin else "holds" if low > -margin else "undecided"
                ahead = "fails" if high < 0 else "holds" if low > 0 else "undecided"
                for key, own in (("verdict", keeps), ("superior", ahead)):
                    # Other rivals can only worsen what the interval over the best one says.
                    assert said[key] == own or (said["rivals"] > 1 and own == "holds")
                assert ("too few draws" in said["said"]) == (said["draws"] < LEAST_DRAWS)
                known = {key: said[key] for key in Verdict.model_fields}
                assert Verdict(**known).said == said["said"]
                assert f"**{said['said']}** | {said['measured']} |" in page
                found += 1
    assert found > 20


def test_variants_of_fidelity_are_of_the_code_as_it_is() -> None:
    """Each names a key, or what it replaces; both may be renamed."""
    fidelity = program("fidelity")
    for variant in fidelity.VARIANTS:
        load_experiment("demo", fidelity.keys_of(variant))
        with fidelity.changed(variant):
            pass
