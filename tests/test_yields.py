"""Yields: sheets, draws that can be made again, the interval, and what failures share."""

from types import SimpleNamespace

import numpy as np
import pytest
from programs import program
from scipy import stats
from small_study import done_here, load, without_workers, write_experiment  # noqa: F401  a fixture
from test_cli import cli  # noqa: F401  a fixture

from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import write_json
from optsim.core.random_streams import stream
from optsim.experiment.experiment import load_experiment
from optsim.study.folder import Workplace
from optsim.study.measurement import measured
from optsim.study.parameters import ALL
from optsim.study.point import Point, changed_only
from optsim.study.sheets import Sheet, read_sheet
from optsim.study.stage import frames_to_score, make_stage
from optsim.study.yield_causes import shared_by_failures, travel_of, won_by_halving
from optsim.study.yields import (
    YieldPlan,
    assignments_of,
    binomial_interval,
    drawn,
    yields,
)
from optsim.study.yields_page import lead, write_yield_page

SHEET = Sheet({"shift_x": (0.2, 1.5), "rotation": (0.0, 0.0)})


def plan(**changes):
    settings = {"draws": 3, "mode": "unknown", "compensators": (), "method": "hdr_mosaic"}
    settings |= {"frames": 1, "sheet": SHEET, "region": "static", "target_db": None}
    return YieldPlan(**{**settings, **changes})


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_experiment(tmp_path_factory.mktemp("study"))


@pytest.fixture(scope="module")
def base(file):
    return load(file, "hdr_mosaic")


def test_a_sheet_is_shipped_or_a_file_or_a_finished_study(tmp_path):
    shipped = read_sheet("machining")
    assert shipped.limits["rotation"] == (1e-3, 1e-3)
    assert set(shipped.limits) == set(ALL)
    (tmp_path / "sheet.toml").write_text("[shift_x]\nplus = 0.3\nminus = 0.2\n[rotation]\nplus = 2\n")
    read = read_sheet(str(tmp_path / "sheet.toml"))
    assert read == Sheet({"shift_x": (0.2, 0.3), "rotation": (2e-3, 2e-3)})
    row = {"parameter": "tilt", "mode": "unknown", "method": "hdr_mosaic"}
    rows = [{**row, "sign": sign, "change": change} for sign, change in ((1, 1e-3), (-1, 2e-3))]
    studied = {"loss_db": 0.5, "regions": ["all", "static"]}
    record = {"format": "optsim study 1", "kind": "tolerance", "rows": rows, "plan": studied}
    write_json(tmp_path / "study" / "study.json", record)
    read = read_sheet(str(tmp_path / "study"))
    assert read.limits == {"tilt": (2e-3, 1e-3)}
    assert read.of == "drifts that cost hdr_mosaic 0.5 dB of PU21-PSNR (all, static)"
    write_json(tmp_path / "study" / "study.json", {**record, "kind": "sweep"})
    with pytest.raises(StorageError, match="no finished tolerance study"):
        read_sheet(str(tmp_path / "study"))


TWO = "[shift_x]\nplus = 0.4\n[tilt]\nplus = 0.2\nminus = 0.1\n"
MOUNT = "[mounts.a]\nparameters = ['shift_x', 'tilt']\n"


