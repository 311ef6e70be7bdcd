"""Extrapolate a late motion mask: each region is dilated along its own motion, ahead to the coded frame.

The mask is made from frames that arrived, which are late by the latency. The paper's mask stays behind the
motion. This extrapolation is the project's own (no source).
"""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Bools, Doubles, Ints
from optsim.optics.neighbourhoods import regions

# A jump of more than this many object lengths counts as another object: a sensible default, no source.
# Without a limit two distant false alarms would be one object that crosses the panel.
_FURTHEST_LENGTHS = 3.0


def swept_ahead(mask: Bools, before: Bools, frames_ahead: float) -> Bools:
    """Sweep each region along its displacement, straight on and up to ``frames_ahead`` times as far."""
    # A region cut by the panel's edge, or just merged or split, follows its centroid.
    places, displacements = region_displacements(mask, before)
    swept = mask.copy()
    for (v, u), displacement in zip(places, displacements, strict=True):
        if not np.isfinite(displacement).all():
            continue
        moved = frames_ahead * displacement
        # A step of at most one pixel on either axis leaves no gaps.
        for share in np.linspace(0, 1, int(np.ceil(np.abs(moved).max())) + 1)[1:]:
            dv, du = np.rint(share * moved).astype(int)
            on_panel = (v + dv >= 0) & (v + dv < mask.shape[0]) & (u + du >= 0) & (u + du < mask.shape[1])
            swept[v[on_panel] + dv, u[on_panel] + du] = True
    return swept


def region_displacements(mask: Bools, before: Bools) -> tuple[list[tuple[Ints, Ints]], Doubles]:
    """Displacement of each region's centroid since the mask before; NaN if unknown.

    Two successive masks share the frame between them. So a region overlaps its predecessor unless it moves by
    more than its length in a frame. If it does, the shared frame's region stays, and a new one comes from it.
    Without overlap the predecessor is the nearest region within three lengths.
    """
    (now, n_now), (then, n_then) = regions(mask), regions(before)
    places = _places(now, n_now)
    displacements = np.full((n_now, 2), np.nan)
    if n_then == 0:
        return places, displacements
    middles_then = np.array([(v.mean(), u.mean()) for v, u in _places(then, n_then)])
    for n, (v, u) in enumerate(places):
        shifts = np.array([v.mean(), u.mean()]) - middles_then
        overlaps = np.bincount(then[v, u], minlength=n_then + 1)[1:]
        distances = np.hypot(*shifts.T)
        if overlaps.any():
            displacements[n] = shifts[overlaps.argmax()]
        elif distances.min() <= _FURTHEST_LENGTHS * (max(np.ptp(v), np.ptp(u)) + 1):
            displacements[n] = shifts[distances.argmin()]
    return places, displacements


def _places(labels: Ints, n: int) -> list[tuple[Ints, Ints]]:
    """Rows and columns of the pixels of regions 1 to n, found in one pass."""
    if n == 0:
        return []
    v, u = np.nonzero(labels)
    numbers = labels[v, u]
    order = np.argsort(numbers, kind="stable")
    cuts = np.cumsum(np.bincount(numbers, minlength=n + 1)[1:])[:-1]
    return list(zip(np.split(v[order], cuts), np.split(u[order], cuts), strict=True))
