"""A measured grey curve of the panel: level and reflectance from a CSV file."""

from __future__ import annotations

import csv
from pathlib import Path

from optsim.core.errors import ConfigError

_COLUMNS = ("level", "reflectance")


def read_grey_curve(path: Path) -> tuple[tuple[float, float], ...]:
    """Read level and reflectance, two columns; a header may name them in either order.

    Raises
    ------
    ConfigError
        For a file that cannot be read, a header of other names, or a row of other than two numbers.
    """
    cure = f"cure: two columns, {' and '.join(_COLUMNS)}, a row each level that was measured"
    try:
        rows = [row for row in csv.reader(path.read_text(encoding="utf-8-sig").splitlines()) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else f"no CSV: {error}"
        raise ConfigError(f"{path}: got {reason}, expected a table of the panel; {cure}") from None
    columns = [name.strip().lower() for name in rows[0]] if rows else []
    order = (0, 1)
    if set(columns) == set(_COLUMNS):
        order = columns.index("level"), columns.index("reflectance")
        rows = rows[1:]
    elif not all(_is_number(name) for name in columns):
        raise ConfigError(f"{path}: got columns {', '.join(columns)}, expected {', '.join(_COLUMNS)}; {cure}")
    for row in rows:
        if len(row) != len(_COLUMNS) or not all(_is_number(each) for each in row):
            raise ConfigError(f"{path}: got the row {','.join(row)[:60]!r}, expected two numbers; {cure}")
    return tuple((float(row[order[0]]), float(row[order[1]])) for row in rows)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
