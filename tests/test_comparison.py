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

from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_json, write_json
from optsim.metrics.comparison import Judgement, estimate, judge, row_level
from optsim.report.baseline import Facts, Run, Scored, read_baseline, scored_runs, write_baseline
from optsim.report.comparison import ALL_CASES, Comparison, Delta, between_methods, compare
from optsim.report.comparison_text import as_junit, as_markdown, as_text

PU21, STOPS = "PU21-PSNR[banding_glare, peak=256]", "log-RMSE[e=0.01 cd/m2] (stops)"
METRICS = {
    PU21: Facts(unit="dB", higher_is_better=True),
    STOPS: Facts(unit="stops", higher_is_better=False),
    "PSNR[peak=white]": Facts(unit="dB", higher_is_better=True),
}
FRAMES = 5
CONTENT = np.array([0.0, 1.5, -1.0, 0.7, 2.0])


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


def compared(a: Scored, b: Scored, *, whole: bool = True) -> Comparison:
    return compare(a, b, "2026-01-02T03:04:05", whole=whole)


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


def test_linear_psnr_decides_nothing() -> None:
    values = {"PSNR[peak=white]": 20 + CONTENT + np.zeros((3, 1)), PU21: 20 + CONTENT + np.zeros((3, 1))}
    worse = {**values, "PSNR[peak=white]": values["PSNR[peak=white]"] - 9}
    found = compared(side("a", values), side("b", worse))
    assert found.outcome == "pass"
    assert {d.verdict for d in found.deltas if d.metric.startswith("PSNR")} == {"not judged"}


def test_what_is_missing_cannot_pass() -> None:
    values = {PU21: 20 + CONTENT + np.zeros((2, 1)), STOPS: np.full((2, FRAMES), 0.3)}
    a, b = side("a", values), side("b", {PU21: values[PU21]})
    assert compared(a, b).outcome == "cannot compare"
    assert any(STOPS in line for line in compared(a, b).missing)
    assert compared(a, b, whole=False).outcome == "pass"
    one_seed = b.model_copy(update={"runs": b.runs[:1], "metrics": a.metrics})
    assert "scene_a: seed 2" in compared(a, one_seed).missing


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


def test_changed_settings_are_noted() -> None:
    values = {PU21: 20 + CONTENT + np.zeros((2, 1))}
    b = side("b", values)
    b.experiments["scene_a"]["camera"]["f_number"] = 8
    notes = compared(side("a", values), b).notes
    assert any("camera.f_number was None and is 8" in note for note in notes)


def test_two_methods_of_a_run() -> None:
    scored = side("a", {PU21: 20 + CONTENT + np.zeros((2, 1))})
    run = scored.runs[0]
    rows_of = run.scores[PU21]["m"]
    better = {name: [v + 1 for v in values if v is not None] for name, values in rows_of.items()}
    runs = [r.model_copy(update={"scores": {PU21: {"m": rows_of, "n": better}}}) for r in scored.runs]
    found = compared(*between_methods(scored.model_copy(update={"runs": runs}), "m", "n"), whole=False)
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


def test_several_runs_of_a_folder(made: Path, tmp_path: Path) -> None:
    worse(made, tmp_path / "a", db=0)
    worse(made, tmp_path / "b", db=0)
    with pytest.raises(ConfigError, match="several runs of 'synthetic' with seed 0"):
        scored_runs(tmp_path)
    assert isinstance(scored_runs(made), Scored)
    assert math.isclose(scored_runs(made).runs[0].frames[0], 5)
    assert Delta.model_fields
