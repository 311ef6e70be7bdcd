"""COCO instances: masks, boxes and cameras are those of the set, by other code."""

import json
import tarfile

import numpy as np
import pytest
from PIL import Image

from optsim.core.errors import ConfigError
from optsim.core.files import content_hash
from optsim.dataset import export_passes
from optsim.dataset.exports import EXPORTS
from optsim.dataset.reading import Dataset
from optsim.experiment.experiment import load_experiment
from optsim.render import choose_backend

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
def dataset(tmp_path_factory):
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    folder = tmp_path_factory.mktemp("set")
    export_passes(load_experiment("demo", SMALL), folder / "test/solids/truth", range(5, 7))
    sequences = [{"name": "test/solids", "split": "test", "seeds": []}]
    (folder / "manifest.jsonl").touch()
    listed = {"sha256": content_hash(folder / "manifest.jsonl")}
    return Dataset(folder, {"name": "solids", "sequences": sequences, "manifest": listed})


def unpacked(segmentation):
    """Decode COCO's runs: down the columns, background first."""
    rows, cols = segmentation["size"]
    flat, at, value = np.zeros(rows * cols, bool), 0, False
    for run in segmentation["counts"]:
        flat[at : at + run] = value
        at, value = at + run, not value
    assert at == flat.size
    return flat.reshape(cols, rows).T


def test_instances_are_the_masks_and_boxes_of_the_set(dataset, tmp_path):
    EXPORTS["coco"](dataset, tmp_path / "coco", lambda *_: None)
    assert not json.loads((tmp_path / "coco/instances_train.json").read_text())["images"]
    said = json.loads((tmp_path / "coco/instances_test.json").read_text())
    sample = dataset.test[0]
    ids = sample["id"]
    names = {each["id"]: each["name"] for each in said["categories"]}
    assert len(said["images"]) == 2
    assert sorted(each["id"] for each in said["annotations"]) == [*range(1, len(said["annotations"]) + 1)]
    for image in said["images"]:
        slot = int(image["file_name"][-8:-4])
        with Image.open(tmp_path / "coco" / image["file_name"]) as picture:
            assert picture.size == (image["width"], image["height"]) == ids.shape[:0:-1]
        mine = [each for each in said["annotations"] if each["image_id"] == image["id"]]
        assert {each["track_id"] for each in mine} == set(np.unique(ids[slot]).tolist()) - {
            0,
            *(number for number, name in sample.objects.items() if name.startswith(("lamp", "static"))),
        }
        for each in mine:
            mask = unpacked(each["segmentation"])
            np.testing.assert_array_equal(mask, ids[slot] == each["track_id"])
            rows, cols = np.nonzero(mask)
            box = [cols.min(), rows.min(), np.ptp(cols) + 1, np.ptp(rows) + 1]
            assert (each["bbox"], each["area"], each["iscrowd"]) == (box, mask.sum(), 0)
            label = sample.labels(slot)[each["track_id"]]
            assert names[each["category_id"]] == label["category"]
            assert 0 < each["visibility"] <= 1
            if each["bbox_amodal"][2] < image["width"] and each["area"] > 20:
                assert each["bbox_amodal"][2] > each["bbox"][2] - 2


def test_a_sequences_objects_are_listed(dataset, capsys):
    from optsim.app.dataset import show
    from optsim.core.files import write_json
    from optsim.dataset.reading import KIND

    write_json(dataset.folder / "dataset.json", {**dataset.card, "kind": KIND})
    show(dataset.folder, "test/solids")
    said = capsys.readouterr().out
    for number, label in dataset.test[0].labels(1).items():
        assert f"{number} {label['name']} ({label['category']}): " in said
    with pytest.raises(ConfigError, match=r"unknown sequence 'test/solid'; .*did you mean 'test/solids'"):
        show(dataset.folder, "test/solid")


def test_shards_and_hdf5_carry_the_labels(dataset, tmp_path):
    h5py = pytest.importorskip("h5py")
    EXPORTS["webdataset"](dataset, tmp_path / "tar", lambda *_: None)
    with tarfile.open(tmp_path / "tar/test-000000.tar") as tar:
        found = [json.load(tar.extractfile("000000.json"))["labels"]]
    EXPORTS["hdf5"](dataset, tmp_path / "set.h5", lambda *_: None)
    with h5py.File(tmp_path / "set.h5") as file:
        found.append(json.loads(file["test/solids/labels"][()]))
    expected = [dataset.test[0].labels(slot) for slot in (0, 1)]
    assert found == [[{str(k): each for k, each in slot.items()} for slot in expected]] * 2


def test_the_camera_of_a_picture_projects_as_the_sets_own(dataset, tmp_path):
    """BOP: millimetres, and pixel centres at whole numbers."""
    EXPORTS["coco"](dataset, tmp_path / "coco", lambda *_: None)
    (image, *_) = json.loads((tmp_path / "coco/instances_test.json").read_text())["images"]
    sample = dataset.test[0]
    ids, depth = sample.slot("id", 0), sample.slot("depth", 0).astype(np.float64)
    row, col = np.argwhere(ids > 0)[::97].T
    k, pose = sample.camera["intrinsics_px"], sample.camera["camera_to_world"][0]
    there = np.stack(
        [(col + 0.5 - k[0, 2]) / k[0, 0], (row + 0.5 - k[1, 2]) / k[1, 1], np.ones(len(row))], -1
    )
    world_mm = 1000 * (there * depth[row, col, None] @ pose[:3, :3].T + pose[:3, 3])
    turn, shift = np.reshape(image["cam_R_w2c"], (3, 3)), np.array(image["cam_t_w2c"])
    seen = (world_mm @ turn.T + shift) @ np.reshape(image["cam_K"], (3, 3)).T
    np.testing.assert_allclose(seen[:, :2] / seen[:, 2:], np.stack([col, row], -1), atol=1e-6)
    np.testing.assert_allclose(seen[:, 2], 1000 * depth[row, col], rtol=1e-9)
