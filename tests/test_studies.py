"""The engine of studies, and sweeps: points, paired seeds, what is shared, and what a user sees."""

import csv
import html
import json
import re
import shlex
import sys

import numpy as np
import pytest
from small_study import FRAMES, SMALL, load, without_workers, write_experiment  # noqa: F401  a fixture
from test_cli import cli  # noqa: F401  a fixture

from optsim.core.errors import ConfigError, StorageError
from optsim.core.quantities import ExposureCode
from optsim.experiment.experiment import load_experiment
from optsim.experiment.truth import render_truth
from optsim.study.comparison import Seeds, compare, pool_scatter, student
from optsim.study.folder import Workplace
from optsim.study.measurement import measured
from optsim.study.point import Axis, Point, changed_only, experiment_at, full_key, parse_axis, shares_truth
from optsim.study.stage import frames_to_score, make_stage
from optsim.study.sweep import SweepPlan, sweep
from optsim.study.sweep_page import write_sweep_page
from optsim.study.words import assumptions
from optsim.tasks import Outcome

SHIFT = "camera.relay.shift_x_px"
ONE = Seeds(1, 1)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_experiment(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def base(file):
    return load(file, "hdr_mosaic")


@pytest.fixture(scope="module")
def stage(base):
    return make_stage(base, frames_to_score(base, 1))


def test_values_of_a_range_are_exact_in_its_middle_and_may_have_units(base):
    assert parse_axis(base, "relay.rotation_rad=-2e-3:2e-3:9").values[4] == 0
    axis = parse_axis(base, "camera.relay.rotation_rad=-1 mrad:1 mrad:3")
    assert axis == Axis("camera.relay.rotation_rad", (-1e-3, 0, 1e-3))
    assert axis.label == "relay.rotation_rad"
    assert parse_axis(base, "overlap=true,false").values == (True, False)
    assert full_key(base, "n_frames") == "n_frames"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("relay.shft_x_px=0:1:2", "did you mean 'relay.shift_x_px'"),
        ("relay.shift_x_px", "got no values"),
        ("relay.shift_x_px=0:1:1", "empty range"),
        ("relay.shift_x_px=1:1:5", "empty range"),
        ("relay.shift_x_px=0:1", "got 2 numbers"),
        ("relay.shift_x_px=1,1", "a value twice"),
        ("splitter.placement=a:b:3", "no numbers"),
        ("relay.rotation_rad=1 mm:2 mm:3", "unit 'mm'"),
    ],
)
def test_a_range_that_cannot_be_read_is_refused(base, text, said):
    with pytest.raises(ConfigError, match=said):
        parse_axis(base, text)


def test_what_a_calibration_knows_is_in_the_camera_and_the_rest_in_its_drift(base):
    known, unknown = (experiment_at(base, Point(((SHIFT, 0.3),), mode)) for mode in ("known", "unknown"))
    assert (known.camera.relay.shift_x_px, known.drift) == (0.3, {})
    assert (unknown.camera.relay.shift_x_px, unknown.drift) == (0, {"relay": {"shift_x_px": 0.3}})
    assert known.at_work() == unknown.at_work()
    with pytest.raises(ConfigError, match="truth is the light behind the objective"):
        experiment_at(base, Point((("camera.objective.f_number", 8.0),), "unknown"))
    with pytest.raises(ConfigError, match="only the camera drifts"):
        experiment_at(base, Point((("reading_px", 3),), "unknown"))
    assert changed_only(base, {SHIFT: 0.0, "camera.relay.shift_y_px": 1.0}) == (
        ("camera.relay.shift_y_px", 1.0),
    )
    keys = SHIFT, "camera.objective.f_number", "reading_px", "scene.variation"
    assert [shares_truth(Point(((key, 1),))) for key in keys] == [True, False, True, False]


