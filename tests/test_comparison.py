"""Comparison of runs: intervals against scipy's, verdicts, realised error rates, files and exit codes."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from made_up_run import make_results
from PIL import Image
from scipy import stats
from test_cli import cli  # noqa: F401  a fixture

from optsim.core.errors import ConfigError, StorageError, ValueCheckError
from optsim.core.files import read_json, write_json
from optsim.metrics.comparison import Judgement, estimate, judge, row_level
from optsim.metrics.tolerances import TOLERANCES
from optsim.report.baseline import Facts, Run, Scored, read_baseline, scored_runs, write_baseline
from optsim.report.comparison import ALL_CASES, Comparison, Delta, between_methods, compare
from optsim.report.comparison_page import write_comparison
from optsim.report.comparison_text import as_junit, as_markdown, as_text

PU21, STOPS = "PU21-PSNR[banding_glare, peak=256]", "log-RMSE[e=0.01 cd/m2] (stops)"
METRICS = {
    PU21: Facts(unit="dB", higher_is_better=True),
    STOPS: Facts(unit="stops", higher_is_better=False),
    "PSNR[peak=white]": Facts(unit="dB", higher_is_better=True),
}
FRAMES = 5
CONTENT = np.array([0.0, 1.5, -1.0, 0.7, 2.0])


_ACCEPTED = [
    ("PU21-PSNR", 0.1),
    ("log-RMSE", 0.01),
    ("mu-law-PSNR", 0.1),
    ("SMAPE", 0.003),
    ("PU21-SSIM", 0.003),
    ("PU21-MS-SSIM", 0.003),
    ("difference-PSNR", 0.1),
    ("one-gain PU21-PSNR", 0.1),
    ("valid share", 0.002),
    ("bench: read noise", 1.0),
    ("bench: gain", 1.0),
    ("bench: saturation", 1.0),
    ("bench: responsivity", 1.0),
    ("bench: crosstalk", 1.5),
    ("bench: pixel map, row", 0.05),
    ("bench: pixel map, column", 0.05),
    ("time: capture", 30.0),
    ("memory: capture", 15.0),
]


def units(values: np.ndarray, first_seed: int = 1) -> dict[tuple[int, int], float]:
    """Values of shape (seed, frame) by seed and frame."""
    return {
        (first_seed + s, f): float(value)
        for s, row in enumerate(np.atleast_2d(values))
        for f, value in enumerate(row)
    }


def judged(a: np.ndarray, b: np.ndarray, tolerance: float = 0.1, level: float = 0.05) -> Judgement:
    found = estimate(units(a), units(b), True)
    assert found is not None
    return judge(found, tolerance, level)


# --- one row --------------------------------------------------------------------------------------


def test_frames_of_one_seed_give_the_paired_interval_of_scipy() -> None:
    rng = np.random.default_rng(1)
    a, b = 20 + CONTENT, 20 + CONTENT + rng.normal(0.2, 0.1, FRAMES)
    theirs = stats.ttest_rel(b, a).confidence_interval(0.95)
    ours = judged(a, b)
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high))


def test_other_seeds_give_the_interval_of_welch() -> None:
    rng = np.random.default_rng(2)
    a, b = (20 + CONTENT + rng.normal(0, sd, (k, 1)) for sd, k in ((0.1, 4), (0.3, 6)))
    theirs = stats.ttest_ind(b.mean(axis=1), a.mean(axis=1), equal_var=False).confidence_interval(0.95)
    found = estimate(units(a), units(b, first_seed=100), True)
    assert found is not None
    assert not found.paired
    ours = judge(found, 0.1, 0.05)
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high))


def test_seeds_that_scatter_more_than_their_frames_count_alone() -> None:
    a = np.zeros((4, FRAMES))
    b = np.array([[0.5], [-0.4], [0.1], [0.7]]) + 1e-3 * np.random.default_rng(3).normal(size=a.shape)
    theirs = stats.ttest_1samp(b.mean(axis=1), 0).confidence_interval(0.95)
    ours = judged(a, b)
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high))
    # And where frames scatter alike, all of them count.
    c = np.random.default_rng(5).normal(size=a.shape)
    assert judged(a, c - c.mean(axis=1, keepdims=True)).high == pytest.approx(
        stats.ttest_1samp((c - c.mean(axis=1, keepdims=True)).ravel(), 0).confidence_interval(0.95).high
    )


@pytest.mark.parametrize(
    ("shift", "sd", "verdict", "alarm"),
    [
        (0.0, 0.001, "same", ""),
        (-0.5, 0.01, "worse", "fail"),
        (0.5, 0.01, "better", ""),
        (-0.5, 2.0, "cannot tell", "warn"),
        (-0.08, 0.001, "same", "warn"),
        (-0.03, 0.001, "same", ""),
        (0.0, 2.0, "cannot tell", ""),
    ],
)
def test_verdicts(shift: float, sd: float, verdict: str, alarm: str) -> None:
    noise = sd * np.array([1, -1, 0.5, -0.5, 0])
    found = judged(20 + CONTENT, 20 + CONTENT + shift + noise)
    assert (found.verdict, found.alarm) == (verdict, alarm)


def test_a_smaller_error_is_better() -> None:
    found = estimate(units(np.full(5, 0.3)), units(np.full(5, 0.2) + 0.001 * CONTENT), False)
    assert found is not None
    assert judge(found, 0.01, 0.05).verdict == "better"


def test_grown_scatter_is_told_from_a_shifted_mean() -> None:
    rng = np.random.default_rng(4)
    a = 20 + CONTENT + 0.05 * rng.normal(size=(6, FRAMES))
    b = 20 + CONTENT + 0.5 * rng.normal(size=(6, FRAMES))
    grown = judged(a, b)
    assert grown.alarm == "warn"
    assert "scatter grew" in grown.why
    shifted = judged(a, a - 0.5)
    assert (shifted.alarm, shifted.why) == ("fail", "mean shifted")


def test_one_unit_warns_and_never_fails() -> None:
    found = judged(np.array([20.0]), np.array([10.0]))
    assert (found.verdict, found.alarm, found.low) == ("cannot tell", "warn", None)
    assert estimate({(1, 0): 1.0}, {(1, 5): 1.0}, True) is None


# --- whole comparisons ----------------------------------------------------------------------------


def side(name: str, values: dict[str, np.ndarray], first_seed: int = 1, case: str = "scene_a") -> Scored:
    """Scores of method ``m``: metric -> array (seed, frame); every metric in three regions."""
    some = next(iter(values.values()))
    runs = [
        Run(
            case=case,
            seed=first_seed + s,
            frames=list(range(some.shape[1])),
            scores={
                metric: {"m": {region: array[s].tolist() for region in ("all", "moving", "static")}}
                for metric, array in values.items()
            },
        )
        for s in range(some.shape[0])
    ]
    settings = {"name": case, "scene": {"name": "room"}, "camera": {"panel_rows": 12}}
    return Scored(
        format="optsim baseline 1",
        name=name,
        made_utc="2026-01-02T03:04:05",
        versions={"optsim": "1"},
        metrics={metric: METRICS[metric] for metric in values},
        experiments={case: settings},
        runs=runs,
    )


def compared(a: Scored, b: Scored) -> Comparison:
    return compare(a, b, "2026-01-02T03:04:05")


def with_cases(sides: list[Scored]) -> Scored:
    return sides[0].model_copy(
        update={
            "experiments": {k: v for each in sides for k, v in each.experiments.items()},
            "runs": [run for each in sides for run in each.runs],
        }
    )


def rows(n: int, **scores: float) -> Callable[[np.random.Generator], dict[str, np.ndarray]]:
    def draw(rng: np.random.Generator) -> dict[str, np.ndarray]:
        seeds = rng.normal(0, scores["between"], (n, 1))
        return {PU21: 20 + CONTENT + scores["shift"] + seeds + rng.normal(0, scores["within"], (n, FRAMES))}

    return draw


@pytest.mark.parametrize("between", [0.0, 0.05, 0.3])
def test_other_seeds_fail_as_rarely_as_stated(between: float) -> None:
    """At most 5 % of comparisons without a change fail, whatever the scatter of seeds."""
    rng, draw = np.random.default_rng(6), rows(4, between=between, within=0.1, shift=0.0)
    fails = sum(
        compared(side("a", draw(rng)), side("b", draw(rng), first_seed=9)).outcome != "pass"
        for _ in range(200)
    )
    # Binomial of 200 at 5 %: above 20 with a probability of 0.1 %.
    assert fails <= 20


def test_the_smallest_detectable_loss_is_detected_nine_times_of_ten() -> None:
    rng, caught, n = np.random.default_rng(7), 0, 150
    draw = rows(4, between=0.0, within=0.2, shift=0.0)
    for _ in range(n):
        a, b = draw(rng)[PU21], draw(rng)[PU21]
        (loss,) = [d.worst for d in compared(side("a", {PU21: a}), side("b", {PU21: b})).detectable]
        # The fluctuation of this very pair is taken out, and a fresh one put in.
        c = a + draw(rng)[PU21] - 20 - CONTENT - loss
        caught += compared(side("a", {PU21: a}), side("b", {PU21: c})).outcome == "regression"
    assert 0.8 < caught / n <= 1


def test_a_loss_fails_in_its_row_and_another_metric_does_not() -> None:
    rng = np.random.default_rng(8)
    a = {PU21: 20 + CONTENT + 0 * np.zeros((3, 1)), STOPS: np.full((3, FRAMES), 0.3)}
    b = {PU21: a[PU21] - 0.2 + 0.01 * rng.normal(size=(3, FRAMES)), STOPS: a[STOPS]}
    found = compared(side("a", a), side("b", b))
    assert found.outcome == "regression"
    assert {d.metric for d in found.deltas if d.alarm == "fail"} == {PU21}
    assert {d.verdict for d in found.deltas if d.metric == STOPS} == {"same"}
    assert [d.metric for d in found.detectable] == [PU21, STOPS]


def test_small_losses_in_all_scenes_add_up() -> None:
    rng = np.random.default_rng(9)
    cases = [f"scene_{k}" for k in range(6)]
    a = [{PU21: 20 + CONTENT + np.zeros((3, 1))} for _ in cases]
    b = [{PU21: each[PU21] - 0.25 + rng.normal(0, 0.3, (3, FRAMES))} for each in a]
    found = compared(
        *(with_cases([side("s", v, case=c) for c, v in zip(cases, x, strict=True)]) for x in (a, b))
    )
    failed = {d.case for d in found.deltas if d.alarm == "fail"}
    assert ALL_CASES in failed


def test_the_interval_over_scenes_is_that_of_their_mean() -> None:
    """Of independent scenes variances add; freedom by Welch and Satterthwaite, the level by Sidak."""
    rng = np.random.default_rng(12)
    names = [f"scene_{k}" for k in range(5)]
    shifts = [rng.normal(0.1 * k, 0.1 + 0.1 * k, FRAMES + k % 2) for k in range(5)]
    sides: list[list[Scored]] = [[], []]
    for name, shift in zip(names, shifts, strict=True):
        base = 20 + rng.normal(size=shift.size)
        for each, values in zip(sides, (base, base + shift), strict=True):
            each.append(side("s", {PU21: values[None]}, case=name))
    found = compared(*map(with_cases, sides))
    (row,) = (d for d in found.deltas if (d.case, d.region) == (ALL_CASES, "all"))
    errors = np.array([stats.sem(shift) for shift in shifts])
    freedom = (errors**2).sum() ** 2 / sum(e**4 / (x.size - 1) for e, x in zip(errors, shifts, strict=True))
    level = 1 - 0.95 ** (1 / found.judged)
    half = stats.t.ppf(1 - level / 2, freedom) * np.sqrt((errors**2).sum()) / len(errors)
    mean = np.mean([shift.mean() for shift in shifts])
    assert (row.low, row.high) == pytest.approx((mean - half, mean + half))


@pytest.mark.parametrize(("metric", "tolerance"), _ACCEPTED)
def test_a_loss_of_more_than_the_accepted_one_fails(metric: str, tolerance: float) -> None:
    """Accepted losses are a choice; changing one changes this list too."""
    assert set(TOLERANCES) | {"time: capture", "memory: capture"} == {name for (name, _) in _ACCEPTED}
    noise = 0.01 * tolerance * np.array([1, -1, 0.5, -0.5, 0])
    for share, outcome in ((0.9, "pass"), (1.1, "regression")):
        facts = {metric: Facts(unit="", higher_is_better=True)}
        a, b = (
            side("s", {PU21: 20 + CONTENT[None] + shift}).model_copy(update={"metrics": facts})
            for shift in (0.0, noise - share * tolerance)
        )
        for each in (a, b):
            for run in each.runs:
                run.scores[metric] = run.scores.pop(PU21)
        assert compared(a, b).outcome == outcome, share


def test_linear_psnr_decides_nothing() -> None:
    values = {"PSNR[peak=white]": 20 + CONTENT + np.zeros((3, 1)), PU21: 20 + CONTENT + np.zeros((3, 1))}
    worse = {**values, "PSNR[peak=white]": values["PSNR[peak=white]"] - 9}
    found = compared(side("a", values), side("b", worse))
    assert found.outcome == "pass"
    assert {d.verdict for d in found.deltas if d.metric.startswith("PSNR")} == {"not judged"}


def cut(scored: Scored, change: Callable[[dict[str, Any]], object], seeds: tuple[int, ...]) -> Scored:
    """Change the record of some runs; a side is what its file says."""
    record = json.loads(scored.model_dump_json())
    for run in record["runs"]:
        if run["seed"] in seeds:
            change(run)
    return Scored.model_validate(record)


def two_methods(n_seeds: int, first_seed: int = 1, db: float = 0.0) -> Scored:
    """Two metrics, methods m and n, three regions, five frames."""
    noise = 0.01 * np.random.default_rng(first_seed).normal(size=(n_seeds, FRAMES))
    values = {PU21: 20 + CONTENT + noise + db, STOPS: 0.3 + noise / 10}
    scored = side("a", values, first_seed)
    for run in scored.runs:
        for methods in run.scores.values():
            methods["n"] = methods["m"]
    return scored


def none_at(frames: tuple[int, ...], region: str) -> Callable[[dict[str, Any]], object]:
    def change(run: dict[str, Any]) -> None:
        for methods in run["scores"].values():
            for regions in methods.values():
                regions[region] = [None if f in frames else v for f, v in enumerate(regions[region])]

    return change


def without_method(run: dict[str, Any]) -> None:
    run["scores"] = {metric: {"n": methods["n"]} for metric, methods in run["scores"].items()}


@pytest.mark.parametrize("db", [0.0, -10.0])
@pytest.mark.parametrize(
    ("change", "seeds", "named"),
    [
        (without_method, (1, 2, 3), ["scene_a, m: all scores"]),
        (without_method, (2,), ["scene_a, m: all scores, seed 2"]),
        (
            lambda run: run["scores"].pop(STOPS),
            (1, 2),
            [f"scene_a, m, n: {STOPS} (all, moving, static), seeds 1, 2"],
        ),
        (
            none_at((3, 4), "moving"),
            (1, 2, 3),
            ["scene_a, m, n: all metrics (moving), seeds 1 to 3 frames 3, 4"],
        ),
        (none_at((1,), "all"), (3,), ["scene_a, m, n: all metrics (all), seed 3 frame 1"]),
        (
            lambda run: run.update(frames=[], scores=cut_short(run["scores"], 0)),
            (1, 2, 3),
            ["scene_a, m, n: all scores"],
        ),
        (
            lambda run: run.update(frames=[0, 1], scores=cut_short(run["scores"], 2)),
            (1, 2, 3),
            ["scene_a, m, n: all scores, seeds 1 to 3 frames 2 to 4"],
        ),
    ],
)  # fmt: skip
def test_lost_scores_are_named_and_never_pass(
    db: float, change: Callable[[dict[str, Any]], object], seeds: tuple[int, ...], named: list[str]
) -> None:
    found = compared(two_methods(3), cut(two_methods(3, db=db), change, seeds))
    assert (found.outcome, found.missing) == ("cannot compare", named)
    assert all(f"missing: {line}" in as_text(found) for line in named)
    # With other seeds a side has to have the same rows and frames.
    other = cut(two_methods(4, 11), change, tuple(seed + 10 for seed in seeds))
    if len(seeds) == 1:
        assert compared(two_methods(3), other).missing == [
            line.replace(f"seed {seeds[0]}", f"seed {seeds[0] + 10}") for line in named
        ]
    assert compared(two_methods(3), other).outcome == "cannot compare"
    # More than the first side has is no fault.
    assert compared(cut(two_methods(3), change, (1, 2, 3)), two_methods(3)).missing == []


def cut_short(scores: dict[str, Any], n: int) -> dict[str, Any]:
    return {
        metric: {m: {r: values[:n] for r, values in regions.items()} for m, regions in methods.items()}
        for metric, methods in scores.items()
    }


def test_a_reading_of_zero_is_compared() -> None:
    """An ideal calibration has no crosstalk."""
    facts = Facts(unit="share", higher_is_better=True, either_way=True, relative=True)
    sides: list[Scored] = []
    for shares in ((0.0, 0.0), (0.0, 0.0), (0.2, 0.21)):
        whole = two_methods(2)
        runs = [
            run.model_copy(update={"readings": {"bench: crosstalk": share}})
            for run, share in zip(whole.runs, shares, strict=True)
        ]
        metrics = whole.metrics | {"bench: crosstalk": facts}
        sides.append(whole.model_copy(update={"runs": runs, "metrics": metrics}))
    assert compared(sides[0], sides[1]).outcome == "pass"
    assert compared(sides[0], sides[2]).outcome == "regression"


def test_lost_seeds_and_scenes_are_named() -> None:
    found = compared(two_methods(4), two_methods(2))
    assert (found.outcome, found.missing) == ("cannot compare", ["scene_a: seeds 3, 4"])
    assert compared(two_methods(4), two_methods(2, 11)).missing == [], "other seeds, fewer of them"
    values = {PU21: 20 + CONTENT + np.zeros((2, 1))}
    both = with_cases([side("a", values), side("a", values, case="scene_b")])
    assert compared(both, side("a", values)).missing == ["scene_b: seeds 1, 2"]


def test_a_reading_must_be_there_and_any_cost() -> None:
    facts = dict.fromkeys(("bench: gain", "time: capture", "time: decode"), METRICS[STOPS])
    readings = dict.fromkeys(facts, 1.0)
    whole = two_methods(2)
    whole = whole.model_copy(
        update={
            "runs": [run.model_copy(update={"readings": readings}) for run in whole.runs],
            "metrics": whole.metrics | facts,
        }
    )
    assert compared(whole, cut(whole, lambda run: run["readings"].pop("time: capture"), (1,))).missing == []
    # A stage of half a second in all runs may take a little less in all of another machine.
    short = cut(whole, lambda run: run["readings"].pop("time: capture"), (1, 2))
    assert compared(whole, short).missing == []
    none = cut(short, lambda run: run["readings"].pop("time: decode"), (1, 2))
    assert compared(whole, none).missing == ["scene_a, whole run: time: capture, time: decode"]
    bare = cut(whole, lambda run: run["readings"].pop("bench: gain"), (1, 2))
    assert compared(whole, bare).missing == ["scene_a, whole run: bench: gain"]
    one = cut(whole, lambda run: run["readings"].pop("bench: gain"), (1,))
    assert compared(whole, one).missing == ["scene_a, whole run: bench: gain, seed 1"]


def test_nothing_compared_is_no_pass() -> None:
    values = {PU21: np.full((1, 1), 20.0)}
    assert compared(side("a", values), side("b", values)).outcome == "cannot compare"


def test_other_truths_are_refused() -> None:
    values = {PU21: 20 + CONTENT + np.zeros((2, 1))}
    a, b = side("a", values), side("b", values)
    other = copy.deepcopy(b.experiments)
    other["scene_a"]["camera"]["panel_rows"] = 13
    with pytest.raises(ConfigError, match=r"panel_rows: got 13, expected 12"):
        compared(a, b.model_copy(update={"experiments": other}))
    two = with_cases([a, side("a", values, case="scene_b")])
    with pytest.raises(ConfigError, match="nothing to compare"):
        compared(two, side("b", values, case="scene_c"))
    # One experiment each: their names don't matter.
    assert compared(a, side("b", values, case="scene_c")).outcome == "pass"


def test_changed_settings_stand_in_the_record_and_on_the_page(tmp_path: Path) -> None:
    values = {PU21: 20 + CONTENT + np.zeros((2, 1))}
    b = side("b", values)
    b.experiments["scene_a"]["camera"] |= {f"key_{k:02d}": k for k in range(20)}
    found = compared(side("a", values), b.model_copy(update={"versions": {"optsim": "2"}}))
    assert [(s.case, s.key, s.before, s.after) for s in found.settings] == [
        *(("scene_a", f"camera.key_{k:02d}", "–", f"{k}") for k in range(20)),
        ("scene_a", "version of optsim", "1", "2"),
    ]
    page = write_comparison(tmp_path, found, {}).read_text()
    assert all(f"<td>camera.key_{k:02d}</td><td>–</td><td>{k}</td>" in page for k in range(20))
    assert "differs: scene_a: camera.key_03 was – and is 3" in as_text(found)
    assert "differs: 9 more, on the page" in as_markdown(found)
    # A setting that differs alike in all scenes is one row.
    two = [with_cases([side("s", values, case=c) for c in ("scene_a", "scene_b")]) for _ in range(2)]
    for case in two[1].experiments.values():
        case["camera"]["f_number"] = 8
    assert [s.case for s in compared(*two).settings] == [ALL_CASES]


def test_two_methods_of_a_run() -> None:
    scored = side("a", {PU21: 20 + CONTENT + np.zeros((2, 1))})
    run = scored.runs[0]
    rows_of = run.scores[PU21]["m"]
    better = {name: [v + 1 for v in values if v is not None] for name, values in rows_of.items()}
    runs = [r.model_copy(update={"scores": {PU21: {"m": rows_of, "n": better}}}) for r in scored.runs]
    methods = [{"name": name, "scheme": {"kind": kind}} for name, kind in (("m", "normal"), ("n", "random"))]
    scored.experiments["scene_a"]["methods"] = methods
    found = compared(*between_methods(scored.model_copy(update={"runs": runs}), "m", "n"))
    assert [(s.key, s.before, s.after) for s in found.settings] == [
        ("methods.n over m.scheme.kind", "normal", "random")
    ]
    assert {(d.method, d.verdict) for d in found.deltas} == {("n over m", "better")}
    with pytest.raises(ConfigError, match="did you mean 'm'"):
        between_methods(scored, "mm", "n")


def test_the_level_is_that_of_sidak() -> None:
    assert row_level(1) == pytest.approx(0.05)
    assert (1 - row_level(100)) ** 100 == pytest.approx(0.95)


# --- files ----------------------------------------------------------------------------------------


def failed() -> Comparison:
    a = {PU21: 20 + CONTENT + np.zeros((3, 1))}
    return compared(side("a", a), side("b <&>", {PU21: a[PU21] - 1 + 0.01 * np.zeros((3, 1))}))


def test_junit_has_a_case_a_row() -> None:
    root = ElementTree.fromstring(as_junit(failed()))
    assert len(root.findall("testsuite/testcase")) == 3
    assert len(root.findall("testsuite/testcase/failure")) == 3
    assert root.find("testsuite").get("failures") == "3"
    nothing = compared(side("a", {PU21: np.full((1, 1), 20.0)}), side("b", {PU21: np.full((1, 1), 20.0)}))
    nothing = nothing.model_copy(update={"deltas": []})
    assert ElementTree.fromstring(as_junit(nothing)).findall("testsuite/testcase/error")


def test_text_and_markdown_begin_with_what_can_be_detected() -> None:
    for text in (as_text(failed()), as_markdown(failed())):
        assert "regression: 3 of 3 judged rows fail" in text
        assert text.index("Smallest loss") < text.index("worse: mean shifted")
    assert "<details>" in as_markdown(failed())


def test_a_baseline_reads_back(tmp_path: Path) -> None:
    scored = side("a", {PU21: 20 + CONTENT + np.zeros((2, 1)), STOPS: np.full((2, FRAMES), 0.3)})
    write_baseline(tmp_path / "a.json", scored)
    assert read_baseline(tmp_path / "a.json") == scored
    ragged = read_json(tmp_path / "a.json")
    ragged["runs"][0]["frames"].pop()
    write_json(tmp_path / "c.json", ragged)
    with pytest.raises(StorageError, match="without 4 values, expected one a frame"):
        read_baseline(tmp_path / "c.json")
    (tmp_path / "b.json").write_text('{"format": "else"}')
    with pytest.raises(StorageError, match="optsim accept"):
        read_baseline(tmp_path / "b.json")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a made-up run."""
    folder = tmp_path_factory.mktemp("run") / "one"
    write_json(folder / "results.json", make_results(folder, 24, 32, 9))
    return folder


