"""One image of all passes of a slot, each with its scale: for viewing, never for scores."""

from __future__ import annotations

from collections.abc import Mapping
from colorsys import hsv_to_rgb
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from optsim.core.quantities import Bools, Bytes, Doubles, Floats, Ids
from optsim.core.units import REC709_Y
from optsim.report.pictures import enlarge, ramp, rgb, tinted

_WIDTH_PX = 480
_GAP, _LEGEND, _TITLE = 14, 72, 34
_INK, _PAPER, _NOTHING = (30, 30, 30), (255, 255, 255), (120, 120, 120)
_DEPTH = ("#fff7bc", "#fec44f", "#d95f0e", "#7f2704", "#1c0a02")
_NOISE = ("#f7fbff", "#9ecae1", "#3182bd", "#08306b")
_GREY = ("#000000", "#ffffff")
_SIGNED = ("#08306b", "#6baed6", "#f7f7f7", "#fb6a4a", "#67000d")
_MASKS = ((18, 166, 131), (224, 69, 123), (242, 178, 50))
# Depths that spread over more than this ratio are drawn logarithmically.
_FAR_TO_NEAR = 12.0
# Relative noise at the dark end of its colours.
_NOISIEST = 0.5
_LISTED = 11

Channels = Mapping[str, NDArray[Any]]
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class _Panel:
    """An image with its legend: a colour bar, swatches, or the colour wheel of a flow of ``wheel_px``."""

    picture: Bytes
    text: str
    colours: tuple[str, ...] = ()
    ticks: tuple[str, ...] = ()
    swatches: tuple[tuple[Colour, str], ...] = ()
    wheel_px: float | None = None


