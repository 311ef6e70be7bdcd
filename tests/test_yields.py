"""Yields: sheets, draws that can be made again, the interval, and what failures share."""

import numpy as np
import pytest
from small_study import load, without_workers, write_experiment  # noqa: F401  a fixture
from test_cli import cli  # noqa: F401  a fixture

from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import write_json
from optsim.experiment.experiment import load_experiment
from optsim.study.folder import Workplace
from optsim.study.measurement import measured
from optsim.study.parameters import ALL
from optsim.study.stage import frames_to_score, make_stage
from optsim.study.yields import (
    YieldPlan,
    assignments_of,
    binomial_interval,
    drawn,
    point_of,
    read_sheet,
    shared_by_failures,
    yields,
)
from optsim.study.yields_page import lead, write_yield_page

SHEET = {"shift_x": (0.2, 1.5), "rotation": (0.0, 0.0)}


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
    assert shipped["rotation"] == (1e-3, 1e-3)
    assert set(shipped) == set(ALL)
    (tmp_path / "sheet.toml").write_text("[shift_x]\nplus = 0.3\nminus = 0.2\n[rotation]\nplus = 2\n")
    assert read_sheet(str(tmp_path / "sheet.toml")) == {"shift_x": (0.2, 0.3), "rotation": (2e-3, 2e-3)}
    rows = [{"parameter": "tilt", "mode": "unknown", "sign": sign, "change": 1e-3} for sign in (1, -1)]
    record = {"format": "optsim study 1", "kind": "tolerance", "rows": rows}
    write_json(tmp_path / "study" / "study.json", record)
    assert read_sheet(str(tmp_path / "study")) == {"tilt": (1e-3, 1e-3)}
    write_json(tmp_path / "study" / "study.json", {**record, "kind": "sweep"})
    with pytest.raises(StorageError, match="no finished tolerance study"):
        read_sheet(str(tmp_path / "study"))


@pytest.mark.parametrize("end", [0, 1], ids=["down", "up"])
@pytest.mark.parametrize("name", ALL)
def test_every_bad_specimen_of_the_demo_can_be_built(name, end):
    demo = load_experiment("demo")
    change = (-1, 1)[end] * read_sheet("machining")[name][end]
    load_experiment("demo", [f"{key}={value!r}" for key, value in ALL[name].changes(demo, change).items()])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[shft_x]\nplus = 1", "did you mean 'shift_x'"),
        ("[shift_x]\nplus = -1", "expected plus and minus in CCD px"),
        ("[shift_x]\nplus = 1\nabout = 2", "expected plus and minus"),
        ("shift_x = 'much'", "expected plus and minus"),
        ("", "got no parameter"),
    ],
)
def test_a_wrong_sheet_is_refused(text, said, tmp_path):
    (tmp_path / "sheet.toml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        read_sheet(str(tmp_path / "sheet.toml"))


def test_a_camera_is_drawn_by_its_number_alone_and_within_its_limits(base):
    draws = [drawn(base, SHEET, camera)[0]["shift_x"] for camera in range(400)]
    assert drawn(base, SHEET, 17)[0]["shift_x"] == draws[17]
    assert -0.2 <= min(draws) < -0.15
    assert 1.45 < max(draws) <= 1.5
    assert np.mean(draws) == pytest.approx(0.65, abs=0.1)
    both = {"response": (0.5, 0.5), "temperature": (5.0, 5.0)}
    point = point_of(base, both, "known", (), 3)
    assert dict(point.changes)["camera.serial_number"] == base.camera.serial_number + 3
    assert "camera.serial_number" not in dict(point_of(base, both, "unknown", (), 3).changes)


@pytest.mark.parametrize("mode", ["known", "unknown"])
def test_its_overrides_build_the_same_camera(base, file, mode):
    sheet = {name: (each.usual / 2, each.usual / 2) for name, each in ALL.items()}
    chosen = plan(sheet=sheet, mode=mode)
    given = [f"{key}={value}" for key, value in _of_the_small_one(base)]
    rebuilt = load_experiment(str(file), [*given, *assignments_of(base, chosen, 2)])
    point = point_of(base, sheet, mode, (), 2)
    assert rebuilt.seed == point.seed
    at_work, expected = rebuilt.at_work(), dict(point.changes)
    assert at_work.relay.rotation_rad == expected["camera.relay.rotation_rad"]
    assert at_work.modulator.tau_on_s == expected["camera.modulator.tau_on_s"]
    assert (rebuilt.drift == {}) == (mode == "known")


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
    record |= {"target_db": 28.0, "nominal_db": 29.0, "interval": (0.4, 0.6)}
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
    again = measured(stage, point_of(base, SHEET, "unknown", (), 3))
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
