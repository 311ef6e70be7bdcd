"""Variations of a scene: named tables of changes, and numbered random draws of its ranges.

Each key draws from its own random stream, so adding or removing a range leaves all others bitwise the same.
``3,light=7`` is variation 3 under the light of variation 7: an aspect may have its own number.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from optsim.core.config import Table, override
from optsim.core.errors import ConfigError, unknown_name

# Aspect -> tables of ``scene.toml`` whose ranges follow its number.
ASPECTS = {
    "light": ("lamps", "sky"),
    "camera": ("camera",),
    "motion": ("movers",),
    "textures": ("materials",),
    "objects": ("objects", "populate"),
}


@dataclass(frozen=True)
class Range:
    """Values that a key may take: an interval, or choices."""

    key: str  # Dotted key in scene.toml; a number steps into a list.
    low: float = 0.0  # Whole ends draw whole numbers, both ends included.
    high: float = 0.0
    choices: tuple[Any, ...] = ()

    def drawn(self, rng: np.random.Generator) -> Any:
        """Draw a value, uniform."""
        if self.choices:
            return self.choices[int(rng.integers(len(self.choices)))]
        if isinstance(self.low, int) and isinstance(self.high, int):
            return int(rng.integers(self.low, self.high, endpoint=True))
        return float(rng.uniform(self.low, self.high))

    def extreme(self, index: int) -> Any:
        """Choice of this index, modulo their number, or the low and the high end in turn."""
        if self.choices:
            return self.choices[index % len(self.choices)]
        return (self.low, self.high)[index % 2]


def is_number(variation: str) -> bool:
    """Whether a variation is a whole number as text, in its shortest form, maybe with aspects of others."""
    first, *further = variation.split(",")
    aspects = [text.partition("=") for text in further]
    numbers = [first, *(number for _, _, number in aspects)]
    return {aspect for aspect, _, _ in aspects} <= {*ASPECTS} and all(
        number.isascii() and number.isdigit() and str(int(number)) == number for number in numbers
    )


def number_of(variation: str, aspect: str) -> int:
    """Return the number that an aspect of a variation follows; 0 for a variation with a name."""
    if not is_number(variation):
        return 0
    first, *further = variation.split(",")
    return int(dict(text.split("=") for text in further).get(aspect, first))


def varied(table: Table, variation: str, where: str) -> Table:
    """Build the table of a scene in one variation, without ``variations`` and ``ranges``."""
    named, ranges = named_variations(table), find_ranges(table, where)
    plain = {key: value for key, value in table.items() if key not in ("variations", "ranges")}
    if variation in named:
        return merged(plain, named[variation])
    if variation == "main":
        return plain
    if not is_number(variation):
        raise unknown_name(f"variation of {where}", variation, ["main", *named])
    if not ranges and "populate" not in table:
        raise ConfigError(
            f"{where}: variation {variation!r} is a number, which draws the scene's ranges, but it has none; "
            "cure: add a table [ranges], or choose one of: " + ", ".join(["main", *named])
        )
    name = str(table.get("name", ""))
    return laid(plain, {item.key: item.drawn(_stream(name, item.key, variation)) for item in ranges})


def _stream(scene: str, key: str, variation: str) -> np.random.Generator:
    """Random numbers of one key in a variation of a scene."""
    words = [zlib.crc32(text.encode()) for text in (scene, key)]
    table = key.partition(".")[0]
    aspect = next((name for name, tables in ASPECTS.items() if table in tables), "")
    return np.random.default_rng([*words, number_of(variation, aspect)])


def extremes(table: Table, where: str) -> Iterator[Table]:
    """Yield tables that cover both ends of every interval and every choice: all must be valid."""
    ranges = find_ranges(table, where)
    plain = {key: value for key, value in table.items() if key not in ("variations", "ranges")}
    for index in range(max((len(item.choices) or 2 for item in ranges), default=0)):
        yield laid(plain, {item.key: item.extreme(index) for item in ranges})


def find_ranges(table: Table, where: str) -> list[Range]:
    """Ranges of a scene, sorted by key; the table may be nested or have dotted keys in quotes."""
    ranges = table.get("ranges", {})
    if not isinstance(ranges, Mapping):
        raise ConfigError(f"{where}: ranges: got {ranges!r}, expected a table of key = [low, high]")
    found = sorted(_flat("", cast("Table", ranges), where), key=lambda item: item.key)
    for item in found:
        _check_place(table, item.key, where)
    return found


def _flat(prefix: str, ranges: Mapping[str, Any], where: str) -> Iterator[Range]:
    for key, value in ranges.items():
        whole = f"{prefix}{key}"
        if not isinstance(value, Mapping):
            yield _interval(whole, value, where)
        elif "choices" in value:
            yield _choices(whole, cast("Table", value), where)
        else:
            yield from _flat(f"{whole}.", cast("Table", value), where)


def _interval(key: str, value: object, where: str) -> Range:
    ends = cast("list[Any]", value) if isinstance(value, list) else []
    numbers = [end for end in ends if isinstance(end, int | float) and not isinstance(end, bool)]
    if len(ends) != 2 or len(numbers) != 2 or not np.isfinite(numbers).all() or numbers[0] > numbers[1]:
        raise ConfigError(
            f"{where}: ranges.{key}: got {value!r}, expected [low, high] of finite numbers, low first, "
            "or { choices = [...] }"
        )
    return Range(key, low=ends[0], high=ends[1])


def _choices(key: str, value: Table, where: str) -> Range:
    choices = value["choices"]
    if set(value) != {"choices"} or not isinstance(choices, list) or not choices:
        raise ConfigError(f"{where}: ranges.{key}: got {value!r}, expected {{ choices = [one, or more] }}")
    return Range(key, choices=tuple(cast("list[Any]", choices)))


def _check_place(table: Table, key: str, where: str) -> None:
    """Check that a key's table exists: a range must not add an object to the scene."""
    place: Any = table
    for step in key.split(".")[:-1]:
        if isinstance(place, list) and step.isdigit() and int(step) < len(cast("list[Any]", place)):
            place = cast("list[Any]", place)[int(step)]
        elif isinstance(place, Mapping) and step in place:
            place = cast("Table", place)[step]
        else:
            known = [str(name) for name in cast("Table", place)] if isinstance(place, Mapping) else []
            raise ConfigError(f"{where}: ranges.{key}: {unknown_name('key', step, known or ['(no table)'])}")
    last = key.split(".")[-1]
    if isinstance(place, list) and not (last.isdigit() and int(last) < len(cast("list[Any]", place))):
        raise ConfigError(
            f"{where}: ranges.{key}: got {last!r}, expected a place in the list, "
            f"0 .. {len(cast('list[Any]', place)) - 1}"
        )
    if not isinstance(place, Mapping | list):
        raise ConfigError(f"{where}: ranges.{key}: {last!r} is inside a plain value, not a table or list")


def laid(table: Table, values: Mapping[str, Any]) -> Table:
    """Table with the values of some dotted keys replaced; steps that are numbers go into lists."""
    result = override(table, [])
    for key, value in values.items():
        *steps, last = key.split(".")
        place: Any = result
        for step in steps:
            place = place[_index(place, step)]
        place[_index(place, last)] = value
    return result


def _index(place: Any, step: str) -> int | str:
    return int(step) if isinstance(place, list) else step


def merged(table: Mapping[str, Any], changes: Mapping[str, Any]) -> Table:
    """Merge nested changes into a table; a name mapped to the empty string is removed."""
    result = dict(table)
    for key, value in changes.items():
        if value == "":
            result.pop(key, None)
        elif isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = merged(result[key], cast("Table", value))
        else:
            result[key] = value
    return result


def named_variations(table: Table) -> dict[str, Table]:
    """Tables of changes by the variation's name; ``main`` and numbers are no names."""
    named = cast("dict[str, Table]", table.get("variations", {}))
    for name in named:
        if name == "main" or name.isdigit():
            raise ConfigError(
                f"variations.{name}: this name is taken (main is the scene as written, a number draws the "
                "ranges); cure: rename it"
            )
    return named
