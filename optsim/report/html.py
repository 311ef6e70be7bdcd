"""The page report.html from results.json, with relative image paths and without network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from optsim.core.errors import StorageError
from optsim.core.files import write_text
from optsim.metrics.claims import measured
from optsim.metrics.records import Series
from optsim.report import headline, plots, words
from optsim.report.schema import LegendEntry, Picture, Results, Section, check_results

if TYPE_CHECKING:
    import jinja2

TEMPLATES = Path(__file__).parent / "template"


def write_report(folder: Path, results: object) -> Path:
    """Render ``report.html`` from a results record and the images below the run folder alone.

    Parameters
    ----------
    folder : Path
        Run folder; ``pictures[].file`` is relative to it.
    results : Results
        Content of ``results.json``, see :mod:`optsim.report.schema`.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    ValueCheckError
        When the record does not follow the schema.
    StorageError
        When an image is missing.
    """
    record = check_results(results)
    for picture in record.pictures:
        for file in (picture.file, picture.still or picture.file):
            if not (folder / file).is_file():
                raise StorageError(
                    f"report: picture {folder / file} is missing; "
                    "cure: run the experiment again into this folder"
                )
    page = page_environment().get_template("report.html.j2").render(**_context(record))
    path = folder / "report.html"
    write_text(path, page)
    return path


def page_environment() -> jinja2.Environment:
    """Return the templates of pages, with the filters for numbers and words."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = cast("dict[str, Callable[..., str]]", environment.filters)
    filters.update(
        score=words.score,
        share=words.share,
        seconds=words.seconds,
        number=words.number,
        words=words.label,
        sentence=words.sentence,
        with_unit=words.metric,
    )
    return environment


def _context(results: Results) -> dict[str, object]:
    """Names for the template; numbers are arranged here and never computed."""
    latency = results.latency
    reached = headline.phases_reached(results)
    phase = reached[0] if reached else None
    return {
        "r": results,
        "methods": list(results.methods),
        "style": {name: headline.style_of(list(results.methods), name) for name in results.methods},
        "phase": phase,
        "cards": headline.cards(results, phase) if phase else [],
        "tables": [(p, headline.table(results.scores, results.methods, p)) for p in reached],
        "ceilings": {p: headline.ceilings(results, p) for p in reached},
        "coverage": {(c.phase, c.region, c.method): c for c in results.coverage},
        "regions": headline.REGIONS,
        "uncertainty": [u for u in results.uncertainty if u.phase == phase and u.n],
        "pictures": {section: _grouped(results, section) for section in ("crops", "capture", "errors")},
        "compare": [p for p in results.pictures if p.section == "compare"],
        "moving": [p for p in results.pictures if p.section == "moving"],
        "frame_plots": _series_plots(results, results.frame_series, "coded frame", latency.frames),
        "slot_plots": _series_plots(results, results.slot_series, "slot in the coded frame", None),
        "mask_plot": _mask_plot(results),
        "pooled_masks": results.pooled_masks,
        "time_plot": plots.bar_plot(
            [(t.stage, t.wall_s, words.seconds(t.wall_s)) for t in results.timings],
            title="Wall time of each stage",
        ),
        "quantity": words.quantity,
        "flat": _flat(results.experiment),
        "drift": _flat(results.experiment.get("drift", {})),
        "known": _known(results),
        "certified": [s for s in results.noise_ceiling if s.phase == phase and s.value is not None],
        "n_validated": sum(row.validated for row in results.evidence),
        "all_peaks_fresh": all(stage.peak_is_of_this_stage for stage in results.timings),
        "legend_of": _legend_of,
        "colour_bar": plots.colour_bar,
        "captions_of": _captions_of,
        "measured": measured,
    }


def _known(results: Results) -> dict[str, list[str]]:
    """Names of the methods by their calibration."""
    found: dict[str, list[str]] = {}
    for name, operator in results.calibrations.items():
        found.setdefault(operator, []).append(name)
    return found


def _grouped(results: Results, section: Section) -> list[tuple[str, list[Picture]]]:
    chosen = [p for p in results.pictures if p.section == section]
    order = list(dict.fromkeys(p.group for p in chosen))
    chosen.sort(key=lambda p: order.index(p.group))
    return [(name, list(group)) for name, group in groupby(chosen, key=lambda p: p.group)]


def _legend_of(pictures: Sequence[Picture]) -> list[LegendEntry]:
    """Colours of several images, each meaning once."""
    return list({entry.meaning: entry for picture in pictures for entry in picture.legend}.values())


def _captions_of(pictures: Sequence[Picture]) -> str:
    return " ".join(picture.caption for picture in pictures)


def _phase_bands(latency: int) -> list[plots.Band]:
    """Phases on the axis of coded frames, as the scores define them."""
    return [
        (-0.5, latency + 0.5, "warm-up"),
        (latency + 0.5, latency + 3.5, "merging"),
        (latency + 3.5, 1e9, "steady"),
    ]


def _series_plots(
    results: Results, series: list[Series], x_label: str, latency: int | None
) -> list[tuple[str, list[tuple[str, object]]]]:
    """One plot a metric and region, grouped by region; phases shaded where the axis is coded frames."""
    methods = list(results.methods)
    found: list[tuple[str, list[tuple[str, object]]]] = []
    for region, where in headline.REGIONS:
        of_region: list[tuple[str, object]] = []
        for metric in dict.fromkeys(s.metric for s in series):
            chosen = [s for s in series if s.metric == metric and s.region == region]
            lines = [(s.method, headline.style_of(methods, s.method), s.x, s.values) for s in chosen]
            plot = plots.line_plot(
                lines,
                title=f"{metric} against {x_label}, {where.lower()}",
                x_label=x_label,
                y_label=chosen[0].unit if chosen else "",
                bands=[] if latency is None else _phase_bands(latency),
            )
            of_region.append((metric, plot))
        if of_region:
            found.append((where, of_region))
    return found


def _mask_plot(results: Results) -> object:
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


def _flat(table: Mapping[str, Any], prefix: str = "") -> list[tuple[str, object]]:
    """Dotted keys of a nested table, as ``--set`` takes them."""
    rows: list[tuple[str, object]] = []
    for key, value in table.items():
        below: dict[str, Any] | None = None
        if isinstance(value, Mapping):
            below = dict(cast("Mapping[str, Any]", value))
        elif isinstance(value, (list, tuple)):
            items = cast("Sequence[Any]", value)
            if any(isinstance(item, Mapping) for item in items):
                below = {str(i): item for i, item in enumerate(items)}
        rows += [(f"{prefix}{key}", value)] if below is None else _flat(below, f"{prefix}{key}.")
    return rows
