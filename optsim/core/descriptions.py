"""Descriptions of configuration keys for the JSON schema, read from the docstrings of their parts."""

from __future__ import annotations

import inspect
import re

from optsim.core.units import unit_of

_ENTRY = re.compile(r"^(\w+(?:, \w+)*)(?: : .*)?$")
_ROLE = re.compile(r":\w+:`~?([^`]*)`")


def describe(part: type, key: str) -> str:
    """Say what a key of a part means, and its unit."""
    if key == "kind":
        return inspect.cleandoc(part.__doc__ or "").partition("\n")[0]
    texts = [entries[key] for each in part.__mro__ if key in (entries := _entries(each))]
    unit = unit_of(key)
    return " ".join([*texts[:1], *([f"Unit: {unit}."] if unit else [])])


def _entries(part: type) -> dict[str, str]:
    """Read the texts of a ``Parameters`` section by key; keys listed together share one text."""
    found: dict[str, str] = {}
    _, _, section = inspect.cleandoc(part.__doc__ or "").partition("Parameters\n----------\n")
    keys: list[str] = []
    lines: list[str] = []
    # A blank line ends the section.
    for line in [*section.partition("\n\n")[0].splitlines(), ""]:
        entry = _ENTRY.match(line)
        if entry or not line:
            text = _ROLE.sub(r"\1", " ".join(lines)).replace("``", "")
            found |= dict.fromkeys(keys, text)
            keys, lines = entry[1].split(", ") if entry else [], []
        else:
            lines.append(line.strip())
    return found
