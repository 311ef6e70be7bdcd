"""Logarithmic and even axes of the benchmark pictures, as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

# Colour-blind safe set (M. Okabe and K. Ito, 2008), without yellow and black.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#666666")

_STEPS = (1, 2, 5)


def picture(width: int, height: int, parts: Sequence[str]) -> str:
    """Put parts on a white ground: an SVG for a browser or a document."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" '
        f'height="{height}" font-family="sans-serif" font-size="12">'
        f'<rect width="{width}" height="{height}" fill="white"/>{"".join(parts)}</svg>\n'
    )


def round_numbers(low: float, high: float) -> list[float]:
    """Numbers 1, 2, 5 times powers of ten that enclose the values."""
    every = [m * 10.0**e for e in range(-7, 7) for m in _STEPS]
    first = max(i for i, tick in enumerate(every) if tick <= low)
    last = min(i for i, tick in enumerate(every) if tick >= high)
    return every[first : last + 1] if last > first else every[first : first + 2]


def even_numbers(low: float, high: float, step: float) -> list[float]:
    """Multiples of a step that enclose the values."""
    first, last = math.floor(low / step), math.ceil(high / step)
    return [step * k for k in range(first, max(last, first + 1) + 1)]


@dataclass(frozen=True)
class Axes:
    """A panel with ticks: time along, on a logarithmic axis, something else up.

    Parameters
    ----------
    left, right, top, bottom : float
        Edges of the panel, pixels of the picture.
    across, up : sequence of float
        Ticks, ascending; the first and the last are at the edges.
    log_up : bool
        Whether the other axis is logarithmic too.
    """

    left: float
    right: float
    top: float
    bottom: float
    across: Sequence[float]
    up: Sequence[float]
    log_up: bool = True

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a point lies in the picture."""
        along, rise = _log_share(x, self.across), (_log_share if self.log_up else _share)(y, self.up)
        return self.left + along * (self.right - self.left), self.bottom - rise * (self.bottom - self.top)

    def grid(self, unit: str, factor: float = 1) -> list[str]:
        """Lines and numbers at the ticks; those of the other axis are given in a unit."""
        parts: list[str] = []
        edge = self.left - 6
        for tick in self.up:
            y = self.place(self.across[0], tick)[1]
            parts.append(
                f'<line x1="{self.left:g}" x2="{self.right:g}" y1="{y:.1f}" y2="{y:.1f}" stroke="#ddd"/>'
                f'<text x="{edge:g}" y="{y + 4:.1f}" text-anchor="end">{factor * tick:g} {unit}</text>'
            )
        for tick in self.across:
            x = self.place(tick, self.up[0])[0]
            parts.append(
                f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{self.top:g}" y2="{self.bottom:g}" stroke="#ddd"/>'
                f'<text x="{x:.1f}" y="{self.bottom + 16:g}" text-anchor="middle">{tick:g}</text>'
            )
        return parts

    def line(self, points: Sequence[tuple[float, float]], style: str, colour: str) -> list[str]:
        """Join points and mark each."""
        places = [self.place(*point) for point in points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        marks = [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in places]
        return [f'<polyline points="{path}" fill="none" {style}/>', *marks]


def _log_share(value: float, ticks: Sequence[float]) -> float:
    return math.log(value / ticks[0]) / math.log(ticks[-1] / ticks[0])


def _share(value: float, ticks: Sequence[float]) -> float:
    return (value - ticks[0]) / (ticks[-1] - ticks[0])
