"""Builds of data sets: whole arrays, sources that travel with a set, draws, forecasts, and damaged copies."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from test_dataset import spec_of, write_sequences

from optsim.app.cli import app
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_exr, write_json
from optsim.dataset import build_dataset, forecast, load_spec, open_dataset
from optsim.dataset.building import finish, own, tasks_of
from optsim.dataset.exports import EXPORTS
from optsim.dataset.forecast import Forecast
from optsim.dataset.regenerating import regenerate
from optsim.dataset.sources import bundled, carry, check_sources, hashes, inside
from optsim.dataset.spec import check_spec, remarks
from optsim.dataset.verify import statistics, verify

SLOT = "train/wheel-main-main/truth/slot000001.exr"
TINY = """
name = "tiny"
n_frames = 1
calibration = "ideal"
[scene]
name = "wheel"
[camera]
hardware = "demo"
latency_frames = 1
panel_rows = 12
panel_cols = 16
sensor = { rows = 44, cols = 56 }
objective = { focal_length_m = "0.3333 mm" }
[render]
static_error = 0.3
change_error = 0.5
moving_error = 0.8
interpolation_error = 0.3
slots_per_segment = 36
[[methods]]
name = "random"
scheme = { kind = "random_exposure" }
decoder = { kind = "sparse_coding", dictionary = "DICTIONARY" }
[[methods]]
name = "mosaic"
scheme = { kind = "hdr_mosaic" }
decoder = { kind = "hdr_merge" }
"""
SET = """
name = "tiny"
experiment = "./tiny.toml"
schemes = ["random"]
seeds = [1, 2]
half = true
[scenes]
"./house" = ["0:2"]
"""


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two sequences as a build leaves them."""
    root = tmp_path / "set"
    write_sequences(root)
    finish(spec_of(), root, "exr", recipe=False)
    return root


@pytest.fixture
def home(tmp_path) -> Path:
    """A spec with an experiment, a dictionary and a scene of the user's own."""
    place = tmp_path / "home"
    shutil.copytree(Path(__file__).parents[1] / "scenes/wheel", place / "house")
    priors = Path(__file__).parents[1] / "optsim/priors"
    shutil.copy(next(iter(sorted(priors.rglob("dictionary*.npz")))), place / "mine.npz")
    (place / "tiny.toml").write_text(TINY.replace("DICTIONARY", str(place / "mine.npz")))
    (place / "spec.toml").write_text(SET)
    return place


# --- what a damaged copy says ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    "lost",
    [
        "truth/slot000001.exr",
        "truth/slot000002.exr",
        "seed1/codes/adaptive/000000.exr",
        "seed1/masks/adaptive/000000.png",
        "seed1/frames/adaptive",
    ],
)
def test_a_lost_file_is_refused_by_name_by_readers_and_exports(lost, folder, tmp_path):
    path = folder / "train/wheel-main-main" / lost
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    name = lost.removeprefix("truth/").removeprefix("seed1/") if "." in lost else "adaptive/000000.png"
    read = ("radiance", "codes/adaptive", "masks/adaptive", "frames/adaptive")
    with pytest.raises(StorageError, match=name):
        [open_dataset(folder).train[0][each] for each in read]
    for kind in ("webdataset", "hdf5"):
        with pytest.raises(StorageError, match=name):
            EXPORTS[kind](open_dataset(folder), tmp_path / kind, lambda *_: None)
    with pytest.raises(StorageError, match=name):
        statistics(open_dataset(folder))


def test_arrays_of_another_length_or_form_are_refused(folder):
    sample = open_dataset(folder).train[0]
    mapped = sample.mapped("radiance")
    mapped.parent.mkdir(parents=True)
    np.save(mapped, sample["radiance"][:2])
    with pytest.raises(StorageError, match=r"radiance\.npy: got 2 in it, expected 3"):
        open_dataset(folder).train[0]["radiance"]
    mapped.write_bytes(mapped.read_bytes()[:-8])
    with pytest.raises(StorageError, match=r"radiance\.npy cannot be read"):
        open_dataset(folder).train[0]["radiance"]
    frame = folder / "train/wheel-main-main/seed1/frames/adaptive/000000.png"
    frame.write_bytes(frame.read_bytes()[:40])
    with pytest.raises(StorageError, match=r"000000\.png cannot be read as PNG"):
        open_dataset(folder).train[0]["frames/adaptive"]


