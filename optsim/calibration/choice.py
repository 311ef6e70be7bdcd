"""Calibration choice of an experiment: source of the calibration, and size of the readout window."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, NamedTuple, cast

from pydantic import AfterValidator, BeforeValidator, Field

from optsim.core.config import Table
from optsim.core.errors import StorageError, nearest_name

# Widest readout window over a panel pixel: a sensible default, no source.
_WIDEST = 1.2

OPERATORS = ("bench", "true", "ideal")
CALIBRATION_FILE = "calibration.npz"
BENCH_FILE = "bench.json"
_PATHS = f"the path of a {CALIBRATION_FILE} (or of the run folder that holds it) or of a bench folder"


def _true_is_a_word(value: object) -> object:
    """Read ``calibration=true``, a truth value in TOML, as the word "true"."""
    return "true" if value is True else value


def _word_or_path(value: str) -> str:
    """Refuse an unknown word; accept the path of a file, which may be on another machine."""
    if value in OPERATORS:
        return value
    path = Path(value).expanduser()
    if not _is_path(value) and not path.exists():
        near = nearest_name(OPERATORS, value)
        cure = f"did you mean {near!r}? Or name {_PATHS}" if near else f"or name {_PATHS}"
        raise ValueError(f"expected one of: {', '.join(OPERATORS)}; {cure}")
    return str(in_folder(path))


def _is_path(value: str) -> bool:
    """Tell a path from a word: paths have a slash or the suffix of a file."""
    return "/" in value or value.endswith((".npz", ".json"))


# Source of the calibration: measured on the bench, true parameters, the paper's equations, or a file.
Operator = Annotated[
    Literal["bench", "true", "ideal"] | str, BeforeValidator(_true_is_a_word), AfterValidator(_word_or_path)
]


def _with_a_middle(value: int) -> int:
    if value % 2 == 0:
        raise ValueError("expected an odd number: a square around the pixel at the centre")
    return value


# Side of the readout window, CCD pixels.
ReadingPx = Annotated[int, Field(ge=1, le=9), AfterValidator(_with_a_middle)]


class CalibrationChoice(NamedTuple):
    """Source of the calibration for schemes and decoders, and their readout window."""

    operator: str  # bench, true, ideal, or a file (:func:`stored_file`)
    reading_px: int  # side of the readout window, CCD pixels

    @property
    def file(self) -> Path | None:
        """File that holds it, a calibration's or a bench's record; None if it is made anew."""
        return None if self.operator in OPERATORS else Path(self.operator)

    def __str__(self) -> str:
        """Name it in reports."""
        square = f", {self.reading_px} x {self.reading_px} CCD pixels read" if self.reading_px > 1 else ""
        return self.operator + square


def stored_file(path: Path) -> Path:
    """Find the file of a stored calibration or bench record, from its own path or its folder's."""
    found = in_folder(path.expanduser())
    if not found.exists():
        raise StorageError(f"calibration: no such file or folder: {path}; expected {_PATHS}")
    if not found.is_file():
        raise StorageError(
            f"calibration: {path} holds neither {CALIBRATION_FILE} nor {BENCH_FILE}; expected {_PATHS}"
        )
    return found


def resolve_stored(table: Table, folder: Path) -> None:
    """Resolve the relative paths of calibrations from the experiment's own folder."""
    methods: object = table.get("methods")
    for each in (table, *(cast("list[object]", methods) if isinstance(methods, list) else ())):
        held = cast("Table", each) if isinstance(each, dict) else {}
        path = held.get("calibration")
        if isinstance(path, str) and path not in OPERATORS:
            found = folder / Path(path).expanduser()
            held["calibration"] = str(found) if _is_path(path) or found.exists() else path


def in_folder(path: Path) -> Path:
    """Find the calibration or bench file of a folder; else return the path itself."""
    return next((path / name for name in (CALIBRATION_FILE, BENCH_FILE) if (path / name).is_file()), path)


def widest_reading(ratio: float) -> int:
    """Widest readout window allowed at a number of CCD pixels per panel pixel, CCD pixels."""
    return max(1, int((_WIDEST * ratio - 1) // 2) * 2 + 1)
