"""Columns of studies that users act on, computed again from the raw tables by other code."""

import csv
import math
import statistics
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats
from small_study import done_here, load, write_experiment

from optsim.study.comparison import Compared, Estimate, pool_scatter, student
from optsim.study.folder import Workplace
from optsim.study.parameters import ALL
from optsim.study.sheets import Sheet
from optsim.study.tolerance import TolerancePlan, tolerance
from optsim.study.tolerance_page import sheet, won_back, write_tolerance_page
from optsim.study.yields import YieldPlan, yields
from optsim.study.yields_page import shared_lines, write_yield_page

SHIFT, TURN = "camera.relay.shift_x_px", "camera.relay.rotation_rad"
WON = {"registration": 0.5, "focus": 0.6, "black_gain": 0.7, "bench": 0.1}
"""Share of the loss that is left, by compensator."""
LIMITS = {"shift_x": {-1: 1.0, 1: 2.0}, "rotation": {-1: 2e-3, 1: 1e-3}}
"""Change that costs 1 dB, by parameter and sign, in the keys' units: each costs by its square."""

TOGETHER = 300.0
"""dB that a pixel and a radian cost together, beside what each costs."""


MEASURED = {"seeds": 4}


def loss_db(shift: float, turn: float, compensators: tuple[str, ...] = ()) -> float:
    alone = [
        (value / LIMITS[name][1 if value > 0 else -1]) ** 2
        for name, value in (("shift_x", shift), ("rotation", turn))
    ]
    return math.prod(WON[name] for name in compensators) * (sum(alone) + TOGETHER * shift * turn)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return load(write_experiment(tmp_path_factory.mktemp("study")), "hdr_mosaic")


@pytest.fixture(scope="module")
def by_formula(base):
    """Studies whose scores come from :func:`loss_db`: nothing is rendered, exposed or decoded."""

    def compared(stage, point, seeds, decides=list):
        changes = dict(point.changes)
        loss = loss_db(changes.get(SHIFT, 0.0), changes.get(TURN, 0.0), point.compensators)
        change = {("hdr_mosaic", "static"): Estimate(-loss, 0.05, MEASURED["seeds"])}
        return Compared(point, change, change, {}, SimpleNamespace(values={}), "", {})

    def measured(stage, point):
        changes = dict(point.changes)
        db = 30 - loss_db(changes.get(SHIFT, 0.0), changes.get(TURN, 0.0), point.compensators)
        return SimpleNamespace(
            db={("hdr_mosaic", "static"): db}, map_residual_px=0.0, refused="", work={}, values={}
        )

    with pytest.MonkeyPatch.context() as patch:
        for name in ("render_truth", "calibrate_all"):
            patch.setattr(f"optsim.study.folder.{name}", lambda *_, **__: None)
        patch.setattr("optsim.study.folder.run_tasks", done_here)
        for study, name, stand_in in (("tolerance", "compare", compared), ("yields", "measured", measured)):
            patch.setattr(f"optsim.study.{study}.{name}", stand_in)
            patch.setattr(f"optsim.study.{study}.stage_of", lambda *_: SimpleNamespace(base=base))
        yield


@pytest.fixture(scope="module")
def record(base, tmp_path_factory, by_formula):
    plan = TolerancePlan(1.0, ("shift_x", "rotation"), ("static",), known=False, draws=200)
    return tolerance(base, plan, Workplace(tmp_path_factory.mktemp("sheet")))


def ends_of(record):
    return {(row["parameter"], row["sign"]): row for row in record["rows"]}


def test_limits_and_db_a_unit_are_those_of_the_formula(record):
    for (name, sign), row in ends_of(record).items():
        limit = LIMITS[name][sign]
        assert row["change"] == pytest.approx(limit, rel=0.01)
        # Of a loss that is 1 at its limit and grows with the square: 2 dB over the limit, as drawn.
        drawn = {"CCD px": limit, "mrad": 1e3 * limit}[row["unit"]]
        assert row["value"] == pytest.approx(drawn, rel=0.01)
        assert row["db_per_unit"] == pytest.approx(2 / drawn, rel=0.02)
        # Where 1.05 and 0.95 times the square cost 1 dB: the losses' own interval is 0.05 dB.
        ends = drawn * np.sqrt([1 / 1.05, 1 / 0.95])
        assert (row["value_least"], row["value_most"]) == pytest.approx(tuple(ends), rel=0.01)
        assert (row["loss_half"], row["capped"]) == (0.05, False)
    steepest = {name: float(slope) for name, *_, slope, _ in sheet(record["rows"], "unknown")}
    assert steepest == pytest.approx({"shift_x": 2.0, "rotation": 2.0}, rel=0.02)