@pytest.mark.parametrize(
    "line",
    [
        "7",
        "[1]",
        '{"path": 1, "bytes": 1, "sha256": "0"}',
        '{"path": "../x", "bytes": 1, "sha256": "0"}',
        "{",
    ],
)
def test_a_manifest_of_anything_else_is_refused_by_its_line(line, folder):
    with (folder / "manifest.jsonl").open("a") as stream:
        stream.write(line + "\n")
    with pytest.raises(StorageError, match="expected an object with path, bytes and sha256") as caught:
        verify(open_dataset(folder))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        *({"sequences": each} for each in (None, 3, [7], [{"name": "a"}])),
        {"sequences": [{"name": 5, "split": "train", "seeds": [1]}]},
        {"sequences": [{"name": "a", "split": "train", "seeds": None}]},
        {"manifest": None},
        {"documents": []},
        {"sources": "x"},
    ],
)
def test_a_card_of_other_shape_is_refused(change, folder):
    card = json.loads((folder / "dataset.json").read_text())
    write_json(folder / "dataset.json", {**card, **change})
    with pytest.raises(StorageError, match="got no list of sequences"):
        open_dataset(folder)


def test_a_manifest_that_lost_lines_is_refused_by_readers(folder):
    path = folder / "manifest.jsonl"
    lines = path.read_bytes().splitlines()
    path.write_bytes(b"\r\n".join(lines) + b"\r\n")
    n_slots = {sample.n_slots for sample in open_dataset(folder).test}
    assert min(n_slots) > 1
    for kept in (lines[:-1], []):
        path.write_bytes(b"".join(line + b"\n" for line in kept))
        with pytest.raises(
            StorageError, match=r"manifest\.jsonl: changed since dataset\.json was written; cure"
        ):
            open_dataset(folder).samples("test")


def test_a_cut_calibration_is_said_in_a_line(folder):
    sample = open_dataset(folder).test[0]
    (sample.folder / "seed1/calibration.npz").write_bytes(b"PK\3\4 and no end")
    with pytest.raises(StorageError, match=r"calibration\.npz cannot be read as NPZ") as caught:
        list(sample)
    assert "\n" not in str(caught.value)


def test_files_that_systems_leave_are_no_arrays(folder):
    sample = open_dataset(folder).test[0]
    names = list(sample)
    for place in (sample.folder / "seed1").iterdir():
        if place.is_dir():
            (place / ".DS_Store").write_bytes(b"x")
    assert list(open_dataset(folder).test[0]) == names


def test_verify_tells_what_lies_outside_of_sequences(folder):
    (folder / "more").mkdir()
    for name in ("junk.bin", "more/junk.exr", ".DS_Store"):
        (folder / name).write_text("x")
    (folder / "away").symlink_to("/nowhere")
    with (folder / "README.md").open("a") as stream:
        stream.write("more")
    strange = {f"{name}: not in the manifest" for name in ("junk.bin", "more/junk.exr", ".DS_Store", "away")}
    assert set(verify(open_dataset(folder))) == strange | {"README.md: changed"}


# --- sources --------------------------------------------------------------------------------------------


def test_a_set_carries_its_experiment_scenes_and_their_files(home, tmp_path, monkeypatch):
    spec, root = load_spec(str(home / "spec.toml")), tmp_path / "set"
    mine, sources = own(root, spec)
    files = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    assert {"experiment.toml", "scenes/house/scene.toml", "spec.json"} < files
    assert any(name.endswith("/mine.npz") for name in files)
    assert str(home) not in (root / "spec.json").read_text() + (root / "experiment.toml").read_text()
    keys = [task.key for task in tasks_of(mine, root, "exr", sources)]
    # Moved, and the spec's folder gone: the same tasks.
    shutil.rmtree(home)
    root.rename(tmp_path / "moved")
    again = tasks_of(mine, tmp_path / "moved", "exr", sources)
    assert [task.key for task in again] == keys
    with inside(tmp_path / "moved"):
        experiment = mine.experiment_of(mine.sequences()[0], 1)
        assert Path(experiment.methods[0].decoder.dictionary).is_file()
    assert str(tmp_path) not in experiment.model_dump_json()
    scene = tmp_path / "moved/scenes/house/scene.toml"
    scene.write_text(scene.read_text() + "\n")
    with pytest.raises(StorageError, match=r"scenes/house/scene\.toml: got it lost or changed"):
        tasks_of(mine, tmp_path / "moved", "exr", sources)


def test_a_build_does_not_go_on_with_other_files(home, tmp_path):
    spec = load_spec(str(home / "spec.toml"))
    own(tmp_path / "set", spec)
    own(tmp_path / "set", spec)
    (home / "house/extra.obj").write_text("v 0 0 0\n")
    with pytest.raises(StorageError, match=r"in which scenes/house/extra\.obj was another file"):
        own(tmp_path / "set", spec)


def test_a_shipped_scene_that_changed_is_refused_by_name(tmp_path):
    _, files = bundled(spec_of(), tmp_path)
    known = hashes(files)
    carry(files, tmp_path)
    check_sources(tmp_path, known)
    place = next(name for name in known if name.startswith("shipped:wheel/"))
    with pytest.raises(StorageError, match=r"wheel/scene\.toml: got it lost or changed.*version of optsim"):
        check_sources(tmp_path, {**known, place: "0"})


