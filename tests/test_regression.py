"""The regression matrix: what is in it, what a run leaves behind, readings and costs, and its command."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_up_run import make_results
from test_cli import cli  # noqa: F401  a fixture

from optsim.core.files import read_json, write_json
from optsim.experiment.calibrations import calibrate
from optsim.experiment.experiment import load_experiment
from optsim.experiment.readings import bench_readings
from optsim.metrics.tolerances import MEMORY, READING, TIME, tolerance_of
from optsim.report.baseline import YARDSTICK, Scored, scored_runs
from optsim.report.comparison import compare
from optsim.report.missing import RUN
from optsim.study import regression
from optsim.tasks import Outcome


def test_cameras_of_a_scene_share_its_truth() -> None:
    made = regression.matrix()
    assert len({(e.name, e.seed) for e in made}) == len(made) == 24
    assert all(e.camera.geometry().fits for e in made)
    for scene in regression.SCENES:
        of_scene = [e for e in made if e.scene is not None and e.scene.name == scene]
        first = of_scene[0]
        assert len(of_scene) == 8
        for each in of_scene:
            assert (each.camera.view, each.timing) == (first.camera.view, first.timing)
            assert each.camera.objective == first.camera.objective
    assert len({e.camera for e in made if e.scene == made[0].scene}) == 2


def test_a_frame_of_the_matrix_is_steady() -> None:
    one = regression.matrix((1,))[0]
    assert one.n_frames - (one.camera.latency_frames + 4) >= 2


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    found = make_results(tmp_path_factory.mktemp("made"), 24, 32, 9)
    # Short files: many are written.
    for key in ("pictures", "evidence", "slot_series", "pairs", "masks", "coverage", "ledgers"):
        found[key] = []
    found["frame_series"] = [s for s in found["frame_series"] if s["method"] == "adaptive"]
    reading = {"name": "read noise", "value": 12.5, "unit": "DN"}
    return {**found, "readings": [reading, {"name": "pixel map, row", "value": 90.0, "unit": "px"}]}


def fake_run(results: dict[str, Any]) -> Callable[..., None]:
    """Stand for a run of an experiment: results, and what else lies in a folder."""

    def execute(experiment: Any, folder: Path, **_: Any) -> None:
        own = copy.deepcopy(results)
        own["experiment"] = {"name": experiment.name, "seed": experiment.seed}
        noise = np.random.default_rng(experiment.seed)
        own["readings"][0]["value"] *= 1 + 1e-4 * noise.normal()
        for stage in own["timings"]:
            stage["cpu_s"] *= 1 + 0.01 * noise.normal()
        write_json(folder / "results.json", own)
        (folder / "frames" / "a").mkdir(parents=True)
        (folder / "calibration.npz").write_bytes(b"x")

    return execute


def matrix_of(results: dict[str, Any], folder: Path, monkeypatch: pytest.MonkeyPatch) -> Scored:
    monkeypatch.setattr(regression.job, "execute", fake_run(results))
    for one in regression.matrix((1, 2, 3, 4), ("wheel",), ("nominal",)):
        place = folder / one.name / str(one.seed)
        place.mkdir(parents=True)
        regression.measure_run(place, one)
        assert {p.name for p in place.iterdir()} == {"results.json"}, "what is heavy goes"
        assert read_json(place / "results.json")["timings"][-1]["stage"] == YARDSTICK
    return scored_runs(folder)


def test_a_changed_reading_is_caught_either_way(
    results: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = matrix_of(results, tmp_path / "sound", monkeypatch)
    for factor, shift, fails in (
        (1.03, 0.0, {"read noise"}),
        (0.97, 0.0, {"read noise"}),
        (1.004, 0.2, {"pixel map, row"}),
    ):
        other = copy.deepcopy(results)
        other["readings"][0]["value"] *= factor
        other["readings"][1]["value"] += shift
        changed = matrix_of(other, tmp_path / f"{factor}{shift}", monkeypatch)
        found = compare(sound, changed, "2026-01-02T03:04:05")
        failed = {d.metric.removeprefix(READING) for d in found.deltas if d.alarm == "fail"}
        # The machine that tests is too busy for judgements of time.
        assert {name for name in failed if not name.startswith(TIME)} == fails
        noise = next(d for d in found.deltas if d.metric == READING + "read noise")
        assert noise.before == pytest.approx(12.5, rel=1e-3)
        assert (noise.unit, noise.method) == ("%", RUN)
        assert noise.advantage == pytest.approx(100 * np.log(factor), abs=0.05)


def test_a_slower_stage_and_more_memory_are_caught(
    results: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(regression, "_yardstick_s", lambda: 0.5)
    sound = matrix_of(results, tmp_path / "sound", monkeypatch)
    other = copy.deepcopy(results)
    for stage in other["timings"]:
        if stage["stage"] == "decode":
            stage["cpu_s"] *= 1.6
            stage["peak_rss_mb"] *= 1.3
    found = compare(sound, matrix_of(other, tmp_path / "slow", monkeypatch), "2026")
    failed = {d.metric for d in found.deltas if d.alarm == "fail"}
    assert failed == {TIME + "decode", MEMORY + "decode"}
    assert not any(d.metric == TIME + "render" for d in found.deltas)
    assert tolerance_of(TIME + "decode") == 30
    # A machine half as fast is no change: its yardstick takes twice as long.
    slow = copy.deepcopy(results)
    for stage in slow["timings"]:
        stage["cpu_s"] *= 2
    monkeypatch.setattr(regression, "_yardstick_s", lambda: 1.0)
    found = compare(sound, matrix_of(slow, tmp_path / "old", monkeypatch), "2026")
    assert found.outcome == "pass"


def test_the_yardstick_takes_time() -> None:
    assert regression._yardstick_s() > 1e-3


def test_readings_are_those_of_the_camera() -> None:
    experiment = load_experiment(
        "demo",
        ["camera.panel_rows=24", "camera.panel_cols=32", "camera.sensor.rows=80", "camera.sensor.cols=104"],
        calibration="true",
    )
    found = {r.name: r.value for r in bench_readings(calibrate(experiment))}
    sensor = experiment.camera.sensor
    assert found["read noise"] == pytest.approx(sensor.read_noise_e / sensor.step_e, rel=0.1)
    assert found["gain"] == pytest.approx(1 / sensor.step_e, rel=0.05)
    assert 0 < found["crosstalk"] < 0.5
    assert found["pixel map, row"] == pytest.approx(39.5, abs=1)


def test_the_command_compares_with_the_baseline(
    results: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    cli: Callable[..., tuple[int, str, str]],  # noqa: F811
) -> None:
    matrix_of(results, tmp_path / "runs", monkeypatch)

    def run_matrix(experiments: Any, out: Path, **_: Any) -> tuple[Path, Outcome]:
        assert len(experiments) == 24
        return tmp_path / "runs", Outcome((), (), {})

    monkeypatch.setattr(regression, "run_matrix", run_matrix)
    assert cli("regress")[0] == 2
    assert cli("accept", str(tmp_path / "runs"), "--name", "regress")[0] == 0
    assert cli("regress")[0] == 0
    assert cli("regress", "--seeds", "a,b")[0] == 2
    lost = tmp_path / "runs" / "wheel-nominal" / "1" / "results.json"
    lost.write_text(lost.read_text().replace('"adaptive"', '"adaptive_2"'))
    code, out, _ = cli("regress", "--json")
    assert code == 2
    assert [line.partition(", ")[2] for line in json.loads(out)["missing"]] == [
        "adaptive: all scores, seed 1"
    ]
    failed = Outcome((), (), {"window_room-nominal/1": "no memory"})
    monkeypatch.setattr(regression, "run_matrix", lambda *_, **__: (tmp_path, failed))
    code, _, err = cli("regress")
    assert code == 2
    assert "no memory" in err
