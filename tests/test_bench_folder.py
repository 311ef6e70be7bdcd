"""From an experiment to a bench's folder, from there to a calibration, and from that to a run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from small_camera import small
from test_cli import cli  # noqa: F401  a fixture

from optsim.calibration import Bench, Calibration, calibrate_from, read_calibration
from optsim.camera.bench_folder import UNFINISHED, take_bench
from optsim.camera.camera import CodedCamera
from optsim.camera.laboratory import FEW_FRAMES, measure_bench
from optsim.core.errors import StorageError
from optsim.core.files import read_tiff16

SIZE = ("--set", "camera.panel_rows=30", "--set", "camera.panel_cols=40")
CLI = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def camera() -> CodedCamera:
    sensor = small().sensor.model_copy(update={"rows": 108, "cols": 140})
    return small(panel_rows=30, panel_cols=40, sensor=sensor)


class Stop(Exception):
    """What a user's Ctrl-C is here."""


@pytest.fixture(scope="module")
def folder(camera: CodedCamera, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bench that was stopped twice, and went on."""
    folder = tmp_path_factory.mktemp("lab") / "bench"

    def stops_at(shot: int) -> Callable[[str, int, int], None]:
        def progress(stage: str, done: int, total: int) -> None:
            taken.append(done)
            if done == shot:
                raise Stop

        return progress

    taken: list[int] = []
    for shot in (1, 11):
        with pytest.raises(Stop):
            take(camera, folder, stops_at(shot))
        assert (folder / UNFINISHED).is_file()
        assert not (folder / "bench.json").exists()
    assert take(camera, folder, stops_at(-1))
    assert taken == sorted(set(taken))
    return folder


def take(camera: CodedCamera, folder: Path, progress: Callable[[str, int, int], None]) -> bool:
    rng = np.random.default_rng(11)
    return take_bench(camera, rng, folder, about={"seed": 11}, frames=FEW_FRAMES, progress=progress)


@pytest.fixture(scope="module")
def in_memory(camera: CodedCamera) -> Bench:
    return measure_bench(camera, np.random.default_rng(11), FEW_FRAMES)


def test_a_bench_that_was_stopped_has_the_images_of_one_that_was_not(folder: Path, in_memory: Bench) -> None:
    read = Bench.read(folder)
    assert [name for name, _ in read.groups()] == [name for name, _ in in_memory.groups()]
    np.testing.assert_array_equal(read.darks, in_memory.darks)
    for (name, ours), (_, theirs) in zip(read.groups(), in_memory.groups(), strict=True):
        np.testing.assert_array_equal(ours.dn, theirs.dn, err_msg=name)
    assert len(list(folder.glob("*.png"))) == 60 - 4  # no glare on so small a panel
    assert not (folder / UNFINISHED).exists()


def test_images_may_be_tiff(camera: CodedCamera, in_memory: Bench, tmp_path: Path) -> None:
    def stop(*_: object) -> None:
        raise Stop

    rng = np.random.default_rng(11)
    with pytest.raises(Stop):
        take_bench(camera, rng, tmp_path, about={}, frames=FEW_FRAMES, suffix="tiff", progress=stop)
    darks = sorted(tmp_path.glob("*.tiff"))
    np.testing.assert_array_equal(np.stack([read_tiff16(each) for each in darks]), in_memory.darks)


def test_its_calibration_is_that_of_the_images_in_memory(folder: Path, in_memory: Bench) -> None:
    ours, theirs = calibrate_from(Bench.read(folder)), calibrate_from(in_memory)
    for field in fields(Calibration):
        one, two = getattr(ours, field.name), getattr(theirs, field.name)
        if isinstance(one, np.ndarray):
            np.testing.assert_array_equal(one, two, strict=True)
        else:
            assert one == two, field.name


def test_nothing_of_the_true_camera_is_in_the_folder(folder: Path) -> None:
    text = (folder / "bench.json").read_text()
    assert {each.suffix for each in folder.iterdir()} == {".png", ".json"}
    for name in ("shift", "rotation", "tau", "contrast", "read_noise"):
        assert name not in text


def test_a_finished_bench_stays_and_another_is_refused(folder: Path, camera: CodedCamera) -> None:
    before = (folder / "bench.json").stat().st_mtime_ns
    assert not take(camera, folder, lambda *_: None)
    assert (folder / "bench.json").stat().st_mtime_ns == before
    with pytest.raises(StorageError, match=r"another bench.*cure: choose another folder"):
        take_bench(camera, np.random.default_rng(12), folder, about={}, frames=FEW_FRAMES)


@pytest.mark.slow
def test_laboratory_calibrate_and_run_hand_on_to_each_other(cli: CLI) -> None:  # noqa: F811
    code, _, err = cli("laboratory", "demo", "--few", "--out", "bench", *SIZE)
    assert code == 0, err
    code, out, err = cli("calibrate", "bench", "--out", "mine.npz", "--truth", "demo", *SIZE, "--json")
    assert code == 0, err
    record = json.loads(out)
    assert record == json.loads(Path("mine.json").read_text())
    found = read_calibration(Path("mine.npz"))
    by_key = {each["key"]: each for each in record["quantities"]}
    assert by_key["leak"]["value"] == found.response.leak
    assert by_key["dn_per_e"]["standard_error"] == found.standard_errors["dn_per_e"] > 0
    assert by_key["tau_on_s"]["true"] == pytest.approx(5e-4)
    assert 0 < record["score"]["map_rms_px"] < 0.02
    assert record["score"]["held"] >= 0.7 * record["score"]["intervals"] > 0
    page = Path("mine.html").read_text()
    assert f'data-value="{found.map_residual_px}"' in page
    assert "Against the true camera" in page
    assert not re.search(r"(src|href)=\"http", page)
    # Standard errors travel with the file, and a run takes it.
    assert set(found.standard_errors) >= {"leak", "tau_on_s", "map_px", "read_noise_dn"}
    code, _, err = cli("run", "demo", *SIZE, "--calibration", "mine.npz", "--dry-run")
    assert code == 0, err
    code, _, err = cli("run", "demo", "--calibration", "mine.npz", "--dry-run")
    assert code == 2
    assert "got (30, 40) panel pixels (rows, columns), expected (120, 160)" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("calibrate", "nowhere"), "no such file: nowhere/bench.json; a bench folder needs bench.json"),
        (("calibrate", "nowhere", "--out", "mine.txt"), "--out mine.txt: got .txt, expected .npz"),
        (("calibrate", "nowhere", "--reading-px", "2"), "expected an odd number; cure: 3"),
        (("calibrate", "nowhere", "--set", "seed=2"), "--set: got without --truth"),
        (("calibrate", "nowhere", "--truth", "dmeo"), "did you mean 'demo'"),
        (("laboratory", "dmeo", "--out", "bench"), "did you mean 'demo'"),
        (("laboratory", "demo", "--out", "bench", "--set", "camera.panel_rows=20"), "at least 24 panel pix"),
    ],
)  # fmt: skip
def test_wrong_words_end_in_one_line(cli: CLI, words: tuple[str, ...], message: str) -> None:  # noqa: F811
    code, out, err = cli(*words)
    assert code == 2
    assert out == ""
    assert message in err
    assert len(err.strip().splitlines()) == 1
    assert not Path("bench").exists()
