"""Scores over time: their mean over slots, the level of the worst twentieth, and the worst slot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from optsim.metrics.metric import Metric
from optsim.metrics.records import REGIONS, Temporal
from optsim.metrics.scoring import FrameTally, by_method_and_phase, rows_of

_WORST_SHARE = 0.05


def temporal_records(
    metrics: Sequence[Metric], tallies: Iterable[FrameTally], latency_frames: int
) -> list[Temporal]:
    """Score every slot by itself and summarise the slots of each phase.

    Parameters
    ----------
    metrics : sequence of Metric
        Metrics in the order of the sums.
    tallies : iterable of FrameTally
        Sums of errors of each coded frame, in any order.
    latency_frames : int
        Latency of the loop, for the phases.

    Returns
    -------
    list of Temporal
        One a method, phase, metric and region with a value. The mean of slots' scores is not the pooled
        score: in dB it is higher.
    """
    found: list[Temporal] = []
    for (method, phase), group in by_method_and_phase(tallies, latency_frames).items():
        for m, metric in enumerate(metrics):
            for region in REGIONS:
                rows = rows_of(region)
                slots = [
                    (value, tally.index, slot)
                    for tally in group
                    for slot in range(tally.counts.shape[1])
                    if (
                        value := metric.finish(
                            float(tally.sums[m, rows, slot].sum()), int(tally.counts[rows, slot].sum())
                        )
                    )
                    is not None
                ]
                if not slots:
                    continue
                values = np.array([value for value, _, _ in slots])
                share = _WORST_SHARE if metric.higher_is_better else 1 - _WORST_SHARE
                worst = (min if metric.higher_is_better else max)(slots)
                found.append(
                    Temporal(
                        method=method,
                        metric=metric.name,
                        unit=metric.unit,
                        region=region,
                        phase=phase,
                        mean=float(values.mean()),
                        worst_twentieth=float(np.quantile(values, share)),
                        worst=worst[0],
                        worst_frame=worst[1],
                        worst_slot=worst[2],
                    )
                )
    return found
