"""A whole run on disk, tiny: every file is there, means what it says, and a second run finds the truth."""

import json
from pathlib import Path

import numpy as np
import pytest
from skimage.io import imread
from typer.testing import CliRunner

from optsim.app.cli import app
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_exr, read_json, read_png16
from optsim.decoding import GaussianMixture, SparseCoding, Union
from optsim.experiment import job
from optsim.experiment.calibrations import calibrate
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import planned
from optsim.experiment.measurement import decode_measurement
from optsim.experiment.measurement.runs import decoder_of_run, read_run
from optsim.experiment.object_masks import object_masks
from optsim.experiment.scoring import OBJECTS
from optsim.report.schema import check_results

SMALL = [
    "n_frames=6",
    "camera.panel_rows=16",
    "camera.panel_cols=20",
    "camera.sensor.rows=56",
    "camera.sensor.cols=68",
    "camera.objective.focal_length_m='0.4167 mm'",
    # The oracle takes no noise of the truth for motion: more of it, and nothing would move.
    "render.static_error=0.1",
    "render.change_error=0.1",
    "render.moving_error=0.2",
    "render.interpolation_error=0.3",
    "render.slots_per_segment=36",
    "calibration=true",
]


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment("demo", [*SMALL, "methods.random.calibration=ideal"])


@pytest.fixture(scope="module")
def folder(experiment: Experiment, tmp_path_factory: pytest.TempPathFactory) -> Path:
    where = tmp_path_factory.mktemp("run") / "demo"
    job.execute(experiment, where, command="optsim run demo", export_truth=True)
    return where