def test_fewer_than_four_seeds_have_no_interval(base, by_formula, tmp_path, monkeypatch):
    monkeypatch.setitem(MEASURED, "seeds", 2)
    plan = TolerancePlan(1.0, ("shift_x", "rotation"), ("static",), known=False, draws=0)
    found = tolerance(base, plan, Workplace(tmp_path))
    for row in found["rows"]:
        assert (row["value_least"], row["value_most"], row["loss_half"], row["capped"]) == (*[None] * 3, True)
    assert {row["before_half"] for row in found["compensators"]} == {None}
    assert {row["after_half"] for row in found["compensators"]} == {None}
    assert [pair["half"] for pair in found["interactions"]] == [None]


def test_each_compensator_is_measured_alone(record):
    for sign in (-1, 1):
        for name in LIMITS:
            left = {
                row["compensator"]: row["after_db"]
                for row in record["compensators"]
                if row["parameter"] == name and row["change"] * sign > 0
            }
            assert left == pytest.approx({name: -share for name, share in WON.items()}, rel=0.05)
    before = [row["before_db"] for row in record["compensators"]]
    assert before == pytest.approx([-1] * 16, rel=0.05)
    heads, lines = won_back(record["compensators"])
    for line in lines:
        cell = dict(zip(heads, line, strict=True))["bench"]
        assert cell.startswith("−0.10")


def test_a_pair_is_measured_at_the_ends_that_are_nearer(record):
    (pair,) = record["interactions"]
    assert set(pair["names"]) == {"shift_x", "rotation"}
    ends = ends_of(record)
    # A pixel down and a milliradian up are half as far as the other ends.
    shift, turn = -ends["shift_x", -1]["change"], ends["rotation", 1]["change"]
    assert pair["alone_db"] == pytest.approx([1, 1], rel=0.05)
    assert pair["together_db"] == pytest.approx(loss_db(shift, turn), rel=0.02)
    assert pair["interaction_db"] == pytest.approx(TOGETHER * shift * turn, rel=0.05)
    assert pair["interaction_db"] == pytest.approx(pair["together_db"] - sum(pair["alone_db"]))


def test_the_budget_is_that_of_cameras_drawn_between_the_limits(record):
    ends = ends_of(record)
    drawn = [r for name, r in record["results"].items() if name.startswith("budget/")]
    for name in ("shift_x", "rotation"):
        values = np.array([each["drawn"][name] for each in drawn])
        low, high = -ends[name, -1]["value"], ends[name, 1]["value"]
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
        # Even draws: five standard errors of the mean.
        error = (high - low) / np.sqrt(12 * len(values))
        assert values.mean() == pytest.approx((low + high) / 2, abs=5 * error)
    losses = [loss_db(each["drawn"]["shift_x"], 1e-3 * each["drawn"]["rotation"]) for each in drawn]
    assert [each["loss_db"] for each in drawn] == pytest.approx(losses)
    budget = record["budget"]
    assert budget["mean_db"] == pytest.approx(statistics.fmean(losses))
    assert budget["p90_db"] == pytest.approx(statistics.quantiles(losses, n=10, method="inclusive")[8])
    assert budget["worst_db"] == pytest.approx(max(losses))
    assert budget["within_loss"] == len([loss for loss in losses if loss <= 1])
    squares = [ends[name, sign]["loss_db"] ** 2 for name in LIMITS for sign in (-1, 1)]
    assert budget["rss_db"] == pytest.approx(np.sqrt(sum(squares) / 2))


def test_limits_that_hold_together_are_put_to_the_test(record):
    """Two drifts share 1 dB by root sum of squares; each limit shrinks by the root of its share."""
    ends, share = ends_of(record), np.sqrt(1 / 2)
    within = record["allocation"]
    assert within["share_db"] == pytest.approx(share)
    for (name, sign), row in ends.items():
        assert row["together"] == pytest.approx(LIMITS[name][sign] * np.sqrt(share), rel=0.02)
    drawn = [r for name, r in record["results"].items() if name.startswith("allocation/")]
    assert len(drawn) == within["draws"] == 200
    for name in LIMITS:
        values = np.array([each["drawn"][name] for each in drawn])
        low, high = (sign * ALL[name].shown(ends[name, sign]["together"]) for sign in (-1, 1))
        assert low <= values.min() < low + 0.05 * (high - low)
        assert high - 0.05 * (high - low) < values.max() <= high
    losses = [loss_db(each["drawn"]["shift_x"], 1e-3 * each["drawn"]["rotation"]) for each in drawn]
    assert within["mean_db"] == pytest.approx(np.mean(losses))
    half = stats.t.ppf(0.975, 199) * stats.sem(losses)
    assert within["mean_half"] == pytest.approx(half)


