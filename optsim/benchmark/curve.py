"""Time against error as a picture: one panel a record, one line a method and region, logarithmic axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import Any

_WIDTH, _HEIGHT = 430, 330
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 20, 44, 50
# Colour-blind safe pair (M. Okabe and K. Ito, 2008); regions differ by dash.
_COLOURS = {"plain": "#d55e00", "optsim": "#0072b2"}
_DASHES = {"movers": "", "picture": "", "elsewhere": "5 4"}
_TICKS = (1, 2, 5)

Points = list[tuple[float, float]]


def time_against_error(records: Sequence[dict[str, Any]]) -> str:
    """Draw the curves of render records as SVG.

    Parameters
    ----------
    records : sequence of dict
        As :func:`optsim.benchmark.measure_all` returns them; those without a curve are left out.

    Returns
    -------
    str
        SVG with a white ground, for a browser or a document.
    """
    drawn = [record for record in records if record["conditions"].get("curve")]
    panels = [_panel(record, index * _WIDTH) for index, record in enumerate(drawn)]
    width = max(1, len(drawn)) * _WIDTH
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {_HEIGHT}" width="{width}" '
        f'height="{_HEIGHT}" font-family="sans-serif" font-size="12">'
        f'<rect width="{width}" height="{_HEIGHT}" fill="white"/>{"".join(panels)}</svg>\n'
    )


def _lines(curve: Sequence[dict[str, Any]]) -> dict[tuple[str, str], Points]:
    lines: dict[tuple[str, str], Points] = {}
    for point in curve:
        for key, error in point.items():
            if key.startswith("error_") and error > 0:
                line = lines.setdefault((point["method"], key.removeprefix("error_")), [])
                line.append((point["seconds"], error))
    return {key: sorted(points) for key, points in lines.items()}


def _panel(record: dict[str, Any], offset: int) -> str:
    lines = _lines(record["conditions"]["curve"])
    seconds, errors = zip(*(point for points in lines.values() for point in points), strict=True)
    x_ticks, y_ticks = _ticks(min(seconds), max(seconds)), _ticks(min(errors), max(errors))

    def place(second: float, error: float) -> tuple[float, float]:
        across = _share(second, x_ticks) * (_WIDTH - _LEFT - _RIGHT)
        down = (1 - _share(error, y_ticks)) * (_HEIGHT - _TOP - _BOTTOM)
        return offset + _LEFT + across, _TOP + down

    left, right = offset + _LEFT, offset + _WIDTH - _RIGHT
    title = f"{record['name']}: {record['ratio']:.1f}x the plain loop"
    parts = [f'<text x="{left}" y="20" font-size="14" font-weight="bold">{escape(title)}</text>']
    for tick in y_ticks:
        y = place(x_ticks[0], tick)[1]
        parts.append(f'<line x1="{left}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{100 * tick:g} %</text>')
    for tick in x_ticks:
        x = place(tick, y_ticks[0])[0]
        bottom = _HEIGHT - _BOTTOM
        parts.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP}" y2="{bottom}" stroke="#ddd"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{tick:g}</text>')
    middle = (left + right) / 2
    parts.append(f'<text x="{middle}" y="{_HEIGHT - 12}" text-anchor="middle">seconds a frame</text>')
    parts.append(f'<text x="{left}" y="36" fill="#444">relative error</text>')
    for (method, region), points in lines.items():
        places = [place(*point) for point in points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        style = f'stroke="{_COLOURS[method]}" stroke-width="2" stroke-dasharray="{_DASHES[region]}"'
        parts.append(f'<polyline points="{path}" fill="none" {style}/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{_COLOURS[method]}"/>' for x, y in places]
    for row, (method, region) in enumerate(lines):
        y = _TOP + 12 + 15 * row
        style = f'stroke="{_COLOURS[method]}" stroke-width="2" stroke-dasharray="{_DASHES[region]}"'
        parts.append(f'<line x1="{right - 128}" x2="{right - 104}" y1="{y - 4}" y2="{y - 4}" {style}/>')
        parts.append(f'<text x="{right - 98}" y="{y}">{escape(method)}, {escape(region)}</text>')
    return "".join(parts)


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers that enclose the values."""
    every = [m * 10.0**e for e in range(-7, 7) for m in _TICKS]
    first = max(i for i, tick in enumerate(every) if tick <= low)
    last = min(i for i, tick in enumerate(every) if tick >= high)
    return every[first : last + 1] if last > first else every[first : first + 2]


def _share(value: float, ticks: Sequence[float]) -> float:
    return math.log(value / ticks[0]) / math.log(ticks[-1] / ticks[0])