def test_a_run_whose_truth_is_refused_leaves_its_folder_free(
    experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And one that renders keeps others out from the first moment on."""
    other = load_experiment("demo", [*SMALL, "seed=5"])

    def refused(*_: object, **__: object) -> None:
        assert job.run_folder(experiment, tmp_path) == tmp_path
        with pytest.raises(StorageError, match="of another experiment"):
            job.run_folder(other, tmp_path)
        raise StorageError("frame 7 holds NaN")

    monkeypatch.setattr(job, "render_truth", refused)
    with pytest.raises(StorageError, match="frame 7"):
        job.execute(experiment, tmp_path)
    assert job.run_folder(other, tmp_path) == tmp_path
    # What an earlier run made stays that run's.
    (tmp_path / "experiment.json").write_text(json.dumps({"fingerprint": experiment.fingerprint()}))
    (tmp_path / "frames").mkdir()
    with pytest.raises(StorageError, match="frame 7"):
        job.execute(experiment, tmp_path)
    with pytest.raises(StorageError, match="of another experiment"):
        job.run_folder(other, tmp_path)


@pytest.mark.slow
def test_results_follow_their_schema_and_hold_no_nan(folder: Path, experiment: Experiment) -> None:
    text = (folder / "results.json").read_text()
    results = check_results(json.loads(text))
    assert "NaN" not in text
    assert "Infinity" not in text
    assert {s.stage for s in results.timings} >= {"render", "calibrate", "capture", "decode and score"}
    assert {s.method for s in results.scores} == {"adaptive", "normal", "hdr_mosaic", "random"}
    assert {s.phase for s in results.scores} == {"warm-up", "merging", "steady"}
    # The dictionary states no uncertainty; beside it the adaptive scheme's merge states its own.
    assert {u.method for u in results.uncertainty} == {"normal", "hdr_mosaic", "adaptive"}
    stated = [u for u in results.uncertainty if u.region == "static" and u.n]
    assert {u.method for u in stated} == {"normal", "hdr_mosaic", "adaptive"}
    assert all(u.within_one > 0.05 for u in stated)
    known = {"adaptive": "true", "normal": "true", "hdr_mosaic": "true", "random": "ideal"}
    assert results.calibrations == known
    for name, operator in known.items():
        assert results.methods[name].endswith(f", calibration: {operator}")
    # Light is that of the experiment's.
    by = calibrate(planned(experiment)[0])
    assert results.light_rule.saturation_dn == pytest.approx(np.median(by.saturation_dn - by.black_dn))
    assert results.latency.hypothetical
    assert results.noise_ceiling


def test_masks_are_scored_by_phase_and_the_report_shows_them(folder: Path, experiment: Experiment) -> None:
    results = read_json(folder / "results.json")
    pooled = {p["phase"]: p for p in results["pooled_masks"] if p["method"] == "adaptive"}
    # Latency 1 of six frames; warm-up ends with the second frame that has arrived.
    frames = {"warm-up": (0, 1), "merging": (2, 3, 4), "steady": (5,)}
    beside = {p["phase"]: p for p in results["pooled_masks"] if p["method"] == OBJECTS}
    assert len(results["pooled_masks"]) == len(pooled) + len(beside) == 6
    table = (folder / "report.html").read_text().split('id="masks"')[1].split("</table>")[0]
    for phase, found in pooled.items():
        masks = [imread(folder / "masks" / "adaptive" / f"{k:06d}.png") > 0 for k in frames[phase]]
        assert found["marked"] == pytest.approx(np.mean(masks))
        for share in ("moves", "marked", "precision", "recall", "iou"):
            # A share without meaning, as precision where nothing is marked, is a dash.
            said = "–" if found[share] is None else f"{100 * found[share]:.1f} %"
            assert f">{said}<" in table
    # Of the movers themselves, whose masks no method made, against the same oracle.
    objects = object_masks(experiment)
    assert objects is not None
    for phase, found in beside.items():
        assert found["marked"] == pytest.approx(objects[list(frames[phase])].mean())
        assert found["moves"] == pooled[phase]["moves"]
    # All of it is marked until something is known.
    assert (pooled["warm-up"]["marked"], pooled["warm-up"]["recall"]) == (1, 1)
    assert pooled["warm-up"]["precision"] == pooled["warm-up"]["moves"] == pooled["warm-up"]["iou"]
    # One frame in that phase: its own shares.
    last = next(m for m in results["masks"] if (m["method"], m["frame"]) == ("adaptive", 5))
    assert {k: last[k] for k in ("precision", "recall", "iou")}.items() <= pooled["steady"].items()


def test_every_frame_code_and_mask_is_written(folder: Path, experiment: Experiment) -> None:
    for method in experiment.methods:
        for index in range(6):
            dn = read_png16(folder / "frames" / method.name / f"{index:06d}.png")
            assert dn.shape == (56, 68)
            assert dn.max() < 2**14
            levels, said = read_exr(folder / "codes" / method.name / f"{index:06d}.exr")
            assert len(levels) == 36
            assert set(np.unique(levels["slot00"])) <= {0.0, 255.0}
            assert said["unit"].startswith("drive level")


def test_reconstructions_are_radiance_of_the_truth_s_order(folder: Path) -> None:
    video, said = read_exr(folder / "reconstructions" / "adaptive" / "000005.exr")
    truth, _ = read_exr(folder / "truth" / "000005.exr")
    assert said["unit"].startswith("W m^-2 sr^-1")
    assert len(video) == len(truth) == 36
    ratio = np.median(video["slot10"]) / np.median(truth["slot10"])
    assert 0.5 < ratio < 2, "two units would differ by far more"


def test_report_opens_without_a_network(folder: Path) -> None:
    html = (folder / "report.html").read_text()
    assert "http://" not in html
    assert "https://" not in html
    for picture in read_json(folder / "results.json")["pictures"]:
        assert (folder / picture["file"]).stat().st_size > 0


def test_the_same_folder_takes_the_same_experiment_only(folder: Path, experiment: Experiment) -> None:
    assert job.run_folder(experiment, folder) == folder
    with pytest.raises(StorageError, match="another experiment"):
        job.run_folder(load_experiment("demo", [*SMALL, "seed=2"]), folder)


@pytest.mark.slow
def test_a_second_run_finds_the_truth_and_gives_the_same_scores(
    folder: Path, experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from optsim.render.stage import RenderStage

    def rendering(*_: object, **__: object) -> None:
        pytest.fail("rendered again what the cache holds")

    monkeypatch.setattr(RenderStage, "radiance", rendering)
    again = job.execute(experiment, tmp_path / "again")
    for one, other in zip(
        again.as_json()["scores"], read_json(folder / "results.json")["scores"], strict=True
    ):
        assert {**one, "value": 0} == {**other, "value": 0}
        # Threads add overlapping patches in any order: rounding, nothing more.
        assert one["value"] == pytest.approx(other["value"], rel=1e-6)


def test_not_enough_disk_is_said_before_anything_starts(
    experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import shutil
    from collections import namedtuple

    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10, 10, 0))
    with pytest.raises(StorageError, match=r"needs about .* MB, free are 0 MB"):
        job.check(experiment, tmp_path / "new", None)


def test_a_prior_that_is_missing_is_said_before_anything_starts(
    experiment: Experiment, tmp_path: Path
) -> None:
    for decoder in (SparseCoding(dictionary="none.npz"), Union(moving=GaussianMixture(mixture="none.npz"))):
        last = experiment.methods[-1].model_copy(update={"decoder": decoder})
        wanted = experiment.model_copy(update={"methods": (*experiment.methods[:-1], last)})
        with pytest.raises(StorageError, match=r"random.*none\.npz"):
            job.check(wanted, tmp_path / "new", None)


@pytest.mark.parametrize("name", ["adaptive", "normal", "random"])
def test_a_relay_that_blurs_too_much_is_refused_before_the_render(
    name: str, experiment: Experiment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Motion detection, HDR merging and patch decoders all take the neighbours' light out."""

    def rendering(*_: object, **__: object) -> None:
        pytest.fail("rendered for a camera that can't be decoded")

    monkeypatch.setattr(job, "render_truth", rendering)
    blurry = load_experiment("demo", [*SMALL, "camera.relay.aberration_m='15 um'"])
    one = tuple(method for method in blurry.methods if method.name == name)
    with pytest.raises(ConfigError, match=rf"{name}.*crosstalk: a pixel keeps only .*row_summed"):
        job.execute(blurry.model_copy(update={"methods": one}), tmp_path / "new")


def test_a_run_too_short_for_the_steady_phase_says_so_on_the_terminal() -> None:
    short = job.Results.model_construct(title="demo", methods={"adaptive": ""}, scores=[])
    assert "too short" in job.summary(short)


def test_a_decoder_is_refused_before_a_run_s_frames_are_read(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "optsim.experiment.measurement.runs.read_frames", lambda *_: pytest.fail("frames were read")
    )
    line = ["reconstruct", str(folder), "--method", "random", "--out", str(tmp_path / "none")]
    for wrong in (["--decoder", "gausian"], ["--set", "decoder.n_atom=3"]):
        with pytest.raises(ConfigError, match=r"decoder\.(kind: got 'gausian'|n_atom: unknown key)"):
            CliRunner().invoke(app, [*line, *wrong], catch_exceptions=False)


def test_a_run_decoded_again_says_of_which_run_and_how_to_score_it(folder: Path, tmp_path: Path) -> None:
    line = ["reconstruct", str(folder), "--method", "random", "--decoder", "interpolation"]
    found = CliRunner().invoke(app, [*line, "--out", str(tmp_path / "out")], catch_exceptions=False)
    assert "--set methods.random.decoder.kind=interpolation" in found.output
    said = read_json(tmp_path / "out" / "results.json")["measurement"]
    assert (said["run"], said["method"]) == (str(folder), "random")
    assert said["fingerprint"] == read_json(folder / "experiment.json")["fingerprint"]


def test_a_run_s_frames_decode_again_to_the_same_light(folder: Path, tmp_path: Path) -> None:
    found, decoder = read_run(folder, "random"), decoder_of_run(folder, "random")
    decode_measurement(found, decoder, tmp_path / "again")
    for index in (0, 5):
        again, _ = read_exr(tmp_path / "again" / "reconstruction" / f"{index:06d}.exr")
        stored, said = read_exr(folder / "reconstructions" / "random" / f"{index:06d}.exr")
        for name, radiance in stored.items():
            # Stored as half floats: 11 bits, and steps of 6e-8 in the dark.
            scale = said["irradiance_per_radiance"]
            np.testing.assert_allclose(again[name], radiance * scale, rtol=6e-4, atol=4e-8 * scale)
    with pytest.raises(ConfigError, match=r"--method: missing; .* adaptive, normal"):
        read_run(folder, None)
    with pytest.raises(ConfigError, match=r"--method.*'randon'.*random"):
        read_run(folder, "randon")