def test_limits_that_hold_together_go_on_a_drawing(base, by_formula, tmp_path):
    plan = TolerancePlan(1.0, ("shift_x", "rotation"), ("static",), known=False, draws=2, compensators=())
    found = tolerance(base, plan, Workplace(tmp_path))
    write_tolerance_page(tmp_path, found)
    page = (tmp_path / "study.html").read_text()
    assert "gives each drift 0.71 dB, 1 dB by that sum. 2 cameras drawn within them lose " in page
    for mean, told in ((0.4, True), (0.6, False)):
        within = {**found["allocation"], "mean_db": mean, "mean_half": 0.5}
        write_tolerance_page(tmp_path, {**found, "allocation": within})
        page = (tmp_path / "study.html").read_text()
        assert ("That is not 1 dB: the sum does not hold for this camera." in page) == told
    with (tmp_path / "allocation.csv").open() as stream:
        lines = {line["operand"]: line for line in csv.DictReader(stream)}
    assert set(lines) == {"shift_x", "rotation"}
    for name, unit in (("shift_x", "CCD px"), ("rotation", "mrad")):
        low, high = (sign * ALL[name].shown(LIMITS[name][sign]) * 0.5**0.25 for sign in (-1, 1))
        assert set(lines[name]) == {"operand", "min", "max", "unit"}
        assert float(lines[name]["min"]) == pytest.approx(low, rel=0.02)
        assert float(lines[name]["max"]) == pytest.approx(high, rel=0.02)
        assert lines[name]["unit"] == unit


def test_the_columns_of_a_yield_are_those_of_its_raw_table(base, tmp_path, by_formula):
    limits = {"shift_x": (1.0, 2.0), "rotation": (2e-3, 1.5e-3)}
    plan = YieldPlan(Sheet(limits), 120, "unknown", (), "hdr_mosaic", "static", None)
    record = yields(base, plan, Workplace(tmp_path))
    with (tmp_path / "points.csv").open() as stream:
        raw = list(csv.DictReader(stream))
    db = np.array([float(row["db"]) for row in raw])
    changes = {name: np.array([float(row[name]) for row in raw]) for name in limits}
    assert db == pytest.approx([30 - loss_db(x, 1e-3 * y) for x, y in zip(*changes.values(), strict=True)])
    good = db >= 29
    assert 0.2 < good.mean() < 0.8
    # Some cameras lie where a target half a decibel off would count them otherwise.
    assert min(np.count_nonzero((db > low) & (db < low + 0.5)) for low in (28.5, 29)) > 3
    assert (record["target_db"], record["good"]) == (29, np.count_nonzero(good))
    assert [row["good"] for row in raw] == [str(bool(each)) for each in good]
    shared = {row["parameter"]: row for row in record["shared"]}
    # A rotation is drawn in mrad.
    for name, most in (("shift_x", 2.0), ("rotation", 2.0)):
        share = changes[name] / most
        row = shared[name]
        assert row["failures"] == pytest.approx(share[~good].mean())
        assert row["good"] == pytest.approx(share[good].mean())
        assert row["correlation"] == pytest.approx(stats.pearsonr(share, db).statistic)
        assert row["size_correlation"] == pytest.approx(stats.pearsonr(np.abs(share), db).statistic)
    strength = [max(abs(row["correlation"]), abs(row["size_correlation"])) for row in record["shared"]]
    assert strength == sorted(strength, reverse=True)
    for line, row in zip(shared_lines(record), record["shared"], strict=True):
        numbers = (row["failures"], row["good"], row["correlation"], row["size_correlation"])
        written = [float(cell.replace("−", "-")) for cell in line[2:]]
        assert line[0] == row["parameter"]
        assert written == pytest.approx(numbers, abs=0.0051)
    write_yield_page(tmp_path, record)
    tenths = statistics.quantiles(db.tolist(), n=10, method="inclusive")
    said = f"Median {statistics.median(db):.2f} dB, the middle 80 % at {tenths[0]:.2f} to {tenths[8]:.2f} dB"
    assert said in (tmp_path / "study.html").read_text()


def test_the_intervals_of_a_curve_are_those_of_its_pooled_raw_scores():
    rng = np.random.default_rng(8)
    points = [rng.normal(25 + at, 0.4, n) for at, n in enumerate((2, 3, 4, 2))]
    curve = {"mode": "known", "method": "a", "region": "all", "refused": ""}
    rows = []
    for scores in points:
        level = student(scores.tolist())
        score = {"db": level.mean, "db_half": level.half, "change_db": level.mean, "change_half": level.half}
        rows.append(curve | score | {"seeds": len(scores)})
    pool_scatter(rows)
    freedom = sum(len(scores) - 1 for scores in points)
    pooled = np.sqrt(sum(((scores - scores.mean()) ** 2).sum() for scores in points) / freedom)
    for row, scores in zip(rows, points, strict=True):
        half = stats.t.ppf(0.975, freedom) * pooled / np.sqrt(len(scores))
        assert (row["db_half"], row["change_half"]) == pytest.approx((half, half))
