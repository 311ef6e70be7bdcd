"""Error of one coded frame against luminance, and the place where it is largest, in stops."""

from __future__ import annotations

from typing import cast

import numpy as np

from optsim.core.quantities import Bools, Doubles, Floats
from optsim.metrics.log_error import LogRmse
from optsim.metrics.records import Record


class LuminanceBin(Record):
    """Error of a method where the truth lies in one stop of luminance: mean and rms, in stops."""

    method: str
    low_cd_m2: float
    high_cd_m2: float
    n: int
    bias_stops: float
    rms_stops: float


class Place(Record):
    """Rectangle of panel pixels in which a method errs most, and the slot in which it errs most there."""

    method: str
    frame: int
    slot: int
    row: int
    col: int
    height: int
    width: int
    bias_stops: float
    rms_stops: float


def error_by_luminance(
    method: str, estimate_cd_m2: Floats, reference_cd_m2: Floats, where: Bools, metric: LogRmse
) -> list[LuminanceBin]:
    """Sort errors by the true luminance, a bin a stop; empty bins are left out.

    Parameters
    ----------
    method : str
        Name for the records.
    estimate_cd_m2, reference_cd_m2 : ndarray of shape (slot, v, u), float32
        Luminance, cd/m^2.
    where : ndarray of shape (v, u), bool
        Pixels to count.
    metric : LogRmse
        Its encoding states the offset below which errors fade out.
    """
    edges: dict[int, tuple[int, float, float]] = {}
    for slot in range(len(reference_cd_m2)):
        truth = reference_cd_m2[slot][where]
        error = _stops(estimate_cd_m2[slot][where], truth, metric)
        stop = np.floor(np.log2(np.maximum(truth, metric.e_cd_m2))).astype(np.int64)
        lowest = int(stop.min(initial=0))
        sums = [np.bincount(stop - lowest, weights) for weights in (np.ones_like(error), error, error**2)]
        for at, (n, total, squares) in enumerate(zip(*sums, strict=True)):
            before = edges.get(lowest + at, (0, 0.0, 0.0))
            edges[lowest + at] = (before[0] + int(n), before[1] + float(total), before[2] + float(squares))
    return [
        LuminanceBin(
            method=method,
            low_cd_m2=2.0**stop,
            high_cd_m2=2.0 ** (stop + 1),
            n=n,
            bias_stops=total / n,
            rms_stops=(squares / n) ** 0.5,
        )
        for stop, (n, total, squares) in sorted(edges.items())
        if n
    ]


def worst_place(
    method: str,
    frame: int,
    estimate_cd_m2: Floats,
    reference_cd_m2: Floats,
    where: Bools,
    metric: LogRmse,
    *,
    size: tuple[int, int],
) -> Place | None:
    """Find the rectangle with the largest squared error in stops, over all slots.

    Parameters
    ----------
    method, frame : str, int
        Names for the record.
    estimate_cd_m2, reference_cd_m2 : ndarray of shape (slot, v, u), float32
        Luminance, cd/m^2.
    where : ndarray of shape (v, u), bool
        Pixels to count.
    metric : LogRmse
        Its encoding states the offset below which errors fade out.
    size : (int, int)
        Height and width of the rectangle, panel pixels.

    Returns
    -------
    Place or None
        None where no pixel counts.
    """
    if not where.any():
        return None
    errors = np.where(where, _stops(estimate_cd_m2, reference_cd_m2, metric), 0.0)
    row, col = best_corner((errors**2).sum(axis=0), size)
    height, width = size
    inside = errors[:, row : row + height, col : col + width]
    counted = int(where[row : row + height, col : col + width].sum()) * len(errors)
    by_slot = cast("Doubles", (inside**2).sum(axis=(1, 2)))
    return Place(
        method=method,
        frame=frame,
        slot=int(by_slot.argmax()),
        row=row,
        col=col,
        height=height,
        width=width,
        bias_stops=float(inside.sum()) / max(counted, 1),
        rms_stops=(float(by_slot.sum()) / max(counted, 1)) ** 0.5,
    )


def best_corner(weight: Doubles, size: tuple[int, int]) -> tuple[int, int]:
    """Row and column of the rectangle with the largest total weight, from a table of cumulative sums."""
    height, width = size
    sums = np.pad(weight, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    totals = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    row, col = divmod(int(totals.argmax()), totals.shape[1])
    return row, col


def _stops(estimate_cd_m2: Floats, reference_cd_m2: Floats, metric: LogRmse) -> Doubles:
    """Signed error, stops: above 0 is too bright."""
    ours, truth = (
        metric.encode(light.astype(np.float64), 1.0) for light in (estimate_cd_m2, reference_cd_m2)
    )
    return ours - truth
