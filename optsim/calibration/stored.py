"""Calibration files: read and write a calibration as described arrays in an .npz.

Beside the fields of a :class:`Calibration` the file has two tables for readers with numpy alone.
``slot_weight`` is a panel pixel's transmission in a slot after it was held at another level. ``direct_share``
is the share of even light that is not glare.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from optsim import __version__
from optsim.calibration.calibration import Calibration
from optsim.calibration.choice import CALIBRATION_FILE
from optsim.calibration.glare import Glare
from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.files import atomic
from optsim.core.foreign import check_memory, reading
from optsim.core.quantities import Bytes, Floats
from optsim.optics.panel import PanelResponse, settled_panel, slot_weights

_FORMAT = "optsim calibration 1"
_CURE = f"name a {CALIBRATION_FILE} that 'optsim run' wrote, whole, or the folder that holds it"
_GLARE = "glare_"
_ABOUT = "about"
_GREYS = "grey_curve"

# Axes, unit and meaning of every array of the file.
_MEANING: dict[str, tuple[str, str, str]] = {
    "slot_s": ("", "s", "duration of a slot"),
    "slots_per_frame": ("", "1", "slots in a frame's period"),
    "coded_slots": ("", "1", "slots at its start in which the shutter is open; later ones weigh 0"),
    "ccd_shape": ("(rows, columns)", "CCD pixels", "size of a frame"),
    "centre_row": ("v, u", "CCD pixel", "row of a frame that is read for a panel pixel, from 0"),
    "centre_col": ("v, u", "CCD pixel", "column of a frame that is read for a panel pixel, from 0"),
    "reading_px": ("", "CCD pixels", "side of the readout window, whose mean is read"),
    "valid": ("v, u", "mask", "false: off the CCD, a dead CCD pixel, a stuck panel pixel"),
    "responsivity_dn": (
        "v, u",
        "DN / (W m^-2 slot)",
        "signal of even light at weight 1, shading included; irradiance is that on the modulator, on axis",
    ),
    "black_dn": ("v, u", "DN", "black level of the readout window"),
    "saturation_dn": ("v, u", "DN", "a pixel of a frame at or above it is saturated"),
    "read_noise_dn": ("", "DN", "noise of the readout window in the dark, standard deviation"),
    "dn_per_e": ("", "DN / electron", "its shot noise has the variance dn_per_e (DN above black)"),
    "crosstalk": (
        "v, u, dv, du",
        "1",
        "shares of the light of (v + dv - k, u + du - k), k half the kernel, that are read with (v, u)",
    ),
    "tau_on_s": ("", "s", "time constant of the panel's retardance, rising"),
    "tau_off_s": ("", "s", "time constant of the panel's retardance, falling"),
    "leak": ("", "1", "light through the panel fully off over fully on: 1 / contrast"),
    "white_rad": ("", "rad", "retardance of level 255"),
    "drive_exponent": ("", "1", "of retardance against level"),
    "grey_curve": (
        "pair, column",
        "1",
        "level and reflectance as measured, in place of the exponent; or none",
    ),
    "field_drive": ("field", "1", "relative retardance of successive slots, repeated"),
    "delay_s": ("", "s", "when the panel's first row turns to a slot's level, after the slot began"),
    "scan_s": ("", "s", "how much later the row after the last one would"),
    "gain_uncertainty": ("", "1", "relative standard uncertainty of the responsivity, pixel to pixel"),
    "leak_uncertainty": ("", "1", "relative standard uncertainty of the leak, pixel to pixel"),
    "map_residual_px": ("", "panel pixels", "rms distance of the map from the measured dots"),
    "glare_veil": ("", "1", "share of the light that is spread evenly"),
    "glare_ghost": ("", "1", "share of the light that comes back mirrored through the panel's middle"),
    "glare_ghost_blur_px": ("", "panel pixels", "standard deviation of the ghost's blur"),
    "glare_wings": ("ring", "1", "PSF tails: a reading r panel pixels away gets strength / r^3"),
    "slot_weight": (
        "field, end, before, level",
        "1",
        "weight of a slot in which the panel is driven to a level after the one before; end 0 is the first "
        "row and 1 the last, between them it is linear; slot k of frame n is of field ((n + 1) "
        "slots_per_frame + k) % fields; before the first slot of an experiment is the last of its code",
    ),
    "direct_share": ("v, u", "1", "share of even light that is no glare"),
}
_DERIVED = ("slot_weight", "direct_share")
_WHOLE = ("slots_per_frame", "coded_slots", "ccd_shape", "reading_px")


def calibration_arrays(calibration: Calibration) -> dict[str, NDArray[Any]]:
    """Name the arrays of a calibration; ``about`` is JSON: format, source, units and axes."""
    about = {
        "format": _FORMAT,
        "optsim": __version__,
        "source": calibration.source,
        "standard_errors": dict(calibration.standard_errors),
        "misalignment": dict(calibration.misalignment),
        "arrays": {n: {"axes": a, "unit": u, "meaning": m} for n, (a, u, m) in _MEANING.items()},
    }
    held: dict[str, Any] = {
        **{name: getattr(calibration, name) for name in _own_names()},
        **calibration.response.model_dump(),
        **{_GLARE + name: value for name, value in vars(calibration.glare).items()},
        "slot_weight": _slot_weights(calibration),
        "direct_share": calibration.direct_share,
    }
    held[_GREYS] = np.reshape(held[_GREYS], (-1, 2))
    return {_ABOUT: np.array(json.dumps(about)), **{name: np.asarray(held[name]) for name in _MEANING}}


def calibration_of(arrays: Mapping[str, NDArray[Any]], where: object) -> Calibration:
    """Make a calibration from the arrays of :func:`calibration_arrays`.

    Parameters
    ----------
    arrays : Mapping
        Scalars may have one axis of length 1.
    where : object
        Name of the file, for messages.

    Raises
    ------
    StorageError
        When an array is missing or wrong, or the format is another.
    """
    about = _said(arrays, where)
    arrays = {_GREYS: np.empty((0, 2)), **arrays}  # files of before it
    if missing := sorted(_MEANING.keys() - arrays.keys()):
        raise StorageError(f"{where}: got no {', '.join(missing)}, expected {_FORMAT}; cure: {_CURE}")
    for name, (axes, _, _) in _MEANING.items():
        array, n_axes = arrays[name], len(axes.split(",")) if "(" not in axes else 1
        numbers = array.dtype.kind in ("iu" if name in _WHOLE else "biuf") and bool(np.isfinite(array).all())
        if not numbers or (array.ndim != n_axes if axes else array.size != 1):
            got = (
                f"{array.dtype} of shape {array.shape}{'' if numbers else ', of other or not finite numbers'}"
            )
            raise StorageError(
                f"{where}: {name}: got {got}, expected finite numbers with axes ({axes}); cure: {_CURE}"
            )
    glare = [name for name in _MEANING if name.startswith(_GLARE)]
    try:
        found = Calibration(
            source=about["source"],
            standard_errors=_numbers(about, "standard_errors", 0, where),
            misalignment=_numbers(about, "misalignment", -np.inf, where),
            response=PanelResponse.model_validate({n: _value(arrays, n) for n in PanelResponse.model_fields}),
            glare=Glare(**{name.removeprefix(_GLARE): _value(arrays, name) for name in glare}),
            **{name: _value(arrays, name) for name in _own_names()},
        )
    except (ValueCheckError, ValidationError, TypeError) as error:
        why = error.errors()[0]["msg"] if isinstance(error, ValidationError) else error
        raise StorageError(f"{where}: {why}; cure: {_CURE}") from None
    fields, ends = len(found.response.field_drive), 2
    for name, shape in (("slot_weight", (fields, ends, 256, 256)), ("direct_share", found.shape)):
        if arrays[name].shape != shape:
            raise StorageError(
                f"{where}: {name}: got shape {arrays[name].shape}, expected {shape}; cure: {_CURE}"
            )
    return found


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as a compressed .npz file; the same calibration gives the same bytes.

    Raises
    ------
    StorageError
        When the disk refuses.
    """
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **cast("Any", calibration_arrays(calibration)))
    with atomic(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def read_calibration(path: Path) -> Calibration:
    """Read and check a file of :func:`write_calibration`.

    Raises
    ------
    StorageError
        When the file is missing, damaged, or no calibration.
    """
    with reading(path, "a calibration", _CURE), path.open("rb") as stream:
        with ZipFile(stream) as archive:
            check_memory(path, sum(each.file_size for each in archive.infolist()), "a calibration")
        stream.seek(0)
        # Reading each member to its end verifies its checksum.
        with np.load(stream, allow_pickle=False) as stored:
            arrays = {name: np.asarray(stored[name]) for name in stored.files}
    return calibration_of(arrays, path)


def _said(arrays: Mapping[str, NDArray[Any]], where: object) -> dict[str, Any]:
    """Read the file's own description."""
    try:
        about: object = json.loads(str(arrays[_ABOUT].item()))
    except (KeyError, ValueError):
        about = None
    said = cast("dict[str, Any]", about) if isinstance(about, dict) else {}
    if said.get("format") != _FORMAT or said.get("source") not in ("bench", "true", "ideal"):
        there = ", ".join(sorted(arrays)[:5]) or "nothing"
        got = repr(said["format"]) if "format" in said else f"a file of {there}"
        raise StorageError(f"{where}: got {got}, expected {_FORMAT!r}; cure: {_CURE}")
    return said


def _numbers(about: Mapping[str, Any], key: str, least: float, where: object) -> dict[str, float]:
    """Read a table of single numbers."""
    said: object = about.get(key)
    if not isinstance(said, dict):
        raise StorageError(f"{where}: {key}: got {said!r}, expected a table; cure: {_CURE}")
    numbers = cast("dict[str, Any]", said)
    for name, number in numbers.items():
        if not isinstance(number, int | float) or not least <= number < np.inf or number == -np.inf:
            expected = "a number" if least else f"a number of at least {least}"
            raise StorageError(f"{where}: {key}.{name}: got {number!r}, expected {expected}; cure: {_CURE}")
    return numbers


def _own_names() -> list[str]:
    """Names of the arrays that are fields of a calibration directly."""
    inside = {*PanelResponse.model_fields, *_DERIVED}
    return [name for name in _MEANING if name not in inside and not name.startswith(_GLARE)]


def _value(arrays: Mapping[str, NDArray[Any]], name: str) -> Any:
    """Convert an array to an image, a number or a few numbers."""
    axes, array = _MEANING[name][0], arrays[name]
    if "v, u" in axes:
        return np.ascontiguousarray(array)
    return tuple(array.tolist()) if axes else array.item()


def _slot_weights(calibration: Calibration) -> Floats:
    """Weight of a slot by field, end of the panel, level before it and level in it: (f, 2, 256, 256)."""
    response, slot_s = calibration.response, calibration.slot_s
    levels: Bytes = np.tile(np.arange(256, dtype=np.uint8), (256, 1))
    delays_s = response.row_delays_s(calibration.shape[0])[[0, -1]]
    n_fields = len(response.field_drive)
    table = np.empty((n_fields, 2, 256, 256), np.float32)
    for end, delay_s in enumerate(delays_s):
        row = response.model_copy(update={"delay_s": float(delay_s), "scan_s": 0.0})
        for field in range(n_fields):
            # Assumes that the level before was held under the drive of its own field.
            turned = (*response.field_drive[field:], *response.field_drive[:field])
            before = settled_panel(levels.T, row.model_copy(update={"field_drive": turned}))
            now = row.model_copy(update={"field_drive": turned})
            table[field, end] = slot_weights(levels[None], before, now, slot_s)[0][0]
    return table
