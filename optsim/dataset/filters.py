"""Filters of a data set: ranges of numbers measured in each sequence; one outside of any is dropped."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator

from optsim.core.config import Part
from optsim.core.files import read_exr, write_json

DROPPED = "filtered.json"
"""File of a dropped sequence with its reasons; all but its measured numbers is removed."""
MEASURED = {
    "moving_share": "share of samples that show a mover, mean over the slots",
    "speed_px": "99th percentile of the speeds of what moves, in the fastest slot, fine samples a slot",
    "range_stops": "stops from the 1st to the 99.9th percentile of radiance above 0, median over the slots",
    "noise_share": "noise of the truth, median of sigma over radiance",
    "negative_share": "share of samples with negative radiance (unbiased noise)",
    "flow_error_px": "flow against depth and poses, largest difference, fine samples",
    "id_agreement": "share of ids that agree after following the flow",
}
# Slower counts as standing still, fine samples a slot.
_STILL_PX = 0.01


def _ordered(ends: tuple[float, float]) -> tuple[float, float]:
    if ends[0] > ends[1]:
        raise ValueError("expected the smaller end first")
    return ends


Range = Annotated[tuple[float, float], AfterValidator(_ordered)]


class Filter(Part):
    """Ranges in which a sequence's measured numbers must lie, ends included; None: any number.

    Parameters
    ----------
    moving_share : range
        Share of samples that show a mover, mean over the slots.
    speed_px : range
        Speed of what moves, fine samples a slot: 99th percentile, in the fastest slot; 0 if nothing moves.
    range_stops : range
        Stops between the 1st and the 99.9th percentile of radiance above 0, median over the slots.
    noise_share, negative_share : range
        Noise of the truth, median of sigma over radiance, and share of samples with negative radiance, in the
        middle slot.
    flow_error_px, id_agreement : range
        Largest difference of flow and depth, and share of ids that agree after the flow, in the middle slot.
    """

    moving_share: Range | None = None
    speed_px: Range | None = None
    range_stops: Range | None = None
    noise_share: Range | None = None
    negative_share: Range | None = None
    flow_error_px: Range | None = None
    id_agreement: Range | None = None

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Ranges that are stated, by name."""
        stated = {key: getattr(self, key) for key in MEASURED}
        return {key: ends for key, ends in stated.items() if ends is not None}

    def failed(self, found: Mapping[str, float]) -> list[str]:
        """Names of the ranges in which a sequence's numbers don't lie; what wasn't measured is outside."""
        inside = {
            key: key in found and low <= found[key] <= high for key, (low, high) in self.ranges().items()
        }
        return [key for key, is_inside in inside.items() if not is_inside]

    def counts(self, found: Mapping[str, Mapping[str, float]]) -> list[dict[str, Any]]:
        """Rows of the card: each filter, its range, and the sequences that it drops, by their numbers."""
        return [
            {
                "key": key,
                "what": MEASURED[key],
                "range": list(ends),
                "dropped": {
                    name: numbers.get(key) for name, numbers in found.items() if key in self.failed(numbers)
                },
            }
            for key, ends in self.ranges().items()
        ]


def content(truth: Path) -> dict[str, float]:
    """Measure what the slots of an export show: motion, speed, range and noise."""
    shares, speeds, stops, noise = list[float](), list[float](), list[float](), list[float]()
    for path in sorted(truth.glob("slot*.exr")):
        channels, said = read_exr(path)
        if said.get("noise_share"):
            noise.append(said["noise_share"])
        shares.append(float((channels["moving"] > 0).mean()))
        speed = np.hypot(channels["flow.forward.row"], channels["flow.forward.col"])
        moving = speed[speed > _STILL_PX]
        speeds.append(float(np.percentile(moving, 99)) if moving.size else 0.0)
        light = channels["Y"][channels["Y"] > 0]
        ends = np.percentile(light, (1, 99.9)) if light.size else (1.0, 1.0)
        stops.append(float(np.log2(ends[1] / ends[0])))
    return {
        "moving_share": float(np.mean(shares)),
        "speed_px": max(speeds),
        "range_stops": float(np.median(stops)),
        **({"noise_rms": float(np.median(noise))} if noise else {}),
    }


def lines(filters: list[dict[str, Any]], built: int) -> list[str]:
    """Say in a line each what filters dropped, of this many sequences."""
    found: list[str] = []
    for each in filters:
        low, high = each["range"]
        found.append(f"{each['key']} from {low:g} to {high:g}: {len(each['dropped'])} of {built} dropped")
    return found


def drop(folder: Path, reasons: Mapping[str, float | None], keep: str) -> None:
    """Mark a sequence's folder as dropped and remove its files, except one."""
    write_json(folder / DROPPED, dict(reasons))
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name not in (DROPPED, keep):
            path.unlink()


def take_back(folder: Path) -> None:
    """Remove what is left of a dropped sequence, so that it is made again."""
    # Under another name first: half of it must not count as whole.
    gone = folder.with_name(f".{folder.name}.dropped")
    shutil.rmtree(gone, ignore_errors=True)
    # Another shard may do the same.
    with suppress(FileNotFoundError):
        folder.rename(gone)
    shutil.rmtree(gone, ignore_errors=True)
