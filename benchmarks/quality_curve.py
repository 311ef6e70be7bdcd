"""Quality against time as a picture: one line a decoder, time on a logarithmic axis."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape
from itertools import cycle
from typing import Any

from benchmarks.axes import COLOURS, Axes, even_numbers, picture, round_numbers

_WIDTH, _HEIGHT = 720, 440
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 200, 44, 50
_STEP_DB = 1.0


def quality_against_time(record: Mapping[str, Any]) -> str:
    """Draw the points of ``reconstruct.quality`` as SVG.

    Parameters
    ----------
    record : mapping
        As :func:`benchmarks.measure_all` returns it.

    Returns
    -------
    str
        SVG with a white ground, for a browser or a document.
    """
    conditions = record["conditions"]
    points, still = conditions["quality"], conditions["long_exposure_psnr_db"]
    lines: dict[str, list[dict[str, Any]]] = {}
    for point in points:
        lines.setdefault(point["decoder"], []).append(point)
    seconds, levels = zip(*((p["seconds"], p["psnr_db"]) for p in points), strict=True)
    up = even_numbers(min(*levels, still), max(levels), _STEP_DB)
    middle = (_LEFT + _WIDTH - _RIGHT) / 2
    right, bottom = _WIDTH - _RIGHT, _HEIGHT - _BOTTOM
    axes = Axes(_LEFT, right, _TOP, bottom, round_numbers(min(seconds), max(seconds)), up, log_up=False)
    title = f"{conditions['slots']} frames of {conditions['pixels']} from one"
    parts = [
        f'<text x="{_LEFT}" y="20" font-size="14" font-weight="bold">{escape(title)}</text>',
        f'<text x="{_LEFT}" y="36" fill="#444">PSNR of all frames; settings: ends of a line</text>',
        *axes.grid("dB"),
        f'<text x="{middle:g}" y="{_HEIGHT - 12}" text-anchor="middle">seconds an exposure</text>',
    ]
    for colour, members in zip(cycle(COLOURS), lines.values(), strict=False):
        members.sort(key=lambda point: point["seconds"])
        style = f'stroke="{colour}" stroke-width="2"'
        parts += axes.line([(p["seconds"], p["psnr_db"]) for p in members], style, colour)
    y = axes.place(axes.across[0], still)[1]
    parts.append(
        f'<line x1="{_LEFT}" x2="{right}" y1="{y:.1f}" y2="{y:.1f}" stroke="black" stroke-dasharray="5 4"/>'
    )
    for row, (colour, (name, members)) in enumerate(zip(cycle(COLOURS), lines.items(), strict=False)):
        top = _TOP + 12 + 34 * row
        parts += _key(right + 14, top, f'stroke="{colour}" stroke-width="2"', name, _settings(members))
    below = _TOP + 12 + 34 * len(lines)
    parts += _key(right + 14, below, 'stroke="black" stroke-dasharray="5 4"', "long exposure, still", "")
    return picture(_WIDTH, _HEIGHT, parts)


def _settings(members: list[dict[str, Any]]) -> str:
    """Name the settings of a line's ends."""
    return " .. ".join(dict.fromkeys((members[0]["setting"], members[-1]["setting"])))


def _key(x: float, y: float, style: str, name: str, settings: str) -> list[str]:
    return [
        f'<line x1="{x:g}" x2="{x + 22:g}" y1="{y - 4:g}" y2="{y - 4:g}" {style}/>',
        f'<text x="{x + 28:g}" y="{y:g}">{escape(name)}</text>',
        f'<text x="{x + 28:g}" y="{y + 14:g}" fill="#444">{escape(settings)}</text>',
    ]
