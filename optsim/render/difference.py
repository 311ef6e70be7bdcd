"""Difference rendering with common random numbers: the change that movers cause outside their own pixels.

Control variate (J. M. Hammersley and D. C. Handscomb, "Monte Carlo Methods", Methuen 1964, ch. 5): F_n - B_n,
the same n random paths with and without movers, has almost no noise wherever few paths meet a mover. Paths
that never come near a mover (``nearby``) are not traced again: their difference is zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.core.quantities import Bools, Doubles, Floats, Ints
from optsim.render.allocation import Statistics, smoothed, tally
from optsim.render.nearby import boxes_around
from optsim.render.plan import RenderPlan
from optsim.render.stage import RenderStage

_MOST = 32
_PILOT_SAMPLES = 2
# Relative cost of a path that is looked up instead of traced again.
_LOOK_UP = 0.03


@dataclass(frozen=True, eq=False)
class _TracedPaths:
    """Paths without movers: a range of the samples of some pixels; (n, sample)."""

    radiance: Floats
    near: Bools


class Difference:
    """The scene with movers, without them, and with boxes around them; caches paths traced without them."""

    def __init__(self, plan: RenderPlan, static: Floats) -> None:
        times_s = np.asarray([plan.time_s(slot) for slot in range(plan.timing.n_slots + 1)])
        boxes = boxes_around(plan.scene, times_s, plan.view.aperture_m / 2)
        seen, azimuth_rad = (plan.scene, plan.view), plan.azimuth_rad
        self.moving = RenderStage(*seen, boxes=boxes, azimuth_rad=azimuth_rad)
        self._plan, self._boxes, self._static = plan, boxes, static.mean(axis=0).ravel()
        self._still = RenderStage(*seen, movers=False, boxes=boxes, azimuth_rad=azimuth_rad)
        self._around = RenderStage(*seen, movers=False, boxes=boxes, glow=True, azimuth_rad=azimuth_rad)
        # (turn, half, level) -> row of each pixel, and its paths. Only a cache: paths are keyed by pixel, so
        # the order of tracing has no effect.
        self._traced: dict[tuple[object, int, int], tuple[Ints, _TracedPaths]] = {}
        entry = plan.cache.get(plan.key("near", plan.timing.n_slots), self._near_share)
        self._cost = np.array(entry["share"]).ravel() + np.float32(_LOOK_UP)

    def counts(self, statistics: Statistics, pixels: Ints, target: float) -> Floats:
        """Allocate samples a half to some pixels, from statistics of other random numbers."""
        cost = self._cost[pixels]
        return self._plan.counts(
            statistics, pixels, self._static[pixels], target, least=1, most=_MOST, cost=cost
        )

    def pilot(self, time_s: float, pixels: Ints) -> Statistics:
        """Statistics at an instant, from separate random numbers."""
        return self.change(time_s, pixels, np.full(len(pixels), _PILOT_SAMPLES, np.float32), "pilot")[1]

    def change(self, time_s: float, pixels: Ints, counts: Floats, turn: object) -> tuple[Doubles, Statistics]:
        """Render the change that movers cause at an instant, in some pixels."""
        all_near = self._boxes is None or not self._boxes.hold(self._plan.scene, time_s)
        self.trace_without(turn, pixels, counts)
        where: list[Ints] = []
        first: list[Ints] = []
        before: list[Floats] = []
        for part, level, here in _wanted(counts):
            rows, paths = self._traced[turn, part, level]
            at = rows[pixels[here]]
            row, sample = np.nonzero(paths.near[at] | all_near)
            where.append(here[row] + part * len(pixels))
            first.append(sample + (1 << level >> 1))
            before.append(paths.radiance[at[row], sample])
        place = np.concatenate(where)
        seeds = np.asarray(self._plan.seeds("key", turn), np.int64)
        half, which = np.divmod(place, max(1, len(pixels)))
        self.moving.pose(time_s)
        once = np.ones(len(place), np.int64)
        seen = self.moving.paths(pixels[which], once, seeds[half], np.concatenate(first))
        difference = seen - np.concatenate(before)
        n, total = counts.astype(np.float64), 2 * len(pixels)
        added = np.bincount(place, difference, total).reshape(2, -1)
        squared = np.bincount(place, difference**2, total).reshape(2, -1).sum(axis=0)
        variance = np.maximum(squared - added.sum(axis=0) ** 2 / (2 * n), 0) / (2 * n - 1)
        change = added / n
        light = self._static[pixels] + change.mean(axis=0)
        return change, tally(self._plan.shape, pixels, variance, light)

    def trace_without(self, turn: object, pixels: Ints, counts: Floats) -> None:
        """Trace paths without movers ahead of a ``change``; known paths aren't traced again."""
        self._trace_new(turn, [(half, level, pixels[here]) for half, level, here in _wanted(counts)])

    def _trace_new(self, turn: object, wanted: list[tuple[int, int, Ints]]) -> None:
        """Trace new paths without movers, for (half, level, pixels)."""
        # Level 0 is path 0 of a pixel, 1 is path 1, 2 paths 2 and 3, 3 paths 4 to 7, ...
        asks: list[Ints] = []
        for half, level, pixels in wanted:
            first, width = _stretch(level)
            if (turn, half, level) not in self._traced:
                nothing = np.zeros((0, width), np.float32)
                rows = np.full(len(self._static), -1, np.int64)
                self._traced[turn, half, level] = rows, _TracedPaths(nothing, nothing.astype(np.bool_))
            rows, paths = self._traced[turn, half, level]
            new = pixels[rows[pixels] < 0]
            rows[new] = len(paths.radiance) + np.arange(len(new))
            seeds = np.full(len(new) * width, self._plan.seeds("key", turn)[half])
            asks.append(np.stack([np.repeat(new, width), seeds, np.tile(first + np.arange(width), len(new))]))
        ask = np.concatenate(asks, axis=1)
        if not ask.size:
            return
        once = np.ones(ask.shape[1], np.int64)
        found = self._still.paths(ask[0], once, *ask[1:])
        # A path whose radiance changes by the glow meets a box: a mover may change it.
        near = found != self._around.paths(ask[0], once, *ask[1:]) if self._boxes else once > 0
        ends = np.cumsum([part.shape[1] for part in asks])[:-1]
        parts = zip(wanted, np.split(found.astype(np.float32), ends), np.split(near, ends), strict=True)
        for (half, level, _), radiance, is_near in parts:
            rows, paths = self._traced[turn, half, level]
            shape = -1, _stretch(level)[1]
            self._traced[turn, half, level] = (
                rows,
                _TracedPaths(
                    np.concatenate([paths.radiance, radiance.reshape(shape)]),
                    np.concatenate([paths.near, is_near.reshape(shape)]),
                ),
            )

    def _near_share(self) -> dict[str, Floats]:
        """Share of each pixel's paths that come near a mover, smoothed."""
        pixels = self._plan.pixels
        self._trace_new("pilot", [(0, 0, pixels), (1, 0, pixels)])
        halves = [self._traced["pilot", half, 0][1].near[:, 0] for half in (0, 1)]
        return {"share": smoothed(self._plan.shape, np.mean(halves, axis=0))}


def _wanted(counts: Floats) -> list[tuple[int, int, Ints]]:
    """Levels of paths that pixels need: (half, level, indices of the pixels)."""
    levels = range(int(np.log2(counts.max(initial=1))) + 1)
    return [(half, level, np.flatnonzero(counts >= 1 << level)) for half in (0, 1) for level in levels]


def _stretch(level: int) -> tuple[int, int]:
    """First path of a level, and the number of paths."""
    return 1 << level >> 1, max(1, 1 << level >> 1)
