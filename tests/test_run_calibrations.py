"""A run keeps what it knew of its camera: it joins frames with codes, in numpy too; other runs take it."""

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optsim.calibration import read_calibration
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_exr, read_json
from optsim.decoding import Interpolation
from optsim.experiment import calibrations, job
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.measurement import decode_measurement, read_measurement
from optsim.experiment.measurement.files import measurement_files
from optsim.experiment.measurement.runs import read_run
from optsim.experiment.truth import render_truth

EVEN_W_M2_SR = 0.1
LAB = """
name = "lab"
n_frames = 2
calibration = "true"
save_reconstructions = ["random"]
[source.footage]
path = "even.npy"
axes = "tyx"
frame_rate_hz = "180 fps"
scale_w_m2_sr = 1.0
fit = "crop"
white_w_m2_sr = 0.4
full_scale = 1.0
linearisation = "linear"
[camera]
hardware = "demo"
latency_frames = 1
panel_rows = 16
panel_cols = 20
effects = { bend = "ideal", fringing = "ideal" }
[camera.sensor]
rows = 56
cols = 68
[[methods]]
name = "random"
[methods.scheme]
kind = "random_exposure"
[methods.decoder]
kind = "interpolation"
[[methods]]
name = "plain"
calibration = "ideal"
[methods.scheme]
kind = "random_exposure"
[methods.decoder]
kind = "interpolation"
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An experiment on even light."""
    folder = tmp_path_factory.mktemp("lab")
    np.save(folder / "even.npy", np.full((72, 48, 60), EVEN_W_M2_SR, np.float32))
    (folder / "lab.toml").write_text(LAB)
    return folder / "lab.toml"


@pytest.fixture(scope="module")
def experiment(lab: Path) -> Experiment:
    return load_experiment(str(lab))


