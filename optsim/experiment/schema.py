"""The JSON schema of an experiment, for people and editors: each key with its meaning and usual value."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, cast

from optsim.camera import hardware
from optsim.core.config import Part, Table
from optsim.core.errors import ConfigError, unknown_name
from optsim.experiment.experiment import Experiment

_DATA_SHEETS = (hardware.prototype, hardware.lcr720, hardware.icx674)


def experiment_schema() -> dict[str, Any]:
    """Return the schema; keys of the camera's parts give the prototype's values, and their sources."""
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
                found_lines = source if source.startswith("No source") else f"Source: {source}"
                about["description"] += f" {found_lines.rstrip('.')}."
    return schema


def explain_key(path: str) -> list[str]:
    """Describe a key by meaning, unit, typical value, source and default; a table by each of its keys.

    Parameters
    ----------
    path : str
        As ``--set`` takes it, for example ``camera.relay.shift_x_px``; indices of lists may be left out.

    Returns
    -------
    list of str
        One line a key, those of a table indented.

    Raises
    ------
    ConfigError
        For an unknown key, with the nearest.
    """
    schema = experiment_schema()
    tables, abouts, done = [schema], list[Table](), list[str]()
    for step in path.split("."):
        if done and step.isdecimal():
            continue
        names = {name for table in tables for name in table.get("properties", {})}
        if not names:
            raise ConfigError(
                f"{path}: got {step!r}, but {'.'.join(done)} is no table of known keys; "
                f"cure: optsim config schema {'.'.join(done)}"
            )
        if step not in names:
            raise unknown_name("key", ".".join([*done, step]), [".".join([*done, name]) for name in names])
        done.append(step)
        abouts = [keys[step] for table in tables if step in (keys := table.get("properties", {}))]
        if done in (["drift"], ["drift_per_frame"]):
            # Its tables are the camera's, each key a change of it.
            tables = _tables(schema["properties"]["camera"], schema["$defs"])
            continue
        tables = [table for about in abouts for table in _tables(about, schema["$defs"])]
    found_lines = dict.fromkeys(_line(".".join(done), about) for about in abouts)
    for table in {table["title"]: table for table in tables}.values():
        keys: Table = table["properties"]
        if "kind" in keys:
            found_lines |= dict.fromkeys(
                [f"  kind = {keys['kind'].get('const')}: {keys['kind']['description']}"]
            )
        found_lines |= dict.fromkeys(
            f"    {_line(key, about)}" for key, about in keys.items() if key != "kind"
        )
    return list(found_lines)


def _line(key: str, about: Table) -> str:
    default: object = about.get("default")
    text = "Default: a table" if isinstance(default, dict) else f"Default: {json.dumps(default)}"
    return f"{key}: {about['description']} {text if 'default' in about else 'No default'}."


def _tables(about: Table, known: Table) -> list[Table]:
    """Tables that a key may be, or hold a list or names of."""
    found: list[Table] = [known[about["$ref"].rpartition("/")[2]]] if "$ref" in about else []
    inner = [
        *about.get("anyOf", []),
        *about.get("oneOf", []),
        about.get("items"),
        about.get("additionalProperties"),
    ]
    for each in inner:
        found += _tables(cast("Table", each), known) if isinstance(each, dict) else []
    return [table for table in found if "properties" in table]


def _parts(part: Part) -> Iterator[Part]:
    yield part
    for _, value in part:
        if isinstance(value, Part):
            yield from _parts(value)


def _text(value: object) -> str:
    """Write a value as TOML does; empty for a table, or for a value that would fill a page."""
    if isinstance(value, float):
        return f"{value:g}"
    text = "" if value is None or isinstance(value, dict) else str(value)
    return text.lower() if isinstance(value, bool) else text if len(text) < 40 else ""
