"""The curves of a report: errors against luminance, slot and coded frame, and the motion masks."""

from __future__ import annotations

import math
from collections.abc import Sequence

from optsim.metrics.error_maps import LuminanceBin
from optsim.metrics.log_error import LogRmse
from optsim.metrics.records import Phase, Region, Series
from optsim.report import headline, plots, verdict, words
from optsim.report.schema import Results


def error_plots(results: Results) -> list[tuple[str, object]]:
    """Error in stops against luminance, slot and time, everywhere."""
    metric, methods = LogRmse().name, list(results.methods)
    lines: list[plots.Line] = []
    for name in methods:
        bins = [b for b in results.by_luminance if b.method == name and b.n >= verdict.LEAST_SAMPLES]
        lines.append((name, headline.style_of(methods, name), *_curve(bins)))
    centres = [x for line in lines for x in line[2]]
    decades = range(math.ceil(min(centres, default=0)), math.floor(max(centres, default=0)) + 1)
    by_luminance = plots.line_plot(
        lines,
        title="Relative error against true luminance",
        x_label="true luminance, cd/m²",
        y_label="stops, rms",
        ticks=[(k, words.number(10.0**k)) for k in decades],
    )
    found: list[tuple[str, object]] = [("luminance", by_luminance)]
    for what, series, bands in (
        ("slot", results.slot_series, []),
        ("coded frame", results.frame_series, _phase_bands(results.latency.frames)),
    ):
        plot = _series_plot(results, series, metric, "all", what, bands)
        found.append((what, plot))
    return found


def _curve(bins: Sequence[LuminanceBin]) -> tuple[list[float], list[float | None]]:
    """Centres of luminance bins, in decades, and their rms error."""
    return [math.log10(b.low_cd_m2 * b.high_cd_m2) / 2 for b in bins], [b.rms_stops for b in bins]


def other_plots(results: Results) -> list[tuple[str, str, list[tuple[str, object]]]]:
    """All other metrics and regions against coded frame and slot, by region."""
    found: list[tuple[str, str, list[tuple[str, object]]]] = []
    for what, series, bands in (
        ("coded frame", results.frame_series, _phase_bands(results.latency.frames)),
        ("slot", results.slot_series, []),
    ):
        for region, where in headline.REGIONS:
            metrics = dict.fromkeys(s.metric for s in series if s.region == region)
            drawn = [
                (metric, _series_plot(results, series, metric, region, what, bands))
                for metric in metrics
                if (metric, region) != (LogRmse().name, "all")
            ]
            found += [(what, where, drawn)] if drawn else []
    return found


def _series_plot(
    results: Results,
    series: Sequence[Series],
    metric: str,
    region: Region,
    what: str,
    bands: Sequence[plots.Band],
) -> object:
    """One plot of a metric in a region, a line a method."""
    methods = list(results.methods)
    chosen = [s for s in series if (s.metric, s.region) == (metric, region)]
    return plots.line_plot(
        [(s.method, headline.style_of(methods, s.method), s.x, s.values) for s in chosen],
        title=f"{metric} against {what}",
        x_label=what,
        y_label=chosen[0].unit if chosen else "",
        bands=bands,
    )


def worst_frames(results: Results, phase: Phase) -> list[tuple[str, int, float, str]]:
    """Worst coded frame of each method in a phase: method, frame, stops, state of the viewer."""
    found: list[tuple[str, int, float, str]] = []
    for name in results.methods:
        errors = headline.by_frame(results, LogRmse().name, "all", name, phase)
        if errors:
            worst = max(errors, key=lambda index: errors[index])
            show = verdict.state(results, frame=worst, left=name, right="", view="difference")
            found.append((name, worst, errors[worst], show))
    return found


def _phase_bands(latency: int) -> list[plots.Band]:
    """Phases on the axis of coded frames, as the scores define them."""
    return [
        (-0.5, latency + 0.5, "warm-up"),
        (latency + 0.5, latency + 3.5, "merging"),
        (latency + 3.5, 1e9, "steady"),
    ]


def mask_plot(results: Results) -> object:
    """Intersection over union of the motion masks against the oracle: a line a method, and one of movers."""
    methods = list(results.methods)
    lines: list[plots.Line] = []
    for method in dict.fromkeys(m.method for m in results.masks):
        rows = [m for m in results.masks if m.method == method]
        style = headline.style_of(methods, method)
        lines.append((method, style, [m.frame for m in rows], [m.iou for m in rows]))
    return plots.line_plot(
        lines,
        title="Intersection over union of motion mask and oracle",
        x_label="coded frame",
        y_label="intersection over union",
        bands=_phase_bands(results.latency.frames),
    )
