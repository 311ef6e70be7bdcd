"""Bench files: the raw images of a calibration bench and the settings they were taken with.

A folder of 16-bit greyscale PNG files with a ``bench.json`` is the whole interface to a real bench. This
module defines it. ``bench.json`` holds the fields of :class:`Bench`. A field of images lists their file
names, relative to the folder. All images are of the whole CCD, not scaled.

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

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, cast

import numpy as np

from optsim.calibration.record import RECORD, Table
from optsim.core.errors import BenchError, StorageError
from optsim.core.files import read_json, write_json, write_png16
from optsim.core.folder_claims import claimed
from optsim.core.quantities import Bytes, Words, checked

_FORMAT = "optsim bench 3"


@dataclass(frozen=True, eq=False)
class Flat:
    """Frames of the uniform source with the whole panel held at one level.

    Parameters
    ----------
    level : int
        Drive level, 0..255.
    irradiance_w_m2 : float
        Modulator irradiance on axis (before the splitter), W m^-2: from the source's calibrated radiance.
    dn : ndarray of shape (frame, y, x), uint16
        Raw images.
    """

    level: int
    irradiance_w_m2: float
    dn: Words


@dataclass(frozen=True, eq=False)
class Patches:
    """Frames of the uniform source with a lattice of bright square patches held on black.

    Parameters
    ----------
    rows, cols : tuple of int
        First panel row, column of the patches; the lattice is their product.
    size : int
        Edge of a patch, panel pixels.
    irradiance_w_m2 : float
        As in :class:`Flat`.
    dn : ndarray of shape (frame, y, x), uint16
        Raw images.
    """

    rows: tuple[int, ...]
    cols: tuple[int, ...]
    size: int
    irradiance_w_m2: float
    dn: Words

    def levels(self, panel_shape: tuple[int, int]) -> Bytes:
        """Drive levels of the pattern: array of shape (v, u), uint8."""
        levels = np.zeros(panel_shape, np.uint8)
        for row in self.rows:
            for col in self.cols:
                levels[row : row + self.size, col : col + self.size] = 255
        return levels


@dataclass(frozen=True, eq=False)
class Step:
    """Frames lit by one flash each, around a change of the whole panel from one held level to another.

    With both levels the same there is no change; the delay then counts from the frame's first field sync.

    Parameters
    ----------
    before, after : int
        Drive levels.
    delay_s : float
        Start of the flash after the field sync at which the level changes, s; may be negative.
    flash_s : float
        Duration of the flash, s; the same flash energy in all steps.
    dn : ndarray of shape (frame, y, x), uint16
        Raw images.
    """

    before: int
    after: int
    delay_s: float
    flash_s: float
    dn: Words


_Group = Flat | Patches | Step


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
    """

    FILES: ClassVar[tuple[str, ...]] = (
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

    def __post_init__(self) -> None:
        ccd = self.darks.shape[1:]
        for name, dn in (("darks", self.darks), *((n, g.dn) for n, g in self._named())):
            checked(f"bench {name}", dn, axes=("frame", "y", "x"), dtype=np.uint16, unit="DN")
            if dn.shape[1:] != ccd:
                raise BenchError(
                    f"bench {name}: got images of {dn.shape[1:]} pixels, expected {ccd} as the darks have; "
                    "take all images with the same full CCD frame"
                )
        if not 0 < self.white_rad < 2 * math.pi:
            raise BenchError(
                f"bench white_rad: got {self.white_rad:g}, expected more than 0 and less than 2 pi"
            )
        for name, least in (("darks", 2), ("off", 1), ("saturated", 2)):
            group = self.darks if name == "darks" else cast("Flat", getattr(self, name)).dn
            _enough(name, len(group), least, "frames")
        _enough("flats", len(self.flats), 1, "irradiances")
        for flat in self.flats:
            _enough("flats", len(flat.dn), 2, "frames at each irradiance (photon transfer needs pairs)")
        _enough("anchors", len(self.anchors), 3, "patches")
        _enough("dots", len(self.dots), 1, "lattices")

    def _named(self) -> list[tuple[str, _Group]]:
        groups: list[tuple[str, _Group]] = []
        for name in self.FILES:
            field = cast("_Group | tuple[_Group, ...]", getattr(self, name))
            groups += [(name, group) for group in (field if isinstance(field, tuple) else (field,))]
        return groups

    def write(self, folder: Path) -> None:
        """Write the images and ``bench.json`` into a folder, which is made if need be.

        Raises
        ------
        StorageError
            When the disk refuses, or another process writes into the folder.
        """
        with claimed(folder):
            record: dict[str, Any] = {
                "format": _FORMAT,
                "slot_s": self.slot_s,
                "slots_per_frame": self.slots_per_frame,
                "coded_slots": self.coded_slots,
                "panel_shape": list(self.panel_shape),
                "white_rad": self.white_rad,
                "darks": _write_images(folder, "dark", self.darks),
            }
            for name in self.FILES:
                field = cast("_Group | tuple[_Group, ...]", getattr(self, name))
                if isinstance(field, tuple):
                    record[name] = [_as_table(folder, f"{name}-{i:02d}", g) for i, g in enumerate(field)]
                else:
                    record[name] = _as_table(folder, name, field)
            write_json(folder / RECORD, record)

    @classmethod
    def read(cls, folder: Path) -> Bench:
        """Read a bench folder.

        Raises
        ------
        BenchError
            When a file or key is missing or of the wrong kind; it names the file and the cure.
        """
        path = folder / RECORD
        try:
            record = cast("object", read_json(path))
        except StorageError as error:
            raise BenchError(f"{error}; a bench folder needs {RECORD} beside its images") from None
        if not isinstance(record, dict) or cast("dict[str, Any]", record).get("format") != _FORMAT:
            raise BenchError(f'{path}: expected a JSON object with "format": {json.dumps(_FORMAT)}')
        table = Table(path, "", cast("dict[str, Any]", record))
        return cls(
            slot_s=table.number("slot_s"),
            slots_per_frame=int(table.number("slots_per_frame")),
            coded_slots=int(table.number("coded_slots")),
            panel_shape=cast("tuple[int, int]", table.integers("panel_shape", length=2)),
            darks=table.images("darks"),
            flats=tuple(_flat(t) for t in table.tables("flats")),
            off=_flat(table.table("off")),
            greys=tuple(_flat(t) for t in table.tables("greys")),
            saturated=_flat(table.table("saturated")),
            anchors=tuple(_patches(t) for t in table.tables("anchors")),
            dots=tuple(_patches(t) for t in table.tables("dots")),
            glare=tuple(_patches(t) for t in table.tables("glare")),
            steps=tuple(_step(t) for t in table.tables("steps")),
            fields=tuple(_step(t) for t in table.tables("fields")),
            white_rad=table.number("white_rad"),
        )


def _enough(name: str, got: int, least: int, of: str) -> None:
    if got < least:
        raise BenchError(f"bench {name}: got {got}, expected at least {least} {of}")


def _write_images(folder: Path, stem: str, dn: Words) -> list[str]:
    names = [f"{stem}-{i:02d}.png" for i in range(len(dn))]
    for name, image in zip(names, dn, strict=True):
        write_png16(folder / name, image)
    return names


def _as_table(folder: Path, stem: str, group: _Group) -> dict[str, Any]:
    table: dict[str, Any] = {key: value for key, value in vars(group).items() if key != "dn"}
    return {**table, "files": _write_images(folder, stem, group.dn)}


def _flat(table: Table) -> Flat:
    return Flat(int(table.number("level")), table.number("irradiance_w_m2"), table.images("files"))


def _patches(table: Table) -> Patches:
    rows, cols = table.integers("rows"), table.integers("cols")
    return Patches(
        rows, cols, int(table.number("size")), table.number("irradiance_w_m2"), table.images("files")
    )


def _step(table: Table) -> Step:
    before, after = int(table.number("before")), int(table.number("after"))
    return Step(before, after, table.number("delay_s"), table.number("flash_s"), table.images("files"))
