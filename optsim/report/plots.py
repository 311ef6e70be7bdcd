# pyright: reportUnknownMemberType=false
"""Plots by matplotlib as inline SVG, coloured by the page's style sheet for its light and dark mode."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup, escape

from optsim.core.files import atomic
from optsim.core.quantities import Doubles, Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Variables of report.css, and colours that replace them until the SVG is written.
COLOURS = {
    "ink": "#1b1d22",
    "soft": "#5d6068",
    "rule": "#dfdbd1",
    "sunk": "#f1efe9",
    "noise": "#77797f",
    "s0": "#1d5fc4",
    "s1": "#b8560f",
    "s2": "#0d7f5f",
    "s3": "#9a2f92",
    "s4": "#6b6a1b",
    "s5": "#a3283d",
}
# Text stays text. The salt makes the names of shapes the same in every run.
SVG: dict[str, Any] = {"svg.fonttype": "none", "svg.hashsalt": "optsim", "font.family": "DejaVu Sans"}
# The style sheet sets fonts and line joins. A name is needed only for what is used again.
_USELESS = [
    (re.compile(pattern, re.DOTALL), instead)
    for pattern, instead in (
        (r"^.*?<svg[^>]*>|<metadata>.*?</metadata>|<style.*?</style>", ""),
        (r' (transform="rotate\(-0 [^"]*\)"|vector-effect="[^"]*")', ""),
        (r"font-(size|family): [^;]*; ", ""),
        (r'<g id="[^"]*"(/?)>', r"<g\1>"),
        (r"\s+", " "),
        (r"> <", "><"),
        (r"<g/>|<defs></defs>", ""),
    )
]
_PLACES = re.compile(r' (?:d|x|y|transform)="[^"]*"')
_UNITS_AN_INCH = 72
_WIDTH, _HEIGHT = 540, 250
# Of bars to both sides: room for their labels, and for the words beyond them.
_LABEL_WIDTH, _WORDS_WIDTH = 150, 110
_NOTHING = Markup('<p class="none">Nothing to plot: no values.</p>')

Line = tuple[str, str, Sequence[float], Sequence[float | None]]
"""Label, CSS variable of its colour, x, y; a None breaks the line."""
Band = tuple[float, float, str]
"""Start and stop of a shaded stretch of the horizontal axis, and its label."""
Spread = Sequence[tuple[float, float] | None]
"""Low and high end at each x of a line; None where none is known."""


def line_plot(
    lines: Sequence[Line],
    *,
    title: str,
    x_label: str,
    y_label: str,
    bands: Sequence[Band] = (),
    spreads: Sequence[Spread] = (),
    whole_x: bool = True,
    ticks: Sequence[tuple[float, str]] = (),
) -> Markup:
    """Draw lines, with a legend in the order of their last values."""
    figure = _line_figure(lines, x_label, y_label, bands, spreads, whole_x, ticks)
    return _NOTHING if figure is None else _inline(figure, title)


def write_line_plot(
    path: Path, lines: Sequence[Line], *, x_label: str, y_label: str, spreads: Sequence[Spread] = ()
) -> None:
    """Write such a plot, with numbers along x, as a file of its own: SVG or PNG by its suffix."""
    figure = _line_figure(lines, x_label, y_label, (), spreads, False, ())
    if figure is not None:
        _write(path, figure)


def write_signed_bars(path: Path, rows: Sequence[tuple[str, float, str]]) -> None:
    """Write such bars as :func:`signed_bars` draws as a file of their own: SVG or PNG by its suffix."""
    _write(path, signed_figure(rows))


def _write(path: Path, figure: Figure) -> None:
    from matplotlib.style import context

    with context(SVG), atomic(path) as temporary:
        metadata = {"Date": None} if path.suffix == ".svg" else None
        figure.savefig(
            temporary,
            format=path.suffix[1:],
            dpi=200,
            facecolor="white",
            bbox_inches="tight",
            metadata=metadata,
        )


def _line_figure(
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    bands: Sequence[Band],
    spreads: Sequence[Spread],
    whole_x: bool,
    ticks: Sequence[tuple[float, str]],
) -> Figure | None:
    from matplotlib.ticker import MaxNLocator

    around = dict(enumerate(spreads))
    drawn = [(line, around.get(n)) for n, line in enumerate(lines) if any(y is not None for y in line[3])]
    if not drawn:
        return None
    figure, axes = _axes(_WIDTH, _HEIGHT, left=60, right=108, top=24, bottom=42)
    xs = [x for line, _ in drawn for x in line[2]]
    beyond = 0.5 if whole_x else 0.03 * (max(xs) - min(xs)) or 0.5
    low, high = min(xs) - beyond, max(xs) + beyond
    for place, (start, stop, label) in enumerate(bands):
        first, last = max(start, low), min(stop, high)
        if last <= first:
            continue
        if place % 2 == 0:
            axes.axvspan(first, last, color=COLOURS["sunk"], linewidth=0)
        middle = (first + last) / 2
        axes.text(
            middle,
            1.03,
            label,
            transform=axes.get_xaxis_transform(),
            fontsize=13,
            ha="center",
            color=COLOURS["soft"],
        )
    for (label, style, x, y), spread in sorted(drawn, key=lambda each: _last_value(each[0]), reverse=True):
        dashed = style == "noise"
        if spread is not None:
            below, above = ([float("nan") if e is None else e[end] for e in spread] for end in (0, 1))
            colour = COLOURS.get(style, COLOURS["ink"])
            axes.fill_between(x, below, above, color=colour, alpha=0.18, linewidth=0)
        axes.plot(
            x,
            [float("nan") if value is None else value for value in y],
            label=label,
            color=COLOURS.get(style, COLOURS["ink"]),
            linestyle=(0, (2, 2.5)) if dashed else "-",
            linewidth=1.5 if dashed else 2,
            marker="o" if len(x) <= 16 else "",
            markersize=5,
        )
    axes.set(xlim=(low, high), xlabel=x_label, ylabel=y_label)
    if ticks:
        axes.set_xticks([place for place, _ in ticks], [label for _, label in ticks])
    elif whole_x:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(axis="y", color=COLOURS["rule"], linewidth=1)
    legend = axes.legend(
        loc="center left",
        bbox_to_anchor=(1, 0.5),
        frameon=False,
        labelcolor="linecolor",
        handlelength=0,
        borderpad=0,
    )
    for text in legend.get_texts():
        text.set_fontweight("bold")
    return figure


def bar_plot(rows: Sequence[tuple[str, float, str]], *, title: str) -> Markup:
    """Draw horizontal bars from zero; a row is (label, value, value in words)."""
    if not rows:
        return _NOTHING
    labels, values, words = zip(*rows, strict=True)
    figure, axes = _axes(_WIDTH, 26 * len(rows), left=130, right=90)
    bars = axes.barh(range(len(rows)), values, height=0.7, color=COLOURS["s0"])
    axes.bar_label(bars, words, padding=6)
    axes.set_yticks(range(len(rows)), labels, color=COLOURS["ink"])
    axes.set_xlim(0, max(values) or 1)
    axes.set_xticks([])
    axes.invert_yaxis()
    return _inline(figure, title)


def signed_bars(rows: Sequence[tuple[str, float, str]], *, title: str) -> Markup:
    """Draw horizontal bars to both sides of zero, losses in another colour; rows as of :func:`bar_plot`."""
    return _inline(signed_figure(rows), title) if rows else _NOTHING


def signed_figure(rows: Sequence[tuple[str, float, str]]) -> Figure:
    """Return the figure of :func:`signed_bars`."""
    labels, words = [label for label, _, _ in rows], [said for _, _, said in rows]
    values = [value for _, value, _ in rows]
    figure, axes = _axes(_WIDTH, 26 * len(rows), left=_LABEL_WIDTH, right=0)
    colours = [COLOURS["s5"] if value < 0 else COLOURS["s2"] for value in values]
    bars = axes.barh(range(len(rows)), values, height=0.7, color=colours)
    axes.bar_label(bars, words, padding=6)
    axes.axvline(0, color=COLOURS["soft"], linewidth=1)
    axes.set_yticks(range(len(rows)), labels, color=COLOURS["ink"])
    low, high = min([*values, 0]), max([*values, 0])
    # Room for the words beyond the bars.
    left, right = (_WORDS_WIDTH if has else 0 for has in (low < 0, max(values) >= 0))
    a_pixel = (high - low or 1) / (_WIDTH - _LABEL_WIDTH - left - right)
    axes.set_xlim(low - left * a_pixel, high + right * a_pixel)
    axes.set_xticks([])
    axes.invert_yaxis()
    return figure


def arrow_plot(places: Doubles, arrows: Doubles, *, shape: tuple[int, int], title: str, label: str) -> Markup:
    """Draw arrows over a field, with a scale: the longest is as long as the field allows."""
    if not len(places):
        return _NOTHING
    height = 44 + (_WIDTH - 68) * shape[0] / shape[1]
    figure, axes = _axes(_WIDTH, height + 30, left=50, right=18, top=34, bottom=40)
    length = float(np.percentile(np.hypot(*arrows.T), 95)) or 1.0
    gap = float(np.sqrt(shape[0] * shape[1] / len(places)))
    drawn = axes.quiver(
        places[:, 1],
        places[:, 0],
        arrows[:, 1],
        arrows[:, 0],
        angles="xy",
        scale_units="xy",
        scale=length / max(1.2 * gap, shape[1] / 40),
        color=COLOURS["s0"],
        width=0.0022,
    )
    axes.quiverkey(drawn, 0.02, 1.05, length, f"{length:.2g} {label}", labelpos="E", color=COLOURS["s1"])
    axes.set(xlim=(0, shape[1]), ylim=(shape[0], 0), aspect="equal")
    axes.set(xlabel="panel column", ylabel="panel row")
    axes.patch.set_facecolor(COLOURS["sunk"])
    return _inline(figure, title)


def field_plot(image: Floats, *, title: str, unit: str) -> Markup:
    """Draw an image over the panel in shades of one colour, with its range; NaN stays empty."""
    height = (_WIDTH - 150) * image.shape[0] / image.shape[1]
    figure, axes = _axes(_WIDTH, height + 50, left=50, right=100, top=10, bottom=40)
    step = max(1, image.shape[1] // 320)
    rows, cols = image.shape
    drawn = axes.imshow(image[::step, ::step], cmap="viridis", extent=(0, cols, rows, 0), aspect="equal")
    axes.set(xlabel="panel column", ylabel="panel row")
    bar = figure.colorbar(drawn, ax=axes, fraction=0.035, pad=0.02)
    bar.outline.set_visible(False)
    bar.ax.tick_params(length=0, labelsize=13, labelcolor=COLOURS["soft"])
    bar.set_label(unit, color=COLOURS["soft"])
    return _inline(figure, title)


def _last_value(line: Line) -> float:
    return next(y for y in reversed(line[3]) if y is not None)


def _axes(
    width: float, height: float, *, left: float, right: float, top: float = 0, bottom: float = 0
) -> tuple[Figure, Axes]:
    """Return a figure of a size in SVG units, with margins, and its axes, which have no frame."""
    from matplotlib.figure import Figure
    from matplotlib.style import context

    with context({"font.size": 13, "text.color": COLOURS["soft"], "axes.labelcolor": COLOURS["soft"]}):
        figure = Figure((width / _UNITS_AN_INCH, height / _UNITS_AN_INCH))
        inside = (width - left - right) / width, (height - top - bottom) / height
        axes = figure.add_axes((left / width, bottom / height, *inside))
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0, labelsize=13, labelcolor=COLOURS["soft"])
    return figure, axes


def _inline(figure: Figure, title: str) -> Markup:
    """Write a figure as an element of a page, with the page's colours and font."""
    from matplotlib.style import context

    for artist in figure.findobj():
        artist.set_clip_on(False)
    written = io.StringIO()
    with context(SVG):
        figure.savefig(written, format="svg", transparent=True, metadata={"Date": None})
    body = written.getvalue()
    for useless, instead in _USELESS:
        body = useless.sub(instead, body)
    body = _PLACES.sub(lambda place: re.sub(r"(\.\d\d)\d+", r"\1", place[0]), body)
    for name, colour in COLOURS.items():
        body = body.replace(colour, f"var(--{name})")
    width, height = figure.get_size_inches() * _UNITS_AN_INCH
    return Markup(
        f'<svg class="plot" viewBox="0 0 {width:g} {height:g}" role="img" aria-label="{escape(title)}">{body}'
    )
