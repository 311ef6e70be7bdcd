"""Waterfalls: which effects are steps, and shares that add up to the total."""

import pytest
from small_study import load, without_workers, write_experiment  # noqa: F401  a fixture
from test_cli import cli  # noqa: F401  a fixture

from optsim.core.errors import ConfigError
from optsim.report import plots
from optsim.study.comparison import Seeds
from optsim.study.folder import Workplace
from optsim.study.point import Point, experiment_at
from optsim.study.waterfall import (
    WaterfallPlan,
    chart_rows,
    effects_of,
    measured_orders,
    sampled_orders,
    steps_of,
    switched_off,
    waterfall,
)
from optsim.study.waterfall_page import lead, lines_of, write_waterfall_page


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    return load(write_experiment(tmp_path_factory.mktemp("study")), "hdr_mosaic")


def test_effects_are_those_that_the_camera_has_behind_the_lens(base):
    names = effects_of(base)
    assert {"contrast", "response", "distortion", "relay_blur", "read_noise"} <= set(names)
    assert not {"vignetting", "objective_blur", "misregistration", "sync", "lost_fields"} & set(names)
    ideal = experiment_at(base, Point(switched_off(base, ["response", "relay_blur"])))
    assert ideal.camera.modulator.tau_on_s == 0
    assert not ideal.camera.relay.diffraction
    with pytest.raises(ConfigError, match="did you mean 'contrast'"):
        effects_of(base, ["contarst"])
    with pytest.raises(ConfigError, match="vignetting can be no step"):
        effects_of(base, ["vignetting"])


def levels(value):
    """Scores of the cameras with some of a, b and c off, in four seeds."""
    sets = ("", "a", "b", "c", "ab", "ac", "bc", "abc")
    return {
        frozenset(off): {
            "off": list(off),
            "refused": "",
            "db": [[["m", "all", value(set(off), seed)]] for seed in range(4)],
        }
        for off in sets
    }


def test_shares_add_up_to_the_total_and_share_an_interaction_fairly():
    def value(off, seed):
        # b and c cost 1 and 2 dB alone, and 3 more together.
        on = {"a", "b", "c"} - off
        return 30 + 0.1 * seed - 1.0 * ("b" in on) - 2.0 * ("c" in on) - 3.0 * ({"b", "c"} <= on)

    orders = sampled_orders("abc", 6, 1)
    rows = steps_of(levels(value), orders, 4)
    share = {row["effect"]: row["share_db"] for row in rows}
    assert sum(share.values()) == pytest.approx(rows[0]["total_db"]) == pytest.approx(-6)
    assert sum(row["step_db"] for row in rows) == pytest.approx(-6)
    assert share == pytest.approx({"a": 0, "b": -2.5, "c": -3.5})
    steps = {row["effect"]: row["step_db"] for row in rows}
    assert steps == pytest.approx({"a": 0, "b": -1, "c": -5})
    assert [row["share_half"] for row in rows] == pytest.approx([0, 0, 0], abs=1e-9)
    assert {row["share_half"] for row in steps_of(levels(value), orders, 3)} == {None}


def test_orders_come_with_their_reverse_and_a_refused_camera_ends_only_its_own():
    orders = sampled_orders("abc", 4, 1)
    assert orders[0] == ("a", "b", "c")
    assert orders[1] == ("c", "b", "a")
    assert orders[3] == orders[2][::-1]
    found = levels(lambda off, seed: 30.0 - len(off))
    found[frozenset("bc")]["refused"] = "crosstalk: no dot"
    kept = measured_orders(found, [("a", "b", "c"), ("c", "b", "a")])
    assert kept == [("c", "b", "a")]
    assert {row["step_db"] for row in steps_of(found, [("a", "b", "c"), ("c", "b", "a")], 2)} == {None}


def test_the_lead_names_only_what_the_seeds_tell():
    def row(effect, share, half):
        common = {"place": 0, "method": "adaptive", "region": "all", "total_db": -1.0, "total_half": 0.2}
        return {"effect": effect, "share_db": share, "share_half": half, **common}

    rows = [row("bend", -0.5, 1.3), row("contrast", -0.4, 0.3), row("read_noise", 0.5, 0.2)]
    assert lead({"rows": rows}).endswith("; most costs: contrast −0.40 ± 0.30.")
    assert lead({"rows": rows[::2]}).endswith("these seeds tell no effect's share from 0.")


def test_words_of_a_bar_keep_off_its_label():
    rows = [("fringing", -0.54, "−0.54 ± 1.37"), ("read_noise", 0.51, "+0.51 ± 2.49")]
    figure = plots.signed_figure(rows)
    figure.canvas.draw()
    (axes,) = figure.axes
    words = [text.get_window_extent() for text in axes.texts]
    inside = axes.get_window_extent()
    assert len(words) == len(rows)
    for box in words:
        assert inside.x0 <= box.x0
        assert box.x1 <= inside.x1


@pytest.mark.slow
@pytest.mark.usefixtures("without_workers")
def test_a_waterfall_of_a_camera_adds_up(base, tmp_path):
    plan = WaterfallPlan(effects_of(base, ["contrast", "read_noise"]), 2, frames=1, seeds=Seeds(2, 2))
    record = waterfall(base, plan, Workplace(tmp_path))
    write_waterfall_page(tmp_path, record)
    assert len(record["results"]) == 4
    for region in ("all", "moving", "static"):
        rows = chart_rows(record["rows"], "hdr_mosaic", region)
        total = rows[0]["nominal_db"] - rows[0]["ideal_db"]
        assert rows[0]["total_db"] == pytest.approx(total)
        assert sum(row["share_db"] for row in rows) == pytest.approx(total)
        assert sum(row["step_db"] for row in rows) == pytest.approx(total)
        # Two seeds tell no interval.
        assert {row["share_half"] for row in rows} == {None}
    assert lines_of(record["rows"], "hdr_mosaic", "all")[-1][0] == "all together"
    assert "2 effects together change hdr_mosaic by" in lead(record)
    assert (tmp_path / "study.html").read_text().count("<svg") == 3


def test_unknown_effects_end_in_one_line(cli):  # noqa: F811
    code, _, shown = cli("waterfall", "demo", "--effects", "contarst")
    assert code == 2
    assert "did you mean 'contrast'" in shown
