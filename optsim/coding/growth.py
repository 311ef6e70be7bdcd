# pyright: reportMissingTypeStubs=false
"""Extrapolate a late motion mask: each region is moved along its own motion, ahead to the coded frame.

The mask is made from frames that arrived, which are late by the latency. The paper's mask stays behind the
motion. This extrapolation is the project's own (no source).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np

from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.optics.neighbourhoods import dilated, regions

# Reach by which changed fragments of a mover join; blur of masks that are compared, and its room; panel px.
_JOIN_PX, _BLUR_PX, _ROOM_PX = 8, 2.0, 8
# A jump of more than this many object lengths counts as another object: a sensible default, no source.
# Without a limit two distant false alarms would be one object that crosses the panel.
_FURTHEST_LENGTHS = 3.0
# Of its way ahead, a region covers this last share: it may be slower than it was.
_COVERED = 0.5


def swept_ahead(mask: Bools, before: Bools, frames_ahead: float) -> Bools:
    """Add to a mask where each region will be: the last half of ``frames_ahead`` times its displacement."""
    places, displacements = region_displacements(mask, before)
    swept = mask.copy()
    for (v, u), displacement in zip(places, displacements, strict=True):
        if not np.isfinite(displacement).all():
            continue
        moved = frames_ahead * displacement
        # A step of at most one pixel on either axis leaves no gaps.
        for share in np.linspace(1 - _COVERED, 1, int(np.ceil(_COVERED * np.abs(moved).max())) + 1):
            dv, du = np.rint(share * moved).astype(int)
            on_panel = (v + dv >= 0) & (v + dv < mask.shape[0]) & (u + du >= 0) & (u + du < mask.shape[1])
            swept[v[on_panel] + dv, u[on_panel] + du] = True
    return swept


def region_displacements(mask: Bools, before: Bools) -> tuple[list[tuple[Ints, Ints]], Doubles]:
    """Pixels of each region of a mask, and its displacement since the mask before; NaN if unknown.

    A region's fragments are joined, and its displacement is where both masks correlate best. Two successive
    masks share the frame between them, so a mover's own place counts once, and its displacement twice. A
    mover that leaves its joined region in a frame comes from the nearest one within three lengths.
    """
    labels, n = regions(dilated(mask | before, _JOIN_PX))
    now, then = _places(np.where(mask, labels, 0), n), _places(np.where(before, labels, 0), n)
    middles_then = np.array([(v.mean(), u.mean()) for v, u in then if v.size])
    there = [k for k in range(n) if now[k][0].size]
    displacements = np.full((len(there), 2), np.nan)
    for displacement, k in zip(displacements, there, strict=True):
        v, u = now[k]
        if then[k][0].size:
            displacement[:] = _correlated(now[k], then[k])
        elif middles_then.size:
            shifts = np.array([v.mean(), u.mean()]) - middles_then
            distances = np.hypot(*shifts.T)
            if distances.min() <= _FURTHEST_LENGTHS * (max(np.ptp(v), np.ptp(u)) + 1):
                displacement[:] = shifts[distances.argmin()]
    return [now[k] for k in there], displacements


def _correlated(now: tuple[Ints, Ints], then: tuple[Ints, Ints]) -> Doubles:
    """Displacement at which the blurred pixels of one mask lie best on those of the other."""
    from scipy import ndimage, signal

    # With room for the blur: a cut one would draw the displacement towards zero.
    low = np.min([np.min(each, axis=1) for each in (now, then)], axis=0) - _ROOM_PX
    shape = np.max([np.max(each, axis=1) for each in (now, then)], axis=0) - low + 1 + _ROOM_PX
    pictures: list[Floats] = []
    for v, u in (now, then):
        picture = np.zeros(shape, np.float32)
        picture[v - low[0], u - low[1]] = 1
        blur = cast("Callable[..., Floats]", ndimage.gaussian_filter)
        pictures.append(blur(picture, _BLUR_PX, mode="constant"))
    likeness: Floats = cast("Any", signal).correlate(*pictures, mode="full", method="fft")
    return np.array(np.unravel_index(int(likeness.argmax()), likeness.shape)) - (shape - 1.0)


def _places(labels: Ints, n: int) -> list[tuple[Ints, Ints]]:
    """Rows and columns of the pixels of regions 1 to n, found in one pass."""
    v, u = np.nonzero(labels)
    numbers = labels[v, u]
    order = np.argsort(numbers, kind="stable")
    cuts = np.cumsum(np.bincount(numbers, minlength=n + 1)[1:])[:-1]
    return list(zip(np.split(v[order], cuts), np.split(u[order], cuts), strict=True)) if n else []