@pytest.mark.parametrize("end", [0, 1], ids=["down", "up"])
@pytest.mark.parametrize("name", ALL)
def test_every_bad_specimen_of_the_demo_can_be_built(name, end):
    demo = load_experiment("demo")
    change = (-1, 1)[end] * read_sheet("machining").limits[name][end]
    load_experiment("demo", [f"{key}={value!r}" for key, value in ALL[name].changes(demo, change).items()])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[shft_x]\nplus = 1", "did you mean 'shift_x'"),
        ("[shift_x]\nplus = -1", "shift_x.plus: got -1, expected a size in CCD px, 0 or more; fix: "),
        ("[shift_x]\nplus = -0.2\nminus = 0.3", "shift_x.plus: got -0.2, expected a size"),
        ("[shift_x]\nminus = true", "shift_x.minus: got True"),
        ("[shift_x]\nplus = inf", "shift_x.plus: got inf"),
        ("[shift_x]\nplus = 1\nabout = 2", "unknown key of .*sheet.toml: shift_x 'about'"),
        ("[shift_x]", "got no limit, expected plus in CCD px; fix: "),
        ("shift_x = 'much'", "expected a size in CCD px"),
        (
            "[contrast]\nplus = 2\nminus = 1",
            "contrast.minus: got 1, expected plus alone, .*; fix: leave",
        ),
        ("[contrast]\nminus = 1", "contrast.minus: got 1, expected plus alone, since contrast goes up only"),
        ("[shift_x]\nplus = 1\ndistribution = 'even'", "unknown distribution of .*: shift_x 'even'"),
        ("[contrast]\nplus = 1\ndistribution = 'normal'", "contrast.distribution: got 'normal'"),
        ("[shift_x]\nplus = 1\n[mounts]\nrelay = 3", "mounts.relay: got 3, expected parameters"),
        ("mounts = 3\n[shift_x]\nplus = 1", "mounts.: got 3, expected parameters"),
        (f"{TWO}[mounts.a]\nparameters = ['tilt']", "got .*, expected parameters, two or more"),
        (f"{TWO}[mounts.a]\nparameters = ['tilt', 'shift_x']\nfree = 1", "expected parameters, two or more"),
        (f"{TWO}[mounts.a]\nparameters = ['tilt', 'shft_x']", "did you mean 'shift_x'"),
        (f"{TWO}[mounts.a]\nparameters = ['tilt', 'tilt']", "got tilt twice"),
        (f"{TWO}{MOUNT}[mounts.b]\nparameters = ['tilt', 'shift_x']", "mounts.b: got .* twice"),
        (f"{TWO}distribution = 'normal'\n{MOUNT}", "mounts.a: got tilt, which has a distribution of its own"),
        (f"{TWO}[contrast]\nplus = 1\n{MOUNT[:-2]}, 'contrast']\n", "got contrast, which has one way to go"),
        ("", "got no parameter"),
    ],
)
def test_a_wrong_sheet_is_refused(text, said, tmp_path):
    (tmp_path / "sheet.toml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        read_sheet(str(tmp_path / "sheet.toml"))


def test_a_wrong_sheet_ends_in_one_line(cli, tmp_path):  # noqa: F811
    (tmp_path / "sheet.toml").write_text("[contrast]\nplus = 2\nminus = 1\n")
    code, _, shown = cli("yield", "demo", "--sheet", "./sheet.toml")
    assert code == 2
    assert "contrast.minus: got 1" in shown
    assert "Traceback" not in shown


def test_a_camera_is_drawn_by_its_number_alone_and_within_its_limits(base):
    draws = [drawn(base, SHEET, "unknown", (), camera).changes["shift_x"] for camera in range(400)]
    assert drawn(base, SHEET, "unknown", (), 17).changes["shift_x"] == draws[17]
    assert -0.2 <= min(draws) < -0.15
    assert 1.45 < max(draws) <= 1.5
    assert np.mean(draws) == pytest.approx(0.65, abs=0.1)
    both = Sheet({"response": (0.5, 0.5), "temperature": (5.0, 5.0)})
    camera = drawn(base, both, "known", (), 3)
    assert dict(camera.point.changes)["camera.serial_number"] == base.camera.serial_number + 3
    assert camera.serial_number == base.camera.serial_number + 3
    drifted = drawn(base, both, "unknown", (), 3)
    assert "camera.serial_number" not in dict(drifted.point.changes)
    assert drifted.serial_number == base.camera.serial_number


def test_a_parameter_that_goes_one_way_is_drawn_one_way(tmp_path):
    (tmp_path / "sheet.toml").write_text("[contrast]\nplus = 5\n[defocus]\nplus = 36\n")
    sheet = read_sheet(str(tmp_path / "sheet.toml"))
    assert sheet.limits == {"contrast": (0.0, 0.05), "defocus": (36e-6, 36e-6)}
    rng = np.random.default_rng(1)
    contrasts = [sheet.draw(rng)["contrast"] for _ in range(300)]
    assert min(contrasts) >= 0
    # Each end is missed by 300 even draws with a chance of 2e-7.
    assert (min(contrasts) < 0.0025, max(contrasts) > 0.0475) == (True, True)


@pytest.mark.parametrize(
    ("said", "like"),
    [
        ("", stats.uniform(-0.1, 0.4)),
        ("distribution = 'uniform'", stats.uniform(-0.1, 0.4)),
        # Limits are two standard deviations from their middle.
        ("distribution = 'normal'", stats.norm(0.1, 0.1)),
        ("distribution = 'truncated'", stats.truncnorm(-2, 2, 0.1, 0.1)),
    ],
)
def test_changes_are_distributed_as_the_sheet_says(said, like, tmp_path):
    """By Kolmogorov and Smirnov: a false alarm once in a thousand; another distribution never passes."""
    (tmp_path / "sheet.toml").write_text(f"[shift_x]\nplus = 0.3\nminus = 0.1\n{said}\n")
    sheet, rng = read_sheet(str(tmp_path / "sheet.toml")), np.random.default_rng(3)
    draws = [sheet.draw(rng)["shift_x"] for _ in range(4000)]
    assert stats.kstest(draws, like.cdf).pvalue > 1e-3
    assert (max(draws) > 0.3) == ("normal" in said)


def test_a_mount_moves_its_parameters_together(tmp_path):
    more = "distribution = 'normal'\n[rotation]\nplus = 1\n"
    (tmp_path / "sheet.toml").write_text(f"{TWO}{MOUNT}{more}")
    sheet, rng = read_sheet(str(tmp_path / "sheet.toml")), np.random.default_rng(4)
    draws = [sheet.draw(rng) for _ in range(2000)]
    shift, tilt, turn = (np.array([each[name] for each in draws]) for name in ("shift_x", "tilt", "rotation"))
    # Of limits of 0.4 px both ways and of -0.1 to 0.2 %.
    assert (tilt - 0.5e-3) / 1.5e-3 == pytest.approx(shift / 0.4)
    assert stats.kstest(shift, stats.norm(0, 0.2).cdf).pvalue > 1e-3
    # Five standard errors.
    assert abs(stats.pearsonr(shift, turn).statistic) < 5 / np.sqrt(2000)
    assert stats.kstest(turn, stats.uniform(-1e-3, 2e-3).cdf).pvalue > 1e-3


WIDE = Sheet({"shift_x": (8.0, 8.0)})


def test_what_cannot_be_built_is_drawn_again_from_its_stream(base):
    cameras = [drawn(base, WIDE, "unknown", (), camera) for camera in range(60)]
    again = [each for each in cameras if each.refused]
    assert 10 < len(again) < 60
    assert all("falls" in why for each in again for why in each.refused)
    for number, each in enumerate(cameras):
        rng = stream(base.seed, "yield", number)
        shifts = [rng.uniform(-8, 8) for _ in range(len(each.refused) + 1)]
        assert each.changes["shift_x"] == pytest.approx(shifts[-1])
        assert abs(each.changes["shift_x"]) < min(map(abs, shifts[:-1]), default=9)
    none = drawn(base, Sheet({"contrast": (0.0, 9e4)}), "known", (), 1)
    assert (none.point, len(none.refused)) == (None, 50)


def test_a_camera_that_cannot_be_built_is_not_counted_as_bad(base, tmp_path, monkeypatch):
    """A camera scores 30 dB, and cannot be calibrated where its shift is below -2 px."""

    def measured_by_formula(stage, point):
        bad = dict(point.changes).get("camera.relay.shift_x_px", 0) < -2
        db = {} if bad else {("hdr_mosaic", "static"): 30.0}
        return SimpleNamespace(
            db=db, map_residual_px=0.0, refused="no dots" if bad else "", work={}, values={}
        )

    for name in ("render_truth", "calibrate_all"):
        monkeypatch.setattr(f"optsim.study.folder.{name}", lambda *_, **__: None)
    monkeypatch.setattr("optsim.study.folder.run_tasks", done_here)
    monkeypatch.setattr("optsim.study.yields.measured", measured_by_formula)
    monkeypatch.setattr("optsim.study.yields.stage_of", lambda *_: SimpleNamespace(base=base))
    record = yields(base, plan(sheet=WIDE, draws=40), Workplace(tmp_path))
    write_yield_page(tmp_path, record)
    cameras = [drawn(base, WIDE, "unknown", (), camera) for camera in range(40)]
    uncalibrated = sum(each.changes["shift_x"] < -2 for each in cameras)
    assert 0 < uncalibrated < 40
    assert (record["cameras"], record["good"]) == (40, 40 - uncalibrated)
    draws = sum(len(each.refused) for each in cameras)
    assert draws > 0
    assert (record["not_built"]["draws"], record["not_built"]["cameras"]) == (draws, 0)
    assert sum(record["not_built"]["reasons"].values()) == draws
    said = f"{draws} draws could not be built and were drawn again."
    assert said in lead(record)
    page = (tmp_path / "study.html").read_text()
    assert said in page
    assert f"{uncalibrated} of 40 cameras cannot be calibrated or decoded: they are failures." in page
    narrow = yields(base, plan(sheet=Sheet({"contrast": (0.0, 9e4)}), draws=2), Workplace(tmp_path / "none"))
    write_yield_page(tmp_path / "none", narrow)
    assert (narrow["cameras"], narrow["not_built"]["cameras"]) == (0, 2)
    assert lead(narrow).startswith("No camera could be measured. 100 draws could not be built")


@pytest.mark.parametrize("mode", ["known", "unknown"])
def test_its_overrides_build_the_same_camera(base, file, mode):
    sheet = Sheet({name: (each.usual / 2, each.usual / 2) for name, each in ALL.items()})
    chosen = plan(sheet=sheet, mode=mode)
    given = [f"{key}={value}" for key, value in _of_the_small_one(base)]
    rebuilt = load_experiment(str(file), [*given, *assignments_of(base, chosen, 2)])
    point = drawn(base, sheet, mode, (), 2).point
    assert rebuilt.seed == point.seed
    at_work, expected = rebuilt.at_work(), dict(point.changes)
    assert at_work.relay.rotation_rad == expected["camera.relay.rotation_rad"]
    assert at_work.modulator.tau_on_s == expected["camera.modulator.tau_on_s"]
    assert (rebuilt.drift == {}) == (mode == "known")
    with pytest.raises(ConfigError, match=r"--sheet: got no camera 2 that can be built in 50 draws"):
        assignments_of(base, plan(sheet=Sheet({"contrast": (0.0, 9e4)})), 2)


def _of_the_small_one(base):
    camera = base.camera
    yield "camera.panel_rows", camera.panel_rows
    yield "camera.panel_cols", camera.panel_cols
    yield "camera.sensor.rows", camera.sensor.rows
    yield "camera.sensor.cols", camera.sensor.cols
    yield "n_frames", base.n_frames


def test_the_interval_is_that_of_agresti_and_coull():
    low, high = binomial_interval(92, 100)
    assert (low, high) == (pytest.approx(0.848, abs=0.002), pytest.approx(0.960, abs=0.002))
    assert binomial_interval(10, 10)[0] > 0.65
    assert binomial_interval(0, 10)[0] == 0


def made_rows(rng, loss_of, cameras=200):
    """Cameras with a defocus and a rotation within 1 of 0, and a score that they cost."""
    rows = []
    for camera in range(cameras):
        defocus, turn = rng.uniform(-1, 1, 2)
        db = 30 - loss_of(defocus) + 0.1 * rng.standard_normal()
        row = {"camera": camera, "defocus": 36 * defocus, "rotation": turn}
        rows.append({**row, "db": db, "good": bool(db >= 28)})
    return rows


MADE = {"rotation": (1e-3, 1e-3), "defocus": (36e-6, 36e-6)}


@pytest.mark.parametrize(
    ("loss_of", "worse_at", "strongest", "failures"),
    [
        (lambda x: 2 + 2 * x, "+", "correlation", 0.5),
        (lambda x: 2 - 2 * x, "−", "correlation", -0.5),
        (lambda x: 4 * x * x, "both ends", "size_correlation", 0),
        (lambda x: 4 - 4 * x * x, "the middle", "size_correlation", 0),
    ],
)
def test_failures_lie_where_their_cause_lies(loss_of, worse_at, strongest, failures):
    rows = made_rows(np.random.default_rng(1), loss_of)
    # A camera without a score is a failure that has no part in a correlation.
    rows.append({**rows[0], "db": None, "good": False})
    first, second = shared_by_failures(rows, MADE)
    assert (first["parameter"], first["worse_at"]) == ("defocus", worse_at)
    assert abs(first[strongest]) > 0.94
    assert first["failures"] == pytest.approx(failures, abs=0.35)
    assert first["good"] == pytest.approx(-failures, abs=0.35)
    assert (second["parameter"], second["worse_at"]) == ("rotation", "")
    failed = sum(not row["good"] for row in rows)
    plan_of = {"method": "a", "region": "all", "mode": "known"}
    record = {"shared": [first, second], "good": len(rows) - failed, "cameras": len(rows), "plan": plan_of}
    record |= {
        "not_built": {"draws": 0, "cameras": 0},
        "target_db": 28.0,
        "nominal_db": 29.0,
        "interval": (0.4, 0.6),
    }
    assert f"Failures lie at {worse_at} defocus." in lead(record)
    assert "28.00 dB, PU21-PSNR of a, everywhere: " in lead(record)
    assert "Failures" not in lead({**record, "good": len(rows)})


def test_a_parameter_that_does_nothing_is_seldom_blamed():
    """One in twenty sheets names any; more than 36 of 400 do with a chance of 4e-4 (binomial)."""
    rng = np.random.default_rng(2)
    named = [
        any(each["worse_at"] for each in shared_by_failures(made_rows(rng, lambda _: 2, 12), MADE))
        for _ in range(400)
    ]
    assert 6 <= sum(named) <= 36


def test_halved_limits_win_the_cameras_that_turn_good():
    """Recomputed from the scores; the interval by its definition, a 95 % one of matched pairs."""
    rng = np.random.default_rng(4)
    rows = [{"db": db, "good": bool(db >= 20)} for db in rng.uniform(18, 22, 60)]
    for row in rows:
        row["db, half of tilt"] = row["db"] + rng.uniform(0, 2)
        row["db, half of shift_x"] = row["db"] - 0.2
    first, last = won_by_halving(rows, 20.0)
    assert (first["parameter"], last["parameter"]) == ("tilt", "shift_x")
    turned = sum(row["db"] < 20 <= row["db, half of tilt"] for row in rows)
    assert first["gained"] == turned > 5
    assert first["lost"] == 0 < last["lost"]
    assert first["good"] == sum(row["good"] for row in rows) + turned
    cells = np.array([turned + 0.5, 0.5, 61 - turned])
    values = np.repeat((1, -1, 0), (cells * 2).astype(int))
    half = 1.96 * values.std() / np.sqrt(62)
    np.testing.assert_allclose(first["interval"], (values.mean() - half, values.mean() + half), rtol=1e-6)
    assert won_by_halving(rows, None) == []


def test_travel_is_that_of_the_keys_that_compensators_set():
    moves = np.random.default_rng(5).normal(1e-5, 3e-5, 400)
    rows = [{"set relay.defocus_m": move, "set black_dn": 1.0, "db": 20.0} for move in moves]
    (found,) = travel_of([*rows, {"db": None}])
    assert (found["key"], found["cameras"]) == ("relay.defocus_m", 400)
    ranked = np.sort(moves)
    assert ranked[9] <= found["low"] <= ranked[10]
    assert ranked[389] <= found["high"] <= ranked[390]
    assert found["largest"] == np.abs(moves).max()


@pytest.mark.slow
@pytest.mark.usefixtures("without_workers")
def test_a_yield_halves_each_change_and_says_how_far_compensators_go(base, tmp_path):
    chosen = plan(draws=3, mode="compensated", compensators=("focus",), halve=True)
    record = yields(base, chosen, Workplace(tmp_path))
    write_yield_page(tmp_path, record)
    row = record["rows"][1]
    stage = make_stage(base, frames_to_score(base, 1))
    less = changed_only(base, ALL["shift_x"].changes(base, row["shift_x"] / 2))
    again = measured(stage, Point(less, "compensated", ("focus",), base.seed + 1))
    assert again.db["hdr_mosaic", "static"] == row["db, half of shift_x"] != row["db"]
    (won,) = record["won_by_halving"]
    assert won["good"] == sum(each["db, half of shift_x"] >= record["target_db"] for each in record["rows"])
    (turned,) = record["travel"]
    assert turned["key"] == "relay.defocus_m"
    assert 0 < turned["largest"] < 1.5e-4
    shown = (tmp_path / "study.html").read_text()
    assert "Travel of the compensators" in shown
    assert "limits half as wide" in shown


@pytest.mark.slow
@pytest.mark.usefixtures("without_workers")
def test_a_yield_counts_good_cameras_and_any_can_be_measured_again(base, tmp_path):
    chosen = plan(draws=5)
    record = yields(base, chosen, Workplace(tmp_path))
    write_yield_page(tmp_path, record)
    assert record["cameras"] == 5
    assert record["target_db"] == record["nominal_db"] - 1
    assert record["good"] == sum(row["db"] >= record["target_db"] for row in record["rows"])
    assert f"{record['good']} of 5" in lead(record)
    stage = make_stage(base, frames_to_score(base, 1))
    again = measured(stage, drawn(base, SHEET, "unknown", (), 3).point)
    assert again.db["hdr_mosaic", "static"] == record["rows"][3]["db"]
    assert "--set seed=4" in record["rows"][3]["set"]
    assert "drift.relay.shift_x_px" in (tmp_path / "points.csv").read_text()
    assert "What failures share" in (tmp_path / "study.html").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--sheet", "none.toml"), "no such file"),
        (("--calibration", "knwon"), "did you mean 'known'"),
        (("--region", "middle"), "unknown --region"),
        (("--calibration", "compensated", "--compensators", "focsu"), "did you mean 'focus'"),
        (("--calibration", "compensated", "--compensators", ""), "expected some of registration"),
        (("--target", "high"), "--target: got 'high'"),
    ],
)
def test_bad_input_ends_in_one_line(cli, words, said):  # noqa: F811
    code, _, shown = cli("yield", "demo", *words)
    assert code == 2
    assert said in shown


def test_a_camera_is_rebuilt_by_a_printed_command(cli):  # noqa: F811
    code, out, _ = cli("yield", "demo", "--rebuild", "17", "--calibration", "unknown")
    assert code == 0
    assert out.startswith("optsim run demo --set seed=18 --set drift.relay.shift_x_px=")


def test_yields_side_by_side_are_of_one_score():
    page = program("tolerances")
    one = {"plan": {"method": "a", "region": "all", "frames": 1, "sheet": {}}, "target_db": 25.0}
    page.check_alike({"none": one, "bench": one})
    for other in (
        {**one, "target_db": 24.9},
        *({**one, "plan": {**one["plan"], key: "b"}} for key in ("method", "region", "frames", "sheet")),
    ):
        with pytest.raises(ConfigError, match="expected one method, region and score"):
            page.check_alike({"none": one, "bench": other})
