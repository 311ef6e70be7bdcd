"""The JSON schema of an experiment, for people and editors: each key with what it means and what is usual."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

from optsim.camera import hardware
from optsim.core.config import Part
from optsim.experiment.experiment import Experiment

_DATA_SHEETS = (hardware.prototype, hardware.lcr720, hardware.icx674)


def experiment_schema() -> dict[str, Any]:
    """Return the schema; keys of the camera's parts tell the prototype's values, and their sources."""
    schema = Experiment.model_json_schema()
    sources = {key: text for make in _DATA_SHEETS for key, text in hardware.sources(make).items()}
    typical = {
        (type(part).__name__, key): value
        for part in _parts(hardware.prototype())
        for key, value in part
        if not isinstance(value, Part)
    }
    for name, table in {**schema["$defs"], "Experiment": schema}.items():
        for key, about in cast("dict[str, dict[str, Any]]", table["properties"]).items():
            of_camera = (name, key) in typical
            value = _text(typical.get((name, key), about.get("default")))
            if value:
                about["description"] += f" Typical: {value}{' (prototype)' if of_camera else ''}."
            source = sources.get((name, key), "No source: a default of this project")
            if of_camera and "ource" not in about["description"]:
                told = source if source.startswith("No source") else f"Source: {source}"
                about["description"] += f" {told.rstrip('.')}."
    return schema


def _parts(part: Part) -> Iterator[Part]:
    yield part
    for _, value in part:
        if isinstance(value, Part):
            yield from _parts(value)


def _text(value: object) -> str:
    """Write a value as TOML does; nothing for a table, or for what would fill a page."""
    if isinstance(value, float):
        return f"{value:g}"
    text = "" if value is None or isinstance(value, dict) else str(value)
    return text.lower() if isinstance(value, bool) else text if len(text) < 40 else ""
