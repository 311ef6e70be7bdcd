"""Bench: the raw images that a camera's calibration is made from, and the settings they were taken with.

A folder of greyscale PNG, TIFF or DNG files with a manifest, ``bench.json``, is the whole interface to a
laboratory, virtual or real. This module defines it. The manifest holds the fields of :class:`Bench`. A field
of images lists their file names, relative to the folder. All images are of the whole CCD, not scaled, and
stored as read: rows first, in DN.

Procedure, with the camera's normal timing (its period, its slots, overlapped or not):

============  ==========================================================================================
darks         lens capped; at least 2, better 16 or more
flats         uniform source, whole panel held at 255, one or more irradiances up to half of full well,
              above which interline CCDs bend; at least 2 frames each, better 8
off           the same with the whole panel held at 0; a stronger source is welcome
greys         the same, held at levels in between (may be empty: the exponent then keeps its default)
saturated     held at 255, at least 3 times the light that fills the wells; at least 2 frames
anchors       three single bright patches on black, well inside the picture and not in one line
dots          lattices of single bright pixels on black
glare         a bright patch of a fifth of the picture or so on black, more than 16 panel pixels from much of
              the rest; in two corners in turn (may be empty: stray light then counts as none)
steps         a flash of at most a fifth of a slot at a known delay after the panel changed level, for
              both directions, from half a slot before to two slots after, the change being at the second
              slot of a frame; the flash may light a part of the panel,
              but more than a quarter of its height, if the scan of the rows is to be measured
fields        a flash as long as a slot, in each of six successive slots in turn from a frame's first one on,
              with the panel held at a grey level, and again held at 255 (may be empty: all slots of a
              colour-sequential panel then count as equal)
============  ==========================================================================================

"Held" means shown for at least ten response times before the exposure, and during all of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np
from pydantic import ValidationError

from optsim.calibration.bench_images import (
    Flat,
    Group,
    Patches,
    Step,
    read_flat,
    read_patches,
    read_step,
    write_group,
    write_images,
)
from optsim.calibration.grey_curve import read_grey_curve
from optsim.calibration.orientation import DIRECTIONS, Orientation
from optsim.calibration.record import RECORD, JsonTable, read_record
from optsim.core.errors import BenchError, ConfigError
from optsim.core.files import write_json
from optsim.core.folder_claims import claimed
from optsim.core.quantities import Words, checked
from optsim.optics.panel import GreyCurve, PanelResponse

FORMAT = "optsim bench 3"
# What the numbers of the images are. A manifest that says something else is refused.
_FIXED = {"unit": "DN", "axes": "y, x", "irradiance": "W m^-2 on the modulator, on axis"}
_SAME_TIME = 1e-3  # relative: of stated exposures


@dataclass(frozen=True, eq=False)
class Bench:
    """All images and settings of a bench.

    Parameters
    ----------
    slot_s : float
        Duration of an LCoS slot, s.
    slots_per_frame, coded_slots : int
        Slots in a frame's period, and those at its start in which the shutter is open.
    panel_shape : tuple of int
        Panel pixels used (v, u).
    darks : ndarray of shape (frame, y, x), uint16
        Frames without light.
    flats, off, greys, saturated, anchors, dots, glare, steps, fields
        See the module's table.
    white_rad : float
        Retardance of level 255 in the bench's light, rad. It is pi times the data sheet's half-wave
        wavelength over the light's wavelength. Its error goes into the grey curve's exponent and the time
        constants.
    orientation : tuple of str or None
        Directions on the CCD's image in which panel rows and panel columns count up: ("down", "right") if
        upright, ("down", "left") if mirrored, ("right", "down") if transposed. None: unknown, any is taken.
    ccd_pitch_m, ccd_per_panel_px : float or None
        Pitch of the CCD, m, and the nominal CCD pixels a panel pixel: the units of misalignments.
    grey_curve : tuple of (float, float)
        Level and reflectance of the panel as measured elsewhere, instead of an exponent by ``greys``.
    about : mapping
        Whatever the laboratory notes: who, when, with which program.
    files : mapping
        Files of each set, such as "darks" or "dots[2]", for messages; empty if not read from a folder.
    """

    SETS: ClassVar[tuple[str, ...]] = (
        "flats",
        "off",
        "greys",
        "saturated",
        "anchors",
        "dots",
        "glare",
        "steps",
        "fields",
    )
    slot_s: float
    slots_per_frame: int
    coded_slots: int
    panel_shape: tuple[int, int]
    darks: Words
    flats: tuple[Flat, ...]
    off: Flat
    greys: tuple[Flat, ...]
    saturated: Flat
    anchors: tuple[Patches, ...]
    dots: tuple[Patches, ...]
    glare: tuple[Patches, ...]
    steps: tuple[Step, ...]
    fields: tuple[Step, ...] = ()
    white_rad: float = math.pi
    orientation: Orientation | None = None
    ccd_pitch_m: float | None = None
    ccd_per_panel_px: float | None = None
    grey_curve: GreyCurve = ()
    about: Mapping[str, Any] = field(default_factory=dict[str, Any])
    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])

    def __post_init__(self) -> None:
        ccd = self.darks.shape[1:]
        for name, dn in (("darks", self.darks), *((n, g.dn) for n, g in self.groups())):
            checked(self.where(name), dn, axes=("frame", "y", "x"), dtype=np.uint16, unit="DN")
            if dn.shape[1:] != ccd:
                raise BenchError(
                    f"{self.where(name)}: got images of {dn.shape[1:]} pixels, expected {ccd} as the darks "
                    "have; cure: take all images with the same full CCD frame"
                )
        for fine, key, got, expected in (
            (0 < self.white_rad < 2 * math.pi, "white_rad", self.white_rad, "more than 0, less than 2 pi"),
            (self.slot_s > 0, "slot_s", self.slot_s, "more than 0"),
            (
                1 <= self.coded_slots <= self.slots_per_frame,
                "coded_slots",
                self.coded_slots,
                f"1 to slots_per_frame, {self.slots_per_frame}",
            ),
            (min(self.panel_shape) > 0, "panel_shape", self.panel_shape, "rows and columns"),
            (0 < (self.ccd_pitch_m or 1e-6) < 1e-3, "ccd_pitch_m", self.ccd_pitch_m, "metres, below 0.001"),
        ):
            if not fine:
                raise BenchError(f"bench {key}: got {got}, expected {expected}; cure: correct {RECORD}")
        for name, least in (("darks", 2), ("off", 1), ("saturated", 2)):
            group = self.darks if name == "darks" else cast("Flat", getattr(self, name)).dn
            _enough(self.where(name), len(group), least, "frames")
        _enough("bench flats", len(self.flats), 1, "irradiances")
        for number, flat in enumerate(self.flats):
            where = self.where(f"flats[{number}]")
            _enough(where, len(flat.dn), 2, "frames at each irradiance (photon transfer needs pairs)")
        _enough("bench anchors", len(self.anchors), 3, "patches")
        _enough("bench dots", len(self.dots), 1, "lattices")
        for name, group in self.groups():
            if isinstance(group, Patches):
                _inside(self.where(name), group, self.panel_shape)

    def groups(self) -> list[tuple[str, Group]]:
        """List the images but the darks by set: names such as "off" and "dots[2]"."""
        named: list[tuple[str, Group]] = []
        for name in self.SETS:
            held = cast("Group | tuple[Group, ...]", getattr(self, name))
            if isinstance(held, tuple):
                named += [(f"{name}[{index}]", group) for index, group in enumerate(held)]
            else:
                named.append((name, held))
        return named

    def where(self, name: str, frame: int | None = None) -> str:
        """Name a set, such as "dots[2]", or a frame of it for a message, with its files if they are known."""
        files = self.files.get(name, ())
        shown = files if frame is None else files[frame : frame + 1]
        if not shown:
            return f"bench {name}" + ("" if frame is None else f", frame {frame}")
        return f"{shown[0]}{', ...' if len(shown) > 1 else ''} ({name})"

    @property
    def settings(self) -> dict[str, Any]:
        """Everything but the images, as the manifest holds it."""
        return {
            "slot_s": self.slot_s,
            "slots_per_frame": self.slots_per_frame,
            "coded_slots": self.coded_slots,
            "panel_shape": self.panel_shape,
            "white_rad": self.white_rad,
            "orientation": self.orientation,
            "ccd_pitch_m": self.ccd_pitch_m,
            "ccd_per_panel_px": self.ccd_per_panel_px,
            "grey_curve": self.grey_curve,
            "about": self.about,
        }

    def write(self, folder: Path) -> None:
        """Write the images and the manifest into a folder, which is made if need be.

        Raises
        ------
        StorageError
            When the disk refuses, or another process writes into the folder.
        """
        with claimed(folder):
            tables: dict[str, Any] = {"darks": write_images(folder, "dark", self.darks)}
            for name in self.SETS:
                held = cast("Group | tuple[Group, ...]", getattr(self, name))
                if isinstance(held, tuple):
                    tables[name] = [write_group(folder, f"{name}-{i:02d}", g) for i, g in enumerate(held)]
                else:
                    tables[name] = write_group(folder, name, held)
            write_json(folder / RECORD, manifest(self.settings, tables))

    @classmethod
    def read(cls, folder: Path) -> Bench:
        """Read a bench folder.

        Raises
        ------
        BenchError
            When a file or key is missing or of the wrong kind; it names the file and the cure.
        """
        table = read_record(folder, FORMAT)
        table.only((*_FIXED, "format", "exposure_s", *(each.name for each in fields(cls))))
        for key, value in _FIXED.items():
            table.stated(key, value)
        slot_s, coded_slots = table.positive("slot_s"), int(table.positive("coded_slots"))
        if "exposure_s" in table.items:
            exposure_s = table.positive("exposure_s")
            if abs(exposure_s / (slot_s * coded_slots) - 1) > _SAME_TIME:
                raise table.wrong("exposure_s", f"coded_slots x slot_s, {slot_s * coded_slots:g} s")
        return cls(
            slot_s=slot_s,
            slots_per_frame=int(table.positive("slots_per_frame")),
            coded_slots=coded_slots,
            panel_shape=cast("tuple[int, int]", table.integers("panel_shape", length=2)),
            darks=table.images("darks"),
            flats=tuple(read_flat(t) for t in table.tables("flats")),
            off=read_flat(table.table("off")),
            greys=tuple(read_flat(t) for t in table.tables("greys")),
            saturated=read_flat(table.table("saturated")),
            anchors=tuple(read_patches(t) for t in table.tables("anchors")),
            dots=tuple(read_patches(t) for t in table.tables("dots")),
            glare=tuple(read_patches(t) for t in table.tables("glare")),
            steps=tuple(read_step(t) for t in table.tables("steps")),
            fields=tuple(read_step(t) for t in table.tables("fields")),
            white_rad=table.positive("white_rad"),
            orientation=_orientation(table),
            **{key: table.positive(key) for key in ("ccd_pitch_m", "ccd_per_panel_px") if key in table.items},
            grey_curve=_grey_curve(table),
            about=table.table("about").items if "about" in table.items else {},
            files=_files(table, cls.SETS),
        )


def manifest(settings: Mapping[str, Any], tables: Mapping[str, Any]) -> dict[str, Any]:
    """Join what ``bench.json`` holds: :attr:`Bench.settings`, and the tables of its images by set."""
    said = {key: value for key, value in settings.items() if value is not None}
    exposure_s = settings["slot_s"] * settings["coded_slots"]
    return {"format": FORMAT, **_FIXED, **said, "exposure_s": exposure_s, **tables}


def _grey_curve(table: JsonTable) -> GreyCurve:
    said: object = table.items.get("grey_curve", ())
    try:
        found = read_grey_curve(table.path.parent / said) if isinstance(said, str) else said
        return PanelResponse.model_validate({"grey_curve": found}).grey_curve
    except ConfigError as error:
        raise BenchError(str(error)) from None
    except ValidationError as error:
        why = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise BenchError(f"{table.path}: grey_curve: {why}") from None


def _orientation(table: JsonTable) -> Orientation | None:
    if "orientation" not in table.items:
        return None
    said: object = table.items["orientation"]
    found = tuple(cast("list[object]", said)) if isinstance(said, list) else ()
    if found not in DIRECTIONS:
        raise table.wrong("orientation", f"one of {', '.join(str(list(each)) for each in DIRECTIONS)}")
    return cast("Orientation", found)


def _files(table: JsonTable, sets: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Files of each set, by its name in messages."""
    files = {"darks": table.files("darks")}
    for name in sets:
        if isinstance(table.items[name], list):
            files |= {f"{name}[{i}]": each.files("files") for i, each in enumerate(table.tables(name))}
        else:
            files[name] = table.table(name).files("files")
    return files


def _enough(where: str, got: int, least: int, of: str) -> None:
    if got < least:
        raise BenchError(f"{where}: got {got}, expected at least {least} {of}; cure: take them")


def _inside(where: str, patches: Patches, panel_shape: tuple[int, int]) -> None:
    """Refuse patches that reach beyond the panel: a pattern counted from 1, or of another panel."""
    for key, first, size in zip(("rows", "cols"), (patches.rows, patches.cols), panel_shape, strict=True):
        if min(first) < 0 or max(first) + patches.size > size:
            raise BenchError(
                f"{where}: {key}: got patches at {min(first)} to {max(first) + patches.size - 1}, expected "
                f"0 to {size - 1}, as panel_shape says; cure: count from 0, or correct panel_shape"
            )