def test_recalled_light_of_the_panel_gives_the_same_frame(stage):
    camera = stage.base.camera.with_nd(0.5)
    moved = camera.model_copy(update={"relay": camera.relay.model_copy(update={"shift_x_px": 0.4})})
    rng = np.random.default_rng(0)
    levels = rng.integers(0, 2, (36, camera.panel_rows, camera.panel_cols), dtype=np.uint8) * np.uint8(255)
    code = ExposureCode(levels, np.zeros(levels.shape[1:], np.bool_))
    before = stage.panel_light.found
    for each in (camera, moved, camera):
        expected, after = each.expose(stage.truth, 1, code, None, np.random.default_rng(1))
        frame, panel = stage.expose(each, stage.truth, 1, code, None, np.random.default_rng(1))
        np.testing.assert_array_equal(frame.dn, expected.dn)
        np.testing.assert_array_equal(panel.retardance_rad, after.retardance_rad)
    assert stage.panel_light.found == before + 2
    slower = camera.modulator.model_copy(update={"tau_on_s": 2e-3})
    other = camera.model_copy(update={"modulator": slower})
    expected, _ = other.expose(stage.truth, 1, code, None, np.random.default_rng(1))
    frame, _ = stage.expose(other, stage.truth, 1, code, None, np.random.default_rng(1))
    np.testing.assert_array_equal(frame.dn, expected.dn)


def test_a_drift_costs_and_a_registration_wins_it_back(stage):
    key = ("hdr_mosaic", "static")
    changes = (SHIFT, 0.4), ("camera.relay.rotation_rad", 2e-3)
    nothing = compare(stage, Point(), ONE)
    unknown = compare(stage, Point(changes, "unknown"), ONE)
    registered = compare(stage, Point(changes, "compensated", ("registration",)), ONE)
    assert nothing.change_db[key].mean == 0
    assert unknown.change_db[key].mean < -3
    assert registered.change_db[key].mean > -1
    assert registered.first.values["relay.shift_x_px"] == pytest.approx(-0.4, abs=0.02)
    assert registered.first.values["relay.rotation_rad"] == pytest.approx(-2e-3, abs=4e-4)
    assert registered.point.seed == stage.base.seed


def test_black_and_gain_are_found_anew_after_the_well_or_the_panel_changed(stage):
    changes = (("camera.modulator.mirror_reflectivity", 0.5),)
    found = measured(stage, Point(changes, "compensated", ("black_gain",)))
    ratio = 0.5 / stage.base.camera.modulator.mirror_reflectivity
    assert found.values["gain, ratio"] == pytest.approx(ratio, rel=0.02)
    unknown = measured(stage, Point(changes, "unknown"))
    assert found.db["hdr_mosaic", "static"] > unknown.db["hdr_mosaic", "static"] + 3


def test_a_new_bench_is_a_calibration_of_what_is_there_then(stage):
    keys = SHIFT, "camera.relay.defocus_m"
    drift = tuple(zip(keys, (0.4, 60e-6), strict=True))
    benched = measured(stage, Point(drift, "compensated", ("bench",)))
    assert benched.db == measured(stage, Point(drift, "known")).db
    both = measured(stage, Point(drift, "compensated", ("focus", "bench")))
    left = 60e-6 + both.values["relay.defocus_m"]
    refocused = tuple(zip(keys, (0.4, left), strict=True))
    assert both.db == measured(stage, Point(refocused, "known")).db


def test_focus_is_found_again(stage):
    point = Point((("camera.relay.defocus_m", 60e-6),), "compensated", ("focus",))
    assert measured(stage, point).values["relay.defocus_m"] == pytest.approx(-60e-6, abs=25e-6)


def test_a_measured_point_is_found_again_and_a_refused_one_says_why(stage):
    point = Point(((SHIFT, 0.25),), "unknown")
    first, again = measured(stage, point), measured(stage, point)
    assert first.work["points_measured"] == 1
    assert again.work == {"points_found": 1}
    assert (again.db, again.covered) == (first.db, first.covered)
    refused = compare(stage, Point(((SHIFT, 40.0),)), ONE)
    assert "falls" in refused.refused
    assert refused.change_db == {}


