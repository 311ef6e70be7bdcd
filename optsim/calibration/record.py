"""Read the manifest of a bench folder; its error messages name the file, the key and the cure."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.calibration.choice import BENCH_FILE
from optsim.core.errors import BenchError, OptsimError, StorageError, ValueCheckError, nearest_name
from optsim.core.files import read_json, read_words
from optsim.core.quantities import Words

RECORD = BENCH_FILE


@dataclass(frozen=True)
class JsonTable:
    """A JSON object with its place, so that every message names the file and the key."""

    path: Path
    place: str
    items: Mapping[str, Any]

    def _get(self, key: str) -> object:
        if key not in self.items:
            raise BenchError(f"{self.path}: {self.place}{key} is missing; cure: add it")
        return self.items[key]

    def wrong(self, key: str, expected: str) -> BenchError:
        """Make the error for a value of another kind."""
        got = repr(self.items[key])[:60]
        return BenchError(f"{self.path}: {self.place}{key}: got {got}, expected {expected}; cure: correct it")

    def only(self, known: Sequence[str]) -> None:
        """Refuse keys that nothing reads."""
        for key in self.items:
            if key not in known:
                near = nearest_name(known, key)
                cure = f"did you mean {near!r}? Or put it into about" if near else "put it into about"
                raise BenchError(f"{self.path}: {self.place}{key}: got an unknown key; cure: {cure}")

    def stated(self, key: str, only: str) -> None:
        """Refuse another value than the only one; the key may be absent."""
        if self.items.get(key, only) != only:
            raise self.wrong(key, f"{only!r}, as all images are")

    def positive(self, key: str) -> float:
        """Return a number above 0."""
        value = self.number(key)
        if not 0 < value < math.inf:
            raise self.wrong(key, "a number above 0")
        return value

    def level(self, key: str) -> int:
        """Return a drive level, 0..255."""
        value = self.number(key)
        if value not in range(256):
            raise self.wrong(key, "a drive level, a whole number from 0 to 255")
        return int(value)

    def number(self, key: str) -> float:
        """Return a number, whole or not."""
        value = self._get(key)
        if not isinstance(value, int | float) or isinstance(value, bool):
            raise self.wrong(key, "a number")
        return value

    def integers(self, key: str, *, length: int | None = None) -> tuple[int, ...]:
        """Return one or more whole numbers, ``length`` of them if given."""
        value = self._get(key)
        numbers = cast("list[object]", value) if isinstance(value, list) else []
        if not numbers or not all(isinstance(n, int) for n in numbers) or length not in (None, len(numbers)):
            raise self.wrong(key, f"a list of {length or 'one or more'} whole numbers")
        return tuple(cast("list[int]", numbers))

    def table(self, key: str) -> JsonTable:
        """Return the object inside."""
        value = self._get(key)
        if not isinstance(value, dict):
            raise self.wrong(key, "an object")
        return JsonTable(self.path, f"{self.place}{key}.", cast("dict[str, Any]", value))

    def tables(self, key: str) -> list[JsonTable]:
        """Return a list of objects, maybe empty."""
        value = self._get(key)
        if not isinstance(value, list):
            raise self.wrong(key, "a list of objects")
        items = cast("list[object]", value)
        if not all(isinstance(item, dict) for item in items):
            raise self.wrong(key, "a list of objects")
        return [
            JsonTable(self.path, f"{self.place}{key}[{i}].", cast("dict[str, Any]", item))
            for i, item in enumerate(items)
        ]

    def files(self, key: str) -> tuple[str, ...]:
        """Return the paths of a list of file names, relative ones from the manifest's folder."""
        value = self._get(key)
        names = cast("list[object]", value) if isinstance(value, list) else []
        if not names or not all(isinstance(name, str) for name in names):
            raise self.wrong(key, "a list of file names")
        return tuple(str(self.path.parent / str(name)) for name in names)

    def images(self, key: str) -> Words:
        """Read the images of a list of file names: array of shape (frame, y, x), uint16."""
        return _read_images(self.files(key), f"{self.place}{key}")


def read_record(folder: Path, form: str) -> JsonTable:
    """Read the manifest of a bench folder."""
    path = folder / RECORD
    try:
        record = cast("object", read_json(path))
    except StorageError as error:
        raise BenchError(f"{error}; a bench folder needs {RECORD} beside its images") from None
    if not isinstance(record, dict) or cast("dict[str, Any]", record).get("format") != form:
        raise BenchError(
            f'{path}: expected a JSON object with "format": {json.dumps(form)}; cure: write it as '
            "docs/how-to/calibration.md says"
        )
    return JsonTable(path, "", cast("dict[str, Any]", record))


def _read_images(paths: Sequence[str], place: str) -> Words:
    images: list[Words] = []
    for path in paths:
        try:
            images.append(read_words(Path(path)))
        except (StorageError, ValueCheckError, OSError) as error:
            named = error if isinstance(error, OptsimError) else f"{path}: {error}"
            raise BenchError(
                f"{named}; {RECORD} lists it under {place}, so take it again or mend the list"
            ) from None
        if images[-1].shape != images[0].shape:
            raise BenchError(
                f"{path}: got {images[-1].shape} pixels, expected {images[0].shape} as {paths[0]} has; "
                "cure: take all images with the same full CCD frame"
            )
    return np.stack(images)