def worse(run: Path, folder: Path, *, db: float) -> Path:
    """Copy a run and take decibels from its series."""
    results: dict[str, Any] = read_json(run / "results.json")
    for series in results["frame_series"]:
        if series["method"] == "adaptive" and series["metric"] == PU21:
            series["values"] = [v - db for v in series["values"]]
    for path in (run / "assets").iterdir():
        (folder / "assets").mkdir(parents=True, exist_ok=True)
        (folder / "assets" / path.name).write_bytes(path.read_bytes())
    write_json(folder / "results.json", results)
    return folder


def test_commands_and_their_exit_codes(
    made: Path,
    tmp_path: Path,
    cli: Callable[..., tuple[int, str, str]],  # noqa: F811
) -> None:
    same, bad = worse(made, tmp_path / "same", db=0.0), worse(made, tmp_path / "bad", db=0.2)
    code, out, _ = cli("compare", str(made), str(same), "--out", "c")
    assert (code, "pass: 0 of" in out) == (0, True)
    code, out, _ = cli("compare", str(made), str(bad), "--out", "d")
    assert code == 1
    assert out.index("Smallest loss") < out.index("FAIL")
    assert {p.name for p in Path("d").iterdir()} == {
        "comparison.html",
        "comparison.json",
        "comparison.md",
        "junit.xml",
        "pictures",
    }
    kept = {p.name for p in Path("d/pictures").iterdir()}
    sides = ("before", "after")
    assert {f"synthetic-{side}-{what}_adaptive.png" for side in sides for what in ("still", "error")} == kept
    picture = np.asarray(Image.open("d/pictures/synthetic-after-error_adaptive.png"))
    assert picture.shape[2] == 3
    assert picture.std() > 0, "an error is seen"
    record = Comparison.model_validate_json(Path("d/comparison.json").read_text())
    assert all(f'src="{p.file}"' in Path("d/comparison.html").read_text() for p in record.pictures)
    code, out, _ = cli("compare", str(made), "--methods", "normal,adaptive", "--json")
    assert (code, json.loads(out)["outcome"]) == (0, "pass")
    assert cli("compare", str(made), "--methods", "adaptive,normal")[0] == 1
    for words in (("compare",), ("compare", str(made)), ("compare", "--bogus"), ("compare", "a", "b", "c")):
        assert cli(*words)[0] == 3, words
    assert cli("compare", str(made), str(tmp_path / "none"))[0] == 2


