"""Tolerance sheets: the search for a limit, and a sheet of a small camera."""

import math

import numpy as np
import pytest
from scipy import optimize
from small_study import load, without_workers, write_experiment  # noqa: F401  a fixture
from test_cli import cli  # noqa: F401  a fixture

from optsim.core.errors import ConfigError
from optsim.study.comparison import Seeds, compare, student
from optsim.study.folder import Workplace
from optsim.study.parameters import ALL
from optsim.study.search import largest_change
from optsim.study.stage import frames_to_score, make_stage
from optsim.study.tolerance import (
    TolerancePlan,
    deciding,
    point_at,
    search_limit,
    tolerance,
    worst_loss,
)
from optsim.study.tolerance_page import lead, notes, sheet, write_tolerance_page
from optsim.study.tolerance_rows import allocate, of_drawn, rss_db, sorted_rows


@pytest.mark.parametrize("power", [1, 2, 3])
@pytest.mark.parametrize("scale", [1e-3, 1, 300])
def test_a_limit_is_found_in_few_measurements(power, scale):
    asked: list[float] = []

    def loss(change):
        asked.append(change)
        return 2 * (change / scale) ** power, 0.02

    found = largest_change(loss, 1.0, 0.1 * scale, 20 * scale)
    assert found.status == "found"
    assert found.value == pytest.approx(scale / 2 ** (1 / power), rel=0.03)
    assert found.steps == len(asked) <= 6
    # Where 0.02 dB more, and less, cost as much.
    true_ends = [scale * (loss / 2) ** (1 / power) for loss in (0.98, 1.02)]
    halves = [abs(end - found.value) for end in found.ends]
    assert halves == pytest.approx([abs(end - scale / 2 ** (1 / power)) for end in true_ends], rel=0.3)
    assert found.slope == pytest.approx(power / found.value, rel=0.1)


def test_the_interval_of_a_limit_is_that_of_the_loss_there():
    """A loss of 1 +- 0.71 dB costs as much from 0.76 to 1.86 of the limit on, by the square law."""
    found = largest_change(lambda x: (x * x, 0.71), 1.0, 0.99, 20.0)
    assert found.ends == pytest.approx((1 / math.sqrt(1.71), 1 / math.sqrt(0.29)), rel=0.03)
    unbounded = largest_change(lambda x: (x * x, 1.2), 1.0, 0.99, 20.0)
    assert unbounded.ends is not None
    assert (unbounded.ends[0], unbounded.ends[1]) == (pytest.approx(1 / math.sqrt(2.2), rel=0.02), None)
    assert largest_change(lambda x: (x * x, None), 1.0, 0.99, 20.0).ends is None


def test_an_interval_ends_where_the_last_loss_may_be_as_wanted():
    """Measured from the outside in; the outermost loss may be 0.7 dB, though one nearer in is 1.2."""
    measured = iter([(1.2, 0.5), (1.3, 0.1), (1.05, 0.1)])
    found = largest_change(lambda _: next(measured), 1.0, 1.0, 20.0)
    assert (found.status, found.steps) == ("found", 3)
    assert found.ends[1] > 1


@pytest.mark.parametrize("scatter", [0.05, 0.2])
def test_intervals_of_limits_hold(scatter):
    """Of 400 searches with four seeds a point 95 % hold the limit; below 91 % by chance once in 2000."""
    rng, held, found = np.random.default_rng(6), 0, 0
    for _ in range(400):
        limit = rng.uniform(0.4, 3)

        def loss(change, limit=limit):
            told = student((change / limit) ** 2 + scatter * rng.standard_normal(4))
            return told.mean, told.half

        search = largest_change(loss, 1.0, 0.2, 20.0)
        if search.status == "found":
            found += 1
            least, most = search.ends
            held += least <= limit and (most is None or limit <= most)
    assert found > 300
    assert held / found > 0.91


@pytest.mark.parametrize("at", [0.07, 0.35, 3.0])
@pytest.mark.parametrize("below", [0.02, 0.6, -0.3])
def test_a_step_is_no_square_law(at, below):
    found = largest_change(lambda x: (below if x < at else 4.5, 0.1), 1.0, 0.2, 20.0)
    assert (found.status, found.loss, found.ends) == ("step", below, None)
    assert found.above is not None
    assert found.value < at <= found.above[0] < 1.1 * found.value
    assert found.above[1] == 4.5


def test_a_search_that_did_not_converge_claims_no_loss():
    # Noise as large as the jump makes no step of it.
    noisy = largest_change(lambda x: (0.3 if x < 0.07 else 2.0, 1.5), 1.0, 0.2, 20.0)
    assert (noisy.status, noisy.loss, noisy.above[1]) == ("not converged", 0.3, 2.0)
    # A step too far below the first change to be reached.
    far = largest_change(lambda x: (0.3 if x < 1e-9 else 2.0, 0.1), 1.0, 0.2, 20.0)
    assert (far.status, far.value, far.loss, far.above[1]) == ("not converged", 0.0, 0.0, 2.0)


