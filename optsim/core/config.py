"""Parts (everything configurable), the TOML tables they are built from, and overrides of their keys."""

from __future__ import annotations

import contextlib
import re
import tomllib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

from pydantic import BaseModel, ConfigDict, GetJsonSchemaHandler, ValidationError, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from optsim.core.descriptions import describe
from optsim.core.errors import ConfigError
from optsim.core.problems import problems
from optsim.core.units import parse_quantity

Table = dict[str, Any]


class Part(BaseModel):
    """Base of everything configurable: frozen, no unknown keys, quantity strings read by suffix."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Describe every key by the docstring of its class."""
        schema = handler(core_schema)
        keys = cast("dict[str, Table]", handler.resolve_ref_schema(schema).get("properties", {}))
        for key, about in keys.items():
            about["description"] = " ".join(filter(None, (describe(cls, key), about.get("description"))))
        return schema

    @model_validator(mode="before")
    @classmethod
    def _numbers(cls, values: object) -> object:
        """Read numbers given as text; unreadable text stays for validation to refuse."""
        if not isinstance(values, Mapping):
            return values
        table = dict(cast("Mapping[str, object]", values))
        for key in table.keys() & cls.model_fields.keys():
            table[key] = _number(key, table[key], cls.model_fields[key].annotation)
        return table


def _number(key: str, value: object, annotation: object) -> object:
    allowed = {annotation} if isinstance(annotation, type) else set(get_args(annotation))
    if isinstance(value, bool) and allowed & {int, float} and bool not in allowed:
        # Python counts true and false as 1 and 0; a user does not mean that.
        return str(value).lower()
    if isinstance(value, str) and float in allowed and not allowed - {float, type(None)}:
        with contextlib.suppress(ValueError):
            return parse_quantity(key, value)
    return value


PartT = TypeVar("PartT", bound=BaseModel)


def build(part: type[PartT], table: Mapping[str, object], *, where: str) -> PartT:
    """Validate a table as a part, or raise one ConfigError that lists every problem.

    Parameters
    ----------
    part : type
        The part's class.
    table : Mapping
        Keys and values, as read from TOML.
    where : str
        Name of the file or object, for messages.

    Raises
    ------
    ConfigError
        One line a problem: key, value got, value expected, nearest valid key.
    """
    try:
        return part.model_validate(table)
    except ValidationError as error:
        lines = problems(part, table, error)
        count = f"{len(lines)} problem{'s' if len(lines) > 1 else ''}"
        raise ConfigError(f"{where}: {count}\n" + "\n".join(f"  {line}" for line in lines)) from None


def read_toml(path: Path) -> Table:
    """Read a TOML file, with errors that name the file and the line.

    Raises
    ------
    ConfigError
        When the file is missing or is not TOML.
    """
    try:
        return cast("Table", _copy(_parsed(path.read_bytes())))
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"no such file: {path}") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is a folder; expected a TOML file") from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}{_quoted(path, str(error))}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is no text, expected TOML: {error}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path} cannot be read as TOML: {_too_much(error)}") from None


def _too_much(error: ValueError | RecursionError) -> str:
    """Explain an input that Python's parser refuses with an error other than one of TOML."""
    if isinstance(error, RecursionError):
        return "brackets are nested too deep; cure: fewer of them"
    return "a number has thousands of digits; cure: fewer of them"


def _quoted(path: Path, message: str) -> str:
    """Quote the line whose number a message gives."""
    found = re.search(r"at line (\d+)", message)
    lines = path.read_text(encoding="utf-8").split("\n")
    return f": {lines[int(found[1]) - 1].strip()!r}" if found and int(found[1]) <= len(lines) else ""


@lru_cache(maxsize=64)
def _parsed(text: bytes) -> Table:
    """Parse TOML once: an experiment reads its scene many times, and parsing is slow."""
    return tomllib.loads(text.decode("utf-8-sig"))


def override(table: Table, assignments: list[str]) -> Table:
    """Apply ``key.sub=value`` assignments (values in TOML syntax, bare words taken as strings).

    Raises
    ------
    ConfigError
        For an assignment without '=' or through a key that is no table.
    """
    result = cast("Table", _copy(table))
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        if not equals or not path.strip():
            raise ConfigError(
                f"--set {assignment!r}: expected key=value, for example camera.latency_frames=3"
            )
        try:
            value: object = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text.strip()
        except (ValueError, RecursionError) as error:
            raise ConfigError(
                f"--set {assignment[:60]!r}...: got no value that can be read: {_too_much(error)}"
            ) from None
        *tables, key = path.strip().split(".")
        target: object = result
        for step in tables:
            target = _inside(target, step, assignment)
        if not isinstance(target, dict):
            cure = ""
            if isinstance(target, str):
                at = ".".join(tables)
                cure = f": {at} is the name {target!r}; for more of it, set {at}.hardware={target} instead"
            raise ConfigError(f"--set {assignment!r}: {key!r} has no table to be set in{cure}")
        cast("Table", target)[key] = value
    return result


def merged(under: Mapping[str, object], over: Mapping[str, object]) -> Table:
    """Lay a table over another, table in table."""
    result = dict(under)
    for key, value in over.items():
        below = result.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            result[key] = merged(cast("Table", below), cast("Table", value))
        else:
            result[key] = value
    return result


def flat(table: Mapping[str, object]) -> Table:
    """Write the tables inside a table as keys with dots."""
    found: Table = {}
    for key, value in table.items():
        if isinstance(value, dict):
            found |= {f"{key}.{inner}": each for inner, each in flat(cast("Table", value)).items()}
        else:
            found[key] = value
    return found


def _inside(table: object, step: str, assignment: str) -> object:
    """Find a table inside a table by its key, or inside a list by its index or ``name``."""
    if isinstance(table, dict):
        return cast("Table", table).setdefault(step, {})
    if not isinstance(table, list):
        raise ConfigError(f"--set {assignment!r}: {step!r} is not a table that can be set into")
    rows = cast("list[object]", table)
    names = [cast("Table", row).get("name", "") if isinstance(row, dict) else "" for row in rows]
    place = int(step) if step.isdigit() else names.index(step) if step in names else len(rows)
    if place >= len(rows):
        raise ConfigError(
            f"--set {assignment!r}: got {step!r}, expected "
            f"{', '.join([*filter(None, names), ''])}or a place from 0 to {len(rows) - 1}"
        )
    return rows[place]


def _copy(value: object) -> object:
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in cast("Table", value).items()}
    if isinstance(value, list):
        return [_copy(item) for item in cast("list[object]", value)]
    return value
