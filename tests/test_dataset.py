"""Data sets: splits that don't leak, files that are read as they were written, and checks that notice."""

import io
import json
import re
import tarfile
from pathlib import Path

import numpy as np
import pytest

from optsim.app.cli import app
from optsim.core.config import build
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import write_exr, write_json, write_png8, write_png16
from optsim.dataset import DatasetSpec, build_dataset, load_spec, open_dataset
from optsim.dataset.building import CHECKS, _take_back, finish, own
from optsim.dataset.card import readme
from optsim.dataset.consistency import consistency
from optsim.dataset.exports import EXPORTS
from optsim.dataset.filters import content
from optsim.dataset.regenerating import regenerate
from optsim.dataset.sources import bundled, hashes
from optsim.dataset.spec import check_spec
from optsim.dataset.verify import statistics, verify
from optsim.experiment.experiment import experiment_path, load_experiment
from optsim.render import choose_backend
from optsim.scene import load_scene

ROWS, COLS, SLOTS = 6, 8, 3
SPEC = {
    "name": "small",
    "description": "two made-up sequences",
    "scenes": {"wheel": ["main", "1"]},
    "schemes": ["adaptive"],
    "split": {"test": ["wheel/1"]},
}


def spec_of(**changes) -> DatasetSpec:
    return build(DatasetSpec, {**SPEC, **changes}, where="spec.toml")


def write_slot(path: Path, slot: int, *, flow_col: float = -0.5, moving: int = 0) -> None:
    """A wall that faces a camera which moves to the right by half a sample a slot."""
    focal, depth = 10.0, 2.0
    poses = [np.eye(4) for _ in range(3)]
    for k, pose in enumerate(poses):
        pose[0, 3] = 0.5 * (slot + k - 1) * depth / focal
    ramp = np.linspace(0.1, 1.0, ROWS * COLS, dtype=np.float32).reshape(ROWS, COLS)
    full = np.full((ROWS, COLS), 1, np.float32)
    channels = {
        "Y": ramp + np.float32(slot),
        "Y.sigma": 0.01 * full,
        "Z": depth * full,
        "distance": depth * full,
        "N.X": 0 * full,
        "N.Y": 0 * full,
        "N.Z": -full,
        "albedo": 0.5 * full,
        "id": np.ones((ROWS, COLS), np.uint32),
        **{f"flow.{way}.row": 0 * full for way in ("forward", "backward")},
        "flow.forward.col": np.float32(flow_col) * full,
        "flow.backward.col": 0.5 * full,
        **{name: np.zeros((ROWS, COLS), np.uint32) for name in ("occluded.forward", "occluded.backward")},
        "moving": (np.arange(ROWS * COLS) < moving).astype(np.uint32).reshape(ROWS, COLS),
    }
    write_exr(
        path,
        channels,
        attributes={
            "times_s": [slot - 1.0, slot + 0.0, slot + 1.0],
            "intrinsics_px": [[focal, 0, COLS / 2], [0, focal, ROWS / 2], [0, 0, 1]],
            "radial_k1": 0.0,
            "camera_to_world": [pose.tolist() for pose in poses],
            "id_table": {"1": "object/wall"},
            "object_poses": {},
        },
    )


@pytest.fixture
def folder(tmp_path) -> Path:
    """Two sequences as a build leaves them, with numbers that are easy to tell apart."""
    root = tmp_path / "set"
    write_sequences(root)
    finish(spec_of(), root, "exr", recipe=False)
    return root


def write_sequences(root: Path) -> None:
    """Write the folders of both sequences; the mover of the second fills a quarter of its pictures."""
    for sequence in spec_of().sequences():
        place = root / sequence.name
        for slot in range(SLOTS):
            mover = 12 if sequence.split == "test" else 0
            write_slot(place / "truth" / f"slot{slot:06d}.exr", slot, moving=mover)
        seed = place / "seed1"
        write_png16(seed / "frames/adaptive/000000.png", np.arange(48, dtype=np.uint16).reshape(6, 8) * 300)
        write_png8(seed / "masks/adaptive/000000.png", np.eye(4, dtype=np.uint8) * 255)
        levels = {f"slot{slot:02d}": np.full((4, 4), 10 * slot, np.float32) for slot in range(36)}
        write_exr(seed / "codes/adaptive/000000.exr", levels, attributes={}, half=True)
        write_exr(seed / "reconstructions/adaptive/000000.exr", levels, attributes={}, half=True)
        write_json(place / CHECKS, consistency(place / "truth") | content(place / "truth"))