def test_scenes_of_one_name_or_of_any_size_are_refused(home, tmp_path, monkeypatch):
    shutil.copytree(home / "house", home / "b/house")
    scenes = {str(home / "house"): ("0",), str(home / "b/house"): ("1",)}
    with pytest.raises(ConfigError, match="got two folders named 'house'"):
        bundled(spec_of(scenes=scenes, split={}), tmp_path / "set")
    monkeypatch.setattr("optsim.dataset.sources._MOST_BYTES", 10)
    with pytest.raises(ConfigError, match=r"house has .* GB, expected at most"):
        bundled(spec_of(scenes={str(home / "house"): ("0",)}, split={}), tmp_path / "set")


def test_listing_a_thousand_sequences_takes_no_scene_each(tmp_path):
    spec, sources = own(tmp_path / "set", spec_of(scenes={"wheel": ["0:1000"]}, split={}))
    tasks_of(spec, tmp_path / "set", "exr", sources)
    start = time.process_time()
    tasks = tasks_of(spec, tmp_path / "set", "exr", sources)
    assert len({task.key for task in tasks}) == 1000
    assert (time.process_time() - start) / 1000 < 0.005
    # A worker gets its own part of the list.
    assert tasks[7].arguments[1]["scenes"] == {"wheel": ["7"]}


# --- spec -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenes": {"wheel": ["0:3"]}, "split": {"val": 0.01}}, r"split\.val: got a share of 0\.01"),
        ({"scenes": {"wheel": ["0:3"]}, "split": {"test": 0.01}}, r"split\.test: .* none of the 3 seq"),
        ({"scenes": {"wheel": ["0:3"]}, "split": {"val": 0.5, "test": 0.49999}}, r"split\.train"),
        ({"scenes": {"wheel": ["0:1000000000"]}}, "at most 1000000 variations"),
        ({"n_frames": 100_000_000}, "at most 10000"),
    ],
)
def test_shares_of_nothing_and_endless_lists_are_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        check_spec(spec_of(**changes))


def test_a_set_too_short_for_its_adaptive_scheme_is_said_before_the_work():
    # The demo's latency is 1: frame 2 (counted from 0) is the first to know two frames, frame 5 is steady.
    (said,) = remarks(spec_of())
    assert "adaptive is its moving code in all 1 frames" in said
    (said,) = remarks(spec_of(n_frames=3))
    assert said == (
        "n_frames = 3: adaptive has no steady frame; its first adapted frame is number 3, its first steady "
        "one number 6"
    )
    assert remarks(spec_of(n_frames=6)) == []
    assert remarks(spec_of(schemes=["random"])) == []
    assert remarks(load_spec("demo")) == []


def test_each_sequence_has_draws_of_its_own_whatever_its_split():
    spec = spec_of(seeds=[1, 2])
    first, second = spec.sequences()
    draws = {spec.draws_of(each, seed) for each in (first, second) for seed in (1, 2)}
    assert len(draws) == 4
    moved = spec_of(seeds=[1, 2], split={}).sequences()[1]
    assert (moved.split, second.split) == ("train", "test")
    assert spec.draws_of(moved, 1) == spec.draws_of(second, 1)
    same = spec_of(same_draws=True)
    assert {same.draws_of(each, 1) for each in (first, second)} == {1}


# --- forecast -------------------------------------------------------------------------------------------


def test_wall_time_follows_from_core_seconds():
    said = Forecast(12, 10, core_s=1000.0, serial_s=600.0, disk_mb=1, peak_mb=1, measured=2)
    # One worker on two cores halves what is not serial; two workers have a core each.
    assert said.wall_s(1, cores=2) == pytest.approx(600 + 400 / 2)
    assert said.wall_s(2, cores=2) == pytest.approx(1000 / 2)
    assert said.wall_s(1, cores=1) == pytest.approx(1000)
    assert said.wall_s(100, cores=100) == pytest.approx((600 + 400 / 10) / 10)


def _record(root: Path, name: str, key: str, **numbers: float) -> None:
    (root / name).mkdir(parents=True)
    write_json(root / f".tasks/{name.replace('/', '__')}.json", {"key": key, **numbers})


def test_a_forecast_takes_the_records_that_are_there(tmp_path):
    spec, root = spec_of(scenes={"wheel": ["0:10"]}, split={}), tmp_path / "set"
    mine, sources = own(root, spec)
    numbers = {"seconds": 8.0, "threads": 2, "disk_mb": 3.0, "peak_mb": 500.0}
    for task, core_s in zip(tasks_of(mine, root, "exr", sources)[:3], (30.0, 10.0, 12.0), strict=False):
        _record(root, task.name, task.key, core_s=core_s, **numbers)
    said = forecast(spec, root)
    # The slowest one compiled; 2 x 8 s of two threads did 10 or 12 core-seconds: 6 or 4 s alone.
    assert (said.sequences, said.to_do, said.measured) == (10, 7, 3)
    assert said.core_s == pytest.approx(7 * 11)
    assert said.serial_s == pytest.approx(7 * 5)
    assert (said.disk_mb, said.peak_mb) == (pytest.approx(30), 500)


