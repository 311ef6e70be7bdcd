"""Check of a data set's files against the manifest, and histograms of its content."""

from __future__ import annotations

from typing import Any

import numpy as np

from optsim.core.files import CLAIM, content_hash
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Doubles
from optsim.dataset.reading import CARD, MANIFEST, Dataset, manifest
from optsim.dataset.sources import SHIPPED
from optsim.dataset.spec import SPLITS
from optsim.tasks import RECORDS

# Speeds in fine samples a slot; luminance in stops below the brightest.
_SPEEDS = (0.0, 0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, np.inf)
_STOPS = np.arange(-24, 1, 2.0)


def verify(dataset: Dataset, progress: Progress = silent) -> list[str]:
    """Check every file of a data set by its SHA-256: a line for each missing, changed or unknown one."""
    found: list[str] = []
    listed = manifest(dataset.folder)
    if content_hash(dataset.folder / MANIFEST) != dataset.card["manifest"].get("sha256"):
        found.append(f"{MANIFEST}: changed since the card was written")
    for number, record in enumerate(listed, start=1):
        path = dataset.folder / record["path"]
        if not path.is_file():
            if not dataset.card["recipe"]:
                found.append(f"{record['path']}: missing")
        elif path.stat().st_size != record["bytes"] or content_hash(path) != record["sha256"]:
            found.append(f"{record['path']}: changed")
        progress("verify", number, len(listed))
    bundled = {place: each for place, each in dataset.card.get("sources", {}).items() if SHIPPED not in place}
    beside = {**bundled, **dataset.card.get("documents", {})}
    for place, sha256 in beside.items():
        path = dataset.folder / place
        if not path.is_file() or content_hash(path) != sha256:
            found.append(f"{place}: {'changed' if path.is_file() else 'missing'}")
    known = {record["path"] for record in listed} | {CARD, MANIFEST, *beside}
    for path in sorted(dataset.folder.rglob("*")):
        place = path.relative_to(dataset.folder)
        is_ours = place.parts[0] == RECORDS or place.name.startswith(CLAIM)
        if (path.is_symlink() or not path.is_dir()) and not is_ours and place.as_posix() not in known:
            found.append(f"{place.as_posix()}: not in the manifest")
    return found


def statistics(dataset: Dataset, progress: Progress = silent) -> dict[str, Any]:
    """Split -> its samples, shares by stops and by speed, and moving share, in their middle slots."""
    result: dict[str, Any] = {}
    total = sum(len(dataset.samples(split)) for split in SPLITS)
    done = 0
    for split in SPLITS:
        samples = dataset.samples(split)
        stops, speeds, moving = np.zeros(len(_STOPS)), np.zeros(len(_SPEEDS) - 1), list[float]()
        for sample in samples:
            middle = sample.n_slots // 2
            radiance: Doubles = sample.slot("radiance", middle).astype(np.float64)
            flow = sample.slot("flow_forward", middle).astype(np.float64)
            below = np.log2(np.maximum(radiance, 1e-300) / radiance.max())
            stops += np.histogram(np.clip(below, -24, 0), [*_STOPS - 1, 1.0])[0] / radiance.size
            speeds += np.histogram(np.hypot(flow[..., 0], flow[..., 1]), _SPEEDS)[0] / radiance.size
            moving.append(float(sample.slot("moving", middle).mean()))
            done += 1
            progress("stats", done, total)
        n = max(len(samples), 1)
        result[split] = {
            "samples": len(samples),
            "stops": dict(zip([f"{stop:g}" for stop in _STOPS], (stops / n).tolist(), strict=True)),
            "speeds_px": dict(
                zip([f">= {low:g}" for low in _SPEEDS[:-1]], (speeds / n).tolist(), strict=True)
            ),
            "moving": [min(moving), float(np.mean(moving)), max(moving)] if moving else None,
        }
    return result
