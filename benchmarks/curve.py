"""Time against error as a picture: one panel a record, one line a method and region, logarithmic axes."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from benchmarks.axes import Axes, picture, round_numbers

_WIDTH, _HEIGHT = 430, 330
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 20, 44, 50
# Colour-blind safe pair (M. Okabe and K. Ito, 2008); regions differ by dash.
_COLOURS = {"plain": "#d55e00", "optsim": "#0072b2"}
_DASHES = {"movers": "", "picture": "", "elsewhere": "5 4"}

Points = list[tuple[float, float]]


def time_against_error(records: Sequence[dict[str, Any]]) -> str:
    """Draw the curves of render records as SVG.

    Parameters
    ----------
    records : sequence of dict
        As :func:`benchmarks.measure_all` returns them; those without a curve are left out.

    Returns
    -------
    str
        SVG with a white ground, for a browser or a document.
    """
    drawn = [record for record in records if record["conditions"].get("curve")]
    panels = [_panel(record, index * _WIDTH) for index, record in enumerate(drawn)]
    width = max(1, len(drawn)) * _WIDTH
    return picture(width, _HEIGHT, panels)


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
    left, right = offset + _LEFT, offset + _WIDTH - _RIGHT
    ticks = round_numbers(min(seconds), max(seconds)), round_numbers(min(errors), max(errors))
    axes = Axes(left, right, _TOP, _HEIGHT - _BOTTOM, *ticks)
    title = f"{record['name']}: {record['ratio']:.1f}x the plain loop"
    parts = [f'<text x="{left}" y="20" font-size="14" font-weight="bold">{escape(title)}</text>']
    parts += axes.grid("%", 100)
    middle = (left + right) / 2
    parts.append(f'<text x="{middle}" y="{_HEIGHT - 12}" text-anchor="middle">seconds a frame</text>')
    parts.append(f'<text x="{left}" y="36" fill="#444">relative error</text>')
    for (method, region), points in lines.items():
        style = f'stroke="{_COLOURS[method]}" stroke-width="2" stroke-dasharray="{_DASHES[region]}"'
        parts += axes.line(points, style, _COLOURS[method])
    for row, (method, region) in enumerate(lines):
        y = _TOP + 12 + 15 * row
        style = f'stroke="{_COLOURS[method]}" stroke-width="2" stroke-dasharray="{_DASHES[region]}"'
        parts.append(f'<line x1="{right - 128}" x2="{right - 104}" y1="{y - 4}" y2="{y - 4}" {style}/>')
        parts.append(f'<text x="{right - 98}" y="{y}">{escape(method)}, {escape(region)}</text>')
    return "".join(parts)
