"""The contact sheet of a run: every still image of the report, made from one coded frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.core.errors import ValueCheckError
from optsim.core.files import write_png8
from optsim.core.quantities import Bools, Bytes, Doubles, Floats, Words
from optsim.report import pictures as draw
from optsim.report.schema import Picture, Section

LIMIT_STOPS = 2.0
_SHOWN_PX = 260


@dataclass(frozen=True)
class Crop:
    """A rectangle of panel pixels to enlarge."""

    name: str
    row: int
    col: int
    height: int
    width: int

    def of(self, image: Bytes) -> Bytes:
        """Cut it out of an image (v, u) or (v, u, 3)."""
        return image[self.row : self.row + self.height, self.col : self.col + self.width]


@dataclass(frozen=True, eq=False)
class Shot:
    """Result of one method in the displayed coded frame.

    Parameters
    ----------
    estimate_cd_m2 : ndarray of shape (slot, v, u), float32
        Reconstructed luminance, cd/m^2.
    valid, moving : ndarray of shape (v, u), bool
        Pixels with a valid estimate; pixels with a temporal code.
    dn : ndarray of shape (y, x), uint16
        The captured frame.
    levels : ndarray of shape (slot, v, u), uint8
        The code.
    """

    estimate_cd_m2: Floats
    valid: Bools
    moving: Bools
    dn: Words
    levels: Bytes


@dataclass(frozen=True, eq=False)
class Moment:
    """The displayed coded frame: truth, oracle mask and all methods.

    Parameters
    ----------
    index, slot : int
        Coded frame, and its slot whose estimate is displayed.
    reference_cd_m2 : ndarray of shape (slot, v, u), float32
        True luminance, cd/m^2.
    oracle : ndarray of shape (v, u), bool
        Moving pixels.
    saturation_dn : float
        Level from which captured frames count as saturated, DN.
    shots : Mapping
        Method name -> Shot.
    """

    index: int
    slot: int
    reference_cd_m2: Floats
    oracle: Bools
    saturation_dn: float
    shots: Mapping[str, Shot]


def choose_crops(
    reference_cd_m2: Floats, oracle: Bools, outside: Bools | None, *, size: tuple[int, int]
) -> tuple[Crop, ...]:
    """Choose crops from the truth alone: most motion, window, and most texture in the interior.

    Parameters
    ----------
    reference_cd_m2 : ndarray of shape (v, u), float32
        True luminance of the displayed instant.
    oracle : ndarray of shape (v, u), bool
        Moving pixels.
    outside : ndarray of shape (v, u), bool, or None
        Pixels that show the bright outside; None uses the brightest place.
    size : (int, int)
        Height and width of the crops, panel pixels.
    """
    if any(s > n for s, n in zip(size, reference_cd_m2.shape, strict=True)):
        raise ValueCheckError(f"crops of {size} panel pixels do not fit a panel of {reference_cd_m2.shape}")
    stops = np.log2(np.maximum(reference_cd_m2, 0) + 1e-3)
    gradient = np.hypot(*np.gradient(stops))
    still = (~oracle).astype(np.float32)
    window = stops if outside is None else outside * (1 + gradient)
    interior = gradient * (still if outside is None else still * ~outside)
    # A strong edge (the window's frame) is no texture: count small contrasts, of at most a stop.
    places = (
        ("what moves", oracle.astype(np.float32)),
        ("the window", window * still),
        ("interior texture", np.minimum(interior, 1.0)),
    )
    return tuple(_best(name, cast("Floats", weight), size) for name, weight in places if weight.any())


def _best(name: str, weight: Floats, size: tuple[int, int]) -> Crop:
    """Crop of the largest total weight."""
    total = _totals(weight, size)
    row, col = divmod(int(total.argmax()), total.shape[1])
    return Crop(name, row, col, *size)


def _totals(weight: Floats, size: tuple[int, int]) -> Doubles:
    """Sum over each crop, by its corner, from a table of cumulative sums."""
    height, width = size
    sums = np.pad(weight.astype(np.float64), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    return sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]


def half_moving(moment: Moment, size: tuple[int, int]) -> Crop:
    """Crop in which a motion-adaptive camera marks about half of the pixels as moving: it has both codes."""
    masks = [shot.moving for shot in moment.shots.values()]
    mask = next((m for m in masks if m.any() and not m.all()), moment.oracle)
    off = np.abs(_totals(mask.astype(np.float32), size) - size[0] * size[1] / 2)
    row, col = divmod(int(off.argmin()), off.shape[1])
    return Crop("code", row, col, *size)


def render_pictures(
    folder: Path, moment: Moment, tone: draw.ToneCurve, crops: Sequence[Crop], *, e_cd_m2: float
) -> list[Picture]:
    """Write every still image below ``folder/assets`` and describe it for results.json.

    Parameters
    ----------
    folder : Path
        Run folder.
    moment : Moment
        The coded frame to display.
    tone : ToneCurve
        One curve for all images of light.
    crops : sequence of Crop
        From :func:`choose_crops`; the image of the code is of the first one's size.
    e_cd_m2 : float
        Offset of the error maps, that of the scored log error.
    """
    when = f"Coded frame {moment.index}, slot {moment.slot}"
    at = f"{when}; {tone.caption}."
    truth = moment.reference_cd_m2[moment.slot]
    views = {"truth": truth, **{n: s.estimate_cd_m2[moment.slot] for n, s in moment.shots.items()}}
    toned = {name: tone.apply(view) for name, view in views.items()}
    found = [
        _save(folder, f"full_{name}", image, "compare", caption=at, group="full frame", label=name)
        for name, image in toned.items()
    ]
    for number, crop in enumerate(crops):
        factor = max(1, round(_SHOWN_PX / crop.width))
        place = f"{crop.width} × {crop.height} panel pixels at row {crop.row}, column {crop.col}. {at}"
        for name, image in toned.items():
            shown = draw.enlarge(crop.of(image), factor)
            about = {"caption": place, "group": crop.name, "label": name}
            found.append(_save(folder, f"crop{number}_{name}", shown, "crops", **about))
    of_code = half_moving(moment, (crops[0].height, crops[0].width) if crops else moment.oracle.shape)
    caption = f"Signed error, log2((estimate + e) / (truth + e)), e = {e_cd_m2:g} cd/m². {when}."
    about = {"caption": caption, "group": "error", "scale": draw.error_scale(LIMIT_STOPS)}
    for name, shot in moment.shots.items():
        found += _capture(folder, moment, name, shot, toned["truth"], of_code)
        error = draw.error_picture(views[name], truth, shot.valid, e_cd_m2=e_cd_m2, limit_stops=LIMIT_STOPS)
        found.append(_save(folder, f"error_{name}", error, "errors", label=name, **about))
    return found


def _capture(folder: Path, moment: Moment, name: str, shot: Shot, truth: Bytes, cut: Crop) -> list[Picture]:
    """Draw captured frame, code and mask of one method."""
    factor = max(1, round(_SHOWN_PX / cut.width))
    place = f"{cut.width} × {cut.height} panel pixels at row {cut.row}, column {cut.col}"
    captured = draw.captured_picture(shot.dn, moment.saturation_dn)
    code = draw.enlarge(cut.of(shot.levels[moment.slot]), factor)
    starts = draw.enlarge(cut.of(draw.start_picture(shot.levels)), factor)
    save = partial(_save, folder, section="capture", group=name)
    found = [
        save(
            f"captured_{name}",
            captured,
            label="captured frame",
            caption=f"Raw CCD frame {moment.index}, gamma 1/2.2.",
            legend=draw.captured_legend(),
        ),
        save(
            f"code_{name}",
            code,
            label="code, one slot",
            caption=f"Drive level in slot {moment.slot}; {place}.",
        ),
        save(
            f"starts_{name}",
            starts,
            label="code, exposure start",
            caption=f"When each pixel first opens; grey chequer: never. {place}.",
            scale=draw.start_scale(len(shot.levels)),
        ),
    ]
    if shot.moving.any() and not shot.moving.all():
        caption = f"Motion mask of coded frame {moment.index} against the oracle from the truth."
        mask = draw.mask_picture(shot.moving, moment.oracle, truth)
        found.append(
            save(f"mask_{name}", mask, label="motion mask", caption=caption, legend=draw.mask_legend())
        )
    return found


def _save(folder: Path, name: str, image: Bytes, section: Section, **about: Any) -> Picture:
    """Write one image as PNG."""
    file = f"assets/{name}.png"
    write_png8(folder / file, image)
    return Picture(file=file, section=section, width=image.shape[1], height=image.shape[0], **about)
