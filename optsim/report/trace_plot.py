"""A trace of one CCD pixel as one picture: light, code and electrons slot by slot; beside them where from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import wrap

from markupsafe import escape

from optsim.report.plots import nice_ticks
from optsim.report.trace_record import Reading, Source, Trace, sentences

_WIDTH, _HEIGHT = 1200, 896
_NOTE_CHARS = 170  # of the widest common sans-serif
_LEFT, _RIGHT = 84, 660  # of the plots over slots
_SIDE, _END = 790, 1180  # of what stands beside them
_SOFT, _RULE = "#5d6068", "#dfdbd1"
# Names for people, and colours that colour-blind readers tell apart (M. Okabe and K. Ito, 2008).
_ORIGINS = {
    "own_open": ("own pixel, told open", "#0072b2"),
    "own_leak": ("own pixel, told dark: leak", "#56b4e9"),
    "own_late": ("own pixel, told dark: late", "#a6d8f5"),
    "neighbours": ("8 neighbours", "#d55e00"),
    "near_field": ("2 to 5 pixels away", "#e69f00"),
    "wings": ("farther, PSF wings", "#f0d264"),
    "ghost": ("relay ghost", "#cc79a7"),
    "veil": ("relay veil", "#009e73"),
    "dark_current": ("dark current", "#77797f"),
    "smear": ("smear", "#1b1d22"),
}


def trace_plot(trace: Trace) -> str:
    """Draw a trace as one self-contained SVG with a white ground."""
    title, looks, reads = sentences(trace)
    notes = [line for note in trace.notes for line in wrap(note, _NOTE_CHARS)]
    parts = [
        _text(24, 34, title, size=20, weight=600),
        _text(24, 58, looks, size=14),
        _text(24, 78, reads, size=14),
        *_light(trace),
        *_panel(trace),
        *_electrons(trace),
        *_bars(trace),
        *_chain(trace.reading),
        *_map(trace),
        *_sources(trace.sources),
        *(
            _text(24, _HEIGHT - 10 - 16 * (len(notes) - 1 - i), note, size=11.5, fill=_SOFT)
            for i, note in enumerate(notes)
        ),
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" '
        f'height="{_HEIGHT}" role="img" aria-label="{escape(title)}" font-family="sans-serif" fill="#1b1d22">'
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>{"".join(parts)}</svg>\n'
    )


@dataclass(frozen=True)
class _Frame:
    """Axes of a plot over slots: from the bottom value to the top one, linear or logarithmic."""

    top: float
    bottom: float
    n_slots: int
    ticks: Sequence[float]
    log: bool = False

    def across(self, slot: float) -> float:
        return _LEFT + slot / self.n_slots * (_RIGHT - _LEFT)

    def down(self, value: float) -> float:
        low, high = self.ticks[0], self.ticks[-1]
        if self.log:
            share = math.log(max(value, low) / low) / math.log(high / low)
        else:
            share = (value - low) / (high - low)
        return self.bottom - share * (self.bottom - self.top)

    def axes(self, title: str, y_label: str, x_label: str = "") -> list[str]:
        parts = [_text(_LEFT, self.top - 12, title, size=14, weight=600)]
        for tick in self.ticks:
            y = self.down(tick)
            parts.append(f'<path d="M{_LEFT} {y:.1f}H{_RIGHT}" stroke="{_RULE}"/>')
            parts.append(_text(_LEFT - 8, y + 4, f"{tick:.4g}", anchor="end", fill=_SOFT))
        parts.append(_upright(22, (self.top + self.bottom) / 2, y_label))
        step = max(1, math.ceil(self.n_slots / 12))
        for slot in range(0, self.n_slots, step):
            x = self.across(slot + 0.5)
            parts.append(_text(x, self.bottom + 17, str(slot), anchor="middle", fill=_SOFT))
        if x_label:
            x = (_LEFT + _RIGHT) / 2
            parts.append(_text(x, self.bottom + 36, x_label, anchor="middle", fill=_SOFT))
        return parts

    def steps(self, values: Sequence[float | None], style: str) -> str:
        path = ""
        for slot, value in enumerate(values):
            if value is not None:
                y = self.down(value)
                path += f"{'L' if path else 'M'}{self.across(slot):.1f} {y:.1f}H{self.across(slot + 1):.1f}"
        return f'<path d="{path}" fill="none" stroke-width="2" {style}/>' if path else ""


def _light(trace: Trace) -> list[str]:
    """Irradiance to the left, radiance to the right: where a sharp lens without glare puts it."""
    slots, scale = trace.slots, trace.irradiance_per_radiance
    lines = [
        ("own panel pixel", slots.own_irradiance_w_m2, slots.own_radiance_w_m2_sr, "#0072b2"),
        ("all that can reach it", slots.irradiance_w_m2, slots.radiance_w_m2_sr, _SOFT),
    ]
    drawn = [
        (irradiance, [None if r is None else r * scale for r in radiance], colour)
        for _, irradiance, radiance, colour in lines
    ]
    values = [v for one, other, _ in drawn for v in (*one, *other) if v is not None]
    low, high = min(values), max(values)
    log = low > 0 and high > 30 * low
    ticks = _decades(low, high) if log else nice_ticks(min(low, 0), high)
    frame = _Frame(134, 264, len(slots.level), ticks, log)
    parts = frame.axes("Light on the modulator", "irradiance, W m⁻²")
    low, high = ticks[0] / scale, ticks[-1] / scale
    for tick in _decades(low, high) if log else nice_ticks(low, high):
        if low <= tick <= high:
            parts.append(_text(_RIGHT + 8, frame.down(tick * scale) + 4, f"{tick:.4g}", fill=_SOFT))
    parts.append(_upright(_RIGHT + 64, 199, "radiance, W m⁻² sr⁻¹"))
    for irradiance, radiance, colour in drawn:
        parts.append(frame.steps(radiance, f'stroke="{colour}" stroke-dasharray="3 3"'))
        parts.append(frame.steps(irradiance, f'stroke="{colour}"'))
    for x, (label, _, _, colour) in zip((288, 414), lines, strict=True):
        parts.append(f'<path d="M{x} 118h18" stroke="{colour}" stroke-width="2"/>')
        parts.append(_text(x + 23, 122, label, size=11.5))
    parts.append(_text(_RIGHT, 122, "dashed: radiance", size=11.5, anchor="end", fill=_SOFT))
    return parts


def _panel(trace: Trace) -> list[str]:
    slots = trace.slots
    top = max(1.0, *slots.weight)
    frame = _Frame(322, 412, len(slots.level), nice_ticks(0, top, 3))
    parts = frame.axes("What its panel pixel was told, and what it did", "weight (on = 1)")
    for slot, (level, shutter) in enumerate(zip(slots.level, slots.shutter_open, strict=True)):
        x, width = frame.across(slot), frame.across(1) - frame.across(0)
        y = frame.down(level / 255)
        parts.append(_rect(x, y, width, frame.bottom - y, "#d9d5ca"))
        if not shutter:
            parts.append(_rect(x, frame.top, width, frame.bottom - frame.top, "#00000022"))
    parts.append(frame.steps(slots.weight, 'stroke="#0072b2"'))
    parts.append(_rect(480, frame.top - 22, 12, 12, "#d9d5ca"))
    parts.append(_text(498, frame.top - 12, "told: level / 255", size=11.5))
    parts.append(f'<path d="M{_RIGHT - 48} {frame.top - 16}h18" stroke="#0072b2" stroke-width="2"/>')
    parts.append(_text(_RIGHT, frame.top - 12, "did", size=11.5, anchor="end"))
    return parts


def _electrons(trace: Trace) -> list[str]:
    slots = trace.slots
    columns = list(zip(*(slots.origins_e[name] for name in slots.origins_e), strict=True))
    highest = max(sum(max(e, 0.0) for e in column) for column in columns)
    frame = _Frame(470, 740, len(slots.level), nice_ticks(0, highest or 1.0))
    parts = frame.axes(
        "Electrons of each slot, by origin: colours as on the right", "electrons", "slot of the exposure"
    )
    for slot, column in enumerate(columns):
        base = 0.0
        for name, electrons in zip(slots.origins_e, column, strict=True):
            # Monte-Carlo noise of the truth can be negative; a bar cannot.
            up = base + max(electrons, 0.0)
            y, x = frame.down(up), frame.across(slot) + 0.75
            width = frame.across(1) - frame.across(0) - 1.5
            if up > base:
                parts.append(_rect(x, y, width, frame.down(base) - y, _ORIGINS[name][1]))
            base = up
    return parts


def _bars(trace: Trace) -> list[str]:
    parts = [_text(_SIDE, 122, "Electrons of the whole exposure", size=14, weight=600)]
    longest = max((origin.electrons_e for origin in trace.origins), default=0.0) or 1.0
    for row, origin in enumerate(trace.origins):
        label, colour = _ORIGINS[origin.name]
        y = 134 + 21 * row
        width = max(origin.electrons_e / longest * 74, float(origin.electrons_e > 0))
        parts += [
            _rect(_SIDE, y, 12, 13, colour),
            _text(_SIDE + 18, y + 11, label),
            _rect(_SIDE + 184, y, width, 13, colour),
            _text(_END - 58, y + 11, _electron_count(origin.electrons_e), anchor="end"),
            _text(_END, y + 11, f"{100 * origin.share:.2f} %", anchor="end", fill=_SOFT),
        ]
    return parts


def _chain(reading: Reading) -> list[str]:
    rows = [
        ("collected, dark current included", f"{_electron_count(reading.collected_e)} e⁻"),
        ("less: cut off by the full well", f"{_electron_count(reading.lost_at_well_e)} e⁻"),
        ("plus: smear", f"{_electron_count(reading.smear_e)} e⁻"),
        ("less: lost to the non-linearity", f"{_electron_count(reading.lost_to_bend_e)} e⁻"),
        ("plus: fixed dark pattern", f"{reading.dsnu_e:+.2f} e⁻".replace("-", "−")),
        (
            f"over {reading.gain_e:g} e⁻ a DN, plus {reading.black_dn:g} DN black",
            f"{reading.expected_dn:.1f} DN",
        ),
        ("noise: shot", f"{reading.shot_noise_e:.2f} e⁻"),
        (
            "read, smear, quantisation",
            f"{reading.read_noise_e:.2f}, {reading.smear_noise_e:.2f}, {reading.quantisation_noise_e:.2f} e⁻",
        ),
        ("all noise", f"{reading.sigma_dn:.2f} DN"),
        ("drawn in this frame", f"{reading.drawn_dn} DN"),
    ]
    parts = [_text(_SIDE, 380, "From electrons to the digital number", size=14, weight=600)]
    for row, (label, value) in enumerate(rows):
        weight = 600 if row in (0, 5, len(rows) - 1) else 400
        parts.append(_text(_SIDE, 402 + 18 * row, label, weight=weight))
        parts.append(_text(_END, 402 + 18 * row, value, anchor="end", weight=weight))
    return parts


def _map(trace: Trace) -> list[str]:
    """Electrons of the panel pixels around the own one, logarithmic over four decades."""
    size, left, top = 14, _SIDE, 640
    values = [e for row in trace.neighbourhood_e for e in row if e is not None]
    highest = max(values, default=0.0)
    parts = [_text(left, 618, "Near panel pixels", size=14, weight=600)]
    n = len(trace.neighbourhood_e)
    for v, row in enumerate(trace.neighbourhood_e):
        for u, electrons in enumerate(row):
            x, y = left + u * size, top + v * size
            if electrons is None:
                parts.append(_rect(x, y, size - 1, size - 1, "#f1efe9"))
                continue
            share = 1 + math.log10(electrons / highest) / 4 if electrons > 0 and highest > 0 else 0.0
            parts.append(_rect(x, y, size - 1, size - 1, _shade(min(max(share, 0.0), 1.0))))
    edge = n * size + 1
    parts.append(
        f'<rect x="{left - 1}" y="{top - 1}" width="{edge}" height="{edge}" fill="none" stroke="{_RULE}"/>'
    )
    centre = n // 2 * size
    parts.append(
        f'<rect x="{left + centre - 1}" y="{top + centre - 1}" width="{size + 1}" height="{size + 1}" '
        f'fill="none" stroke="#d55e00" stroke-width="2"/>'
    )
    scale = f"4 decades, up to {_electron_count(highest)} e⁻" if highest > 0 else "none on the direct path"
    parts.append(_text(left, 634, scale, size=11.5, fill=_SOFT))
    return parts


def _sources(sources: Sequence[Source]) -> list[str]:
    left, top = _SIDE + 190, 618
    parts = [_text(left, top, "Others that give most", size=14, weight=600)]
    if not sources:
        return [*parts, _text(left, top + 24, "none on the direct path", fill=_SOFT)]
    parts += [
        _text(left, top + 16, "dv, du", size=11.5, fill=_SOFT),
        _text(left + 98, top + 16, "e⁻", size=11.5, anchor="end", fill=_SOFT),
        _text(left + 108, top + 16, "told, slot by slot", size=11.5, fill=_SOFT),
    ]
    for row, source in enumerate(sources[:8]):
        y = top + 34 + 18 * row
        parts.append(_text(left, y, f"{source.dv:+d}, {source.du:+d}"))
        parts.append(_text(left + 98, y, _electron_count(source.electrons_e), anchor="end"))
        step = (_END - left - 108) / len(source.level)
        parts.append(
            f'<rect x="{left + 108}" y="{y - 10}" width="{_END - left - 108}" height="12" fill="#1b1d22"/>'
        )
        for slot, level in enumerate(source.level):
            if level:
                grey = f"#{level:02x}{level:02x}{level:02x}"
                parts.append(_rect(left + 108 + slot * step, y - 9, step, 10, grey))
    return parts


def _shade(share: float) -> str:
    """White to dark blue."""
    return "#" + "".join(f"{round(255 + (end - 255) * share):02x}" for end in (8, 48, 107))


def _decades(low: float, high: float) -> list[float]:
    return [10.0**k for k in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)]


def _electron_count(electrons: float) -> str:
    if abs(electrons) >= 100:
        return f"{electrons:,.0f}".replace(",", " ")
    return "<0.01" if 0 < electrons < 0.005 else f"{electrons:.2f}"


def _rect(x: float, y: float, width: float, height: float, fill: str) -> str:
    return (
        f'<rect x="{x:.2f}" y="{y:.2f}" width="{width:.2f}" height="{height:.2f}" fill="{fill}" '
        'shape-rendering="crispEdges"/>'
    )


def _text(
    x: float,
    y: float,
    words: str,
    *,
    anchor: str = "start",
    size: float = 12.5,
    fill: str = "#1b1d22",
    weight: int = 400,
) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}" fill="{fill}" '
        f'font-weight="{weight}">{escape(words)}</text>'
    )


def _upright(x: float, y: float, words: str) -> str:
    return (
        f'<text transform="translate({x} {y}) rotate(-90)" font-size="12.5" text-anchor="middle" '
        f'fill="{_SOFT}">{escape(words)}</text>'
    )
