"""The coded frames that a report shows: light of truth and methods for its viewer, and captured frames."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.files import write_png8, write_text
from optsim.core.quantities import Bytes, Words
from optsim.report import light_code
from optsim.report import pictures as draw
from optsim.report.schema import Picture, Section, Viewer, ViewerFrame
from optsim.report.words import number

MAX_BYTES = 12_000_000
"""Largest sum of the viewer's files: a page stays below 15 MB."""
_STEPS = (light_code.STEPS_PER_STOP, 128, 64, 32, 16)
LIMIT_STOPS = 2.0
_WIDEST_PX = 800
_MIDDLE_GREY = 0.18


@dataclass(frozen=True, eq=False)
class ViewedFrame:
    """Result of one method in a displayed coded frame.

    Parameters
    ----------
    light : ndarray of shape (slot, v, u), uint16
        Reconstructed luminance, from :func:`optsim.report.light_code.encode`.
    marks : ndarray of shape (v, u), uint8
        From :func:`optsim.report.light_code.marks_of`.
    levels : ndarray of shape (slot, v, u), uint8
        The code.
    dn : ndarray of shape (y, x), uint16
        The captured frame.
    """

    light: Words
    marks: Bytes
    levels: Bytes
    dn: Words


@dataclass(frozen=True, eq=False)
class Moment:
    """A displayed coded frame.

    Parameters
    ----------
    index : int
        Coded frame.
    why : str
        Reason to show it, for example ``"last"``.
    light : ndarray of shape (slot, v, u), uint16
        True luminance, encoded.
    marks : ndarray of shape (v, u), uint8
        All valid; moving pixels by the oracle.
    shots : Mapping
        Method name -> Shot.
    """

    index: int
    why: str
    light: Words
    marks: Bytes
    shots: Mapping[str, ViewedFrame]


def write_viewer(
    folder: Path, moments: Sequence[Moment], *, e_cd_m2: float, white_cd_m2: float, slot_s: float
) -> Viewer:
    """Write the files of the viewer below ``folder/assets``.

    Where they would exceed :data:`MAX_BYTES`, the steps of the light get coarser, down to 1/16 stop. Where
    that is not enough, the first moment alone is shown.

    Parameters
    ----------
    folder : Path
        Run folder.
    moments : sequence of Moment
        At least one; the most important first.
    e_cd_m2 : float
        Offset of errors in stops, that of the scored log error.
    white_cd_m2 : float
        Declared white of the scene.
    slot_s : float
        Duration of a slot, s.
    """
    floor = light_code.floor_of(e_cd_m2)
    packed, steps, shown = _fitting(moments)
    frames: list[ViewerFrame] = []
    for moment in shown:
        files = {name: _file(moment.index, name) for name in ("", *moment.shots)}
        for name, file in files.items():
            text = packed[moment.index, name]
            write_text(folder / file, f'optsimLight("{file}","{text}");\n')
        truth = files.pop("")
        frames.append(ViewerFrame(index=moment.index, why=moment.why, truth=truth, methods=files))
    slots, rows, cols = shown[0].light.shape
    start = start_white(shown[0], floor)
    return Viewer(
        rows=rows,
        cols=cols,
        slots=slots,
        slot_s=slot_s,
        steps_per_stop=steps,
        floor_cd_m2=floor,
        largest_error=light_code.largest_error(steps),
        e_cd_m2=e_cd_m2,
        white_cd_m2=white_cd_m2,
        start_white_cd_m2=start,
        frames=frames,
    )


def start_white(moment: Moment, floor_cd_m2: float) -> float:
    """Luminance displayed as white at first: the median of the truth's middle slot becomes middle grey."""
    light = light_code.decode(moment.light[len(moment.light) // 2], floor_cd_m2)
    return max(float(np.median(light)) / _MIDDLE_GREY, float(light.max()) * 1e-6, floor_cd_m2)


def still_pictures(folder: Path, moment: Moment, *, e_cd_m2: float) -> list[Picture]:
    """Write the middle slot of truth and methods, and the error of each method: for lists and comparisons.

    Parameters
    ----------
    folder : Path
        Run folder.
    moment : Moment
        The coded frame.
    e_cd_m2 : float
        Offset of errors in stops.
    """
    slot, floor = len(moment.light) // 2, light_code.floor_of(e_cd_m2)
    white = start_white(moment, floor)
    truth, *others = (
        light_code.decode(light[slot], floor).astype(np.float32)
        for light in (moment.light, *(shot.light for shot in moment.shots.values()))
    )
    when = f"Coded frame {moment.index}, slot {slot}"
    views = {"truth": truth, **dict(zip(moment.shots, others, strict=True))}
    found = [
        _save(
            folder,
            f"still_{name}",
            draw.exposed(view, white),
            section="compare",
            group="full frame",
            label=name,
            caption=f"{when}; {number(white)} cd/m² is white.",
        )
        for name, view in views.items()
    ]
    for name, shot in moment.shots.items():
        valid = (shot.marks & 1) > 0
        error = draw.error_picture(views[name], truth, valid, e_cd_m2=e_cd_m2, limit_stops=LIMIT_STOPS)
        about = f"{when}; error from -{LIMIT_STOPS:g} stops, blue, to +{LIMIT_STOPS:g}, red."
        found.append(
            _save(folder, f"error_{name}", error, section="errors", group="error", label=name, caption=about)
        )
    return found


def captured_pictures(folder: Path, moment: Moment, saturation_dn: float) -> list[Picture]:
    """Write the captured frame of each method; saturated pixels are in orange.

    Large frames are shown by means over squares of CCD pixels.
    """
    found: list[Picture] = []
    for name, shot in moment.shots.items():
        by = math.ceil(shot.dn.shape[1] / _WIDEST_PX)
        means = f", means of {by} x {by} pixels" if by > 1 else ""
        picture = _save(
            folder,
            f"captured_{name}",
            draw.captured_picture(draw.binned(shot.dn, by), saturation_dn),
            section="capture",
            group=name,
            label=name,
            caption=f"Raw CCD frame {moment.index}, gamma 1/2.2{means}.",
            legend=draw.captured_legend(),
        )
        found.append(picture)
    return found


def _file(index: int, name: str) -> str:
    """Script of a method, or of the truth, "", below the run folder."""
    return f"assets/view_{index:06d}_{name}.js" if name else f"assets/view_{index:06d}.js"


def _fitting(moments: Sequence[Moment]) -> tuple[dict[tuple[int, str], str], int, Sequence[Moment]]:
    """Pack as many moments in as fine steps as fit; text by frame and method, where "" is the truth."""
    packed: dict[tuple[int, str], str] = {}
    for shown in dict.fromkeys((tuple(moments), tuple(moments[:1]))):
        for steps in _STEPS:
            packed = {
                (moment.index, name): light_code.pack(light_code.coarser(light, steps), marks, levels)
                for moment in shown
                for name, light, marks, levels in [
                    ("", moment.light, moment.marks, None),
                    *((name, s.light, s.marks, s.levels) for name, s in moment.shots.items()),
                ]
            }
            if sum(map(len, packed.values())) <= MAX_BYTES:
                return packed, steps, shown
    return packed, _STEPS[-1], moments[:1]


def _save(folder: Path, name: str, image: Bytes, section: Section, **about: Any) -> Picture:
    """Write one picture as PNG."""
    file = f"assets/{name}.png"
    write_png8(folder / file, image)
    return Picture(file=file, section=section, width=image.shape[1], height=image.shape[0], **about)
