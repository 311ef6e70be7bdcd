"""A data set as COCO instances, with the camera of each picture as BOP states it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.files import write_json, write_png8
from optsim.core.folder_claims import claimed_empty
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bools, Doubles
from optsim.dataset.reading import Array, Dataset, Sample
from optsim.dataset.spec import SPLITS
from optsim.optics.srgb import linear_to_srgb


def export_coco(dataset: Dataset, folder: Path, progress: Progress = silent) -> None:
    """Write 8-bit pictures and ``instances_SPLIT.json``; all splits share the ids of categories."""
    categories: dict[str, int] = {}
    with claimed_empty(folder):
        found: dict[str, dict[str, Any]] = {}
        for split in SPLITS:
            images: list[dict[str, Any]] = []
            annotations: list[dict[str, Any]] = []
            samples = {sample.about["name"]: sample for sample in dataset.samples(split)}
            for done, (name, sample) in enumerate(samples.items(), start=1):
                for slot, picture in enumerate(eight_bits(sample)[0]):
                    file = f"images/{name}/{slot:06d}.png"
                    write_png8(folder / file, picture)
                    size = {"height": picture.shape[0], "width": picture.shape[1]}
                    image = {"id": len(images) + 1, "file_name": file, **size, **_camera(sample, slot)}
                    images.append(image)
                    ids = sample.slot("id", slot)
                    for number, label in sample.labels(slot).items():
                        if label["visible"]:
                            category = categories.setdefault(label["category"], len(categories) + 1)
                            of = {"image_id": image["id"], "category_id": category, "track_id": number}
                            about = _instance(ids == number, label)
                            annotations.append({"id": len(annotations) + 1, **of, **about})
                progress(f"coco {split}", done, len(samples))
            found[split] = {"images": images, "annotations": annotations}
        listed = [{"id": number, "name": name} for name, number in categories.items()]
        about: dict[str, Any] = {"info": {"description": dataset.card["name"]}, "licenses": []}
        for split, said in found.items():
            write_json(folder / f"instances_{split}.json", {**about, **said, "categories": listed})


def eight_bits(sample: Sample) -> tuple[Array, float]:
    """Pictures of all slots (slot, y, x, 3), uint8, sRGB, and the radiance of their white."""
    radiance: Doubles = sample["radiance"].astype(np.float64)[..., None]
    if "colour" in sample:
        radiance = np.moveaxis(sample["colour"].astype(np.float64), 1, -1)
    white = float(np.percentile(radiance, 99))
    share: Doubles = np.clip(radiance / white, 0, 1)
    pictures = np.rint(255 * linear_to_srgb(share)).astype(np.uint8)
    return np.broadcast_to(pictures, (*pictures.shape[:3], 3)), white


def _camera(sample: Sample, slot: int) -> dict[str, Any]:
    """Camera as BOP states it: mm, and pixels whose centres are at whole numbers; boxes count as COCO's."""
    matrix: Doubles = sample.camera["intrinsics_px"] - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    pose: Doubles = sample.camera["camera_to_world"][slot]
    turn: Doubles = pose[:3, :3].T
    return {
        "cam_K": matrix.ravel().tolist(),
        "k1": float(sample.camera["radial_k1"]),
        "cam_R_w2c": turn.ravel().tolist(),
        "cam_t_w2c": (-1000 * turn @ pose[:3, 3]).tolist(),
    }


def _instance(mask: Bools, label: dict[str, Any]) -> dict[str, Any]:
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    # Column by column, the first run is of the background, perhaps of no sample.
    runs = np.diff([0] * (1 + int(flat[0])) + [*changes.tolist(), flat.size])
    return {
        "bbox": _wide(label["visible_box_px"]),
        "bbox_amodal": _wide(label["box_px"] or label["visible_box_px"]),
        "area": int(mask.sum()),
        "iscrowd": 0,
        "segmentation": {"size": list(mask.shape), "counts": runs.tolist()},
        "visibility": label["visibility"],
        "box_m": label["box_m"],
    }


def _wide(box: list[float]) -> list[float]:
    """Left, top, width and height of a box."""
    return [*box[:2], box[2] - box[0], box[3] - box[1]]
