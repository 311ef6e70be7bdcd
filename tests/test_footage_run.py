"""A laboratory's recording through the whole camera: in memory, on disk, and on the command line."""

import json
from pathlib import Path

import numpy as np
import pytest

from optsim import render_truth, run
from optsim.core.errors import ConfigError, OptsimError
from optsim.core.files import read_exr, write_png16
from optsim.experiment import job
from optsim.experiment.experiment import Experiment, experiment_path, load_experiment
from optsim.experiment.explain import explanation
from optsim.experiment.truth import check_truth, chosen_scene, describe_truth, renderer
from optsim.footage import footage
from optsim.report.schema import check_results

ROWS, COLS, FRAMES, PITCH = 16, 20, 6, 3
SMALL = [
    f"n_frames={FRAMES}",
    f"camera.panel_rows={ROWS}",
    f"camera.panel_cols={COLS}",
    f"camera.sensor.rows={3 * ROWS + 8}",
    f"camera.sensor.cols={3 * COLS + 8}",
    "calibration=true",
]
FOOTAGE = """
[source.footage]
path = "{path}"
frame_rate_hz = "360 fps"
scale_w_m2_sr = 0.5
white_w_m2_sr = 0.4
linearisation = "linear"
full_scale = 65535
"""


def recording() -> np.ndarray:
    """360 frames a second, 16-bit codes: a texture, and a bright patch that swings over it."""
    rng = np.random.default_rng(4)
    texture = np.kron(rng.uniform(0.04, 0.3, (ROWS // 2, COLS // 2)), np.ones((6, 6)))
    frames = np.repeat(texture[None], FRAMES * 72, 0)
    for k, frame in enumerate(frames):
        col = round(22 + 12 * np.sin(2 * np.pi * k / 100))
        frame[12:28, col : col + 8] = 0.7
    return np.round(frames * 65535).astype(np.uint16)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A demo experiment whose scene is a folder of PNG beside it."""
    folder = tmp_path_factory.mktemp("laboratory")
    for k, frame in enumerate(recording()):
        write_png16(folder / "shots" / f"shot{k}.png", frame)
    demo = experiment_path("demo").read_text()
    start, stop = demo.index("[scene]"), demo.index("[camera]")
    path = folder / "lab.toml"
    path.write_text(demo[:start] + FOOTAGE.format(path="shots") + demo[stop:])
    return path


@pytest.fixture(scope="module")
def experiment(file: Path) -> Experiment:
    return load_experiment(str(file), SMALL)


@pytest.fixture(scope="module")
def results(experiment: Experiment, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("run") / "lab"
    assert job.check(experiment, folder, None)["backend"] == "none"
    job.execute(experiment, folder, command="optsim run lab.toml", export_truth=True)
    return folder, check_results(json.loads((folder / "results.json").read_text())).as_json()


@pytest.mark.slow
def test_files_and_arrays_give_the_same_frames(experiment: Experiment) -> None:
    means = recording().reshape(FRAMES * 36, 2, PITCH * ROWS, PITCH * COLS).mean(axis=1) / 65535 * 0.5
    arrays = footage(
        means.astype(np.float32), slot_s=experiment.timing.slot_s, samples_per_pitch=PITCH, white_w_m2_sr=0.4
    )
    files = render_truth(experiment)
    for slot in (0, 7, 200):
        np.testing.assert_allclose(files.load(slot).start, arrays.load(slot).start, rtol=2e-7)
    one, other = run(experiment, files), run(experiment, arrays)
    for name, frames in one.frames.items():
        # float32 rounding may tip one photon, never move the light
        worst = max(
            np.abs(a.dn.astype(int) - b.dn).max() for a, b in zip(frames, other.frames[name], strict=True)
        )
        assert worst <= 3
    assert np.ptp(one.frames["normal"][3].dn) > 100


@pytest.mark.slow
def test_a_run_says_what_its_truth_is_and_certifies_no_ceiling(results: tuple[Path, dict]) -> None:
    folder, found = results
    assert found["scene"]["name"] == "footage"
    assert found["scene"]["variation"] == "shots"
    assert found["scene"]["window_interior_ratio_before_glare"] is None
    assert "432 frames of 48 x 60 pixels at 360 Hz; uint16 of 16 bits" in found["scene"]["description"]
    assert "2 of them a slot" in found["scene"]["description"]
    assert "0.000% of pixels at full scale" in found["scene"]["description"]
    assert found["backend"] == "none: the truth is recorded footage"
    assert found["noise_ceiling"] == []
    assert found["scores"]
    html = (folder / "report.html").read_text()
    assert "no two independent halves (footage)" in html
    exported, _ = read_exr(folder / "truth" / "000002.exr")
    mean = recording()[2 * 72 : 2 * 72 + 2, :3, :3].mean() / 65535 * 0.5
    assert exported["slot00"][0, 0] == pytest.approx(mean, rel=1e-5)


def test_the_same_path_from_anywhere(file: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    found = load_experiment(str(file), SMALL)
    check_truth(found)
    assert Path(found.source.footage.path) == file.parent / "shots"


def test_explain_knows_footage(file: Path) -> None:
    record = explanation(str(file), SMALL)
    assert record["ledger"]["white"]["radiance_w_m2_sr"] == 0.4
    assert record["truth"].startswith("footage (shots): 432 frames")


def test_scenes_are_described_as_before() -> None:
    demo = load_experiment("demo")
    facts = describe_truth(demo)
    assert (facts.name, facts.variation) == ("window_room", "main")
    assert facts.white_w_m2_sr == chosen_scene(demo).white_w_m2_sr


@pytest.mark.parametrize("both", [True, False])
def test_scene_or_footage_exactly_one(both: bool, file: Path, tmp_path: Path) -> None:
    text = file.read_text()
    path = tmp_path / "wrong.toml"
    if both:
        path.write_text(text + '\n[scene]\nname = "window_room"\n')
    else:
        path.write_text(text[: text.index("[source.footage]")] + text[text.index("[camera]") :])
    with pytest.raises(ConfigError, match=f"scene, source.footage: got {'both' if both else 'neither'}"):
        load_experiment(str(path), SMALL)


def test_what_needs_a_scene_says_so(experiment: Experiment) -> None:
    with pytest.raises(ConfigError, match="takes its truth from"):
        chosen_scene(experiment)
    with pytest.raises(ConfigError, match="--backend: got 'scalar_rgb'"):
        renderer(experiment, "scalar_rgb")


def test_bad_footage_stops_before_a_run(file: Path) -> None:
    for change, text in (
        ("n_frames=7", "cover 6 coded frames, but n_frames = 7"),
        ("source.footage.path='elsewhere'", "no such file or folder"),
        ("camera.panel_rows=12", "footage has 48 x 60 pixels"),
    ):
        wrong = load_experiment(str(file), [*SMALL, change])
        with pytest.raises(OptsimError, match=text):
            job.check(wrong, None, None)