@pytest.mark.parametrize(
    "words",
    [
        ("sweep", "--vary", "relay.shift_x_px=0,0.1"),
        ("operators",),
        ("tolerance", "--parameters", "shift_x"),
        ("waterfall", "--effects", "contrast"),
        ("yield",),
    ],
)
def test_the_page_of_each_study_shows_what_was_set(words, file, tmp_path, cli, monkeypatch):  # noqa: F811
    """Nothing is measured here: all tasks are put aside, and the page is written nevertheless."""
    aside = lambda tasks, *_, **__: Outcome((), (), {task.name: "not measured" for task in tasks})  # noqa: E731
    for name, stand_in in (("run_tasks", aside), ("render_truth", None), ("calibrate_all", None)):
        monkeypatch.setattr(f"optsim.study.folder.{name}", stand_in or (lambda *_, **__: None))
    keys = [*SMALL, "description=a = <b>"]
    given = [word for key in keys for word in ("--set", key)]
    command, *options = words
    line = [command, str(file), *options, *given, "--out", "out"]
    _, _, err = cli(*line)
    assert "not measured" in err
    page = (tmp_path / "out" / "study.html").read_text()
    said = re.search("<p>Command: <code>(.*)</code></p>", page)[1]
    assert shlex.split(html.unescape(said))[1:] == list(sys.argv[1:]) == line


def test_student_gives_the_textbook_interval():
    found = student([1.0, 2.0, 3.0])
    assert (found.mean, found.half) == (2, pytest.approx(4.3027 / 3**0.5, rel=1e-4))
    assert student([1.0]).half is None
    assert student([1.0]).below_noise
    assert not student([5.0, 5.1, 4.9]).below_noise


def test_intervals_of_a_curve_hold_with_two_seeds_a_point():
    """Of 400 curves of nine points 95 % of the points lie within; false alarm below 1e-6 (binomial)."""
    rng, inside = np.random.default_rng(5), 0
    for _ in range(400):
        points = [student(pair) for pair in rng.normal(3, 0.7, (9, 2))]
        curve = {"mode": "known", "method": "a", "region": "all", "seeds": 2, "refused": ""}
        scores = [
            curve | {"db": p.mean, "db_half": p.half, "change_db": 0, "change_half": 0.0} for p in points
        ]
        other = curve | {"mode": "unknown", "db": 9, "db_half": None, "change_db": 0, "change_half": None}
        pool_scatter([*scores, other, {"mode": "known", "refused": "too far"}])
        assert (other["db_half"], other["below_noise"], scores[0]["change_half"]) == (None, True, 0)
        inside += sum(abs(row["db"] - 3) <= row["db_half"] for row in scores)
    # The nine points of a curve share an estimate, so they count as one: 5 standard errors.
    assert inside / 3600 == pytest.approx(0.95, abs=5 * (0.95 * 0.05 / 400) ** 0.5)


@pytest.mark.usefixtures("without_workers")
def test_a_sweep_goes_on_past_a_refused_value_and_is_one_folder(base, tmp_path):
    plan = SweepPlan((Axis(SHIFT, (-0.3, 0, 40.0)),), frames=1, seeds=ONE, marks=(-0.3,))
    record = sweep(base, plan, Workplace(tmp_path))
    write_sweep_page(tmp_path, record)
    refused = [row for row in record["rows"] if row["refused"]]
    assert {(row["relay.shift_x_px"], row["mode"]) for row in refused} == {
        (40.0, mode) for mode in ("known", "unknown", "compensated")
    }
    rows = [row for row in record["rows"] if row.get("region") == "static"]
    change = {(row["relay.shift_x_px"], row["mode"]): row["change_db"] for row in rows}
    assert change[0, "unknown"] == change[0, "known"] == 0
    assert change[-0.3, "unknown"] < change[-0.3, "compensated"]
    with (tmp_path / "points.csv").open() as stream:
        assert len(list(csv.DictReader(stream))) == len(record["rows"])
    assert json.loads((tmp_path / "study.json").read_text())["kind"] == "sweep"
    page = (tmp_path / "study.html").read_text()
    assert page.count("<svg") == 3
    assert "falls" in page
    pictures = sorted(path.name for path in (tmp_path / "pictures").iterdir())
    assert pictures[0] == "points-0000-compensated-hdr_mosaic.png"
    again = sweep(base, plan, Workplace(tmp_path))
    assert again["work"] == {"tasks_done_before": 3}
    with pytest.raises(StorageError, match="another study"):
        sweep(base, SweepPlan((Axis(SHIFT, (0.1,)),)), Workplace(tmp_path))


