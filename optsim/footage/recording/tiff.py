# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""TIFF files page by page (TIFF 6.0), and DNG: a tag on the stored numbers is honoured or refused."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from optsim.core.errors import StorageError
from optsim.core.foreign.h273 import primaries_at
from optsim.core.foreign.tiff import grey_pixels, opened, page_pixels
from optsim.footage.recording.film import RAW_COUNTS, FileStatement, Pixels, Recording, as_recording


def tiff(path: Path) -> Pixels:
    """Read a TIFF file of one frame, array (y, x, channel)."""
    stack = tiff_stack(path)
    if stack.n_frames > 1:
        raise StorageError(f"{path} holds {stack.n_frames} frames; in a folder of images each file holds one")
    return next(stack.frames(0))


def tiff_stack(path: Path) -> Recording:
    """Open a TIFF file of one page a frame."""
    if path.suffix.lower() == ".dng":
        counts = FileStatement(RAW_COUNTS)
        return as_recording((path,), 1, lambda _: iter([grey_pixels(path)[..., None]]), declared=counts)
    with opened(path) as tiff:
        n_frames = len(tiff.pages)
        if n_frames == 0:
            raise StorageError(f"{path} holds no frames")
        axes = {
            axis: size
            for series in tiff.series
            for axis, size in zip(series.axes, series.shape, strict=True)
            if axis not in "YXS" and size > 1
        }
        n_planes = sum(
            int(np.prod([n for n, axis in zip(s.shape, s.axes, strict=True) if axis not in "YXS"]))
            for s in tiff.series
        )
        declared = _statement(tiff.pages[0].aspage())
    if len(axes) > 1 or "C" in axes:
        said = ", ".join(f"{axis} ({size})" for axis, size in axes.items())
        raise StorageError(
            f"{path} says that its pages run along {said}; cure: write one page a frame, in time"
        )
    if n_planes != n_frames:
        raise StorageError(f"{path}: {n_planes} frames in {n_frames} pages; cure: write one page a frame")

    def pages(first: int) -> Iterator[Pixels]:
        with opened(path) as tiff:
            for index, page in enumerate(islice(tiff.pages, first, None), first):
                yield page_pixels(f"{path}, page {index}", page.aspage(), path.stat().st_size)

    return as_recording((path,), n_frames, pages, declared=declared)


def _statement(page: Any) -> FileStatement:
    """Curve and primaries that the tags TransferFunction and PrimaryChromaticities state."""
    curve = "that of tag TransferFunction" if 301 in page.tags else None
    declared = page.tags.valueof(319)
    if declared is None:
        return FileStatement(curve)
    found = np.reshape(np.asarray(declared, float), (-1, 2))
    places = found[:, 0] / found[:, 1]
    return FileStatement(curve, primaries_at(places.tolist()))