def pass_sheet(channels: Channels, id_table: Mapping[int, str], title: str) -> Bytes:
    """Draw radiance, depth, normals, ids, flow, albedo, masks and noise side by side, then further channels.

    Parameters
    ----------
    channels : Mapping
        Channels of a slot's file, by name: arrays of shape (y, x).
    id_table : Mapping
        Object id -> name.
    title : str
        First line.

    Returns
    -------
    ndarray of shape (rows, columns, 3), uint8
        sRGB.
    """
    seen = channels["id"] > 0
    peak_px = max(_peak_px(channels, "forward"), _peak_px(channels, "backward"))
    tones = _tones(channels["Y"])
    panels = [
        _radiance(channels["Y"], tones, "radiance, mean over the slot"),
        *_colour(channels, tones),
        _depth(channels["Z"], seen),
        _normals(channels, seen),
        _ids(channels["id"], channels["moving"] > 0, id_table),
        _flow(channels, "forward", peak_px, seen),
        _flow(channels, "backward", peak_px, seen),
        _Panel(_shade(_GREY, channels["albedo"], seen), "albedo (diffuse part)", _GREY, ("0", "0.5", "1")),
        _masks(channels),
    ]
    if "Y.sigma" in channels:
        panels.append(_noise(channels["Y"], channels["Y.sigma"]))
    panels += [_radiance(channels[name], tones, text) for name, text in _further(channels)]
    if "S0" in channels:
        panels += _stokes(channels, tones[1])
    rows, cols = channels["Y"].shape
    factor = max(1, round(_WIDTH_PX / cols))
    width, height = max(cols * factor, _WIDTH_PX), rows * factor
    step_x, step_y = width + _GAP, height + _LEGEND + _GAP
    down = -(-len(panels) // 3)
    sheet = Image.new("RGB", (3 * step_x + _GAP, down * step_y + _GAP + _TITLE), _PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((_GAP, 12), title, _INK, ImageFont.load_default(18))
    for index, panel in enumerate(panels):
        x, y = _GAP + index % 3 * step_x, _TITLE + _GAP + index // 3 * step_y
        sheet.paste(Image.fromarray(enlarge(panel.picture, factor)), (x, y))
        draw.rectangle((x - 1, y - 1, x + cols * factor, y + height), outline=_NOTHING)
        _legend(sheet, draw, panel, (x, y + height + 5), width)
    return np.asarray(sheet)


def _legend(
    sheet: Image.Image, draw: ImageDraw.ImageDraw, panel: _Panel, corner: tuple[int, int], width: int
) -> None:
    x, y = corner
    draw.text((x, y), panel.text, _INK, ImageFont.load_default(14))
    if panel.colours:
        bar = ramp(panel.colours, np.linspace(0, 1, width)[None].repeat(11, axis=0))
        sheet.paste(Image.fromarray(bar), (x, y + 22))
        for index, tick in enumerate(panel.ticks):
            share = index / (len(panel.ticks) - 1)
            anchor = "la" if share == 0 else "ra" if share == 1 else "ma"
            place = (x + share * (width - 1), y + 36)
            draw.text(place, tick, _INK, ImageFont.load_default(12), anchor=anchor)
    left, top = x, y + 24
    for colour, label in panel.swatches:
        room = 20 + draw.textlength(label, ImageFont.load_default(12))
        if left > x and left + room > x + width:
            left, top = x, top + 15
        draw.rectangle((left, top + 1, left + 11, top + 12), fill=colour)
        draw.text((left + 15, top - 1), label, _INK, ImageFont.load_default(12))
        left += int(room) + 6
    if panel.wheel_px is not None:
        side = _LEGEND - 8
        across, down = np.meshgrid(np.linspace(-1.05, 1.05, side), np.linspace(-1.05, 1.05, side))
        wheel = flow_colours(down, across, 1.0)
        wheel[np.hypot(across, down) > 1] = _PAPER
        sheet.paste(Image.fromarray(wheel), (x + width - side, y))
        rim = f"rim of the wheel: {_short(panel.wheel_px)} px or more" if panel.wheel_px > 0 else "no motion"
        draw.text((x, y + 22), f"colour: direction; {rim}", _INK, ImageFont.load_default(12))
        draw.text((x, y + 38), "grey: no surface", _INK, ImageFont.load_default(12))


def flow_colours(row: Doubles, col: Doubles, peak: float) -> Bytes:
    """Colour a flow: hue is its direction, saturation its length up to ``peak``; white for none."""
    hue = np.arctan2(row, col) / (2 * np.pi) % 1
    length = np.clip(np.hypot(row, col) / peak, 0, 1) if peak > 0 else np.zeros_like(hue)
    pure = np.clip(np.abs((hue[..., None] * 6 + np.array([0, 4, 2])) % 6 - 3) - 1, 0, 1)
    pure[..., 1] *= 0.85  # a full green drowns its neighbours
    return np.rint(255 * (1 - length[..., None] * (1 - pure))).astype(np.uint8)


def _short(value: float) -> str:
    """Write three digits, in characters of Pillow's built-in font."""
    return f"{value:.3g}"


def _tones(radiance: Floats) -> tuple[float, float]:
    """Knee between the linear shadows and the logarithm, and peak, W m^-2 sr^-1: the same for all panels."""
    low, high = (float(q) for q in np.percentile(radiance, (5, 99.9)))
    peak = max(high, 1e-12)
    return max(low / 3, peak * 1e-6), peak


def _shown(radiance: Floats, tones: tuple[float, float]) -> Bytes:
    knee, peak = tones
    shown = np.log1p(np.clip(radiance, 0, peak) / knee) / np.log1p(peak / knee)
    return np.rint(255 * shown).astype(np.uint8)


def _colour(channels: Channels, tones: tuple[float, float]) -> list[_Panel]:
    if "R" not in channels:
        return []
    light = np.stack([channels[name] for name in "RGB"], axis=-1)
    text = "colour: R, G, B in the tones of the radiance"
    return [_Panel(tinted(light, _shown(light @ np.array(REC709_Y, np.float32), tones)), text)]


def _radiance(radiance: Floats, tones: tuple[float, float], what: str) -> _Panel:
    knee, peak = tones
    places = knee * np.expm1(np.linspace(0, 1, 4) * np.log1p(peak / knee))
    ticks = ("0", *(_short(float(v)) for v in places[1:]))
    text = f"{what}, W m^-2 sr^-1 (logarithmic above the shadows)"
    return _Panel(rgb(_shown(radiance, tones)), text, _GREY, ticks)


def _further(channels: Channels) -> list[tuple[str, str]]:
    """Further channels of radiance: name and meaning."""
    found = [
        (name, f"{word} {name.removeprefix(start)}")
        for start, word in (("Y.band.", "band"), ("Y.light.", "light group"))
        for name in sorted(channels)
        if name.startswith(start)
    ]
    return found + [(name, "denoised, never for figures") for name in ("Y.denoised",) if name in channels]


def _stokes(channels: Channels, peak: float) -> list[_Panel]:
    """Components as shares of S0, all on the scale of the largest."""
    # Black has no polarisation, only noise.
    floor = 1e-3 * peak
    shares = [channels[f"S{i}"] / np.maximum(channels["S0"], floor) for i in (1, 2, 3)]
    most = min(1.0, max(0.01, *(float(np.percentile(np.abs(share), 99.5)) for share in shares)))
    ticks = tuple(_short(most * v) for v in (-1.0, -0.5, 0.0, 0.5, 1.0))
    words = ("+ level, - upright", "+ up to the right, - up to the left", "+ right circular, - left circular")
    return [
        _Panel(
            ramp(_SIGNED, np.clip(share / most / 2 + 0.5, 0, 1)),
            f"polarisation S{i} / S0: {word}",
            _SIGNED,
            ticks,
        )
        for i, (share, word) in enumerate(zip(shares, words, strict=True), start=1)
    ]


def _depth(depth_m: Floats, seen: Bools) -> _Panel:
    if not seen.any():
        return _Panel(_shade(_DEPTH, depth_m, seen), "planar depth: nothing in view")
    near, far = float(depth_m[seen].min()), float(depth_m[seen].max())
    steep = far > _FAR_TO_NEAR * near
    curve = np.log if steep else np.positive
    low, high = float(curve(near)), float(curve(far))
    position = (curve(np.where(seen, depth_m, near)) - low) / max(high - low, 1e-12)
    places = low + np.linspace(0, 1, 5) * (high - low)
    ticks = tuple(_short(float(v)) for v in (np.exp(places) if steep else places))
    text = "planar depth, m" + (" (logarithmic)" if steep else "")
    return _Panel(_shade(_DEPTH, position, seen), text, _DEPTH, ticks)


def _normals(channels: Channels, seen: Bools) -> _Panel:
    normal = np.stack([channels[f"N.{axis}"] for axis in "XYZ"], axis=-1)
    picture = np.rint(127.5 * (normal + 1)).clip(0, 255).astype(np.uint8)
    picture[~seen] = _NOTHING
    axes: list[tuple[Colour, str]] = []
    for index, axis in enumerate("xyz"):
        for sign, word in ((255, "+"), (0, "-")):
            colour = [128, 128, 128]
            colour[index] = sign
            axes.append(((colour[0], colour[1], colour[2]), word + axis))
    return _Panel(picture, "normals in the world, toward the camera", swatches=tuple(axes))


def _ids(ids: Ids, moving: Bools, id_table: Mapping[int, str]) -> _Panel:
    numbers, counts = np.unique(ids[ids > 0], return_counts=True)
    movers = set(np.unique(ids[moving]).tolist())
    order = sorted(
        zip(numbers.tolist(), counts.tolist(), strict=True), key=lambda x: (x[0] not in movers, -x[1])
    )
    picture = np.full((*ids.shape, 3), _NOTHING, np.uint8)
    for number_ in numbers.tolist():
        picture[ids == number_] = _id_colour(number_)
    names = tuple((_id_colour(n), id_table[n].removeprefix("object/")) for n, _ in order[:_LISTED])
    text = f"object ids: {len(numbers)} of {len(id_table)} in view"
    if len(names) < len(numbers):
        text += f"; movers and the largest, {len(names)}:"
    return _Panel(picture, text, swatches=names)


def _id_colour(number_: int) -> Colour:
    # The golden ratio spreads the hues of neighbouring ids.
    red, green, blue = hsv_to_rgb(
        number_ * 0.618034 % 1, 0.35 + 0.5 * (number_ % 2), 0.95 - 0.2 * (number_ % 3)
    )
    return round(255 * red), round(255 * green), round(255 * blue)


def _peak_px(channels: Channels, time_direction: str) -> float:
    visible = channels[f"occluded.{time_direction}"] == 0
    length = np.hypot(channels[f"flow.{time_direction}.row"], channels[f"flow.{time_direction}.col"])[visible]
    return float(length.max()) if length.size else 0.0


def _flow(channels: Channels, time_direction: str, peak_px: float, seen: Bools) -> _Panel:
    picture = flow_colours(
        channels[f"flow.{time_direction}.row"], channels[f"flow.{time_direction}.col"], peak_px
    )
    picture[~seen] = _NOTHING
    to = "next" if time_direction == "forward" else "last"
    return _Panel(picture, f"{time_direction} flow, fine samples to the {to} slot", wheel_px=peak_px)


def _masks(channels: Channels) -> _Panel:
    picture = _shade(("#6a6a6a", "#d8d8d8"), channels["albedo"], channels["id"] > 0)
    names = ("moving", "occluded.forward", "occluded.backward")
    for name, colour in zip(names, _MASKS, strict=True):
        picture[(channels[name] > 0) & (channels["id"] > 0)] = colour
    words = ("moving", "hidden in the next slot", "hidden in the last slot")
    return _Panel(picture, "masks", swatches=tuple(zip(_MASKS, words, strict=True)))


def _noise(radiance: Floats, sigma: Floats) -> _Panel:
    # Relative to no less than a thousandth of the image's mean: relative noise is undefined at black.
    floor = max(1e-3 * float(np.abs(radiance).mean()), 1e-30)
    relative = sigma / np.maximum(np.abs(radiance), floor)
    ticks = ("0", *(f"{_NOISIEST * i / 4:.0%}" for i in (1, 2, 3)), f"{_NOISIEST:.0%} or more")
    text = f"noise of the radiance, share of it; median {float(np.median(relative)):.1%}"
    return _Panel(ramp(_NOISE, np.clip(relative / _NOISIEST, 0, 1)), text, _NOISE, ticks)


def _shade(colours: tuple[str, ...], position: Floats | Doubles, seen: Bools) -> Bytes:
    picture = ramp(colours, position)
    picture[~seen] = _NOTHING
    return picture
