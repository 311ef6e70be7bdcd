"""Images of a decoded measurement: some slots in one image, all of them in a film, beside the truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from optsim.core.files import atomic, write_png8
from optsim.core.quantities import Bytes, Floats, Reconstruction
from optsim.experiment.measurement.coded import Measurement
from optsim.report.pictures import enlarge

_SHOWN = 8  # slots in the picture
_FILM_MS = 80
_GAP_PX = 4
_WIDTH_PX = 160  # of a picture, at least
_HEAD_PX = 20
_DEEP = 20.0  # brightest over median from which pictures are logarithmic
_GAMMA = 1 / 2.2  # of screens


def draw_slots(path: Path, measurement: Measurement, video: Reconstruction) -> None:
    """Draw the first coded image and some of its slots; below them the truth, where it is known."""
    like, factor = _shown(measurement, video), _factor(measurement)
    coded = enlarge(_coded(measurement)[0], factor)
    slots = np.unique(np.linspace(0, len(like) - 1, _SHOWN).astype(int)).tolist()
    stacks = [video.irradiance_w_m2, *measurement.truth[:1]]
    rows = [[coded, *(enlarge(_toned(light[slot], like), factor) for slot in slots)] for light in stacks]
    if measurement.truth:
        rows[1][0] = _labelled(np.full_like(coded, 255), ["truth"])
    heads = ["coded image", *(f"slot {slot}" for slot in slots)]
    head = np.full((_HEAD_PX, len(heads) * (coded.shape[1] + _GAP_PX)), 255, np.uint8)
    write_png8(path, np.vstack([_labelled(head, heads), *map(_side_by_side, rows)]))


def draw_film(path: Path, measurement: Measurement, decoded: Sequence[Reconstruction]) -> None:
    """Draw each slot beside its coded image and the truth, one after the other, as an animated GIF."""
    like, factor, coded = _shown(measurement, decoded[0]), _factor(measurement), _coded(measurement)
    stacks = [
        [video.irradiance_w_m2 for video in decoded],
        *([measurement.truth] if measurement.truth else []),
    ]
    film = [
        _side_by_side(
            [enlarge(each, factor) for each in (coded[k], *(_toned(s[k][slot], like) for s in stacks))]
        )
        for k in range(len(decoded))
        for slot in range(len(like))
    ]
    first, *others = [Image.fromarray(each) for each in film]
    with atomic(path) as temporary:
        first.save(temporary, format="GIF", save_all=True, append_images=others, duration=_FILM_MS, loop=0)


def _shown(measurement: Measurement, video: Reconstruction) -> Floats:
    """Light that sets the tones of all images."""
    return measurement.truth[0] if measurement.truth else video.irradiance_w_m2


def _factor(measurement: Measurement) -> int:
    return -(-_WIDTH_PX // measurement.calibration.shape[1])


def _coded(measurement: Measurement) -> list[Bytes]:
    signals = [measurement.calibration.observe(frame).signal for frame in measurement.frames]
    return [_toned(signal, signals[0]) for signal in signals]


def _toned(light: Floats, like: Floats) -> Bytes:
    """Grey tones of light, up to the brightest of ``like``; logarithmic if its median would be black."""
    middle, white = (max(float(q), 1e-30) for q in np.percentile(like, (50, 99.9)))
    relative = np.clip(light / white, 0, 1)
    if white > _DEEP * middle:
        relative = np.log1p(relative * white / middle) / np.log1p(white / middle)
    else:
        relative = relative**_GAMMA
    return np.rint(255 * relative).astype(np.uint8)


def _labelled(image: Bytes, texts: Sequence[str]) -> Bytes:
    """Write texts into as many columns of an image."""
    picture = Image.fromarray(image)
    pen, width = ImageDraw.Draw(picture), image.shape[1] / len(texts)
    for place, text in enumerate(texts):
        pen.text((place * width + 3, 3), text, fill=0, font=ImageFont.load_default(13))
    return np.asarray(picture)


def _side_by_side(pictures: Sequence[Bytes]) -> Bytes:
    gap = np.full((len(pictures[0]), _GAP_PX), 255, np.uint8)
    row = np.hstack([part for picture in pictures for part in (picture, gap)])
    return np.pad(row, ((0, _GAP_PX), (0, 0)), constant_values=255)
