"""Parts (everything configurable), quantity strings at the edge, TOML, overrides, and their errors."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, ConfigDict, ValidationError, model_validator

from optsim.errors import ConfigError

Table = dict[str, Any]

# SI suffix of a field name -> (unit in words, factors of the strings accepted there).
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "nm": 1e-9}
_UNITS: dict[str, dict[str, float]] = {
    "_m": _LENGTH,
    "_s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
    "_hz": {"hz": 1.0, "khz": 1e3, "fps": 1.0},
    "_rad": {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295},
    "_e": {"e": 1.0, "e-": 1.0, "ke-": 1e3},
    "_c": {"c": 1.0, "°c": 1.0},
}
_QUANTITY = re.compile(r"^\s*([-+0-9.eE]+?)\s*([A-Za-zµ°%][-A-Za-zµ°]*)\s*$")


def parse_quantity(key: str, text: str) -> float:
    """Turn a quantity string such as ``"25 mm"`` into SI, by the unit suffix of its key.

    Parameters
    ----------
    key : str
        Field name; its suffix (``_m``, ``_s``, ...) says the dimension.
    text : str
        Number and unit.

    Returns
    -------
    float
        The value in SI.

    Raises
    ------
    ConfigError
        When the text is no quantity or its unit is of another dimension.
    """
    suffix = next((s for s in _UNITS if key.endswith(s)), None)
    if suffix is None:
        raise ConfigError(f"{key}: got {text!r}, expected a plain number (this key has no unit)")
    match = _QUANTITY.match(text)
    units = _UNITS[suffix]
    cure = f"write for example \"{key} = '1 {next(iter(units))}'\"; units accepted: {', '.join(units)}"
    if not match:
        raise ConfigError(f"{key}: got {text!r}, expected a number with a unit; {cure}")
    number, unit = match.groups()
    if unit.lower() not in units:
        raise ConfigError(f"{key}: unit {unit!r} in {text!r} is not of this key's dimension; {cure}")
    try:
        return float(number) * units[unit.lower()]
    except ValueError:
        raise ConfigError(f"{key}: {number!r} in {text!r} is not a number; {cure}") from None


class Part(BaseModel):
    """Base of everything configurable: frozen, no unknown keys, quantity strings read by suffix."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _quantities(cls, values: object) -> object:
        if not isinstance(values, Mapping):
            return values
        table = dict(cast("Mapping[str, object]", values))
        for key, value in table.items():
            info = cls.model_fields.get(key)
            if isinstance(value, str) and info is not None and info.annotation is float:
                try:
                    table[key] = parse_quantity(key, value)
                except ConfigError as error:
                    raise ValueError(str(error)) from None
        return table


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
        One line a problem: key, what was got, what was expected, nearest valid key.
    """
    try:
        return part.model_validate(table)
    except ValidationError as error:
        items = cast("list[dict[str, Any]]", error.errors())
        # A list whose items are wrong is also called too short: that is no problem of its own.
        inside = {tuple(item["loc"][:depth]) for item in items for depth in range(len(item["loc"]))}
        lines = [_explain(part, i) for i in items if i["type"] != "too_short" or i["loc"] not in inside]
        problems = f"{len(lines)} problem{'s' if len(lines) > 1 else ''}"
        raise ConfigError(f"{where}: {problems}\n" + "\n".join(f"  {line}" for line in lines)) from None


def _explain(part: type[BaseModel], item: dict[str, Any]) -> str:
    location = [str(step) for step in cast("tuple[object, ...]", item["loc"])]
    key = ".".join(location)
    message = cast("str", item["msg"]).removeprefix("Value error, ")
    if item["type"] == "extra_forbidden":
        paths = _field_paths(part)
        near = difflib.get_close_matches(location[-1], sorted(paths), n=1)
        # A right name in the wrong table: only the whole key says what to do.
        meant = paths[near[0]] if near and near[0] == location[-1] else near
        hint = f"did you mean {' or '.join(repr(m) for m in meant)}?" if near else "remove it."
        return f"{key}: unknown key; {hint}"
    if item["type"] == "missing":
        return f"{key}: missing; every experiment needs it"
    if isinstance(item["input"], Mapping) and item["type"] == "value_error":
        # The message names the key inside the table and what it got; the whole table only hides it.
        return f"{key}: {message}" if key else message
    got = repr(cast("object", item["input"]))
    got = got if len(got) < 80 else got[:77] + "..."
    return f"{key}: got {got}; {message}"


def _field_paths(part: type[BaseModel]) -> dict[str, list[str]]:
    """Whole keys by field name, of a part and the parts inside it, for hints."""
    paths: dict[str, list[str]] = {}
    todo: list[tuple[str, object]] = [("", part)]
    seen: set[tuple[str, object]] = set()
    while todo:
        prefix, item = todo.pop()
        if (prefix, item) in seen:
            continue
        seen.add((prefix, item))
        if isinstance(item, type) and issubclass(item, BaseModel):
            for name, info in item.model_fields.items():
                if prefix + name not in paths.setdefault(name, []):
                    paths[name].append(prefix + name)
                todo.append((f"{prefix}{name}.", info.annotation))
        else:
            inside = cast("tuple[object, ...]", getattr(item, "__args__", ()))  # pyright: ignore[reportUnknownArgumentType]
            todo += [(prefix, one) for one in inside]
    return paths


def read_toml(path: Path) -> Table:
    """Read a TOML file, with errors that name the file and the line.

    Raises
    ------
    ConfigError
        When the file is missing or is not TOML.
    """
    try:
        with path.open("rb") as stream:
            return tomllib.load(stream)
    except FileNotFoundError:
        raise ConfigError(f"no such file: {path}; a name without '/' or '.toml' means a preset") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is a folder; expected a TOML file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from None


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
        steps = path.strip().split(".")
        target: Any = result
        for step in steps[:-1]:
            if isinstance(target, list) and step.isdigit() and int(step) < len(cast("list[Any]", target)):
                target = cast("list[Any]", target)[int(step)]
            elif isinstance(target, dict):
                target = cast("Table", target).setdefault(step, {})
            else:
                raise ConfigError(f"--set {assignment!r}: {step!r} is not a table that can be set into")
        if not isinstance(target, dict):
            raise ConfigError(f"--set {assignment!r}: {steps[-1]!r} has no table to be set in")
        cast("Table", target)[steps[-1]] = value
    return result


def _copy(value: object) -> object:
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in cast("Table", value).items()}
    if isinstance(value, list):
        return [_copy(item) for item in cast("list[object]", value)]
    return value