def test_a_limit_that_cannot_be_reached_or_built_is_no_limit():
    flat = largest_change(lambda change: (0.01 * change, 0.1), 1.0, 0.1, 20.0)
    assert (flat.status, flat.value, flat.ends) == ("not reached", 20.0, None)
    walled = largest_change(lambda x: None if x > 1.3 else (0.2 * x * x, 0.01), 1.0, 0.2, 20.0)
    assert walled.status == "refused beyond"
    assert 1.1 < walled.value <= 1.3
    gain = largest_change(lambda change: (-0.1, 0.2), 1.0, 0.1, 20.0)
    assert (gain.status, gain.value) == ("not reached", 20.0)
    assert largest_change(lambda change: None, 1.0, 0.1, 20.0).value == 0


def test_a_shift_that_the_bench_knows_is_searched_within_half_a_pixel():
    def loss(most):
        return lambda shift: (most * math.sin(math.pi * shift) ** 2, 0.01)

    found = search_limit(loss(1.5), 1.0, ALL["shift_x"], "known")
    assert found.status == "found"
    assert found.value == pytest.approx(math.asin(math.sqrt(1 / 1.5)) / math.pi, rel=0.05)
    assert search_limit(loss(0.95), 1.0, ALL["shift_x"], "known").value == 0.5
    never = search_limit(loss(0.8), 1.0, ALL["shift_x"], "known")
    assert (never.status, never.value) == ("not reached", 3.0)
    assert search_limit(loss(0.8), 0.5, ALL["shift_x"], "unknown").value == pytest.approx(0.29, rel=0.05)


def test_all_together_by_root_sum_of_squares():
    rows = [
        {"parameter": name, "mode": mode, "loss_db": loss}
        for name, mode, loss in (
            ("a", "unknown", 3.0),
            ("a", "unknown", 1.0),
            ("b", "unknown", 2.0),
            ("b", "known", 9.0),
        )
    ]
    assert rss_db(rows) == pytest.approx(math.sqrt((9 + 1) / 2 + 4))
    drawn = {f"budget/{n}": {"loss_db": loss, "refused": ""} for n, loss in enumerate((0.5, 1.5))}
    drawn["allocation/0"] = {"loss_db": 7.0, "refused": ""}
    found = of_drawn(drawn, "budget", 1.0)
    assert (found["mean_db"], found["within_loss"], found["draws"]) == (1.0, 1, 2)
    # Student's 97.5 % quantile with one degree of freedom.
    assert found["mean_half"] == pytest.approx(12.706 * 0.5, rel=1e-3)


def test_limits_hold_together_in_equal_shares():
    """A drift that never costs its share keeps its limit; the others share what it leaves."""
    drifts = [
        # Parameter, sign, limit, its loss, its power.
        ("shift_x", -1, 0.3, 1.0, 2.0),
        ("shift_x", 1, 0.2, 1.0, 2.0),
        ("rotation", -1, 2e-3, 1.0, 1.0),
        ("rotation", 1, 2e-3, 0.1, None),
        ("temperature", -1, 40.0, 0.2, None),
        ("temperature", 1, 40.0, -0.1, None),
    ]
    rows = [
        {"parameter": name, "mode": "unknown", "sign": sign, "change": limit, "loss_db": loss}
        | {"value": ALL[name].shown(limit), "db_per_unit": None}
        | ({"db_per_unit": power * loss / ALL[name].shown(limit)} if power else {})
        for name, sign, limit, loss, power in drifts
    ]
    share = allocate(rows, 1.0)
    # Of shift both ends cost the share s, of rotation one, of temperature none.
    by_scipy = optimize.brentq(lambda s: s**2 + (s**2 + 0.1**2) / 2 + 0.2**2 / 2 - 1, 0, 1)
    assert share == pytest.approx(by_scipy)
    for row, (_, _, limit, loss, power) in zip(rows, drifts, strict=True):
        expected = limit * (share / loss) ** (1 / power) if power else limit
        assert row["together"] == pytest.approx(expected)
    few = [row for row in rows if row["parameter"] == "temperature"]
    assert allocate(few, 1.0) == 1.0
    assert [row["together"] for row in few] == [40, 40]


