"""Images of a bench, setting by setting: what the panel showed, in which light, and the raw frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from optsim.calibration.record import JsonTable
from optsim.core.files import write_png16, write_tiff16
from optsim.core.quantities import Bytes, Words


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


Group = Flat | Patches | Step


WRITERS = {"png": write_png16, "tiff": write_tiff16}
"""Formats of images: their suffix, and what writes them."""


def write_images(folder: Path, stem: str, dn: Words, suffix: str = "png") -> list[str]:
    """Write frames as 16-bit images of a format in :data:`WRITERS`, and return the names of their files."""
    names = [f"{stem}-{i:02d}.{suffix}" for i in range(len(dn))]
    for name, image in zip(names, dn, strict=True):
        WRITERS[suffix](folder / name, image)
    return names


def write_group(folder: Path, stem: str, group: Group, suffix: str = "png") -> dict[str, Any]:
    """Write the images of a group, and return its table of the manifest."""
    table: dict[str, Any] = {key: value for key, value in vars(group).items() if key != "dn"}
    return {**table, "files": write_images(folder, stem, group.dn, suffix)}


def read_flat(table: JsonTable) -> Flat:
    """Read a flat and its images."""
    table.only(("level", "irradiance_w_m2", "files"))
    return Flat(table.level("level"), table.positive("irradiance_w_m2"), table.images("files"))


def read_patches(table: JsonTable) -> Patches:
    """Read patches and their images."""
    table.only(("rows", "cols", "size", "irradiance_w_m2", "files"))
    rows, cols = table.integers("rows"), table.integers("cols")
    size, irradiance_w_m2 = int(table.positive("size")), table.positive("irradiance_w_m2")
    return Patches(rows, cols, size, irradiance_w_m2, table.images("files"))


def read_step(table: JsonTable) -> Step:
    """Read a step and its images."""
    table.only(("before", "after", "delay_s", "flash_s", "files"))
    before, after = table.level("before"), table.level("after")
    return Step(before, after, table.number("delay_s"), table.positive("flash_s"), table.images("files"))
