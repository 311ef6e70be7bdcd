"""A data set in the formats of other loaders: webdataset shards, HDF5, NeRF's transforms.json, COCO."""

from __future__ import annotations

import io
import json
import math
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.errors import StorageError
from optsim.core.files import atomic, write_json, write_png8
from optsim.core.folder_claims import claimed_empty
from optsim.core.progress import Progress, silent
from optsim.dataset.coco import eight_bits, export_coco
from optsim.dataset.reading import Dataset, Sample
from optsim.dataset.spec import SPLITS

_SHARD = 64


def export_webdataset(dataset: Dataset, folder: Path, progress: Progress = silent) -> None:
    """Write tar shards, ``train-000000.tar``: a ``NAME.npy`` an array and a ``json`` with units and axes."""
    with claimed_empty(folder):
        for split in SPLITS:
            samples = dataset.samples(split)
            for first in range(0, len(samples), _SHARD):
                with (
                    atomic(folder / f"{split}-{first // _SHARD:06d}.tar") as part,
                    tarfile.open(part, "w") as tar,
                ):
                    for number in range(first, min(first + _SHARD, len(samples))):
                        _add(tar, f"{number:06d}", samples[number])
                        progress(f"webdataset {split}", number + 1, len(samples))


def _add(tar: tarfile.TarFile, key: str, sample: Sample) -> None:
    for name in sample:
        stream = io.BytesIO()
        np.save(stream, sample[name])
        # The format takes everything after the first point as the kind of a file.
        _member(tar, f"{key}.{name.replace('/', '_')}.npy", stream.getvalue())
    _member(tar, f"{key}.json", json.dumps(_about(sample) | {"labels": _labels(sample)}).encode())


def _member(tar: tarfile.TarFile, name: str, content: bytes) -> None:
    entry = tarfile.TarInfo(name)
    entry.size = len(content)
    tar.addfile(entry, io.BytesIO(content))


def export_hdf5(dataset: Dataset, path: Path, progress: Progress = silent) -> None:
    """Write one HDF5 file: a group a sample, below its split, with units and axes as attributes."""
    try:
        import h5py  # pyright: ignore
    except ImportError:
        raise StorageError("--to hdf5: got no h5py; cure: pip install 'optsim[hdf5]'") from None
    h5: Any = h5py
    if path.exists():
        raise StorageError(f"--out {path}: got a file that is there, expected a new one")
    with atomic(path) as part, h5.File(part, "w") as file:
        for split in SPLITS:
            for number, sample in enumerate(dataset.samples(split), start=1):
                seed = "" if sample.seed is None else f"-seed{sample.seed}"
                group = file.create_group(f"{sample.about['name']}{seed}")
                group.attrs["about"] = json.dumps(_about(sample))
                # An attribute holds 64 KiB at most.
                group["labels"] = json.dumps(_labels(sample))
                for name in sample:
                    array = group.create_dataset(name, data=sample[name], compression="gzip", shuffle=True)
                    array.attrs["unit"], array.attrs["axes"] = sample.unit(name), sample.axes(name)
                progress(f"hdf5 {split}", number, len(dataset.samples(split)))


def export_nerf(dataset: Dataset, folder: Path, progress: Progress = silent) -> None:
    """Write a folder a sequence: 8-bit images and ``transforms.json``; camera x right, y up, z back."""
    with claimed_empty(folder):
        for split in SPLITS:
            samples = {sample.about["name"]: sample for sample in dataset.samples(split)}
            for number, (name, sample) in enumerate(samples.items(), start=1):
                _transforms(sample, folder / name)
                progress(f"nerf {split}", number, len(samples))


def _transforms(sample: Sample, folder: Path) -> None:
    pictures, white = eight_bits(sample)
    camera = sample.camera
    (focal_x, _, center_x), (_, focal_y, center_y), _ = camera["intrinsics_px"].tolist()
    rows, cols = pictures.shape[1:3]
    frames: list[dict[str, Any]] = []
    for slot, picture in enumerate(pictures):
        write_png8(folder / "images" / f"{slot:06d}.png", picture)
        # OpenCV's axes (y down, z forward) to OpenGL's.
        pose = camera["camera_to_world"][slot] @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append(
            {
                "file_path": f"images/{slot:06d}.png",
                "transform_matrix": pose.tolist(),
                "time": float(camera["times_s"][slot]),
            }
        )
    write_json(
        folder / "transforms.json",
        {
            "camera_model": "OPENCV",
            "fl_x": focal_x,
            "fl_y": focal_y,
            "cx": center_x,
            "cy": center_y,
            "w": cols,
            "h": rows,
            "k1": float(camera["radial_k1"]),
            "camera_angle_x": 2 * math.atan(cols / 2 / focal_x),
            "radiance_of_white_w_m2_sr": white,
            "frames": frames,
        },
    )


def _labels(sample: Sample) -> list[dict[int, Any]]:
    return [sample.labels(slot) for slot in range(sample.n_slots)]


def _about(sample: Sample) -> dict[str, Any]:
    arrays = {name: {"unit": sample.unit(name), "axes": sample.axes(name)} for name in sample}
    camera = {name: array.tolist() for name, array in sample.camera.items()}
    return {**sample.about, "seed": sample.seed, "arrays": arrays, "camera": camera}


EXPORTS: dict[str, Callable[[Dataset, Path, Progress], None]] = {
    "webdataset": export_webdataset,
    "hdf5": export_hdf5,
    "nerf": export_nerf,
    "coco": export_coco,
}
