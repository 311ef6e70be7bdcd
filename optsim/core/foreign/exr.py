# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""OpenEXR files part by part; what their headers declare about pixels is honoured or refused."""

from __future__ import annotations

import io
from collections.abc import Collection, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import StorageError, ValueCheckError
from optsim.core.foreign import check_memory, one_line, reading

_WHAT = "OpenEXR"
# Names of depth and opacity, reserved by the format or usual, and of what is no light; in capitals.
_NO_LIGHT = {"Z", "ZBACK", "A", "AR", "AG", "AB", "ALPHA", "DEPTH", "MASK", "ID", "X", "U"}
# The library prints damage to stderr: one reader at a time may capture it.
_PRINTED = Lock()


@dataclass(frozen=True, eq=False)
class ExrPart:
    """A part of a file: name (empty if the only part), kind, header, and channels by name as stored."""

    name: str
    kind: str
    header: Mapping[str, Any]
    stored: Mapping[str, NDArray[Any]]

    def pixels(self, path: Path) -> dict[str, NDArray[Any]]:
        """Channels by name, (y, x): uint32 where stored so (ids), otherwise float32.

        Raises
        ------
        ValueCheckError
            For deep, subsampled or non-square pixels, and for a data window other than the display window.
        """
        where = f"{path}: part {self.name}" if self.name else str(path)
        if self.kind.startswith("deep"):
            raise ValueCheckError(
                f"{where} is deep ({self.kind}), expected one value a pixel; cure: flatten it"
            )
        data, display = (
            tuple(int(n) for corner in self.header[key] for n in corner)
            for key in ("dataWindow", "displayWindow")
        )
        if data != display:
            raise ValueCheckError(
                f"{where}: dataWindow is {_window(data)}, expected the displayWindow, {_window(display)}; "
                "cure: write the whole picture, neither a crop nor an overscan"
            )
        aspect = float(self.header.get("pixelAspectRatio", 1.0))
        if abs(aspect - 1) > 1e-3:
            raise ValueCheckError(
                f"{where}: pixelAspectRatio is {aspect:g}, expected 1; cure: scale it to square pixels"
            )
        shape = (data[3] - data[1] + 1, data[2] - data[0] + 1)
        for name, values in self.stored.items():
            if values.shape != shape:
                raise ValueCheckError(
                    f"{where}: channel {name} is subsampled to {values.shape[0]} x {values.shape[1]} values, "
                    f"expected one for each of {shape[0]} x {shape[1]} pixels; cure: write it at full size"
                )
        return {name: _owned(values) for name, values in self.stored.items()}


def exr_header(path: Path) -> dict[str, Any]:
    """Read the header of a file's first part, without any pixel; errors as of :func:`exr_parts`."""
    import OpenEXR

    with reading(path, _WHAT), OpenEXR.File(_source(path), header_only=True) as stream:
        return dict(cast("Mapping[str, Any]", stream.parts[0].header))


def exr_parts(path: Path) -> list[ExrPart]:
    """Read every part of a file.

    Raises
    ------
    StorageError
        When the file is missing or unreadable, or one of its parts is: the library would leave that one out.
    """
    import OpenEXR

    printed = io.StringIO()
    with reading(path, _WHAT), _PRINTED, redirect_stdout(printed):
        if not path.is_file():
            raise StorageError(f"no such file: {path}")
        with OpenEXR.File(_source(path), separate_channels=True, header_only=True) as stream:
            heads = [dict(cast("Mapping[str, Any]", part.header)) for part in stream.parts]
            check_memory(path, sum(_declared(head) for head in heads), _WHAT)
        with OpenEXR.File(_source(path), separate_channels=True) as stream:
            found = [
                ExrPart(part.name(), _kind(part), head, {name: c.pixels for name, c in part.channels.items()})
                for head, part in zip(heads, stream.parts, strict=False)
            ]
    if len(found) != len(heads) or not found:
        why = one_line(RuntimeError(printed.getvalue().replace("Warning: Exception raised", "error")))
        raise StorageError(
            f"{path} cannot be read as {_WHAT}: {len(heads) - len(found)} of {len(heads)} parts are damaged "
            f"({why}); cure: copy it again, whole"
        )
    return found


def light_channels(channels: Collection[str]) -> list[str]:
    """Names of the channels of light: R, G and B, else Y, else the only one; none where it is unclear."""
    if {"R", "G", "B"} <= set(channels):
        return ["R", "G", "B"]
    # Beside X it is a place or CIE's Y; beside RY and BY it has lost its colour.
    if "Y" in channels:
        return [] if {"X", "RY", "BY"} & set(channels) else ["Y"]
    words = {word for name in channels for word in name.upper().split(".")}
    return list(channels) if len(channels) == 1 and not _NO_LIGHT & words else []


def only_part(path: Path, cure: str) -> ExrPart:
    """Read the one part of a file; errors as of :func:`exr_parts`, and one that names several."""
    found = exr_parts(path)
    if len(found) > 1:
        raise StorageError(
            f"{path} holds the parts {', '.join(part.name for part in found)}, expected one; cure: {cure}"
        )
    return found[0]


def _kind(part: Any) -> str:
    return str(part.type()).rpartition(".")[2]


def _declared(head: Mapping[str, Any]) -> float:
    """Bytes of a part's pixels in memory by its header; a lower bound for deep ones."""
    low, high = head["dataWindow"]
    return (
        float(np.prod([float(b) - float(a) + 1 for a, b in zip(low, high, strict=True)]))
        * 4
        * len(head["channels"])
    )


def _owned(pixels: NDArray[Any]) -> NDArray[Any]:
    """Copy a channel; float32 has too few digits for ids above 2^24, so integers stay."""
    return np.array(pixels, np.uint32 if pixels.dtype == np.uint32 else np.float32, order="C")


def _window(corners: tuple[int, ...]) -> str:
    return f"({corners[0]}, {corners[1]}) to ({corners[2]}, {corners[3]})"


def _source(path: Path) -> Any:
    """Return a path that the binding accepts, or the content of a file whose name is not UTF-8."""
    try:
        str(path).encode()
    except UnicodeEncodeError:
        return io.BytesIO(path.read_bytes())
    return str(path)
