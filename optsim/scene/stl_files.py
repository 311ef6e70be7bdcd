"""STL files, binary by their size or text."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from optsim.scene.model_surface import Surface, SurfacePiece

_HEAD = 84
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: Path) -> tuple[list[SurfacePiece], str]:
    """Read the one piece of a file, and what is left out: colours, which programs put in several ways."""
    content, lost = path.read_bytes(), ""
    count = int.from_bytes(content[80:_HEAD], "little") if len(content) >= _HEAD else -1
    if len(content) == _HEAD + count * _FACET.itemsize:
        facets = np.frombuffer(content, _FACET, count, _HEAD)
        corners = facets["corners"].astype(np.float64)
        if facets["attribute"].any() or b"COLOR=" in content[:80]:
            lost = "colours of faces"
    elif content[:1024].lstrip()[:5].lower() == b"solid" and b"facet" in content.lower():
        words = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content, re.IGNORECASE)
        if (
            not words
            or len(words) % 3
            or len(re.findall(rb"\bendfacet", content, re.IGNORECASE)) * 3 != len(words)
        ):
            raise ValueError(f"it has {len(words)} vertices, expected three for each facet, to its end")
        corners = np.array(words).astype(np.float64).reshape(-1, 3, 3)
    else:
        raise ValueError(
            f"it is no text, and holds {len(content)} bytes, "
            f"expected {_HEAD} and 50 for each of {max(count, 0)} faces"
        )
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return [SurfacePiece("facets", Surface(), corners.reshape(-1, 3), faces)], lost
