"""Scores of a run with a display: as text when printed, as a table in a notebook."""

from __future__ import annotations

from html import escape

from optsim.metrics.records import PHASES, Score


class Scores(list[Score]):
    """One record a method, metric, region and phase; the display shows the latest phase reached."""

    def __str__(self) -> str:
        """Write a line a metric and region, a column a method."""
        phase, names, rows = self._table()
        lines = [[f"{phase} phase", *names], *([f"{metric}, {region}", *row] for metric, region, row in rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        return "\n".join(
            "  ".join([first.ljust(widths[0]), *(c.rjust(w) for c, w in zip(rest, widths[1:], strict=True))])
            for first, *rest in lines
        )

    __repr__ = __str__

    def _repr_html_(self) -> str:
        phase, names, rows = self._table()
        head = "".join(f"<th>{escape(name)}</th>" for name in names)
        body = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in (metric, region, *row))}</tr>"
            for metric, region, row in rows
        )
        title = f"<caption>scores of the {phase} phase</caption>"
        return f"<table>{title}<tr><th>metric</th><th>region</th>{head}</tr>{body}</table>"

    def _table(self) -> tuple[str, list[str], list[tuple[str, str, list[str]]]]:
        """Phase, methods, and a row a metric and region with a cell a method."""
        known = [r for r in self if r.value is not None]
        phase = next((p for p in reversed(PHASES) if any(r.phase == p for r in known)), "steady")
        cells = {(r.metric, r.region, r.method): _cell(r) for r in known if r.phase == phase}
        names = list(dict.fromkeys(r.method for r in self))
        return (
            phase,
            names,
            [
                (metric, region, [cells.get((metric, region, name), "–") for name in names])
                for metric, region in dict.fromkeys((metric, region) for metric, region, _ in cells)
            ],
        )


def _cell(score: Score) -> str:
    return f"{score.value:.{2 if score.unit == 'dB' else 3}f}"
