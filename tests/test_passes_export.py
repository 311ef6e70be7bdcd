"""Slots on disk: every channel comes back, an interrupted export resumes, and other folders are refused."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_exr, read_json, write_exr
from optsim.core.quantities import Block, RadianceVideo, Segment
from optsim.dataset import export_passes, parse_slots
from optsim.dataset.channels import HALF_CHANNELS, channels_of, noise_sigma, slot_mean
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.truth import chosen_scene, render_truth
from optsim.render import choose_backend, render_passes
from optsim.report.pass_sheet import flow_colours

SMALL = [
    "n_frames=1",
    "camera.panel_rows=24",
    "camera.panel_cols=32",
    "camera.sensor.rows=80",
    "camera.sensor.cols=104",
    "camera.objective.focal_length_m='0.6667 mm'",
    "render.static_error=0.3",
    "render.change_error=0.5",
    "render.moving_error=0.8",
    "render.interpolation_error=0.3",
    "render.slots_per_segment=36",
]


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    return load_experiment("demo", SMALL)


@pytest.fixture(scope="module")
def folder(experiment, tmp_path_factory) -> Path:
    where = tmp_path_factory.mktemp("passes") / "out"
    export_passes(experiment, where, range(7, 10))
    return where


def test_a_slot_holds_its_mean_radiance_and_the_passes_of_its_middle(experiment, folder) -> None:
    channels, said = read_exr(folder / "slot000008.exr")
    slot_s = experiment.timing.slot_s
    passes = render_passes(chosen_scene(experiment), experiment.camera.view, 8.5 * slot_s, slot_s)
    radiance = render_truth(experiment)
    for name, expected in channels_of(passes, slot_mean(radiance, 8), None).items():
        assert channels[name].dtype == expected.dtype, name
        if name == "Y":
            np.testing.assert_allclose(channels[name], expected, rtol=1e-6)
        else:
            # Rays along an edge may take either side; a graphics card rounds each time anew.
            same = np.isclose(channels[name], expected, rtol=1e-4, atol=1e-5)
            assert np.mean(~same) < 0.003, name
    assert {*channels} == {*channels_of(passes, channels["Y"], channels["Y.sigma"])}
    assert said["times_s"] == pytest.approx([7.5 * slot_s, 8.5 * slot_s, 9.5 * slot_s], abs=1e-12)
    assert (said["slot_start_s"], said["slot_stop_s"]) == pytest.approx((8 * slot_s, 9 * slot_s))
    np.testing.assert_array_equal(said["intrinsics_px"], passes.intrinsics_px)
    np.testing.assert_array_equal(said["camera_to_world"], passes.camera_to_world)
    assert {int(k): v for k, v in said["id_table"].items()} == passes.id_table
    poses = said["object_poses"]
    assert poses["mover/walker"]["world_at_0_to_world"] is None
    assert "deforms" in poses["mover/walker"]["reason"]
    fan = passes.object_poses["mover/fan"].matrices
    np.testing.assert_array_equal(poses["mover/fan"]["world_at_0_to_world"], fan)
    assert said["units"]["Y"] == "W m^-2 sr^-1"
    assert said["render"]["static_error"] == 0.3
    assert said["versions"]["mitsuba"]


def test_the_noise_of_a_slot_is_that_slots_own(experiment, folder) -> None:
    """The mean square of half the difference of the two halves over an object's samples in 5 x 5, by hand."""
    channels, _ = read_exr(folder / "slot000008.exr")
    half = render_truth(experiment).half_difference
    segment = half.load(8 // half.slots_per_segment)
    n, first = half.instants_per_slot, 8 % half.slots_per_segment * half.instants_per_slot
    noise = np.mean([segment.instant(first + k) for k in range(n)], axis=0, dtype=np.float64)
    rows, cols = noise.shape
    for y, x in ((0, 0), (5, 40), (36, 48), (50, 20), (rows - 1, cols - 1)):
        around = np.s_[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
        mine = channels["id"][around] == channels["id"][y, x]
        expected = np.sqrt(np.mean(noise[around][mine] ** 2))
        assert channels["Y.sigma"][y, x] == pytest.approx(expected, rel=1e-4, abs=1e-9)


def test_the_round_trip_is_exact_and_half_keeps_its_promise(experiment, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    slot_s = experiment.timing.slot_s
    passes = render_passes(chosen_scene(experiment), experiment.camera.view, 0.1, slot_s)
    shape = passes.ids.shape
    channels = channels_of(passes, rng.gamma(1.0, 3.0, shape).astype(np.float32), np.ones(shape, np.float32))
    # Neighbouring ids that float32 cannot tell apart, up to the last one.
    channels["id"] = (np.arange(passes.ids.size, dtype=np.uint32) + np.uint32(2**24 + 1)).reshape(shape)
    channels["id"][-1, -1] = 2**32 - 1
    for half in (False, HALF_CHANNELS):
        write_exr(tmp_path / "a.exr", channels, attributes={}, half=half)
        back, _ = read_exr(tmp_path / "a.exr")
        for name, written in channels.items():
            assert back[name].dtype == written.dtype
            if half and name in HALF_CHANNELS:
                np.testing.assert_allclose(back[name], written, rtol=2**-11, atol=3e-8)
                assert (back[name] != written).any(), name
            else:
                np.testing.assert_array_equal(back[name], written)


def _shared_noise(first: np.ndarray, second: np.ndarray) -> float:
    """Mean product of signs: 1 for the same noise, 0 +- 1 / sqrt(n) for independent noise."""
    return float(np.mean(np.sign(first) * np.sign(second)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_still_pixels_share_their_noise_unless_it_is_to_be_independent(experiment, folder, tmp_path) -> None:
    """Half differences are symmetric, so signs of independent ones agree by half: false alarm 7e-6."""
    share = 0.2
    export_passes(experiment, tmp_path, range(8, 10), noise_share=share)
    channels, said = read_exr(tmp_path / "slot000008.exr")
    still = (channels["moving"] == 0) & (read_exr(tmp_path / "slot000009.exr")[0]["moving"] == 0)
    own, common = render_truth(experiment, slot_error=share), render_truth(experiment)
    np.testing.assert_allclose(channels["Y"], slot_mean(own, 8), rtol=1e-6)
    noise = {
        video: [slot_mean(video.half_difference, slot)[still] for slot in (8, 9)] for video in (own, common)
    }
    assert _shared_noise(*noise[common]) > 0.8
    assert abs(_shared_noise(*noise[own])) < 4.5 / np.sqrt(still.sum())
    # Both find the same light: their difference is a draw from the noise of both.
    sigma = np.hypot(channels["Y.sigma"], read_exr(folder / "slot000008.exr")[0]["Y.sigma"])
    apart = (channels["Y"] - slot_mean(common, 8))[still] / sigma[still]
    assert abs(np.mean(np.clip(apart, -3, 3))) < 0.1
    # The manifest's share is that of the definition, and within 10 % of the target.
    measured = [item["noise_share"] for item in read_json(tmp_path / "manifest.json")["files"]]
    floor = 0.01 * own.white_w_m2_sr
    half = slot_mean(own.half_difference, 8) / (np.maximum(channels["Y"], 0) + floor)
    assert measured[0] == pytest.approx(_rms(half), rel=1e-4)
    assert all(0.9 * share <= each <= share for each in measured)
    # Two slots differ by as much as their halves say.
    light = [slot_mean(own, slot)[still] for slot in (8, 9)]
    scale = np.mean(light, axis=0) + floor
    assert _rms((light[0] - light[1]) / scale) == pytest.approx(_rms(np.hypot(*noise[own]) / scale), rel=0.15)
    assert said["noise_share"] == measured[0]
    assert said["noise"]["independent"]
    assert "frozen" not in said["conventions"]["noise"]
    assert not read_exr(folder / "slot000008.exr")[1]["noise"]["independent"]
    with pytest.raises(StorageError, match="another truth"):
        export_passes(experiment, tmp_path, range(8, 10))


def test_the_manifest_lists_the_files(folder) -> None:
    import hashlib

    manifest = read_json(folder / "manifest.json")
    assert manifest["complete"]
    assert [item["slot"] for item in manifest["files"]] == [7, 8, 9]
    for item in manifest["files"]:
        content = (folder / item["file"]).read_bytes()
        assert (item["bytes"], item["sha256"]) == (len(content), hashlib.sha256(content).hexdigest())
    assert manifest["shape"] == [72, 96]
    assert manifest["experiment"]["scene"]["name"] == "window_room"
    with Image.open(folder / manifest["picture"]) as picture:
        assert min(picture.size) > 500
        assert len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 200


def test_whole_files_stay_damaged_and_missing_ones_come_back(experiment, tmp_path: Path) -> None:
    export_passes(experiment, tmp_path, range(4))
    files = [tmp_path / f"slot{slot:06d}.exr" for slot in range(5)]
    good = files[0].read_bytes()
    files[0].write_bytes(good[: len(good) // 2])
    files[2].unlink()
    # Readable, but with other numbers than the manifest's hash is of.
    channels, said = read_exr(files[3])
    write_exr(files[3], channels | {"Y": channels["Y"] + 1}, attributes=said)
    # In no manifest, and of another slot.
    files[4].write_bytes(good)
    stamp = files[1].stat().st_mtime_ns
    done = []
    export_passes(experiment, tmp_path, range(5), progress=lambda stage, n, total: done.append((stage, n)))
    assert [n for stage, n in done if stage == "passes"] == [1, 2, 3, 4]
    assert files[1].stat().st_mtime_ns == stamp
    for path in files:
        _whole(path)
    np.testing.assert_allclose(read_exr(files[3])[0]["Y"], channels["Y"], rtol=1e-6)
    assert [item["slot"] for item in read_json(tmp_path / "manifest.json")["files"]] == [0, 1, 2, 3, 4]


KILLED = """
import os, signal, sys
from pathlib import Path
from optsim.experiment.experiment import load_experiment
from optsim.dataset import export_passes
import optsim.dataset.export as export
import OpenEXR
calls = []
class File(OpenEXR.File):
    def write(self, name):
        super().write(name)
        calls.append(name)
        if len(calls) == 3:  # the third slot, written under its hidden name, not yet renamed
            os.kill(os.getpid(), signal.SIGKILL)
OpenEXR.File = File
export_passes(load_experiment("demo", {small!r}), Path(sys.argv[1]), range(4))
"""


def test_an_export_killed_in_the_middle_resumes(experiment, tmp_path: Path) -> None:
    where = tmp_path / "out"
    code = KILLED.format(small=SMALL)
    done = subprocess.run([sys.executable, "-c", code, str(where)], capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert sorted(p.name for p in where.glob("slot*")) == ["slot000000.exr", "slot000001.exr"]
    assert len(list(where.glob(".*.part.*"))) == 1
    assert not read_json(where / "manifest.json")["complete"]
    kept = {path: path.stat().st_mtime_ns for path in where.glob("slot*")}
    export_passes(experiment, where, range(4))
    assert len(list(where.glob("slot*"))) == 4
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    assert not list(where.glob(".*"))
    manifest = read_json(where / "manifest.json")
    assert manifest["complete"]
    assert len(manifest["files"]) == 4


def _whole(path: Path) -> None:
    channels, said = read_exr(path)
    assert channels["Y"].shape == (72, 96)
    assert said["slot"] == int(path.stem[4:])


def test_other_folders_are_refused(experiment, folder, tmp_path: Path) -> None:
    with pytest.raises(StorageError, match="another truth"):
        export_passes(experiment, folder, range(1), half=True)
    other = load_experiment("demo", [*SMALL, "render.static_error=0.4"])
    with pytest.raises(StorageError, match="another truth"):
        export_passes(other, folder, range(1))
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(StorageError, match="no export of passes"):
        export_passes(experiment, tmp_path)
    with pytest.raises(StorageError, match="is a file"):
        export_passes(experiment, tmp_path / "letter.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_bad_slots_are_named_before_anything_is_rendered(experiment, tmp_path: Path) -> None:
    for slots in (range(36, 40), range(30, 37), range(5, 5), range(-1, 3)):
        with pytest.raises(ConfigError, match="0:36"):
            export_passes(experiment, tmp_path / "out", slots)
    assert not (tmp_path / "out").exists()
    assert parse_slots("0:36") == range(36)
    for text in ("36", "a:b", "3:3", "5:2", "-1:3", ":", "1:2:3"):
        with pytest.raises(ConfigError, match="FIRST:LAST"):
            parse_slots(text)


def test_the_mean_of_a_slot() -> None:
    """A linear base plus a block: the mean over the slot's instants, in closed form."""
    start, stop = np.full((6, 9), 2, np.float32), np.full((6, 9), 10, np.float32)
    excess = np.arange(8, dtype=np.float32)[:, None, None] * np.ones((1, 2, 3), np.float32)
    segment = Segment(start, stop, (Block(1, 4, excess),), 8)
    video = RadianceVideo(6, 9, 3, 0.1, 4, 2, 2, load=lambda index: segment)
    mean = slot_mean(video, 1)
    # Second half of the segment: the base goes from 6 to 10, the block has 4, 5, 6, 7.
    np.testing.assert_allclose(mean[0], 8, rtol=1e-6)
    np.testing.assert_allclose(mean[1:3, 4:7], 8 + 5.5, rtol=1e-6)
    np.testing.assert_allclose(slot_mean(video, 0)[1:3, 4:7], 4 + 1.5, rtol=1e-6)


def test_noise_is_measured_and_stays_with_its_object() -> None:
    rng = np.random.default_rng(11)
    ids = np.zeros((120, 160), np.uint32)
    ids[:, 80:] = 7
    true = np.where(ids > 0, 5.0, 0.1)
    sigma = noise_sigma((true * rng.normal(size=ids.shape)).astype(np.float32), ids)
    # A mean square of n values is sqrt(2 / n) uncertain; n = 120 x 80: 1.4 %. Four of these: a false
    # alarm in 16 000, and the seed is fixed.
    for side in (slice(0, 80), slice(80, 160)):
        share = np.mean((sigma[:, side] / true[:, side]) ** 2)
        assert abs(share - 1) < 0.06
    spread = np.std((sigma / true)[2:-2, 2:78] ** 2)
    assert spread == pytest.approx(np.sqrt(2 / 25), rel=0.15)


def test_colours_of_flow_tell_directions_apart() -> None:
    angle = np.arange(12) * np.pi / 6
    ring = flow_colours(np.sin(angle)[None], np.cos(angle)[None], 1.0)[0].astype(int)
    assert min(np.abs(a - b).sum() for i, a in enumerate(ring) for b in ring[:i]) > 60
    assert (flow_colours(np.zeros((1, 1)), np.zeros((1, 1)), 1.0) == 255).all()
    assert (flow_colours(np.zeros((1, 1)), np.zeros((1, 1)), 0.0) == 255).all()


def test_the_command_line(experiment, tmp_path: Path, monkeypatch, capsys) -> None:
    from optsim.app.cli import main

    def call(*words: str) -> tuple[int, str]:
        settings = [word for item in SMALL for word in ("--set", item)]
        monkeypatch.setattr(sys, "argv", ["optsim", "render", "demo", *settings, *words])
        try:
            main()
        except SystemExit as stop:
            return int(stop.code or 0), capsys.readouterr().err
        return 0, capsys.readouterr().err

    out = tmp_path / "out"
    assert call("--passes", "--slots", "2:3", "--half", "--out", str(out))[0] == 0
    assert {path.name for path in out.iterdir()} == {"slot000002.exr", "manifest.json", "passes.png"}
    assert json.loads((out / "manifest.json").read_text())["half"] == list(HALF_CHANNELS)
    for words, message in (
        (("--passes",), "--passes: got no --out"),
        (("--slots", "0:1", "--out", str(tmp_path / "b")), "optsim: --slots: got without --passes"),
        (("--half",), "optsim: --half: got without --passes"),
        (("--noise-share", "0.01"), "optsim: --noise-share: got without --passes"),
        (("--independent-noise",), "optsim: --independent-noise: got without --passes"),
        (("--passes", "--noise-share", "nan", "--out", str(tmp_path / "b")), "expected 0.001 to 1"),
        (("--half", "--slots", "0:1"), "optsim: --slots, --half: got without --passes"),
        (("--passes", "--slots", "0-3", "--out", str(tmp_path / "b")), "FIRST:LAST"),
        (("--passes", "--slots", "35:37", "--out", str(tmp_path / "b")), "0:36"),
        (("--passes", "--out", str(out)), "another truth"),
    ):
        code, err = call(*words)
        assert (code, message in err) == (2, True), err
    assert not (tmp_path / "b").exists()
    assert os.listdir(tmp_path) == ["out"]