def test_arrays_come_back_with_units_and_axes(folder):
    dataset = open_dataset(folder)
    assert (len(dataset.train), len(dataset.val), len(dataset.test)) == (1, 0, 1)
    sample = dataset.train[0]
    assert sample["radiance"].shape == (SLOTS, ROWS, COLS)
    assert sample["radiance"][2, 0, 0] == pytest.approx(2.1)
    assert sample["normal"].shape == (SLOTS, ROWS, COLS, 3)
    np.testing.assert_array_equal(sample["flow_forward"][1], [[[0.0, -0.5]] * COLS] * ROWS)
    assert sample["moving"].dtype == np.bool_
    assert (sample["frames/adaptive"].dtype, sample["frames/adaptive"][0, 5, 7]) == (np.uint16, 47 * 300)
    np.testing.assert_array_equal(sample["masks/adaptive"][0], np.eye(4, dtype=bool))
    assert (sample["codes/adaptive"].shape, sample["codes/adaptive"].dtype) == ((1, 36, 4, 4), np.uint8)
    np.testing.assert_array_equal(sample["codes/adaptive"][0, :25, 0, 0], np.arange(0, 250, 10))
    assert (sample.unit("radiance"), sample.axes("radiance")) == ("W m^-2 sr^-1", "slot, y, x")
    assert sample.axes("codes/adaptive") == "frame, slot, v, u"
    assert sample.camera["camera_to_world"].shape == (SLOTS, 4, 4)
    assert sample.objects == {1: "object/wall"}
    assert set(sample) >= {"depth", "flow_backward", "reconstructions/adaptive"}
    with pytest.raises(KeyError, match="did you mean 'radiance'"):
        sample["radianc"]


def test_the_lines_of_the_manual_read_it(folder, monkeypatch, capsys):
    page = (Path(__file__).parents[1] / "docs/how-to/datasets.md").read_text()
    code, *_ = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    exec(code.replace("reports/datasets/demo", str(folder)), {})
    assert "(3, 6, 8) W m^-2 sr^-1 slot, y, x" in capsys.readouterr().out