def test_a_missing_baseline_stores_a_candidate_and_accept_makes_it(
    made: Path,
    tmp_path: Path,
    cli: Callable[..., tuple[int, str, str]],  # noqa: F811
) -> None:
    code, _, err = cli("compare", "mine", str(made))
    assert code == 2
    assert "optsim accept" in err
    candidate = Path("reports/baselines/mine.candidate.json")
    assert candidate.is_file()
    assert cli("accept", str(made), "--name", "mine")[0] == 0
    assert not candidate.exists()
    path = Path("reports/baselines/mine.json")
    before = path.read_bytes()
    assert cli("compare", "mine", str(made))[0] == 0
    assert cli("compare", "mine", str(worse(made, tmp_path / "bad", db=0.2)))[0] == 1
    assert path.read_bytes() == before, "a regression leaves its baseline alone"
    code, out, _ = cli("accept", str(tmp_path / "bad"), "--name", "mine")
    assert (code, "regression" in out) == (0, True)


def test_lost_scores_end_compare_and_accept_with_code_two(
    made: Path,
    tmp_path: Path,
    cli: Callable[..., tuple[int, str, str]],  # noqa: F811
) -> None:
    assert cli("accept", str(made), "--name", "mine")[0] == 0
    path = Path("reports/baselines/mine.json")
    whole = path.read_bytes()
    lost = worse(made, tmp_path / "lost", db=10.0)
    results = read_json(lost / "results.json")
    kept = [series for series in results["frame_series"] if series["method"] != "normal"]
    write_json(lost / "results.json", {**results, "frame_series": kept})
    said = "synthetic, normal: all scores"
    for before in (str(made), "mine"):
        code, out, _ = cli("compare", before, str(lost), "--json", "--out", before[-3:])
        assert (code, json.loads(out)["missing"]) == (2, [said]), before
        assert json.loads(out)["outcome"] == "cannot compare"
        for file in ("comparison.html", "comparison.json", "comparison.md", "junit.xml"):
            assert said in (Path(before[-3:]) / file).read_text(), file
    code, _, err = cli("accept", str(lost), "--name", "mine")
    assert (code, said in err, "remove" in err, len(err.splitlines())) == (2, True, True, 1)
    assert path.read_bytes() == whole
    path.unlink()
    assert cli("accept", str(lost), "--name", "mine")[0] == 0


