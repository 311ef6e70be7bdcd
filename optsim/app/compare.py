"""Commands of regression reports: compare runs, and accept one as the baseline.

Exit codes of compare: 0 pass, 1 regression, 2 cannot compare, 3 usage.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from optsim.app.options import Json, print_json

_USAGE = 3
_CODES = {"pass": 0, "regression": 1, "cannot compare": 2}


class UsageIsThree(TyperCommand):
    """A command whose usage errors end with code 3: here 2 says that two sides cannot be compared."""

    def make_context(self, *words: Any, **options: Any) -> Any:
        """Parse the command line."""
        try:
            return super().make_context(*words, **options)
        except Exception as error:
            if hasattr(error, "show"):
                error.exit_code = _USAGE  # type: ignore[attr-defined]
            raise


def compare(
    before: Annotated[
        str,
        typer.Argument(metavar="RUN_OR_BASELINE", help="Folder of runs, or a baseline (name or file)."),
    ],
    after: Annotated[
        Path | None,
        typer.Argument(metavar="[RUN]", help="Folder of one run or more; not with --methods."),
    ] = None,
    methods: Annotated[
        str | None, typer.Option(metavar="OLD,NEW", help="Two methods of the first folder instead.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for page, JSON, Markdown, JUnit [reports/runs/compare-...]."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare a run with a baseline or another run: a verdict a scene, region and metric, with intervals."""
    from optsim.core.console import page
    from optsim.core.folder_claims import claimed_empty, output_folder
    from optsim.report import comparison_text as text
    from optsim.report.comparison_page import write_comparison

    pair = (methods or "").split(",")
    if (methods is None) == (after is None) or (methods is not None and len(pair) != 2):
        raise _usage(
            f"compare: got RUN {after} and --methods {methods}, expected either RUN or --methods OLD,NEW"
        )
    found, places = _found(before, after, pair)
    with output_folder(out, f"compare-{found.after.split()[0]}") as folder, claimed_empty(folder):
        path = write_comparison(folder, found, places)
    if as_json:
        print_json(found.as_json())
    else:
        page.print(text.as_text(found))
        page.print(f"Page: {path}")
    raise typer.Exit(_CODES[found.outcome])


def accept(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run, or of several.")],
    name: Annotated[
        str | None,
        typer.Option(help="Name of the baseline, or a .json file [the experiment's name, or the folder's]."),
    ] = None,
) -> None:
    """Make a run the baseline: the only way that reports/baselines/ changes."""
    from optsim.core.console import page
    from optsim.core.errors import ConfigError
    from optsim.report.baseline import new_baseline_path, read_baseline, scored_runs, write_baseline
    from optsim.report.comparison import compare as compared
    from optsim.report.comparison_text import headline

    scored = scored_runs(run)
    path = new_baseline_path(scored.name if name is None else name)
    if path.exists():
        found = compared(read_baseline(path), scored, scored.made_utc)
        page.print(f"Against the baseline before: {headline(found)}")
        if found.missing:
            raise ConfigError(
                f"{run}: got a run without scores of the baseline {path}: {'; '.join(found.missing)}; cure: "
                f"run it whole, or remove {path} first"
            )
    write_baseline(path, scored.model_copy(update={"name": path.stem}))
    _candidate(path).unlink(missing_ok=True)
    page.print(f"Baseline: {path}. Commit it with the change that it belongs to.")


def _found(before: str, after: Path | None, pair: list[str]) -> tuple[Any, dict[str, Path]]:
    """Compare both sides; return the comparison and the folders of runs by side."""
    from datetime import UTC, datetime

    from optsim.core.errors import StorageError
    from optsim.report.baseline import baseline_path, read_baseline, scored_runs, write_baseline
    from optsim.report.comparison import between_methods
    from optsim.report.comparison import compare as compared

    now = datetime.now(UTC).isoformat(timespec="seconds")
    place = Path(before)
    if after is None:
        first, second = between_methods(scored_runs(place), *pair)
        return compared(first, second, now), {"before": place, "after": place}
    candidate = scored_runs(after)
    if place.is_dir():
        places = {"before": place, "after": after}
        return compared(scored_runs(place), candidate, now), places
    path = baseline_path(before)
    if not path.exists():
        stored = _candidate(path)
        write_baseline(stored, candidate.model_copy(update={"name": path.stem}))
        raise StorageError(
            f"{path}: no such baseline; the candidate is stored as {stored}; cure: look at the run, then "
            f"'optsim accept {after} --name {path.stem}'"
        )
    return compared(read_baseline(path), candidate, now), {"after": after}


def _candidate(path: Path) -> Path:
    return path.with_name(f"{path.stem}.candidate.json")


def _usage(text: str) -> typer.BadParameter:
    error = typer.BadParameter(text)
    error.exit_code = _USAGE
    return error
