"""A recording: its frames as stored, one by one, each checked against the first."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from numpy.typing import NDArray

from optsim.core.errors import StorageError, ValueCheckError

Pixels = NDArray[Any]
_DTYPES = ("uint8", "uint16", "uint32", "uint64", "int16", "int32", "int64", "float16", "float32", "float64")
RAW_COUNTS = "raw counts of DNG"
"""The curve of a sensor's counts with its black level."""


class FileStatement(NamedTuple):
    """Statements of files on their values, each None without a statement.

    Parameters
    ----------
    curve : str or None
        "linear", "srgb", :data:`RAW_COUNTS`, or the name of another curve from light to stored value.
    primaries : str or None
        "BT.709", or the name or place of other primaries of R, G and B.
    """

    curve: str | None = None
    primaries: str | None = None


_NOTHING_SAID = FileStatement()


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames as stored, in order of time; at most one array or one frame is in memory.

    Parameters
    ----------
    files : tuple of Path
        One file a frame, or one file of all frames.
    n_frames : int
        Number of stored frames.
    shape : tuple of int
        Rows, columns and channels of each.
    dtype : str
        Dtype of the stored values.
    bits : int
        Original bits of a stored value: those of a video are decoded to 16.
    frames : callable
        First frame -> iterator over the frames from there, each an array of ``shape``.
    declared : FileStatement
        Statements of the files on their values.
    """

    files: tuple[Path, ...]
    n_frames: int
    shape: tuple[int, int, int]
    dtype: str
    bits: int
    frames: Callable[[int], Iterator[Pixels]]
    declared: FileStatement = _NOTHING_SAID

    def where(self, frame: int) -> str:
        """File and number of a frame, which identify it in messages and elsewhere."""
        return f"{self.files[0]}, frame {frame}" if len(self.files) == 1 else f"{self.files[frame]}"

    def read(self, first: int) -> Iterator[Pixels]:
        """Read frames from ``first`` on, each checked against the first of all.

        Raises
        ------
        ValueCheckError
            When a frame has another size or dtype than the first one.
        StorageError
            When a file ends early or cannot be read.
        """
        seen = first
        for values in self.frames(first):
            if values.shape != self.shape or values.dtype.name != self.dtype:
                raise ValueCheckError(
                    f"{self.where(seen)}: {_said(*values.shape)} of {values.dtype.name}, but the recording "
                    f"starts with {_said(*self.shape)} of {self.dtype}; all frames must be alike"
                )
            yield values
            seen += 1
        if seen < self.n_frames:
            raise StorageError(
                f"{self.files[0]} ends after {seen} of {self.n_frames} frames; copy it again, whole"
            )


def as_recording(
    files: tuple[Path, ...],
    n_frames: int,
    frames: Callable[[int], Iterator[Pixels]],
    bits: int | None = None,
    declared: FileStatement = _NOTHING_SAID,
) -> Recording:
    """Make a recording from its reader, after a check of the first frame."""
    first = next(frames(0), None)
    if first is None or n_frames == 0 or first.size == 0:
        raise StorageError(f"{files[0]} holds no frames")
    if first.dtype.name not in _DTYPES:
        raise ValueCheckError(f"{files[0]} holds {first.dtype.name}; expected one of {', '.join(_DTYPES)}")
    rows, cols, channels = (int(n) for n in first.shape)
    bits = bits or 8 * first.dtype.itemsize
    return Recording(files, n_frames, (rows, cols, channels), first.dtype.name, bits, frames, declared)


def with_channels(values: Pixels) -> Pixels:
    """Add a channel axis to a grey frame, array (y, x)."""
    return values[..., None] if values.ndim == 2 else values


def _said(rows: int, cols: int, channels: int) -> str:
    return f"{rows} x {cols}" + (f" x {channels} channels" if channels > 1 else "")
