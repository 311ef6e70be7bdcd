"""The mask over its lag as pictures: precision, recall, IoU and loss, a line an option of the scheme."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import cycle
from typing import Any

from benchmarks.axes import COLOURS, Axes, even_numbers, picture, round_numbers

_WIDTH, _HEIGHT, _PANELS = 430, 300, 2
_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 20, 34, 50
_FOOT, _KEY_WIDTH = 34, 130
_SHARES = (0.0, 0.25, 0.5, 0.75, 1.0)
_QUANTITIES = {"precision": "precision", "recall": "recall", "iou": "IoU", "loss_db": "loss where it moves"}


def mask_against_lag(record: Mapping[str, Any]) -> str:
    """Draw the points of ``mask.speed_latency`` as SVG.

    Parameters
    ----------
    record : mapping
        As :func:`benchmarks.measure_all` returns it.

    Returns
    -------
    str
        SVG with a white ground. A dot is a speed and a latency; lines join the means at equal lags.
    """
    points = record["conditions"]["mask"]
    options = list(dict.fromkeys(point["option"] for point in points))
    width, height = _PANELS * _WIDTH, -(-len(_QUANTITIES) // _PANELS) * _HEIGHT + _FOOT
    parts: list[str] = []
    for n, (key, title) in enumerate(_QUANTITIES.items()):
        left, top = (n % _PANELS) * _WIDTH, (n // _PANELS) * _HEIGHT
        parts += _panel(points, options, key, title, left, top)
    for n, (colour, option) in enumerate(zip(cycle(COLOURS), options, strict=False)):
        x, y = _LEFT + n * _KEY_WIDTH, height - 14
        parts.append(f'<line x1="{x}" x2="{x + 22}" y1="{y - 4}" y2="{y - 4}" {_style(colour, n)}/>')
        parts.append(f'<text x="{x + 28}" y="{y}">{escape(option)}</text>')
    return picture(width, height, parts)


def _panel(
    points: Sequence[Mapping[str, Any]], options: Sequence[str], key: str, title: str, left: int, top: int
) -> list[str]:
    # An empty mask has no precision: such points are left out.
    drawn = [point for point in points if point[key] is not None]
    lags, values = [point["lag_px"] for point in points], [point[key] for point in drawn]
    is_loss = key == "loss_db"
    axes = Axes(
        left + _LEFT,
        left + _WIDTH - _RIGHT,
        top + _TOP,
        top + _HEIGHT - _BOTTOM,
        round_numbers(min(lags), max(lags)),
        even_numbers(min(values), max(values), 1.0) if is_loss else _SHARES,
        log_up=False,
    )
    middle, below = left + (_LEFT + _WIDTH - _RIGHT) / 2, top + _HEIGHT - 14
    parts = [f'<text x="{left + _LEFT}" y="{top + 22}" font-size="14" font-weight="bold">{title}</text>']
    parts += axes.grid("dB") if is_loss else axes.grid("%", 100)
    parts.append(f'<text x="{middle:g}" y="{below}" text-anchor="middle">speed x latency, pixels</text>')
    for n, (colour, option) in enumerate(zip(cycle(COLOURS), options, strict=False)):
        at_lag: dict[float, list[float]] = {}
        for point in drawn:
            if point["option"] == option:
                at_lag.setdefault(point["lag_px"], []).append(point[key])
        means = [(lag, sum(found) / len(found)) for lag, found in sorted(at_lag.items())]
        parts.append(axes.line(means, _style(colour, n), colour)[0])
        for lag, found in at_lag.items():
            for x, y in (axes.place(lag, value) for value in found):
                parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>')
    return parts


def _style(colour: str, n: int) -> str:
    """Options that lie on each other stay visible: every other line is dashed."""
    return f'stroke="{colour}" stroke-width="2" stroke-dasharray="{"6 5" if n % 2 else ""}"'
