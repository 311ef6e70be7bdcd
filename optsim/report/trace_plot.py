# pyright: reportUnknownMemberType=false
"""A trace of one CCD pixel as one image: light, code and electrons slot by slot, and their origins."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from textwrap import wrap
from typing import TYPE_CHECKING, Any

import numpy as np

from optsim.report.plots import COLOURS, SVG
from optsim.report.trace_record import Contributor, ConvertedReading, Trace, sentences

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_WIDTH, _HEIGHT = 1200, 896
_UNITS_AN_INCH = 72
_NOTE_CHARS = 170  # of the widest common sans-serif
_LEFT, _RIGHT = 84, 660  # of the plots over slots
_SIDE, _END = 790, 1180  # of what stands beside them
_INK, _SOFT, _RULE = COLOURS["ink"], COLOURS["soft"], COLOURS["rule"]
_CODE = "#d9d5ca"
_DECADES = 4
# Display names, and colours that colour-blind readers can distinguish (M. Okabe and K. Ito, 2008).
_ORIGINS = {
    "own_open": ("own pixel, open", "#0072b2"),
    "own_leak": ("own pixel, dark: leak", "#56b4e9"),
    "own_late": ("own pixel, dark: late", "#a6d8f5"),
    "neighbours": ("8 neighbours", "#d55e00"),
    "near_field": ("2 to 5 pixels away", "#e69f00"),
    "wings": ("farther, PSF tails", "#f0d264"),
    "ghost": ("relay ghost", "#cc79a7"),
    "veil": ("relay veil", "#009e73"),
    "dark_current": ("dark current", "#77797f"),
    "smear": ("smear", "#1b1d22"),
}
_OWN, _ALL = _ORIGINS["own_open"][1], _SOFT
_STYLE: dict[str, Any] = {
    "font.size": 12.5,
    "text.color": _INK,
    "text.parse_math": False,
    "axes.edgecolor": _RULE,
    "axes.labelcolor": _SOFT,
    "axes.titlelocation": "left",
    "axes.titlesize": 14,
    "axes.titleweight": "bold",
    "axes.axisbelow": True,
    "grid.color": _RULE,
    "xtick.color": _RULE,
    "ytick.color": _RULE,
    "xtick.labelcolor": _SOFT,
    "ytick.labelcolor": _SOFT,
    "legend.frameon": False,
    "legend.fontsize": 11.5,
}


def trace_plot(trace: Trace) -> str:
    """Draw a trace as one self-contained SVG with a white ground."""
    from matplotlib.figure import Figure
    from matplotlib.style import context

    title, looked, read = sentences(trace)
    with context({**SVG, **_STYLE}):
        figure = Figure((_WIDTH / _UNITS_AN_INCH, _HEIGHT / _UNITS_AN_INCH))
        _write(figure, 24, 34, title, size=20, weight="bold")
        _write(figure, 24, 58, looked, size=14)
        _write(figure, 24, 78, read, size=14)
        _light(_plot(figure, _LEFT, 134, _RIGHT, 264), trace)
        _panel(_plot(figure, _LEFT, 322, _RIGHT, 412), trace)
        _electrons(_plot(figure, _LEFT, 470, _RIGHT, 740), trace)
        _origins(_plot(figure, _SIDE + 184, 132, _SIDE + 258, 346), trace)
        _chain(figure, trace.reading)
        _map(_plot(figure, _SIDE, 640, _SIDE + 154, 794), trace)
        _sources(figure, trace.sources)
        notes = [line for note in trace.notes for line in wrap(note, _NOTE_CHARS)]
        for place, note in enumerate(reversed(notes)):
            _write(figure, 24, _HEIGHT - 10 - 16 * place, note, size=11.5, color=_SOFT)
        written = io.StringIO()
        figure.savefig(written, format="svg", metadata={"Title": title, "Date": None})
    return written.getvalue()


def _plot(figure: Figure, left: float, top: float, right: float, bottom: float) -> Axes:
    """Return axes at a position in SVG units, counted from the top left."""
    place = left / _WIDTH, 1 - bottom / _HEIGHT, (right - left) / _WIDTH, (bottom - top) / _HEIGHT
    axes = figure.add_axes(place)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    return axes


def _write(figure: Figure, x: float, y: float, words: str, **style: Any) -> None:
    figure.text(x / _WIDTH, 1 - y / _HEIGHT, words, **style)


def _over_slots(axes: Axes, n_slots: int, title: str, y_label: str) -> None:
    axes.set(xlim=(0, n_slots), title=title, ylabel=y_label)
    slots = range(0, n_slots, max(1, math.ceil(n_slots / 12)))
    axes.set_xticks([slot + 0.5 for slot in slots], [str(slot) for slot in slots])
    axes.grid(axis="y")


def _steps(axes: Axes, values: Sequence[float | None], **style: Any) -> None:
    known = [math.nan if value is None else value for value in values]
    axes.stairs(known, baseline=None, linewidth=2, **style)


def _light(axes: Axes, trace: Trace) -> None:
    """Irradiance on the left axis, radiance on the right, scaled by a sharp lens without glare."""
    slots, scale = trace.slots, trace.irradiance_per_radiance
    drawn: list[float] = []
    for label, irradiance, radiance, colour in (
        ("own panel pixel", slots.own_irradiance_w_m2, slots.own_radiance_w_m2_sr, _OWN),
        ("all that can reach it", slots.irradiance_w_m2, slots.radiance_w_m2_sr, _ALL),
    ):
        laid = [None if value is None else value * scale for value in radiance]
        _steps(axes, laid, color=colour, linestyle=":")
        _steps(axes, irradiance, color=colour, label=label)
        drawn += [value for value in (*laid, *irradiance) if value is not None]
    _over_slots(axes, len(slots.level), "Light on the modulator", "irradiance, W m⁻²")
    if min(drawn) > 0 and max(drawn) > 30 * min(drawn):
        axes.set_yscale("log")
    else:
        axes.set_ylim(min(0.0, *drawn), 1.05 * max(drawn) or 1.0)
    beside = axes.secondary_yaxis(
        "right", functions=(lambda e: np.asarray(e) / scale, lambda r: np.asarray(r) * scale)
    )
    beside.set_ylabel("radiance, W m⁻² sr⁻¹ (dotted)")
    beside.tick_params(length=0)
    beside.spines[:].set_visible(False)
    _legend(axes)


def _panel(axes: Axes, trace: Trace) -> None:
    slots = trace.slots
    middles = np.arange(len(slots.level)) + 0.5
    axes.bar(
        middles,
        np.array(slots.level) / 255,
        width=1,
        linewidth=0,
        color=_CODE,
        label="commanded: level / 255",
    )
    for slot, is_open in enumerate(slots.shutter_open):
        if not is_open:
            axes.axvspan(slot, slot + 1, color="black", alpha=0.13, linewidth=0)
    _steps(axes, slots.weight, color=_OWN, label="effective")
    axes.set_ylim(0, 1.05 * max(1.0, *slots.weight))
    _over_slots(axes, len(slots.level), "Code of its panel pixel", "weight (on = 1)")
    _legend(axes)


def _electrons(axes: Axes, trace: Trace) -> None:
    slots = trace.slots
    n_slots = len(slots.level)
    base = np.zeros(n_slots)
    for name, electrons in slots.origins_e.items():
        # Monte-Carlo noise of the truth can be negative; a bar cannot.
        height = np.maximum(electrons, 0.0)
        axes.bar(np.arange(n_slots) + 0.5, height, width=0.9, bottom=base, color=_ORIGINS[name][1])
        base = base + height
    axes.set_ylim(0, 1.05 * float(base.max()) or 1.0)
    _over_slots(axes, n_slots, "Electrons of each slot, by origin: colours as on the right", "electrons")
    axes.set_xlabel("slot of the exposure")


def _origins(axes: Axes, trace: Trace) -> None:
    rows = range(len(trace.origins))
    names, colours = zip(*(_ORIGINS[origin.name] for origin in trace.origins), strict=True)
    electrons = [max(origin.electrons_e, 0.0) for origin in trace.origins]
    axes.barh(rows, electrons, height=0.62, color=colours)
    beside = axes.get_yaxis_transform()
    axes.barh(rows, 0.16, left=-2.49, height=0.62, color=colours, transform=beside, clip_on=False)
    axes.set(xlim=(0, max(electrons, default=0.0) or 1.0), ylim=(len(rows) - 0.4, -0.6), xticks=[])
    axes.set_yticks(rows, names, ha="left", color=_INK)
    axes.tick_params(axis="y", pad=166)
    axes.set_title("Electrons of the whole exposure", x=-2.49)
    for row, origin in enumerate(trace.origins):
        count, share = _electron_count(origin.electrons_e), f"{100 * origin.share:.2f} %"
        axes.text(2, row, count, transform=beside, ha="right", va="center")
        axes.text(2.78, row, share, transform=beside, ha="right", va="center", color=_SOFT)


def _chain(figure: Figure, reading: ConvertedReading) -> None:
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
    _write(figure, _SIDE, 380, "From electrons to the digital number", size=14, weight="bold")
    for row, (label, value) in enumerate(rows):
        weight = "bold" if row in (0, 5, len(rows) - 1) else "normal"
        _write(figure, _SIDE, 402 + 18 * row, label, weight=weight)
        _write(figure, _END, 402 + 18 * row, value, ha="right", weight=weight)


def _map(axes: Axes, trace: Trace) -> None:
    """Electrons of the panel pixels around the own one, logarithmic."""
    from matplotlib.colors import LinearSegmentedColormap, LogNorm
    from matplotlib.patches import Rectangle

    electrons = np.array([[np.nan if e is None else e for e in row] for row in trace.neighbourhood_e])
    highest = float(np.nanmax(electrons, initial=0.0))
    shades = LinearSegmentedColormap.from_list("electrons", ["#ffffff", "#08306b"]).with_extremes(
        bad=COLOURS["sunk"]
    )
    # Zero electrons are as white as four decades below the most.
    floor = highest / 10**_DECADES or 1.0
    norm = LogNorm(floor, highest or 10.0, clip=True)
    edges = np.arange(len(electrons) + 1)
    shown = np.where(electrons <= 0, floor, electrons)
    axes.pcolormesh(edges, edges, shown, norm=norm, cmap=shades, edgecolor="white", linewidth=0.5)
    centre = len(electrons) // 2
    axes.add_patch(Rectangle((centre, centre), 1, 1, fill=False, edgecolor="#d55e00", linewidth=2))
    axes.invert_yaxis()
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(True)
    axes.set_title("Near panel pixels", pad=20)
    scale = (
        f"{_DECADES} decades, up to {_electron_count(highest)} e⁻"
        if highest > 0
        else "none on the direct path"
    )
    axes.text(0, 1.03, scale, transform=axes.transAxes, size=11.5, color=_SOFT)


def _sources(figure: Figure, sources: Sequence[Contributor]) -> None:
    left, top = _SIDE + 190, 618
    _write(figure, left, top, "Others that give most", size=14, weight="bold")
    if not sources:
        _write(figure, left, top + 24, "none on the direct path", color=_SOFT)
        return
    soft = {"size": 11.5, "color": _SOFT}
    _write(figure, left, top + 16, "dv, du", **soft)
    _write(figure, left + 98, top + 16, "e⁻", ha="right", **soft)
    _write(figure, left + 108, top + 16, "commanded, by slot", **soft)
    for row, source in enumerate(sources[:8]):
        y = top + 34 + 18 * row
        _write(figure, left, y, f"{source.dv:+d}, {source.du:+d}")
        _write(figure, left + 98, y, _electron_count(source.electrons_e), ha="right")
        axes = _plot(figure, left + 108, y - 10, _END, y + 2)
        axes.imshow([source.level], cmap="gray", vmin=0, vmax=255, aspect="auto", interpolation="nearest")
        axes.set(xticks=[], yticks=[])


def _legend(axes: Axes) -> None:
    """Name the lines above the plot, at the right."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.02, 0.98), ncols=3, borderpad=0.2, columnspacing=1.2)


def _electron_count(electrons: float) -> str:
    if abs(electrons) >= 100:
        return f"{electrons:,.0f}".replace(",", " ")
    return "<0.01" if 0 < electrons < 0.005 else f"{electrons:.2f}"