def test_failed_pilots_are_named(tmp_path, monkeypatch, capsys):
    from optsim.dataset import forecast as forecasting
    from optsim.tasks import Outcome

    def failing(tasks, root, **_):
        return Outcome((), (), {task.name: "light: got none" for task in tasks})

    monkeypatch.setattr(sys.modules["optsim.dataset.forecast"], "run_tasks", failing)
    assert forecasting(spec_of(), tmp_path / "a").failed
    with pytest.raises(SystemExit) as ended:
        app(["dataset", "build", "demo", "--out", str(tmp_path / "b"), "--plan"])
    assert ended.value.code == 1
    assert "train/flying_solids-0-" in capsys.readouterr().err


# --- whole builds ---------------------------------------------------------------------------------------


def _made(root: Path, number: int) -> Path:
    """Make one sequence of the set in this process, as a worker does."""
    spec, sources = own(root, load_spec(str(root.parent / "home/spec.toml")))
    task = tasks_of(spec, root, "npy", sources)[number]
    place = root / "made" / str(number)
    place.mkdir(parents=True, exist_ok=True)
    task.make(place, *task.arguments)
    return place


def _files(place: Path) -> dict[str, bytes]:
    return {
        path.relative_to(place).as_posix(): path.read_bytes() for path in place.rglob("*") if path.is_file()
    }


@pytest.mark.slow
def test_arrays_of_two_seeds_are_whole_also_after_a_stop(home, tmp_path):
    first = _made(tmp_path / "set", 0)
    before = _files(first)
    assert {"arrays/radiance.npy", "arrays/seed1/codes/random.npy", "arrays/seed2/codes/random.npy"} < {
        *before
    }
    # Stopped while an array was written: the same call goes on.
    (first / "arrays/radiance.npy").write_bytes(before["arrays/radiance.npy"][:1000])
    (first / "arrays/seed2/codes/random.npy").unlink()
    assert _files(_made(tmp_path / "set", 0)) == before
    codes = [np.load(first / f"arrays/seed{seed}/codes/random.npy") for seed in (1, 2)]
    other = np.load(_made(tmp_path / "set", 1) / "arrays/seed1/codes/random.npy")
    # Each seed and each sequence has a code of its own, and frames say which.
    assert not np.array_equal(*codes)
    assert not np.array_equal(codes[0], other)
    slots = [read_exr(path)[0]["Y"] for path in sorted((first / "truth").glob("slot*.exr"))]
    np.testing.assert_array_equal(np.load(first / "arrays/radiance.npy"), np.stack(slots))


@pytest.mark.slow
def test_a_killed_build_goes_on_and_a_moved_set_is_made_again_from_itself(home, tmp_path):
    root = tmp_path / "set"
    command = [str(Path(sys.executable).with_name("optsim")), "dataset", "build", str(home / "spec.toml")]
    command += ["--out", str(root), "--layout", "npy", "--workers", "1"]
    running = subprocess.Popen(command, start_new_session=True)
    # In the midst of the first sequence.
    while not list(root.glob("train/.*.part")) and running.poll() is None:
        time.sleep(0.005)
    os.killpg(running.pid, signal.SIGKILL)
    running.wait()
    # Its workers let go of what they claimed when they are dead, too.
    time.sleep(2)
    assert not (root / "dataset.json").exists()
    outcome = build_dataset(load_spec(str(home / "spec.toml")), root, layout="npy", workers=1)
    assert (len(outcome.made) + len(outcome.found), outcome.failed) == (2, {})
    assert verify(open_dataset(root)) == []
    shutil.rmtree(home)
    root.rename(tmp_path / "moved")
    dataset = open_dataset(tmp_path / "moved")
    name, slot = "train/house-0-main", tmp_path / "moved/train/house-0-main/truth/slot000003.exr"
    whole = slot.read_bytes()
    slot.unlink()
    assert regenerate(dataset, [name]) == ({}, 1)
    assert slot.read_bytes() == whole
    assert verify(dataset) == []
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []
    # A manifest of something else is noticed, and the set stays as it is.
    listed = dataset.folder / "manifest.jsonl"
    listed.write_text(listed.read_text().replace('"sha256": "', '"sha256": "0', 1))
    problems, restored = regenerate(dataset, [name])
    assert restored == 0
    assert "1 files are not as in the manifest" in problems[name]
    assert slot.read_bytes() == whole
