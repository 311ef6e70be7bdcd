"""Agreement between the passes of a sequence: measured for each, printed in the card."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.core.files import read_exr
from optsim.core.quantities import Doubles

Channels = dict[str, NDArray[Any]]


def consistency(truth: Path) -> dict[str, float]:
    """Check one slot in the middle of an export against the next one; the card says how."""
    files = sorted(truth.glob("slot*.exr"))
    middle = len(files) // 2
    channels, said = read_exr(files[middle])
    found = {"flow_error_px": _flow_error(channels, said)}
    if middle + 1 < len(files):
        found["id_agreement"] = _id_agreement(channels, read_exr(files[middle + 1])[0])
    radiance = channels["Y"].astype(np.float64)
    found["negative_share"] = float((radiance < 0).mean())
    if "Y.sigma" in channels:
        lit = radiance > 0
        found["noise_share"] = float(np.median(channels["Y.sigma"][lit] / radiance[lit]))
    return found


def _flow_error(channels: Channels, said: dict[str, Any]) -> float:
    """Compare flow with the displacement of each surface point that depth and poses give."""
    # Older sets have no parts.
    ids, depth = channels.get("part", channels["id"]), channels["Z"].astype(np.float64)
    rows, cols = np.mgrid[: len(ids), : ids.shape[1]] + 0.5
    matrix = np.array(said["intrinsics_px"])
    now, then = (np.array(said["camera_to_world"][k]) for k in (1, 2))
    camera = _without_distortion(matrix, cols, rows, said["radial_k1"]) * depth[..., None]
    world = camera @ now[:3, :3].T + now[:3, 3]
    moved, rigid = world.copy(), ids > 0
    names, poses = said["id_table"], said["object_poses"]
    parts = said.get("part_table", {number: {"id": number, "name": name} for number, name in names.items()})
    for number in np.unique(ids[ids > 0]).tolist():
        part, here = parts[str(number)], ids == number
        pose = poses.get(part["name"], poses.get(names[str(part["id"])]))
        if pose is None:
            continue
        if pose["world_at_0_to_world"] is None:
            rigid &= ~here
            continue
        start, stop = (np.array(pose["world_at_0_to_world"][k]) for k in (1, 2))
        step = stop @ np.linalg.inv(start)
        moved[here] = world[here] @ step[:3, :3].T + step[:3, 3]
    inverse = np.linalg.inv(then)
    seen = moved @ inverse[:3, :3].T + inverse[:3, 3]
    rigid &= seen[..., 2] > 1e-6
    plane = seen[..., :2] / np.where(rigid, seen[..., 2], 1)[..., None]
    plane *= 1 + said["radial_k1"] * (plane**2).sum(axis=-1, keepdims=True)
    place = plane @ matrix[:2, :2].T + matrix[:2, 2]
    flow = np.stack([channels["flow.forward.col"], channels["flow.forward.row"]], axis=-1)
    error = np.linalg.norm(place - np.stack([cols, rows], axis=-1) - flow, axis=-1)
    return float(error[rigid].max(initial=0.0))


def _without_distortion(matrix: Doubles, cols: Doubles, rows: Doubles, k1: float) -> Doubles:
    """Directions of the samples' rays, z = 1: fixed-point steps invert the radial polynomial."""
    there = np.stack([cols, rows, np.ones_like(cols)], axis=-1) @ np.linalg.inv(matrix).T
    plane = there[..., :2].copy()
    for _ in range(20):
        plane = there[..., :2] / (1 + k1 * (plane**2).sum(axis=-1, keepdims=True))
    return np.concatenate([plane, np.ones((*cols.shape, 1))], axis=-1)


def _id_agreement(now: Channels, then: Channels) -> float:
    """Follow the forward flow of samples that stay visible and compare object ids."""
    ids = now["id"]
    seen = (now["occluded.forward"] == 0) & (ids > 0)
    rows, cols = np.nonzero(seen)
    row = np.floor(rows + 0.5 + now["flow.forward.row"][seen]).astype(np.int64)
    col = np.floor(cols + 0.5 + now["flow.forward.col"][seen]).astype(np.int64)
    # A surface point may lie anywhere in its sample, whose centre may belong to the adjacent object.
    padded = np.pad(then["id"], 1, mode="edge")
    inside = (row >= 0) & (col >= 0) & (row < len(ids)) & (col < ids.shape[1])
    row, col, own = row[inside] + 1, col[inside] + 1, ids[seen][inside]
    around = [padded[row + i, col + k] == own for i in (-1, 0, 1) for k in (-1, 0, 1)]
    return float(np.any(around, axis=0).mean()) if own.size else 1.0
