"""The page report.html from results.json, with relative image paths and without network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from optsim.core.errors import StorageError
from optsim.core.files import write_text
from optsim.metrics.claims import measured
from optsim.metrics.records import Phase
from optsim.metrics.scoring import phase_of
from optsim.report import class_table, curves, headline, plots, verdict, words
from optsim.report.schema import Results, check_results

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
    for file in record.files:
        if not (folder / file).is_file():
            raise StorageError(
                f"report: {folder / file} is missing; cure: run the experiment again into this folder"
            )
    path = folder / "report.html"
    write_text(path, page_environment().get_template("report.html.j2").render(**_context(record)))
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
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}
    filters = cast("dict[str, Callable[..., str]]", environment.filters)
    filters.update(
        score=words.score,
        share=words.share,
        seconds=words.seconds,
        number=words.number,
        words=words.label,
        sentence=words.sentence,
        plain=words.metric,
    )
    return environment


def _context(results: Results) -> dict[str, object]:
    """Names for the template; numbers are arranged here and never computed."""
    reached = headline.phases_reached(results)
    phase = reached[0] if reached else None
    rows = headline.headline_rows(results, phase) if phase else []
    return {
        "r": results,
        "methods": list(results.methods),
        "style": {name: headline.style_of(list(results.methods), name) for name in results.methods},
        "phase": phase,
        "verdict": verdict.verdict(results, phase) if phase else [],
        "subject": verdict.subject(results, phase) if phase else "",
        "quality": verdict.quality(results, phase) if phase else "",
        "faults": verdict.faults(results, phase) if phase else [],
        "rows": rows,
        "n_frames": _n_frames(results, phase),
        "tables": [(p, headline.table(results.scores, results.methods, p)) for p in reached],
        "class_rows": class_table.class_rows(results),
        "class_frames": class_table.frames_of(results.class_series),
        "ceilings": {p: headline.ceilings(results, p) for p in reached},
        "coverage": {(c.phase, c.region, c.method): c for c in results.coverage},
        "uncertainty": [u for u in results.uncertainty if u.phase == phase and u.n],
        "captured": [p for p in results.pictures if p.section == "capture" and p.label == p.group],
        "error_plots": curves.error_plots(results),
        "other_plots": curves.other_plots(results),
        "worst_frames": curves.worst_frames(results, phase) if phase else [],
        "mask_plot": curves.mask_plot(results),
        "time_plot": plots.bar_plot(
            [(t.stage, t.wall_s, words.seconds(t.wall_s)) for t in results.timings],
            title="Wall time of each stage",
        ),
        "quantity": words.quantity,
        "plus_minus": words.plus_minus,
        "flat": flat(results.experiment),
        "drift": [
            *flat(results.experiment.get("drift", {})),
            *((f"{key}, a frame", each) for key, each in flat(results.experiment.get("drift_per_frame", {}))),
        ],
        "known": _known(results),
        "certified": [s for s in results.noise_ceiling if s.phase == phase and s.value is not None],
        "n_validated": sum(row.validated for row in results.evidence),
        "all_peaks_fresh": all(stage.peak_is_of_this_stage for stage in results.timings),
        "measured": measured,
    }


def _n_frames(results: Results, phase: Phase | None) -> int:
    """Coded frames of a phase."""
    return len({k for s in results.frame_series for k in s.x if phase_of(k, results.latency.frames) == phase})


def _known(results: Results) -> dict[str, list[str]]:
    """Names of the methods by their calibration."""
    found: dict[str, list[str]] = {}
    for name, operator in results.calibrations.items():
        found.setdefault(operator, []).append(name)
    return found


def flat(table: Mapping[str, Any], prefix: str = "") -> list[tuple[str, object]]:
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
        rows += [(f"{prefix}{key}", value)] if below is None else flat(below, f"{prefix}{key}.")
    return rows