def test_a_series_cut_short_is_named_or_refused(
    made: Path,
    tmp_path: Path,
    cli: Callable[..., tuple[int, str, str]],  # noqa: F811
) -> None:
    place = worse(made, tmp_path / "cut", db=0.0)
    whole = read_json(place / "results.json")
    of = [k for k, series in enumerate(whole["frame_series"]) if series["method"] == "adaptive"]
    for steady, said in ((1, "all scores, seed 0 frames 6 to 8"), (0, "all scores")):
        results = copy.deepcopy(whole)
        for k in of:
            series = results["frame_series"][k]
            n = steady and 6
            series["x"], series["values"] = series["x"][:n], series["values"][:n]
        write_json(place / "results.json", results)
        code, out, err = cli("compare", str(made), str(place), "--json", "--out", f"cut{steady}")
        assert code == 2, err
        assert json.loads(out)["missing"] == [f"synthetic, adaptive: {said}"]
    whole["frame_series"][of[0]]["values"].pop()
    write_json(place / "results.json", whole)
    code, out, _ = cli("compare", str(made), str(place), "--json", "--out", "ragged")
    (line,) = json.loads(out)["missing"]
    assert (code, line.startswith("synthetic, adaptive: "), line.endswith(", seed 0 frame 8")) == (
        2,
        True,
        True,
    )


