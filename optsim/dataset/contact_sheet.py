"""A row of images for each sequence: truth, its passes, a coded frame and its reconstruction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.core.files import atomic, write_png8
from optsim.core.quantities import Bytes, Doubles
from optsim.core.units import REC709_Y
from optsim.dataset.reading import Array, Sample
from optsim.report.pictures import tinted

_WIDTH, _HEIGHT, _GAP, _LABEL = 240, 180, 6, 20
_PAPER = 250


def write_contact_sheet(path: Path, samples: Sequence[Sample]) -> None:
    """Draw one row a sample; brightness is the logarithm of radiance over the sample's range."""
    from PIL import Image, ImageDraw

    rows = [_row(sample) for sample in samples]
    wide = max(map(len, rows))
    sheet = Image.new(
        "RGB",
        (wide * (_WIDTH + _GAP) + _GAP, len(rows) * (_HEIGHT + _LABEL + _GAP) + _GAP),
        (_PAPER, _PAPER, _PAPER),
    )
    pen = ImageDraw.Draw(sheet)
    for number, (sample, row) in enumerate(zip(samples, rows, strict=True)):
        top = _GAP + number * (_HEIGHT + _LABEL + _GAP)
        for place, (text, picture) in enumerate(row):
            left = _GAP + place * (_WIDTH + _GAP)
            label = f"{sample.about['name']}: {text}" if place == 0 else text
            pen.text((left, top + 3), label, fill=(30, 30, 30))
            image = Image.fromarray(picture)
            image.thumbnail((_WIDTH, _HEIGHT), Image.Resampling.BOX)
            if image.width < _WIDTH and image.height < _HEIGHT:
                factor = min(_WIDTH / image.width, _HEIGHT / image.height)
                image = image.resize(
                    (round(image.width * factor), round(image.height * factor)), Image.Resampling.NEAREST
                )
            sheet.paste(image, (left, top + _LABEL))
    write_png8(path, np.asarray(sheet))


def _row(sample: Sample) -> list[tuple[str, Bytes]]:
    middle = sample.n_slots // 2
    radiance = sample.slot("radiance", middle)
    low, high = np.percentile(radiance, (1, 99.8))
    ends = float(max(low, high * 1e-4)), float(high)
    shown = _log(radiance, *ends)
    if "colour" in sample:
        light = np.moveaxis(sample.slot("colour", middle), 0, -1)
        shown = tinted(light, _log(light @ np.array(REC709_Y), *ends)[..., 0])
    row = [
        ("radiance", shown),
        ("depth, m", _log(1 / np.where((z := sample.slot("depth", middle)) > 0, z, np.inf), *_range(z))),
        ("object ids", _of_ids(sample.slot("id", middle))),
        ("flow", _of_flow(sample.slot("flow_forward", middle))),
    ]
    schemes = [name.partition("/")[2] for name in sample if name.startswith("frames/")]
    for scheme in schemes[:2]:
        frame = sample[f"frames/{scheme}"][0].astype(np.float64)
        row.append((f"{scheme}: coded frame", _grey(frame / max(frame.max(), 1))))
        if f"reconstructions/{scheme}" in sample:
            video = sample[f"reconstructions/{scheme}"][0]
            row.append((f"{scheme}: one of {len(video)} decoded slots", _log(video[len(video) // 2], *ends)))
    return row


def _range(depth: Array) -> tuple[float, float]:
    seen = depth[depth > 0]
    return (1 / float(seen.max()), 1 / float(seen.min())) if seen.size else (0.1, 1.0)


def _grey(share: Array) -> Bytes:
    grey = np.rint(255 * np.clip(share, 0, 1) ** (1 / 2.2)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def _log(values: Array, low: float, high: float) -> Bytes:
    """Grey by the logarithm, from low (black) to high (white)."""
    share = np.log(np.maximum(values.astype(np.float64), low) / low) / max(np.log(high / low), 1e-9)
    grey = np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def _of_ids(ids: Array) -> Bytes:
    """Colours that differ between consecutive ids; none is white."""
    hue = ids.astype(np.float64) * 0.61803398875 % 1
    colours = _hsv(hue, np.full(hue.shape, 0.55), np.full(hue.shape, 0.85))
    colours[ids == 0] = 255
    return colours


def _of_flow(flow: Array) -> Bytes:
    """Hue is the direction, saturation the speed over the fastest."""
    speed = np.hypot(flow[..., 0], flow[..., 1]).astype(np.float64)
    hue = (np.arctan2(flow[..., 0], flow[..., 1]) / (2 * np.pi)) % 1
    return _hsv(hue.astype(np.float64), speed / max(float(speed.max()), 1e-6), np.ones(speed.shape))


def _hsv(hue: Array, saturation: Array, value: Array) -> Bytes:
    from skimage import color

    stacked = np.stack([hue, saturation, value], axis=-1)
    colours = cast("Doubles", cast("Any", color).hsv2rgb(stacked))
    return np.rint(255 * colours).astype(np.uint8)


def write_histograms(path: Path, statistics: Mapping[str, Any]) -> None:
    """Draw the share of pixels by stops below the brightest, and by speed of what moves, of each split."""
    # Imported here: it is slow to import.
    from matplotlib.figure import Figure

    figure = cast("Any", Figure(figsize=(9, 3), layout="constrained"))
    filled = {split: each for split, each in statistics.items() if each["samples"]}
    for axes, key, label in zip(
        figure.subplots(1, 2),
        ("stops", "speeds_px"),
        ("stops below the brightest", "fine samples a slot"),
        strict=True,
    ):
        for number, (split, each) in enumerate(filled.items()):
            # What stands still would hide all else.
            shares = dict(list(each[key].items())[1 if key == "speeds_px" else 0 :])
            places = np.arange(len(shares)) + (number + 0.5) / len(filled) - 0.5
            axes.bar(places, [100 * share for share in shares.values()], 0.9 / len(filled), label=split)
            axes.set_xticks(range(len(shares)), shares, fontsize=8)
        axes.set(xlabel=label, ylabel="% of pixels")
        axes.legend()
    with atomic(path) as part:
        figure.savefig(part, dpi=100)
