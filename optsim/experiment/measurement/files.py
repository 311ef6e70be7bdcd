"""Coded measurements on disk: one array file, or images that a small TOML file names.

An ``.npz`` or ``.mat`` file by itself is a measurement when it holds the arrays ``image``, ``code`` and, if
known, ``truth`` and ``moving``; the names ``meas``, ``mask`` and ``orig`` of published snapshot-video sets
work too. Arrays of numpy have time first, those of MATLAB last. Everything else stands in a TOML file, whose
keys are the fields of :class:`MeasurementFiles`; paths in it start at its folder.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from optsim.calibration import Bench, calibrate_from, read_calibration
from optsim.calibration.choice import BENCH_FILE, CALIBRATION_FILE, ReadingPx, stored_file
from optsim.core.config import Part, build, override, read_toml
from optsim.core.errors import ConfigError, ValueCheckError
from optsim.core.files import content_hash
from optsim.decoding import Decoder, Interpolation
from optsim.experiment.measurement.coded import (
    Measurement,
    Sensor,
    coded_frames,
    coded_measurement,
    moving_masks,
    stacked,
    truth_frames,
)
from optsim.footage.measured import read_pictures
from optsim.footage.recording import IMAGES, RAW_COUNTS, array_names

_Role = Literal["image", "code", "truth", "moving"]
_NAMES: dict[_Role, tuple[str, ...]] = {
    "image": ("image", "meas"),
    "code": ("code", "mask"),
    "truth": ("truth", "orig"),
    "moving": ("moving",),
}
_ARRAYS = (".npz", ".mat")
_OF_CAMERA = ("bench", "calibration")
_READ = (*IMAGES, ".json")  # what is read of a folder, of a bench too


class DecoderChoice(Part):
    """The decoder of a measurement.

    Parameters
    ----------
    decoder : decoder
        By default interpolation, which needs no training and takes any number of slots.
    """

    decoder: Decoder = Interpolation()

    @field_validator("decoder", mode="before")
    @classmethod
    def _interpolation_unless_said(cls, value: object) -> object:
        return (
            {"kind": "interpolation", **cast("dict[str, Any]", value)} if isinstance(value, dict) else value
        )


class MeasurementFiles(DecoderChoice):
    """Keys of a measurement's TOML file, beside the decoder.

    Parameters
    ----------
    image, code : str
        Coded images, and their codes: an ``.npz`` or ``.mat`` file, or a folder, pattern or file of PNG,
        TIFF, DNG or EXR images. A code has one image a slot, the same for all coded images. Or it has one EXR
        a coded image, whose channels, in the order of their names, are its slots.
    truth : str or None
        Light slot by slot, if known: in the code's format, with all slots of the first coded image, then all
        of the second.
    moving : str or None
        Masks, not zero where a union may use the video's decoder: one, or one a coded image; default
        all.
    slots : int or None
        Slots of a coded image, where the code's files hold those of all coded images one after the other.
    bench, calibration : str or None
        Calibration of a camera whose image of the code is not pixel by pixel; give one of both. ``bench``:
        the folder of a calibration bench. ``calibration``: a ``calibration.npz``, or the folder of a run or
        bench.
    reading_px : int
        With a bench: side of the readout window of a code pixel, sensor pixels, odd.
    sensor : Sensor
        The sensor; not with a bench or a calibration, which state it.
    """

    image: str
    code: str
    truth: str | None = None
    moving: str | None = None
    slots: int | None = Field(default=None, ge=1)
    bench: str | None = None
    calibration: str | None = None
    reading_px: ReadingPx = 1
    sensor: Sensor = Sensor()


def measurement_files(path: Path, assignments: list[str]) -> MeasurementFiles:
    """Read the description of a measurement: a TOML file, or one array file.

    Parameters
    ----------
    path : Path
        The file.
    assignments : list of str
        ``key=value``, with priority over the file.

    Raises
    ------
    ConfigError
        For unknown keys and wrong values.
    """
    if path.suffix.lower() in _ARRAYS:
        there = array_names(path)
        # Image and code are checked where they are read, which can name the files that exist instead.
        table: dict[str, Any] = {
            role: str(path)
            for role, names in _NAMES.items()
            if role in ("image", "code") or any(name in there for name in names)
        }
        folder = Path()
    elif path.is_dir():
        raise ConfigError(
            f"{path} is a folder, but of no finished run; expected one, a TOML file, or an .npz or .mat file "
            "with image and code"
        )
    elif path.suffix.lower() != ".toml" and path.is_file():
        raise ConfigError(
            f"{path}: got one file of {path.suffix or 'no suffix'}, expected image and code: an .npz or .mat "
            f"file of both, or a TOML file with image = '{path.name}' and code = '...'"
        )
    else:
        table, folder = read_toml(path), path.parent
    table = override(table, assignments)
    for key in (*_NAMES, *_OF_CAMERA):
        if isinstance(table.get(key), str):
            table[key] = str(folder / table[key])
    return build(MeasurementFiles, table, where=str(path))


def read_measurement(files: MeasurementFiles) -> Measurement:
    """Read a measurement's arrays.

    Raises
    ------
    ConfigError, StorageError, ValueCheckError
        When a file is missing, cannot be read, or does not fit the others.
    """
    images = _read(files.image, "image")
    codes = _read(files.code, "code")
    if files.slots is not None and codes.ndim == 3:
        if len(codes) % files.slots:
            raise ConfigError(
                f"slots: got {files.slots}, but {files.code} holds {len(codes)} pictures, which is no whole "
                "number of codes; correct one of them"
            )
        codes = codes.reshape(-1, files.slots, *codes.shape[1:])
    truth = None if files.truth is None else _read(files.truth, "truth")
    moving = None if files.moving is None else _read(files.moving, "moving")
    if files.bench is not None and files.calibration is not None:
        raise ConfigError("calibration, bench: got both, expected one of them; remove one")
    if files.bench is None and files.calibration is None:
        if files.reading_px > 1:
            raise ConfigError(
                f"reading_px: got {files.reading_px} without a bench, which says where a code's pixels are; "
                "name its folder as bench, or remove reading_px"
            )
        found = coded_measurement(images, codes, sensor=files.sensor, moving=moving, truth=truth)
    elif files.sensor != Sensor():
        raise ConfigError("sensor: got one and a bench or a calibration, which says all of it; remove one")
    else:
        file = Path(files.bench) / BENCH_FILE if files.bench else stored_file(Path(files.calibration or ""))
        found = _on_a_camera(file, files.reading_px, images, codes, moving, truth)
    return replace(found, origin=_origin(files))


def _origin(files: MeasurementFiles) -> dict[str, object]:
    """Collect the settings of a measurement, and the SHA-256 of each of its files."""
    said = files.model_dump(mode="json", exclude={"decoder"}, exclude_none=True)
    hashes: dict[str, str] = {}
    for key in (each for each in (*_NAMES, *_OF_CAMERA) if each in said):
        path = Path(said[key])
        there = path.iterdir() if path.is_dir() else path.parent.glob(path.name)
        inside = {each for each in there if each.suffix.lower() in _READ and each.is_file()}
        if key == "calibration" and (path / CALIBRATION_FILE).is_file():
            inside = {path / CALIBRATION_FILE}
        for each in sorted({path} if path.is_file() else inside):
            hashes[str(each)] = content_hash(each)
    return {**said, "sha256": hashes}


def _on_a_camera(
    file: Path,
    reading_px: int,
    images: NDArray[Any],
    codes: NDArray[Any],
    moving: NDArray[Any] | None,
    truth: NDArray[Any] | None,
) -> Measurement:
    """Measurement of a calibrated camera, by its file or its bench's: codes are drive levels."""
    images, codes = stacked(images, codes)
    if images.dtype != np.uint16:
        raise ValueCheckError(f"image: got {images.dtype}, expected the sensor's own numbers of 16 bits")
    if file.name == BENCH_FILE:
        known = Bench.read(file.parent)
        ccd, panel, where = known.darks.shape[1:], known.panel_shape, f"the bench {file.parent}"
    else:
        known = read_calibration(file)
        ccd, panel, where = known.ccd_shape, known.shape, f"the calibration {file}"
        if reading_px not in (1, known.reading_px):
            raise ConfigError(
                f"reading_px: got {reading_px}, but {where} is of {known.reading_px}; remove reading_px"
            )
    if images.shape[1:] != ccd:
        raise ValueCheckError(
            f"image: got {images.shape[1:]} pixels, expected {ccd}, the whole sensor as of {where}"
        )
    expected = (known.slots_per_frame, *panel)
    if codes.shape[1:] != expected:
        raise ValueCheckError(f"code: got {codes.shape[1:]}, expected {expected} as of {where}: (slot, v, u)")
    least, most = float(codes.min()), float(codes.max())
    if not (least >= 0 and most <= 255):
        raise ValueCheckError(
            f"code: got values from {least:g} to {most:g}, expected drive levels from 0 to 255, or weights "
            "from 0 to 1 of them"
        )
    calibration = calibrate_from(known, reading_px) if isinstance(known, Bench) else known
    as_shown = codes if most > 1 else codes * 255
    levels = np.rint(as_shown).astype(np.uint8)
    return Measurement(
        coded_frames(list(images), levels, moving_masks(moving, len(images), calibration.shape)),
        calibration,
        truth_frames(truth, len(images), calibration.slots_per_frame),
        "W m^-2 on the modulator",
        float(np.abs(levels - as_shown).max(initial=0)) / 255,
    )


def _read(text: str, role: _Role) -> NDArray[Any]:
    slots = role in ("code", "truth")
    # An image is counts, whose black level the sensor states.
    curves = {"image": ("linear", RAW_COUNTS), "truth": ("linear",)}.get(role)
    return read_pictures(Path(text), role, names=_NAMES[role], slots=slots, curves=curves)
