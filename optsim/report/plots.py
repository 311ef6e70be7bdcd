"""Plots as inline SVG: colours come from the page's style sheet, so they follow light and dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

_WIDTH, _HEIGHT = 540, 250
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 100, 24, 42
_LABEL_STEP = 15


@dataclass(frozen=True)
class Line:
    """One line of a plot: ``style`` is a CSS class, a None breaks the line."""

    label: str
    style: str
    x: Sequence[float]
    y: Sequence[float | None]


@dataclass(frozen=True)
class Band:
    """A shaded stretch of the horizontal axis."""

    start: float
    stop: float
    label: str


def line_plot(
    lines: Sequence[Line], *, title: str, x_label: str, y_label: str, bands: Sequence[Band] = ()
) -> Markup:
    """Lines with direct labels at their right ends.

    Parameters
    ----------
    lines : sequence of Line
        Lines without any value are left out.
    title : str
        Read out to those who cannot see it.
    x_label, y_label : str
        With units.
    bands : sequence of Band
        Shaded and labelled stretches.
    """
    drawn = [line for line in lines if any(y is not None for y in line.y)]
    if not drawn:
        return Markup('<p class="none">Nothing to plot: no values.</p>')
    xs = [x for line in drawn for x in line.x]
    ys = [y for line in drawn for y in line.y if y is not None]
    x_low, x_high = min(xs) - 0.5, max(xs) + 0.5
    ticks = nice_ticks(min(ys), max(ys))
    y_low, y_high = ticks[0], ticks[-1]

    def across(x: float) -> float:
        return _LEFT + (x - x_low) / (x_high - x_low) * (_WIDTH - _LEFT - _RIGHT)

    def down(y: float) -> float:
        return _HEIGHT - _BOTTOM - (y - y_low) / (y_high - y_low) * (_HEIGHT - _TOP - _BOTTOM)

    parts: list[str] = []
    for band in bands:
        start, stop = across(max(band.start, x_low)), across(min(band.stop, x_high))
        if stop > start:
            parts.append(
                f'<rect class="band" x="{start:.1f}" y="{_TOP}" width="{stop - start:.1f}" '
                f'height="{_HEIGHT - _TOP - _BOTTOM}"/>'
                f'<text class="tick" x="{(start + stop) / 2:.1f}" y="{_TOP - 7}" '
                f'text-anchor="middle">{escape(band.label)}</text>'
            )
    left, right, bottom = _LEFT, _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    parts += [
        f'<line class="grid" x1="{left}" x2="{right}" y1="{down(tick):.1f}" y2="{down(tick):.1f}"/>'
        f'<text class="tick" x="{left - 8}" y="{down(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>'
        for tick in ticks
    ]
    whole = sorted({int(x) for x in xs})
    parts += [
        f'<text class="tick" x="{across(x):.1f}" y="{bottom + 17}" text-anchor="middle">{x}</text>'
        for x in whole[:: max(1, math.ceil(len(whole) / 12))]
    ]
    ends: list[tuple[float, Line]] = []
    for line in drawn:
        points = [(across(x), None if y is None else down(y)) for x, y in zip(line.x, line.y, strict=True)]
        ends.append((next(y for _, y in reversed(points) if y is not None), line))
        parts.append(f'<path class="line {line.style}" d="{_path(points)}"/>')
        if len(points) <= 16:
            parts += [
                f'<circle class="dot {line.style}" cx="{x:.1f}" cy="{y:.1f}" r="3"/>'
                for x, y in points
                if y is not None
            ]
    parts += [
        f'<text class="end {line.style}" x="{right + 10}" y="{y + 4:.1f}">{escape(line.label)}</text>'
        for y, line in _spread(ends)
    ]
    middle = (_TOP + bottom) // 2
    parts.append(
        f'<text class="tick" x="{(left + right) // 2}" y="{_HEIGHT - 6}" text-anchor="middle">'
        f"{escape(x_label)}</text>"
        f'<text class="tick" x="14" y="{middle}" text-anchor="middle" transform="rotate(-90 14 {middle})">'
        f"{escape(y_label)}</text>"
    )
    return _svg(title, _HEIGHT, parts)


def bar_plot(rows: Sequence[tuple[str, float, str]], *, title: str) -> Markup:
    """Horizontal bars from zero; a row is (label, value, value in words)."""
    if not rows:
        return Markup('<p class="none">Nothing to plot: no values.</p>')
    longest = max(value for _, value, _ in rows) or 1.0
    left, right, step = 130, 90, 26
    parts: list[str] = []
    for i, (label, value, words) in enumerate(rows):
        width = max(1.0, value / longest * (_WIDTH - left - right))
        y = i * step + 4
        parts.append(
            f'<text class="name" x="{left - 10}" y="{y + 13}" text-anchor="end">{escape(label)}</text>'
            f'<rect class="bar" x="{left}" y="{y}" width="{width:.1f}" height="{step - 8}" rx="2"/>'
            f'<text class="tick" x="{left + width + 8:.1f}" y="{y + 13}">{escape(words)}</text>'
        )
    return _svg(title, len(rows) * step + 4, parts)


def nice_ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round values that enclose low .. high, about ``wanted`` of them."""
    span = (high - low) or abs(high) or 1.0
    raw = span / (wanted - 1)
    magnitude = 10.0 ** math.floor(math.log10(raw))
    step = next(f * magnitude for f in (1, 2, 2.5, 5, 10) if f * magnitude >= raw * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(i * step, 12) for i in range(first, max(last, first + 1) + 1)]


def _path(points: Sequence[tuple[float, float | None]]) -> str:
    steps: list[str] = []
    pen_down = False
    for x, y in points:
        if y is not None:
            steps.append(f"{'L' if pen_down else 'M'}{x:.1f} {y:.1f}")
        pen_down = y is not None
    return " ".join(steps)


def _spread(ends: list[tuple[float, Line]]) -> list[tuple[float, Line]]:
    """Move labels apart so that none covers another, and back inside the picture."""
    ordered = sorted(ends, key=lambda end: end[0])
    ys = [y for y, _ in ordered]
    for i in range(1, len(ys)):
        ys[i] = max(ys[i], ys[i - 1] + _LABEL_STEP)
    ys[-1] = min(ys[-1], _HEIGHT - _BOTTOM)
    for i in range(len(ys) - 2, -1, -1):
        ys[i] = min(ys[i], ys[i + 1] - _LABEL_STEP)
    return [(y, line) for y, (_, line) in zip(ys, ordered, strict=True)]


def _svg(title: str, height: int, parts: Sequence[str]) -> Markup:
    return Markup(
        f'<svg class="plot" viewBox="0 0 {_WIDTH} {height}" role="img" aria-label="{escape(title)}">'
        f"{''.join(parts)}</svg>"
    )
