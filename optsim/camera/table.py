"""Read a ``[camera]`` table: lay it over the data sheets that it names, and refuse an incomplete one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import cast

from pydantic import BaseModel

from optsim.calibration import read_grey_curve
from optsim.camera import hardware
from optsim.camera.camera import CodedCamera
from optsim.camera.effects import ITSELF, switched
from optsim.camera.parts import Ccd
from optsim.core.config import Table, merged
from optsim.core.errors import ConfigError, nearest_name, unknown_name


def check_hardware(table: Table, camera: object, where: str, keys: Collection[str]) -> None:
    """Refuse a camera table without parts.

    Parameters
    ----------
    table : dict
        Table of the experiment.
    camera : object
        Its ``camera`` entry.
    where : str
        Name of the file, for messages.
    keys : collection of str
        Valid keys of an experiment.

    Raises
    ------
    ConfigError
        With the key that was probably meant.
    """
    if not isinstance(camera, dict):
        if isinstance(camera, str) and camera in hardware.ALL:
            raise ConfigError(f"{where}: camera: got {camera!r}, expected a table; set camera.hardware to it")
        return
    parts = cast("Table", camera)
    _check_more("camera", parts, CodedCamera, ("hardware", "effects"), where)
    if isinstance(parts.get("sensor"), dict):
        _check_more("camera.sensor", cast("Table", parts["sensor"]), Ccd, ("hardware",), where)
    needed = [key for key, field in CodedCamera.model_fields.items() if field.is_required()]
    missing = [key for key in needed if key not in parts]
    if "hardware" in parts or not missing:
        return
    near = nearest_name([key for key in table if key not in keys], "camera") if not parts else None
    raise ConfigError(
        f"{where}: camera: got {', '.join(parts) or 'nothing'}, expected hardware = one of "
        f"{', '.join(hardware.ALL)}, or all parts; missing: {', '.join(missing)}"
        + (f"; did you mean 'camera' by {near!r}?" if near else "")
    )


def _check_more(at: str, table: Table, part: type[BaseModel], more: Sequence[str], where: str) -> None:
    """Refuse a misspelt key among those allowed beside a part's own."""
    for key in table:
        names = [*part.model_fields, *more]
        near = nearest_name(names, key, alike=0.7)
        if key not in names and near in more:
            raise ConfigError(f"{where}: {at}.{key}: unknown key; did you mean {near!r}?")


def find_files(table: Table, folder: Path) -> None:
    """Resolve relative paths of data sheets and grey tables from the experiment's own folder."""
    camera: object = table.get("camera")
    if not isinstance(camera, dict):
        return
    parts = cast("Table", camera)
    for part, key in (("sensor", "hardware"), ("modulator", "grey_curve")):
        held: object = parts.get(part)
        at, name = (parts, part) if isinstance(held, str) else (held, key)
        if isinstance(at, dict):
            inner = cast("Table", at)
            path: object = inner.get(name)
            if isinstance(path, str) and _is_file(path):
                inner[name] = str(folder / Path(path).expanduser())


def _is_file(name: str) -> bool:
    return "/" in name or Path(name).suffix in (*hardware.SUFFIXES, ".csv")


def on_hardware(table: object) -> object:
    """Lay a ``[camera]`` table over the data-sheet instance that its ``hardware`` key names.

    The ``sensor`` table works likewise, or is itself a name; a path names an EMVA 1288 data sheet, and
    ``modulator.grey_curve`` a table of the panel. The switches of its ``effects`` table override
    the hardware, and values set by hand override them. Switches of drifts do not change the camera
    (:func:`~optsim.camera.effects.drifted`).
    """
    if not isinstance(table, dict):
        return table
    keys = dict(cast("Table", table))
    under: Table = {}
    if "hardware" in keys:
        name = str(keys.pop("hardware"))
        if name not in hardware.ALL:
            raise unknown_name("camera.hardware", name, hardware.ALL)
        under = hardware.ALL[name]().model_dump()
    sensor = keys.get("sensor")
    if isinstance(sensor, str):
        sensor = keys["sensor"] = {"hardware": sensor}
    if isinstance(sensor, dict) and "hardware" in sensor:
        keys["sensor"] = by_hand = dict(cast("Table", sensor))
        name = str(by_hand.pop("hardware"))
        if _is_file(name):
            under = under | {"sensor": hardware.sensor_of(Path(name)).model_dump()}
        elif name not in hardware.SENSORS:
            raise unknown_name("camera.sensor.hardware", name, hardware.SENSORS)
        else:
            under = under | {"sensor": hardware.SENSORS[name]().model_dump()}
    panel = keys.get("modulator")
    curve: object = cast("Table", panel).get("grey_curve") if isinstance(panel, dict) else None
    if isinstance(curve, str):
        keys["modulator"] = {**cast("Table", panel), "grey_curve": read_grey_curve(Path(curve))}
    switches = keys.pop("effects", {})
    if not isinstance(switches, dict):
        raise ConfigError(
            f"camera.effects: got {switches!r}, expected a table such as {{ fringing = 'ideal' }}; cure: "
            "camera.effects.all=ideal switches all off"
        )
    changes = switched(cast("Table", switches))
    changes |= changes.pop(ITSELF, {})
    return merged(merged(under, changes), keys)
