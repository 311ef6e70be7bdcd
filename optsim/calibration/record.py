"""Read the record of a bench folder; its error messages name the file, the key and the cure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.calibration.choice import BENCH_FILE
from optsim.core.errors import BenchError, StorageError
from optsim.core.files import read_png16
from optsim.core.quantities import Words

RECORD = BENCH_FILE


@dataclass(frozen=True)
class Table:
    """A JSON object with its place, so that every message names the file and the key."""

    path: Path
    place: str
    items: Mapping[str, Any]

    def _get(self, key: str) -> object:
        if key not in self.items:
            raise BenchError(f"{self.path}: {self.place}{key} is missing; add it")
        return self.items[key]

    def _wrong(self, key: str, expected: str) -> BenchError:
        got = repr(self.items[key])[:60]
        return BenchError(f"{self.path}: {self.place}{key}: got {got}, expected {expected}")

    def number(self, key: str) -> float:
        """Return a number, whole or not."""
        value = self._get(key)
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self._wrong(key, "a number")
        return value

    def integers(self, key: str, *, length: int | None = None) -> tuple[int, ...]:
        """Return one or more whole numbers, ``length`` of them if given."""
        value = self._get(key)
        numbers = cast("list[object]", value) if isinstance(value, list) else []
        if not numbers or not all(isinstance(n, int) for n in numbers) or length not in (None, len(numbers)):
            raise self._wrong(key, f"a list of {length or 'one or more'} whole numbers")
        return tuple(cast("list[int]", numbers))

    def table(self, key: str) -> Table:
        """Return the object inside."""
        value = self._get(key)
        if not isinstance(value, dict):
            raise self._wrong(key, "an object")
        return Table(self.path, f"{self.place}{key}.", cast("dict[str, Any]", value))

    def tables(self, key: str) -> list[Table]:
        """Return a list of objects, maybe empty."""
        value = self._get(key)
        if not isinstance(value, list):
            raise self._wrong(key, "a list of objects")
        items = cast("list[object]", value)
        if not all(isinstance(item, dict) for item in items):
            raise self._wrong(key, "a list of objects")
        return [
            Table(self.path, f"{self.place}{key}[{i}].", cast("dict[str, Any]", item))
            for i, item in enumerate(items)
        ]

    def images(self, key: str) -> Words:
        """Read the images of a list of file names: array of shape (frame, y, x), uint16."""
        value = self._get(key)
        if not isinstance(value, list) or not value:
            raise self._wrong(key, "a list of file names")
        return _read_images(self.path.parent, cast("Sequence[object]", value))


def _read_images(folder: Path, names: Sequence[object]) -> Words:
    images: list[Words] = []
    for name in names:
        path = folder / str(name)
        try:
            images.append(read_png16(path))
        except (StorageError, OSError) as error:
            named = error if isinstance(error, StorageError) else f"{path}: {error}"
            raise BenchError(f"{named}; {RECORD} lists it, so take it again or mend the list") from None
        if images[-1].shape != images[0].shape:
            raise BenchError(
                f"{path}: got {images[-1].shape} pixels, expected {images[0].shape} as {names[0]} has; "
                "take all images with the same full CCD frame"
            )
    return np.stack(images)
