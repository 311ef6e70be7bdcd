"""Tolerances of comparisons: the loss of each metric that a change may cause. This file alone owns them.

A tolerance is a choice of this project, no physical limit. 0.1 dB is the error that an approximation may make
in a score that users read; the others are about as visible. A metric that is not listed decides nothing: it
is shown only. Linear PSNR and relMSE are such: a few pixels, bright or dark ones, decide them.
"""

from __future__ import annotations

from typing import Final

READING = "bench: "
TIME, MEMORY = "time: ", "memory: "
"""Beginnings of the names of what is no score: readings of the bench, and the cost of a stage."""

TOLERANCES: Final[dict[str, float]] = {
    "PU21-PSNR": 0.1,
    "log-RMSE": 0.01,
    "mu-law-PSNR": 0.1,
    "SMAPE": 0.003,
    "PU21-SSIM": 0.003,
    "PU21-MS-SSIM": 0.003,
    "difference-PSNR": 0.1,
    "one-gain PU21-PSNR": 0.1,
    "valid share": 0.002,
    # Changes of readings in per cent, either way.
    "bench: read noise": 1.0,
    "bench: gain": 1.0,
    "bench: saturation": 1.0,
    "bench: responsivity": 1.0,
    "bench: crosstalk": 1.5,
    # In CCD pixels.
    "bench: pixel map, row": 0.05,
    "bench: pixel map, column": 0.05,
}
"""Short name of a metric -> accepted loss, in its unit."""
COSTS: Final[dict[str, float]] = {TIME: 30.0, MEMORY: 15.0}
"""Accepted growth of a stage's time, against a yardstick in the same run, and of its memory, per cent."""


def tolerance_of(metric: str) -> float | None:
    """Look up a metric's accepted loss by its full name; None for one that decides nothing."""
    cost = next((size for begin, size in COSTS.items() if metric.startswith(begin)), None)
    return TOLERANCES.get(short_name(metric)) if cost is None else cost


def short_name(metric: str) -> str:
    """Cut parameters and unit off the name of a metric."""
    return metric.partition("[")[0].partition(" (")[0]