@pytest.mark.usefixtures("without_workers")
def test_operators_are_compared_on_one_camera_and_its_light(base, tmp_path):
    axis = parse_axis(base, "calibration=ideal,true")
    record = sweep(base, SweepPlan((axis,), frames=1, seeds=ONE), Workplace(tmp_path))
    write_sweep_page(tmp_path, record)
    assert record["work"]["benches"] == 1
    assert "truths" not in record["work"]
    change = {row["calibration"]: row["change_db"] for row in record["rows"] if row["region"] == "static"}
    assert change["true"] == 0
    assert change["ideal"] < -1
    page = (tmp_path / "study.html").read_text()
    assert "in brackets the change" in page
    assert page.count("<svg") == 1


@pytest.mark.usefixtures("without_workers")
def test_no_truth_is_made_after_the_last_scored_frame(base, tmp_path, monkeypatch):
    made = []

    def noted(experiment, **others):
        made.append(experiment.n_frames)
        return render_truth(experiment, **others)

    monkeypatch.setattr("optsim.study.folder.render_truth", noted)
    monkeypatch.setattr("optsim.study.stage.render_truth", noted)
    longer = base.model_copy(update={"n_frames": FRAMES + 4})
    plan = SweepPlan((Axis(SHIFT, (0.1,)),), frames=1, seeds=ONE)
    record = sweep(longer, plan, Workplace(tmp_path))
    assert set(made) == {FRAMES}
    assert record["experiment"]["n_frames"] == FRAMES + 4


def test_the_published_mismatch_is_a_drift_of_the_demo():
    drifted = load_experiment("published_mismatch")
    assert drifted.camera == load_experiment("demo").camera
    assert drifted.at_work().relay.rotation_rad == pytest.approx(np.deg2rad(0.3))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--vary", "relay.shift_x_px=50,60"), "every value is refused"),
        (("--vary", "relay.shft_x_px=0,1"), "did you mean 'relay.shift_x_px'"),
        (("--vary", "relay.shift_x_px=0,1", "--curves", "knwon"), "did you mean 'known'"),
        (("--vary", "relay.shift_x_px=0,1", "--methods", "best"), "expected one of: adaptive"),
        (("--vary", "relay.shift_x_px=0,1", "--mark", "0.5"), "expected one of the values"),
        (("--vary", "relay.shift_x_px=0,1", "--vary", "relay.shift_x_px=0,1"), "expected two parameters"),
        (("--vary", "reading_px=1,3", "--curves", "unknown"), "no part of the camera"),
        (("--vary", "relay.shift_x_px=0,1", "--seeds", "3:2"), "expected LEAST:MOST"),
    ],
)
def test_bad_input_ends_in_one_line_before_any_work(cli, words, said, tmp_path):  # noqa: F811
    code, _, shown = cli("sweep", "demo", *words, "--out", str(tmp_path / "out"))
    assert code == 2
    assert said in shown
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("most", "said"), [(2, "over 2 seeds of"), (4, "over 2 to 4 seeds of")])
def test_a_page_says_whether_seeds_are_added(most, said):
    plan = {"frames": 1, "seeds": {"least": 2, "most": most, "wanted_db": 0.1}}
    experiment = {"seed": 1, "n_frames": 10, "camera": {"latency_frames": 1}}
    line = assumptions({"plan": plan, "experiment": experiment})[1]
    assert said in line
    assert ("Seeds are added" in line) == (most > 2)
