"""One image a frame: EXR and PNG, as stored, without any rescaling."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np

from optsim.core.errors import ConfigError, unknown_name
from optsim.core.foreign.exr import ExrPart, exr_parts, light_channels
from optsim.core.foreign.h273 import primaries_at
from optsim.core.foreign.png import png_head, png_pixels
from optsim.footage.recording.film import FileStatement, Pixels, with_channels


def exr(path: Path, key: str | None) -> Pixels:
    """Read channel ``key``, PART or PART.CHANNEL, else R, G, B, else Y or the only one: (y, x, channel)."""
    part, channel = _chosen(path, exr_parts(path), key)
    names = [channel] if channel is not None else _light(path, part, part.stored)
    channels = part.pixels(path)
    return np.stack([channels[name] for name in names], axis=-1)


def exr_statement(path: Path, key: str | None) -> FileStatement:
    """Return the primaries that the chosen part states."""
    part, _ = _chosen(path, exr_parts(path), key)
    declared = part.header.get("chromaticities")
    if declared is None:
        return FileStatement()
    return FileStatement(None, primaries_at(np.ravel(declared)[:6].tolist()))


def png(path: Path) -> Pixels:
    """Read grey or colour of 8 or 16 bits, array (y, x, channel)."""
    return with_channels(png_pixels(path, png_head(path)))


def png_statement(path: Path) -> FileStatement:
    """Return the curve and primaries that the chunks state."""
    head = png_head(path)
    return FileStatement(head.curve, head.primaries)


def _chosen(path: Path, parts: Sequence[ExrPart], key: str | None) -> tuple[ExrPart, str | None]:
    """Part that ``key`` selects, and its channel if one is named."""
    if len(parts) == 1:
        if key is not None and key not in parts[0].stored:
            raise unknown_name(f"source.footage.key of {path.name}", key, parts[0].stored)
        return parts[0], key
    for part in parts:
        if key == part.name:
            return part, None
    named = [(part, name) for part in parts for name in part.stored if key in (name, f"{part.name}.{name}")]
    if len(named) == 1:
        return named[0]
    held = ", ".join(f"{part.name} ({', '.join(sorted(part.stored))})" for part in parts)
    raise ConfigError(
        f"source.footage.key: {'missing' if key is None else f'got {key!r}'}; {path.name} holds the parts "
        f"{held}; expected the name of one, as PART or PART.CHANNEL"
    )


def _light(path: Path, part: ExrPart, channels: Collection[str]) -> list[str]:
    """Names of the channels of light."""
    if names := light_channels(channels):
        return names
    where = path.name + (f", part {part.name}," if part.name else "")
    raise ConfigError(
        f"source.footage.key: missing; {where} holds the channels {', '.join(sorted(channels))}"
    )