@pytest.fixture(scope="module")
def run(experiment: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "lab"
    job.execute(experiment, folder)
    return folder


def test_results_name_each_file_with_its_hash(run: Path) -> None:
    said = read_json(run / "results.json")["calibration_files"]
    assert [(each["calibration"], each["file"], each["methods"]) for each in said] == [
        ("true", "calibration.npz", ["random"]),
        ("ideal", "calibration-plain.npz", ["plain"]),
    ]
    for each in said:
        assert each["sha256"] == hashlib.sha256((run / each["file"]).read_bytes()).hexdigest()
        assert read_calibration(run / each["file"]).source == each["calibration"]


def test_frames_of_a_run_are_decoded_by_another_calibration(run: Path) -> None:
    own = read_run(run, "random", None)
    other = read_run(run, "random", run / "calibration-plain.npz")
    assert (own.calibration.source, other.calibration.source) == ("true", "ideal")
    assert other.origin["calibration"] == str(run / "calibration-plain.npz")
    np.testing.assert_array_equal(own.frames[0].dn, other.frames[0].dn)
    with pytest.raises(StorageError, match="no such file or folder"):
        read_run(run, "random", run / "gone.npz")


def manual_lines() -> str:
    """Code blocks of the manual that read a calibration's file by numpy alone."""
    text = (Path(__file__).parents[1] / "docs" / "how-to" / "calibration.md").read_text(encoding="utf-8")
    part = text[text.index("## Frames and codes in numpy") :]
    return "\n".join(re.findall(r"```python\n(.*?)```", part, re.DOTALL)[:2])


@pytest.mark.parametrize("index", [0, 1])
def test_the_lines_of_the_manual_predict_frames_of_an_even_scene(
    experiment: Experiment, run: Path, index: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Residuals are as large as the noise that the file states: a false alarm in 10 000 for each of four."""
    monkeypatch.chdir(run)

    def code_of(frame: int) -> np.ndarray:
        channels, _ = read_exr(run / "codes" / "random" / f"{frame:06d}.exr")
        return np.stack([channels[slot] for slot in sorted(channels)]).astype(int)

    there = {
        "frame": np.asarray(Image.open(run / "frames" / "random" / f"{index:06d}.png")).astype(float),
        "code": code_of(index),
        "before": code_of(max(index - 1, 0)),
        "index": index,
    }
    exec(manual_lines(), there)
    k, signal, expected = there["k"], there["signal"], there["expected"]
    # What a perfect decoder would return.
    light = experiment.camera.with_nd(read_json(run / "results.json")["light_rule"]["nd_transmission"])
    irradiance = light.reference(light.form_image(render_truth(experiment)), index).mean(axis=0)
    dn = signal * k["responsivity_dn"]
    sigma = np.sqrt(k["read_noise_dn"] ** 2 + k["dn_per_e"] * dn) / k["responsivity_dn"]
    seen = k["valid"] & (dn + k["black_dn"] < k["saturation_dn"])
    assert seen.sum() > 200
    off = ((signal - irradiance * expected) / sigma)[seen]
    n = len(off)
    assert abs(off.mean()) < 3.9 / np.sqrt(n)
    assert abs((off**2).mean() - 1) < 3.9 * np.sqrt(2 / n)


def test_a_run_is_decoded_by_what_it_kept(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def anew(*_: object) -> None:
        pytest.fail("calibrated anew")

    monkeypatch.setattr(calibrations, "true_calibration", anew)
    found = read_run(run, "random")
    kept = read_calibration(run / "calibration.npz")
    np.testing.assert_array_equal(found.calibration.crosstalk, kept.crosstalk)
    decode_measurement(found, Interpolation(), tmp_path / "again")
    ours, _ = read_exr(tmp_path / "again" / "reconstruction" / "000001.exr")
    theirs, said = read_exr(run / "reconstructions" / "random" / "000001.exr")
    # Half floats of radiance.
    scaled = theirs["slot07"] * said["irradiance_per_radiance"]
    np.testing.assert_allclose(ours["slot07"], scaled, rtol=2e-3, atol=1e-6)
    assert read_run(run, "plain").calibration.source == "ideal"
    # The same as files of a measurement, by the run's folder.
    (tmp_path / "m.toml").write_text(
        f'image = "{run}/frames/random"\ncode = "{run}/codes/random"\ncalibration = "{run}"\n'
    )
    measured = read_measurement(measurement_files(tmp_path / "m.toml", []))
    first, second = ([*Interpolation().decode(m.frames, m.calibration)][1] for m in (found, measured))
    np.testing.assert_array_equal(first.irradiance_w_m2, second.irradiance_w_m2)
    digest = hashlib.sha256((run / "calibration.npz").read_bytes()).hexdigest()
    assert measured.origin["sha256"][str(run / "calibration.npz")] == digest


def test_a_kept_calibration_that_is_another_is_refused(run: Path, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    shutil.copy(copy / "calibration-plain.npz", copy / "calibration.npz")
    with pytest.raises(StorageError, match=r"calibration\.npz: got other content, expected what"):
        read_run(copy, "random")
    (copy / "calibration.npz").unlink()
    with pytest.raises(StorageError, match=r"calibration\.npz: got no such file"):
        read_run(copy, "random")


@pytest.mark.parametrize("where", ["file", "folder", "toml"])
def test_an_experiment_takes_a_calibration_from_a_path(
    lab: Path, experiment: Experiment, run: Path, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = run / "calibration.npz" if where == "file" else run
    if where == "toml":
        # Beside the experiment, which is run from elsewhere.
        text = LAB.replace('"true"', '"kept.npz"').replace("even.npy", str(lab.parent / "even.npy"))
        (tmp_path / "own.toml").write_text(text)
        (tmp_path / "kept.npz").write_bytes((run / "calibration.npz").read_bytes())
        chosen = load_experiment(str(tmp_path / "own.toml"))
    else:
        chosen = load_experiment(str(lab), [f"calibration={path}", f"methods.plain.calibration={path}"])
    job.check(chosen, None, None)
    monkeypatch.setattr(calibrations, "true_calibration", lambda *_: pytest.fail("calibrated anew"))
    kept = calibrations.calibrate_all(chosen)[chosen.calibration_choice]
    np.testing.assert_array_equal(
        kept.responsivity_dn, read_calibration(run / "calibration.npz").responsivity_dn
    )
    # A record of it can be read where the file isn't.
    again = chosen.model_dump(mode="json") | {"calibration": "/gone/calibration.npz"}
    assert Experiment.model_validate(again).calibration_choice.file == Path("/gone/calibration.npz")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["calibration=bnech"], r"calibration: .*'bnech'.*did you mean 'bench'"),
        (["calibration=/nowhere/calibration.npz"], "no such file or folder: /nowhere/calibration.npz"),
        (["calibration={run}/frames"], "holds neither calibration.npz nor bench.json"),
        (["calibration={run}", "reading_px=3"], "reading_px: got 3, expected 1"),
        (["calibration={run}", "camera.panel_rows=14"], r"got \(16, 20\) panel pixels.*expected \(14, 20\)"),
        (["calibration={run}", "camera.sensor.cols=70"], r"got \(56, 68\) CCD pixels.*expected \(56, 70\)"),
        (["calibration={run}", "camera.slots_per_frame=30"], "got 36 slots a frame, expected 30"),
        (["methods.plain.calibration={run}", "camera.panel_cols=18"], "panel pixels"),
        (["calibration={run}/results.json"], "cannot be read as a calibration"),
    ],
)
def test_what_is_no_calibration_of_this_camera_is_refused_before_any_work(
    lab: Path, run: Path, changes: list[str], message: str
) -> None:
    with pytest.raises((ConfigError, StorageError), match=message):
        job.check(load_experiment(str(lab), [each.format(run=run) for each in changes]), None, None)