def test_the_spec_of_the_manual_can_be_built(tmp_path):
    page = (Path(__file__).parents[1] / "docs/how-to/datasets.md").read_text()
    text = "".join(re.findall(r"^```toml\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)[:2])
    (tmp_path / "spec.toml").write_text(text)
    spec = load_spec(str(tmp_path / "spec.toml"))
    check_spec(spec)
    assert len(spec.sequences()) == 2 * 102


def test_memory_mapped_arrays_are_the_same(folder):
    sample = open_dataset(folder).train[0]
    for name in ("radiance", "codes/adaptive"):
        sample.mapped(name).parent.mkdir(parents=True, exist_ok=True)
        plain = sample[name]
        np.save(sample.mapped(name), plain)
        assert isinstance(sample[name], np.memmap)
        np.testing.assert_array_equal(sample[name], plain)


def test_consistency_sees_a_flow_that_depth_and_poses_contradict(folder, tmp_path):
    truth = folder / "train/wheel-main-main/truth"
    good = consistency(truth)
    assert good["flow_error_px"] < 1e-6
    assert (good["id_agreement"], good["negative_share"]) == (1.0, 0.0)
    write_slot(truth / "slot000001.exr", 1, flow_col=-0.4)
    assert consistency(truth)["flow_error_px"] == pytest.approx(0.1, rel=1e-5)


@pytest.mark.parametrize("damage", ["flip", "lose", "add", "manifest"])
def test_verify_finds_a_flipped_byte_and_files_lost_or_added(folder, damage):
    assert verify(open_dataset(folder)) == []
    path = folder / "test/wheel-1-main/seed1/frames/adaptive/000000.png"
    if damage == "flip":
        content = bytearray(path.read_bytes())
        content[-20] ^= 1
        path.write_bytes(content)
    elif damage == "lose":
        path.unlink()
    elif damage == "add":
        (path.parent / "extra.png").write_bytes(b"x")
    else:
        path = folder / "manifest.jsonl"
        path.write_text(path.read_text().replace('"split": "test"', '"split": "train"'))
    (problem,) = verify(open_dataset(folder))
    assert problem.startswith(
        "manifest" if damage == "manifest" else "test/wheel-1-main/seed1/frames/adaptive/"
    )


def test_the_card_states_rates_checks_and_versions(folder):
    card = open_dataset(folder).card
    camera = card["cameras"]["main"]
    assert camera["slots_a_second"] == pytest.approx(180)
    assert camera["frames_a_second"] == pytest.approx(5)
    assert card["checks"]["flow_error_px"]["worst"] < 1e-6
    assert {"mitsuba", "numpy", "python"} <= set(card["versions"])
    text = (folder / "README.md").read_text()
    assert "2 sequences (1 train, 0 val, 1 test)" in text
    assert "No sequence was filtered out: 2 of 2" in text
    croissant = json.loads((folder / "croissant.json").read_text())
    assert croissant["distribution"][0]["sha256"] == card["manifest"]["sha256"]
    assert (folder / "contact_sheet.png").stat().st_size > 1000


def test_shards_and_transforms_hold_the_samples(folder, tmp_path):
    dataset = open_dataset(folder)
    EXPORTS["webdataset"](dataset, tmp_path / "tar", lambda *_: None)
    with tarfile.open(tmp_path / "tar/train-000000.tar") as tar:
        names = tar.getnames()
        stream = tar.extractfile("000000.radiance.npy")
        np.testing.assert_array_equal(np.load(io.BytesIO(stream.read())), dataset.train[0]["radiance"])
        about = json.load(tar.extractfile("000000.json"))
    assert about["arrays"]["radiance"]["unit"] == "W m^-2 sr^-1"
    # One key a sample, up to the first point: what loaders group by.
    assert {name.partition(".")[0] for name in names} == {"000000"}
    EXPORTS["nerf"](dataset, tmp_path / "nerf", lambda *_: None)
    said = json.loads((tmp_path / "nerf/test/wheel-1-main/transforms.json").read_text())
    pose = np.array(said["frames"][2]["transform_matrix"])
    # A point before OpenCV's camera lies on -z of OpenGL's.
    np.testing.assert_allclose(pose @ [0, 0, -1, 1], [0.2, 0, 1, 1])
    assert (said["fl_x"], said["w"], len(said["frames"])) == (10, COLS, SLOTS)
    assert (tmp_path / "nerf/test/wheel-1-main/images/000002.png").is_file()


def test_the_content_of_slots_is_measured(folder):
    found = content(folder / "test/wheel-1-main/truth")
    # All move by half a sample; Y is a ramp from 0.1 to 1, one more in each slot.
    ends = np.percentile(1 + np.linspace(0.1, 1.0, ROWS * COLS), (1, 99.9))
    expected = {"moving_share": 0.25, "speed_px": 0.5, "range_stops": np.log2(ends[1] / ends[0])}
    assert found == pytest.approx(expected, rel=1e-6)


def test_filters_drop_sequences_and_the_card_counts_them(tmp_path, capsys):
    root = tmp_path / "set"
    write_sequences(root)
    ranges = {"moving_share": [0.01, 0.6], "noise_share": [0, 0.05], "speed_px": [0, 0.6]}
    spec = spec_of(filter=ranges)
    finish(spec, root, "exr", recipe=False)
    dataset = open_dataset(root)
    assert (len(dataset.train), len(dataset.test)) == (0, 1)
    assert verify(dataset) == []
    assert "train/" not in (root / "manifest.jsonl").read_text()
    counts = {each["key"]: each["dropped"] for each in dataset.card["filters"]}
    assert counts == {"moving_share": {"train/wheel-main-main": 0.0}, "speed_px": {}, "noise_share": {}}
    # What is left of it tells a later build that it was made.
    left = {path.name for path in (root / "train/wheel-main-main").iterdir()}
    assert left == {"filtered.json", CHECKS}
    text = (root / "README.md").read_text()
    assert "1 of 2 sequences lie inside all filters" in text
    assert "over the slots | 0.01 | 0.6 | 1 |" in text
    with pytest.raises(SystemExit) as ended:
        app(["dataset", "show", str(root)])
    assert ended.value.code == 0
    assert "filter moving_share from 0.01 to 0.6: 1 of 2 dropped" in capsys.readouterr().out
    # Stopped while it drops: the same again.
    finish(spec, root, "exr", recipe=False)
    assert open_dataset(root).card["filters"] == dataset.card["filters"]


def test_filters_that_leave_nothing_are_said_and_remove_nothing(tmp_path):
    write_sequences(tmp_path)
    spec = spec_of(filter={"moving_share": [0.5, 0.6], "negative_share": [0, 0.1]})
    with pytest.raises(
        ConfigError, match=r"moving_share from 0\.5 to 0\.6: 2 of 2 dropped; negative_share"
    ) as caught:
        finish(spec, tmp_path, "exr", recipe=False)
    assert "\n" not in str(caught.value)
    assert len(list(tmp_path.rglob("slot*.exr"))) == 2 * SLOTS
    assert not (tmp_path / "dataset.json").exists()


def test_a_number_that_was_not_measured_is_outside():
    spec = spec_of(filter={"noise_share": [0, 1]})
    assert spec.filter.failed({"negative_share": 0.0}) == ["noise_share"]
    assert spec.filter.failed({"noise_share": 1.0}) == []
    assert spec_of().filter.failed({}) == []


def test_other_filters_are_a_build_of_the_same_spec(folder):
    first, files = bundled(spec_of(), folder)
    write_json(folder / "spec.json", first.model_dump(mode="json") | {"sources": hashes(files)})
    strict = spec_of(filter={"moving_share": [0.01, 1]})
    own(folder, strict)
    assert not (folder / "dataset.json").exists()
    finish(strict, folder, "exr", recipe=False)
    gone = folder / "train/wheel-main-main"
    _take_back(folder, strict)
    assert (gone / "filtered.json").is_file()
    # Wider again: it is made anew, the other one stays.
    _take_back(folder, spec_of())
    assert not gone.exists()
    assert (folder / "test/wheel-1-main/truth").is_dir()
    with pytest.raises(StorageError, match="a build of another spec"):
        own(folder, spec_of(half=True))


def test_statistics_add_up(folder):
    found = statistics(open_dataset(folder))
    assert found["val"]["samples"] == 0
    for split in ("train", "test"):
        assert sum(found[split]["stops"].values()) == pytest.approx(1)
        assert sum(found[split]["speeds_px"].values()) == pytest.approx(1)
        assert found[split]["speeds_px"][">= 0.3"] == pytest.approx(1)
        assert found[split]["moving"] == ([0, 0, 0] if split == "train" else [0.25, 0.25, 0.25])


def test_an_unfinished_set_and_one_of_another_version_are_refused(folder, tmp_path):
    with pytest.raises(StorageError, match=r"got no dataset\.json"):
        open_dataset(tmp_path / "nothing")
    card = json.loads((folder / "dataset.json").read_text())
    write_json(folder / "dataset.json", {**card, "kind": "optsim data set 9"})
    with pytest.raises(StorageError, match="expected 'optsim data set 1'"):
        open_dataset(folder)


def test_a_scene_and_variation_is_in_one_split_whatever_camera_or_seed():
    spec = spec_of(
        scenes={"wheel": ["0:400"]},
        cameras={"a": {}, "b": {"objective": {"f_number": 4.0}}},
        split={"test": 0.25, "val": 0.1},
    )
    splits: dict[str, set[str]] = {}
    for sequence in spec.sequences():
        splits.setdefault(sequence.variation, set()).add(sequence.split)
    assert len(splits) == 400
    assert all(len(each) == 1 for each in splits.values())
    counts = {split: sum(each == {split} for each in splits.values()) for split in ("train", "val", "test")}
    # Binomial, 5 sigma: false alarm 6e-7 each.
    assert abs(counts["test"] - 100) < 5 * np.sqrt(400 * 0.25 * 0.75)
    assert abs(counts["val"] - 40) < 5 * np.sqrt(400 * 0.1 * 0.9)
    fewer = spec_of(scenes={"wheel": ["0:200"]}, split={"test": 0.25, "val": 0.1})
    assert all(splits[each.variation] == {each.split} for each in fewer.sequences())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"split": {"val": ["wheel/*"], "test": ["wheel/1"]}}, "got wheel/1 in val and in test"),
        ({"split": {"val": 0.7, "test": 0.6}}, "at most 1 together"),
        ({"scenes": {"wheel": ["5:2"]}}, "expected FIRST:LAST"),
        ({"scenes": {"wheel": ["1", "0:3"]}}, "4 variations, 3 different"),
        ({"scenes": {"whel": ["main"]}}, "did you mean 'wheel'"),
        ({"scenes": {"wheel": ["fastt"]}}, "unknown variation"),
        ({"scenes": {}}, "scenes"),
        ({"schemes": ["adaptve"]}, "did you mean 'adaptive'"),
        ({"cameras": {"a": {"objective": {"f_numbr": 4}}}}, "did you mean 'f_number'"),
        ({"licens": "x"}, "licens"),
        ({"filter": {"moving": [0, 1]}}, "filter.moving"),
        (
            {"filter": {"moving_share": [0.6, 0.1]}},
            r"got \[0.6, 0.1\], expected the smaller end",
        ),
        ({"filter": {"speed_px": [0, float("inf")]}}, "filter.speed_px"),
        ({"filter": {"speed_px": 3}}, "filter.speed_px"),
        ({"experiment": "dem"}, "did you mean 'demo'"),
    ],
)
def test_bad_specs_are_said_before_any_work(changes, message):
    with pytest.raises(ConfigError, match=message):
        check_spec(spec_of(**changes))


