"""Scores of one coded frame by content class and metric, and their series over the frames of a run."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from optsim.core.quantities import Bools, Doubles
from optsim.metrics.classes import CLASSES
from optsim.metrics.frame_metric import FrameEstimate, FrameMetric
from optsim.metrics.metric import Metric
from optsim.metrics.pairs import PixelErrors
from optsim.metrics.records import ClassSeries

VALID = "valid share"
"""Metric of the share of a class that a method holds valid: who rejects hard pixels gains elsewhere."""


@dataclass(frozen=True, eq=False)
class ClassTally:
    """Scores of one method in one coded frame.

    Parameters
    ----------
    method : str
        Method of the reconstruction.
    index : int
        Coded frame.
    values : ndarray of shape (metric, class), float64
        Scores, metrics of samples before those of frames; NaN where there is none.
    valid, scored : ndarray of shape (class,), float64
        Shares of each class that the method holds valid, and that are scored; NaN for an empty class.
    """

    method: str
    index: int
    values: Doubles
    valid: Doubles
    scored: Doubles


def tally_classes(
    method: str,
    index: int,
    metrics: Sequence[Metric | FrameMetric],
    errors: PixelErrors,
    frame: FrameEstimate,
) -> ClassTally:
    """Score one method in one coded frame, class by class.

    Parameters
    ----------
    method : str
        Name for the scores.
    index : int
        Coded frame.
    metrics : sequence
        Metrics of samples in the order of ``errors``, then those of frames.
    errors : PixelErrors
        Errors of the method, pixel by pixel, and its valid pixels.
    frame : FrameEstimate
        The estimate beside its truth, with the pixels to score.
    """
    masks = [frame.reference.classes[name] for name in CLASSES]
    slots = len(frame.luminance_cd_m2)
    values = np.full((len(metrics), len(CLASSES)), np.nan)
    for m, metric in enumerate(metrics):
        if isinstance(metric, FrameMetric):
            found = metric.measure(frame)
            row = [found[name] for name in CLASSES]
        else:
            row = [_sampled(metric, errors.sums[m], mask & frame.scored, slots) for mask in masks]
        values[m] = [math.nan if value is None else value for value in row]
    return ClassTally(method, index, values, _shares(masks, errors.valid), _shares(masks, frame.scored))


def _sampled(metric: Metric, sums: Doubles, where: Bools, slots: int) -> float | None:
    return metric.finish(math.fsum(sums[where]), int(np.count_nonzero(where)) * slots)


def _shares(masks: Sequence[Bools], where: Bools) -> Doubles:
    counts = [(np.count_nonzero(mask & where), np.count_nonzero(mask)) for mask in masks]
    return np.array([some / all_ if all_ else math.nan for some, all_ in counts])


def class_series(metrics: Sequence[Metric | FrameMetric], tallies: Iterable[ClassTally]) -> list[ClassSeries]:
    """Arrange scores by method, metric and class; classes without a score in any frame are left out."""
    groups: dict[str, list[ClassTally]] = {}
    for tally in sorted(tallies, key=lambda t: t.index):
        groups.setdefault(tally.method, []).append(tally)
    found: list[ClassSeries] = []
    for method, group in groups.items():
        frames = [t.index for t in group]
        for c, name in enumerate(CLASSES):
            scored = [_number(t.scored[c]) for t in group]
            for m, metric in enumerate(metrics):
                values = [_number(t.values[m, c]) for t in group]
                if any(value is not None for value in values):
                    found.append(
                        ClassSeries(
                            method=method,
                            metric=metric.name,
                            unit=metric.unit,
                            higher_is_better=metric.higher_is_better,
                            region=name,
                            x=frames,
                            values=values,
                            scored=scored,
                        )
                    )
            found.append(
                ClassSeries(
                    method=method,
                    metric=VALID,
                    unit="share",
                    higher_is_better=True,
                    region=name,
                    x=frames,
                    values=[_number(t.valid[c]) for t in group],
                    scored=scored,
                )
            )
    return found


def _number(value: float) -> float | None:
    return None if math.isnan(value) else float(f"{value:.7g}")
