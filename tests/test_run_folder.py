"""A finished run isn't made again, and a camera that the bench knows isn't measured again."""

import json
from pathlib import Path

import numpy as np
import pytest
from test_footage_run import FOOTAGE, SMALL, recording
from typer.testing import CliRunner

from optsim.app import cli
from optsim.calibration.stored import calibration_arrays
from optsim.camera import bench_calibration
from optsim.experiment import calibrations, job, run_folder
from optsim.experiment.experiment import experiment_path, load_experiment

QUICK = [*SMALL, "n_frames=1", "calibration=ideal", "save_reconstructions=[]"]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demo experiment with one method, whose scene is a recording beside it."""
    folder = tmp_path_factory.mktemp("laboratory")
    np.save(folder / "shots.npy", recording())
    demo = experiment_path("demo").read_text()
    start, stop = demo.index("[scene]"), demo.index("[camera]")
    method = demo.index('[[methods]]\nname = "hdr_mosaic"')
    path = folder / "lab.toml"
    path.write_text(
        demo[:start]
        + FOOTAGE.format(path="shots.npy")
        + 'axes = "tyx"\n'
        + demo[stop : demo.index("[[methods]]")]
        + demo[method : demo.index("[[methods]]", method + 1)]
    )
    return path


def run(lab: Path, out: Path, *words: str) -> str:
    assignments = [word for each in QUICK for word in ("--set", each)]
    found = CliRunner().invoke(cli.app, ["run", str(lab), *assignments, "--out", str(out), *words])
    assert found.exit_code == 0, found.output
    return found.output


def test_a_finished_run_stops_and_what_changed_makes_it_anew(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    run(lab, out)
    made = (out / "results.json").read_bytes()

    def never(*_: object, **__: object) -> None:
        raise AssertionError("made anew")

    with monkeypatch.context() as patched:
        patched.setattr(job, "execute", never)
        assert "nothing to do" in run(lab, out)
        printed = run(lab, out, "--json")
        assert json.loads(printed[printed.index("{") :]) == json.loads(made)
    assert (out / "results.json").read_bytes() == made
    # Another version, a lost file, damaged results: each is named.
    with monkeypatch.context() as patched:
        patched.setattr(run_folder, "versions", lambda: {**job.versions(), "numpy": "0.1"})
        assert "numpy was" in run(lab, out)
    assert "made anew" in run(lab, out)
    (out / "report.html").unlink()
    assert "report.html is lost or changed" in run(lab, out)
    for name in ("frames/hdr_mosaic/000000.png", "calibration.npz"):
        (out / name).write_bytes((out / name).read_bytes()[:-1])
        assert f"{name} is lost or changed" in run(lab, out)
    (out / "checksums.json").unlink()
    assert "checksums.json is lost or changed" in run(lab, out)
    (out / "results.json").write_text("{")
    assert "results.json is damaged" in run(lab, out)
    assert "nothing to do" in run(lab, out)


@pytest.mark.slow
def test_a_calibration_is_kept_to_the_bit_and_made_anew_where_it_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPTSIM_CACHE", str(tmp_path))
    size = ("panel_rows=24", "panel_cols=28", "sensor.rows=80", "sensor.cols=92")
    experiment = load_experiment("demo", [f"camera.{each}" for each in size])
    benches: list[int] = []
    # The same images every time: what is asked is how often, and what is made of them.
    bench = calibrations.measure_bench(experiment.camera.with_nd(1.0), np.random.default_rng(1))

    def counted(*_: object) -> object:
        benches.append(1)
        return bench

    monkeypatch.setattr(calibrations, "measure_bench", counted)
    fresh, kept = (calibration_arrays(calibrations.calibrate(experiment)) for _ in range(2))
    assert len(benches) == 1
    assert fresh.keys() == kept.keys()
    for name, array in fresh.items():
        np.testing.assert_array_equal(kept[name], array)
        assert np.asarray(kept[name]).dtype == np.asarray(array).dtype
    calibrations.calibrate(experiment.model_copy(update={"seed": experiment.seed + 1}))
    assert len(benches) == 2
    with monkeypatch.context() as patched:
        patched.setattr(bench_calibration, "version", lambda _: "0.1")
        calibrations.calibrate(experiment)
    assert len(benches) == 3
    for path in tmp_path.glob("entries/*/*/responsivity_dn.npy"):
        path.write_bytes(path.read_bytes()[:-4] + b"\0\0\0\0")
    calibrations.calibrate(experiment)
    assert len(benches) == 4