def test_a_camera_that_drifts_from_frame_to_frame_is_refused(tmp_path):
    path = tmp_path / "going.toml"
    going = "[drift_per_frame]\nrelay = { shift_x_px = 0.1 }\n"
    path.write_text(experiment_path("demo").read_text(encoding="utf-8") + going, encoding="utf-8")
    with pytest.raises(ConfigError, match="got drift_per_frame, expected one camera"):
        check_spec(spec_of(experiment=str(path)))


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(StorageError, match="isn't empty and holds no build"):
        build_dataset(spec_of(), tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_shipped_specs_can_be_built():
    check_spec(load_spec("demo"))
    with pytest.raises(ConfigError, match="did you mean 'demo'"):
        load_spec("demoo")


def tiny_experiment(folder: Path) -> None:
    """Write tiny.toml: the demo on a small panel, as noisy as its plumbing bears."""
    demo = Path(__file__).parents[1] / "optsim/presets/demo.toml"
    small = (
        "[camera]\npanel_rows = 12\npanel_cols = 16\nsensor = { rows = 44, cols = 56 }\n"
        "objective = { focal_length_m = '0.3333 mm' }\n"
    )
    coarse = (
        "[render]\nstatic_error = 0.3\nchange_error = 0.5\nmoving_error = 0.8\ninterpolation_error = 0.3\n"
    )
    text = demo.read_text().replace("[camera]\n", coarse + small)
    # The panel is too small for a bench.
    (folder / "tiny.toml").write_text(text.replace('calibration = "bench"', 'calibration = "ideal"'))


@pytest.mark.slow
def test_a_build_makes_what_regenerate_makes_again_bit_by_bit(tmp_path):
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    tiny_experiment(tmp_path)
    text = (
        'name = "tiny"\nexperiment = "./tiny.toml"\nschemes = ["adaptive"]\n[scenes]\nwheel = ["main", "1"]\n'
        '[split]\ntest = ["wheel/1"]\n'
    )
    (tmp_path / "spec.toml").write_text(text)
    spec, root = load_spec(str(tmp_path / "spec.toml")), tmp_path / "set"
    outcome = build_dataset(spec, root, layout="npy", recipe=True, workers=1)
    assert (len(outcome.made), outcome.failed) == (2, {})
    assert not (root / "test/wheel-1-main").exists()
    assert build_dataset(spec, root, layout="npy", recipe=True, workers=1).made == ()
    dataset = open_dataset(root)
    assert regenerate(dataset, ["test/wheel-1-main"])[0] == {}
    assert verify(dataset) == []
    sample = dataset.test[0]
    assert isinstance(sample["radiance"], np.memmap)
    assert sample["radiance"].shape == (36, 36, 48)
    assert sample["frames/adaptive"].shape == (1, 44, 56)
    assert dataset.card["checks"]["flow_error_px"]["worst"] < 0.01
    assert dataset.card["checks"]["id_agreement"]["worst"] > 0.99


def test_splits_have_noise_of_their_own():
    """By default 2 % where something is evaluated; what is asked by two parts adds up to less."""
    spec = spec_of(noise={"train": {"share": 0.1}})
    train, test = (spec.experiment_of(each, 1).render for each in spec.sequences())
    for render, share in ((train, 0.1), (test, 0.02)):
        assert render.moving_error < share
        assert np.hypot(render.static_error, render.change_error) < share
    left = spec_of().experiment_of(spec_of().sequences()[0], 1).render
    assert left == load_experiment("demo").render
    with pytest.raises(ConfigError, match=r"noise\.test\.share.*0\.001"):
        spec_of(noise={"test": {"share": 0.0}})


@pytest.mark.slow
@pytest.mark.parametrize("independent", [False, True])
def test_the_noise_asked_for_is_reached(tmp_path, independent):
    """Measured by this test from the halves of the render, and as the card says."""
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    tiny_experiment(tmp_path)
    noise = f"{{ share = 0.15, independent = {str(independent).lower()} }}"
    text = (
        'name = "tiny"\nexperiment = "./tiny.toml"\nschemes = ["adaptive"]\n[scenes]\nwheel = ["0", "1"]\n'
        f'[split]\ntest = ["wheel/1"]\n[noise]\ntest = {noise}\n'
    )
    (tmp_path / "spec.toml").write_text(text)
    spec, root = load_spec(str(tmp_path / "spec.toml")), tmp_path / "set"
    assert build_dataset(spec, root, workers=1).failed == {}
    dataset = open_dataset(root)
    said = dataset.card["noise"]["test"]
    assert (said["share"], said["independent"]) == (0.15, independent)
    white = load_scene("wheel", "1").white_w_m2_sr
    sample = dataset.test[0]
    share = sample["radiance_sigma"] / (np.maximum(sample["radiance"], 0) + 0.01 * white)
    # Sigma of a sample is known to 14 %, the mean over some hundred of them to a few percent.
    # Sigma is smoothed: dark samples beside bright ones get too much of it where noise is their own.
    assert 0.05 < np.sqrt(np.mean(share**2)) < 0.15 * (1.5 if independent else 1.15)
    assert said["worst"] < 0.15 * 1.15
    slots = sample["radiance"]
    still = (sample["moving"].max(axis=0) == 0) & (sample["id"].min(axis=0) == sample["id"].max(axis=0))
    alike = (slots[1:, still] == slots[:-1, still]).mean()
    assert (alike < 0.01) == independent
    for reached in (0.14, 0.16):
        said["worst"] = reached
        assert ("**not reached**" in readme(dataset.card)) == (reached > 0.15)