def test_an_end_that_costs_no_loss_makes_no_offender():
    def row(parameter, sign, status, room):
        return {
            "parameter": parameter,
            "mode": "unknown",
            "sign": sign,
            "status": status,
            "room": room,
            "value": room,
            "value_least": None,
            "value_most": None,
            "capped": False,
            "above": None,
            "loss_db": 0.25,
            "db_per_unit": None,
            "method": "hdr_mosaic",
            "region": "static",
        }

    rows = sorted_rows(
        [
            row("tilt", 1, "refused beyond", 0.1),
            row("tilt", -1, "not reached", 2.0),
            row("shift_x", 1, "found", 0.8),
            row("shift_x", -1, "refused beyond", 0.2),
            row("contrast", 1, "found", 0.5),
        ]
    )
    lines = [(name, down, up, costs, room) for name, down, up, _, _, costs, _, room in sheet(rows, "unknown")]
    assert lines == [
        ("contrast", "–", "+0.5", "hdr_mosaic, static", "0.50"),
        ("shift_x", "≥ −0.2", "+0.8", "hdr_mosaic, static", "0.80"),
        ("tilt", "≥ −2", "≥ +0.1", "–", "≥ 0.10"),
    ]
    jumps = {"status": "step", "above": 0.6, "above_db": 4.5}
    jumps["together"], told = 0.25, {"value_least": 0.4, "capped": True, "together": 0.2}
    marked = [row("shift_x", 1, "found", 0.5) | told, row("shift_x", -1, "found", 0.5) | jumps]
    (line,) = sheet(marked, "unknown")
    assert line[1:3] == ("step −0.5 (0.25 dB) and −0.6 (4.50 dB)", "+0.5 (0.4 to ?) *")
    assert line[3:6] == ("−0.25 to +0.2", "CCD px", "hdr_mosaic, static")
    costs = {"plan": {"loss_db": 1.0}, "budget": {"mean_db": None}}
    assert "step −0.5 (0.25 dB) and −0.6 (4.50 dB) and +0.5 (0.4 to ?) CCD px." in lead(
        {"rows": marked} | costs
    )
    said = " ".join(notes(marked))
    assert "step: the loss jumps" in said
    assert "*: the cap on seeds came before the precision asked for" in said
    (ended,) = sheet([row("shift_x", 1, "found", 0.5) | jumps | {"status": "not converged"}], "unknown")
    assert ended[2] == "between +0.5 (0.25 dB) and +0.6 (4.50 dB)"
    record = {"rows": rows, "plan": {"loss_db": 1.0}, "budget": {"mean_db": None}}
    assert lead(record) == "A loss of 1 dB is reached first by a drift of contrast: +0.5 % of light."
    assert "by no drift alone" in lead(record | {"rows": rows[-2:]})
    assert lead(record | {"rows": []}) == "No drift could be measured."


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return load(write_experiment(tmp_path_factory.mktemp("study")), "hdr_mosaic")


def test_every_parameter_changes_the_camera(base):
    for parameter in ALL.values():
        changes = parameter.changes(base, parameter.usual)
        assert set(changes) == set(parameter.keys)
    response = ALL["response"].changes(base, 0.5)
    modulator = base.camera.modulator
    assert list(response.values()) == [1.5 * modulator.tau_on_s, 1.5 * modulator.tau_off_s]
    assert ALL["rotation"].shown(2e-3) == 2


@pytest.mark.slow
@pytest.mark.usefixtures("without_workers")
def test_a_tolerance_put_back_in_costs_the_stated_loss(base, tmp_path):
    plan = TolerancePlan(
        loss_db=2.0,
        names=("shift_x",),
        regions=("static",),
        known=False,
        draws=1,
        interactions=False,
        frames=1,
        seeds=Seeds(1, 1),
    )
    record = tolerance(base, plan, Workplace(tmp_path))
    write_tolerance_page(tmp_path, record)
    stage = make_stage(base, frames_to_score(base, 1))
    for row in record["rows"]:
        assert row["status"] == "found"
        losses: list[float] = []
        # A limit is right to a tenth of the change, or to a tenth of the loss.
        for change in (row["change"] / 1.1, row["change"] * 1.1):
            point = point_at(stage, {"shift_x": row["sign"] * change}, "unknown")
            worst = worst_loss(compare(stage, point, Seeds(1, 1), deciding(plan.regions)), plan.regions)
            assert worst is not None
            losses.append(-worst[1].mean)
        assert losses[0] < 2.2
        assert losses[1] > 1.8
        assert losses[1] - losses[0] > 0.1
    won = {row["compensator"]: row["after_db"] for row in record["compensators"]}
    assert won["registration"] > won["black_gain"]
    assert record["budget"]["draws"] == 1
    (line,) = sheet(record["rows"], "unknown")
    assert line[0] == "shift_x"
    assert line[4] == "CCD px"
    assert "shift_x" in lead(record)
    assert "The bench is a new calibration" in (tmp_path / "study.html").read_text()


def test_a_sheet_of_nothing_is_refused(base, tmp_path):
    for plan, said in (
        (TolerancePlan(names=("shft_x",)), "did you mean 'shift_x'"),
        (TolerancePlan(loss_db=0.0), "more than 0"),
        (TolerancePlan(regions=("middle",)), "unknown region"),
    ):
        with pytest.raises(ConfigError, match=said):
            tolerance(base, plan, Workplace(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_loss_that_is_no_number_is_refused(cli):  # noqa: F811
    code, _, shown = cli("tolerance", "demo", "--loss", "much")
    assert code == 2
    assert "expected a number of dB" in shown