@pytest.mark.parametrize("name", ["sub/base", "../up", ".", "", "--help", "a/.json", ".json", "sub/", "a\nb"])
def test_a_name_of_a_baseline_that_is_none_is_refused(
    name: str,
    made: Path,
    cli: Callable[..., tuple[int, str, str]],  # noqa: F811
) -> None:
    code, _, err = cli("accept", str(made), "--name", name)
    assert (code, len(err.splitlines())) == (2, 1)
    assert err.startswith("optsim: --name: got ")
    assert "cure: --name" in err
    assert not Path("reports").exists()


def test_a_baseline_may_be_a_file(
    made: Path,
    tmp_path: Path,
    cli: Callable[..., tuple[int, str, str]],  # noqa: F811
) -> None:
    for name in ("sub/base.json", str(tmp_path / "b-1.2.json"), "c.json"):
        assert cli("accept", str(made), "--name", name)[0] == 0
        assert read_baseline(Path(name)).name == Path(name).stem
        assert cli("compare", name, str(made))[0] == 0


def test_several_runs_of_a_folder(made: Path, tmp_path: Path) -> None:
    worse(made, tmp_path / "a", db=0)
    worse(made, tmp_path / "b", db=0)
    with pytest.raises(ConfigError, match="several runs of 'synthetic' with seed 0"):
        scored_runs(tmp_path)
    assert isinstance(scored_runs(made), Scored)
    assert math.isclose(scored_runs(made).runs[0].frames[0], 5)
    assert Delta.model_fields


def test_a_bad_record_is_named_with_its_folder(tmp_path: Path) -> None:
    (tmp_path / "2").mkdir()
    (tmp_path / "2/results.json").write_text("{}")
    with pytest.raises(ValueCheckError, match=r"2/results\.json is not of schema version"):
        scored_runs(tmp_path)
