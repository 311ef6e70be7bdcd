"""Pose sampling: the density of poses and key poses, measured by leaving out every other one.

The interpolation error grows as a power of the path between two poses. So the change by leaving out half of
them gives the error (L. F. Richardson, Phil. Trans. R. Soc. A 210, 1911: the deferred approach to the limit).
The change in one half of the truth is multiplied by that in the other, independent one, so that noise does
not count as error. A segment's poses follow from the segments before it: they do not depend on the random
numbers they are used with.
"""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Bools, Doubles
from optsim.render.trajectories import PoseDensity, Trajectory

# Relative error on a mover's own pixels for one fine sample of path between poses, or between keys. It is the
# worst over all scenes with movers: glossy_floor's dark rod before a bright wall (chart's bars, 10 : 1, have
# 0.16 and most movers 0.01 to 0.07). Only a mover's first segment uses it.
_POSES_AT_ONE_PX, _KEYS_AT_ONE_PX = 0.4, 0.03
# The smallest measured power; it was 1.5 to 2.5.
_POWER = 1.5
# Share of the bound for poses and for keys: the squares add up to one.
_SHARE = 0.7
# A segment has at least this share of the earlier poses and keys: errors were measured up to there.
_FEWER = 0.5
# Side of the tiles in which changes of light on a mover's surface are measured, samples. No source.
_TILE = 4


def assumed(bound: float) -> PoseDensity:
    """Density of poses and keys before a mover has been measured."""
    return PoseDensity(_per_px(bound, _POSES_AT_ONE_PX), _per_px(bound, _KEYS_AT_ONE_PX))


def _per_px(bound: float, at_one_px: float, before: float = 0.0) -> float:
    return max((at_one_px / (_SHARE * bound)) ** (1 / _POWER), _FEWER * before)


class Trial:
    """Light on a trajectory's samples in each instant, and its change with half as many poses or keys."""

    def __init__(self, trajectory: Trajectory, n_instants: int, floor_w_m2_sr: float) -> None:
        self._trajectory, self._floor = trajectory, floor_w_m2_sr
        self._covered = 0.0
        self._shares = [hat_means(trajectory.n_steps // every, n_instants) for every in (1, 2)]
        self._light = [np.zeros((2, n_instants, len(trajectory.pixels))) for _ in (1, 2)]
        # Squared changes between keys, and their number of samples. They are summed by tile, since light on a
        # surface varies slowly. Per sample, noise would enter both the change and the light it is relative
        # to.
        self._between: list[Doubles] = []
        self._n_between = 0
        rows, cols = np.divmod(trajectory.pixels, trajectory.mask.shape[1])
        places = rows // _TILE * trajectory.mask.shape[1] + cols // _TILE
        self._tile = np.unique(places, return_inverse=True)[1].ravel()

    @property
    def light(self) -> Doubles:
        """Both halves of the light in each instant, (half, t, sample), W m^-2 sr^-1."""
        return self._light[0]

    def add(self, step: int, seen: Doubles, covered: Bools) -> None:
        """Add a pose: the light on both halves of the samples, and the samples covered by movers."""
        self._covered += float(covered.sum()) / (self._trajectory.n_steps + 1)
        for every, (shares, light) in enumerate(zip(self._shares, self._light, strict=True), start=1):
            if step % every == 0:
                weights = shares[:, step // every]
                for instant in np.flatnonzero(weights):
                    light[:, instant] += weights[instant] * seen

    def compare(self, seen: Doubles, coarse: Doubles, covered: Bools) -> None:
        """Add the light at a key pose, with it and without it as a key."""
        tile, change = self._tile[covered], (coarse - seen)[:, covered]
        about = np.bincount(tile, self._about(seen.mean(axis=0))[covered])
        present = about > 0
        first, second = (np.bincount(tile, each)[present] / about[present] for each in change)
        self._between.append(first * second * np.bincount(tile)[present])
        self._n_between += len(tile)

    def density(self, bound: float, before: PoseDensity) -> PoseDensity:
        """Density of the next segment's poses and keys for a bound on the relative error."""
        poses, keys = before.poses, before.keys
        if self._covered:
            fine, coarse = self._light
            first, second = (coarse - fine) / self._about(fine.mean(axis=0))
            squared = _certain_sum(first * second) / (fine.shape[1] * self._covered)
            # The change is the difference of two errors; one is 2^power times the other.
            twice_as_far = np.sqrt(squared) / (1 - 2**-_POWER)
            poses = _per_px(bound, self._at_one_px(twice_as_far, self._trajectory.n_steps), poses)
        if self._n_between:
            products = np.concatenate(self._between)
            # Midway between two keys a parabola's error is largest: its mean square is 8/15 of that squared.
            twice_as_far = np.sqrt(8 / 15 * _certain_sum(products) / self._n_between)
            keys = _per_px(bound, self._at_one_px(twice_as_far, self._trajectory.n_keys), keys)
        return PoseDensity(poses, keys)

    def _about(self, light: Doubles) -> Doubles:
        return np.maximum(light, 0) + self._floor

    def _at_one_px(self, twice_as_far: float, n: int) -> float:
        return float(twice_as_far) * (n / 2 / max(self._trajectory.length_px, 1e-9)) ** _POWER


def _certain_sum(products: Doubles) -> float:
    """Sum minus its standard error, so that a few outliers do not count."""
    return max(float(products.sum() - products.std() * np.sqrt(products.size)), 0.0) if products.size else 0.0


def hat_means(n_steps: int, n_instants: int) -> Doubles:
    """Means over equal instants of the linear interpolation between equally spaced poses."""
    place = np.arange(n_instants + 1)[:, None] / n_instants * n_steps - np.arange(n_steps + 1)[None]
    place = np.clip(place, -1, 1)
    integral = np.where(place < 0, (1 + place) ** 2 / 2, 1 - (1 - place) ** 2 / 2)
    return np.diff(integral, axis=0) * n_instants / n_steps
