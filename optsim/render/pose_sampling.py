"""How far apart poses and key poses may be: measured by leaving out every other one.

The error of interpolation grows as a power of the way between two poses, so that what leaving out half of
them changes says how large it is (L. F. Richardson, Phil. Trans. R. Soc. A 210, 1911: the deferred approach
to the limit). What changes in one half of the truth is multiplied by what changes in the other, independent
one, so that noise is not taken for error. A segment's poses follow from the segments before it: nothing is
chosen by the random numbers that it is used with.
"""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Bools, Doubles
from optsim.render.trajectories import Density, Trajectory

# Relative error on a mover's own pixels where it goes one fine sample from pose to pose, or from key to key:
# the worst found over all scenes with movers (glossy_floor's dark rod before a bright wall; chart's bars,
# 10 : 1, have 0.16 and most movers 0.01 to 0.07). Only a mover's first segment relies on it.
_POSES_AT_ONE_PX, _KEYS_AT_ONE_PX = 0.4, 0.03
# The least power found: it was 1.5 to 2.5.
_POWER = 1.5
# Of the bound, what each of the two may take: in squares they add up to one.
_SHARE = 0.7
# A segment has at least this share of the poses and keys of those before: that far errors were measured.
_FEWER = 0.5
# Samples a side of the tiles in which changes of light on a mover's surface are measured. No source.
_TILE = 4


def assumed(bound: float) -> Density:
    """Say how dense poses and keys are as long as nothing is known of a mover."""
    return Density(_per_px(bound, _POSES_AT_ONE_PX), _per_px(bound, _KEYS_AT_ONE_PX))


def _per_px(bound: float, at_one_px: float, before: float = 0.0) -> float:
    return max((at_one_px / (_SHARE * bound)) ** (1 / _POWER), _FEWER * before)


class Trial:
    """Light on a track's samples in each instant, and what half as many poses or keys would change.

    Parameters
    ----------
    track : Track
        Whose poses are to be added.
    n_instants : int
        Of the segment.
    floor_w_m2_sr : float
        What errors are relative to on top of the light.
    """

    def __init__(self, trajectory: Trajectory, n_instants: int, floor_w_m2_sr: float) -> None:
        self._trajectory, self._floor = trajectory, floor_w_m2_sr
        self._covered = 0.0
        self._shares = [hat_means(trajectory.n_steps // every, n_instants) for every in (1, 2)]
        self._light = [np.zeros((2, n_instants, len(trajectory.pixels))) for _ in (1, 2)]
        # Squared changes between keys, and of how many samples: by tile, since the light on a surface varies
        # slowly, and a sample's noise would not only be in what changes but in what it is relative to.
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
        """Add a pose: the light on both halves of the samples, and which of them movers cover."""
        self._covered += float(covered.sum()) / (self._trajectory.n_steps + 1)
        for every, (shares, light) in enumerate(zip(self._shares, self._light, strict=True), start=1):
            if step % every == 0:
                weights = shares[:, step // every]
                for instant in np.flatnonzero(weights):
                    light[:, instant] += weights[instant] * seen

    def compare(self, seen: Doubles, coarse: Doubles, covered: Bools) -> None:
        """Add what is seen at a key pose, and what would be were it not one."""
        tile, change = self._tile[covered], (coarse - seen)[:, covered]
        about = np.bincount(tile, self._about(seen.mean(axis=0))[covered])
        present = about > 0
        first, second = (np.bincount(tile, each)[present] / about[present] for each in change)
        self._between.append(first * second * np.bincount(tile)[present])
        self._n_between += len(tile)

    def density(self, bound: float, before: Density) -> Density:
        """Say how dense the next segment's poses and keys must be for a bound on the relative error."""
        poses, keys = before.poses, before.keys
        if self._covered:
            fine, coarse = self._light
            first, second = (coarse - fine) / self._about(fine.mean(axis=0))
            squared = _certain_sum(first * second) / (fine.shape[1] * self._covered)
            # What changed is the difference of two errors, of which one is 2^power-fold the other.
            twice_as_far = np.sqrt(squared) / (1 - 2**-_POWER)
            poses = _per_px(bound, self._at_one_px(twice_as_far, self._trajectory.n_steps), poses)
        if self._n_between:
            products = np.concatenate(self._between)
            # Just between two keys a parabola's error is greatest: its mean square is 8/15 of that.
            twice_as_far = np.sqrt(8 / 15 * _certain_sum(products) / self._n_between)
            keys = _per_px(bound, self._at_one_px(twice_as_far, self._trajectory.n_keys), keys)
        return Density(poses, keys)

    def _about(self, light: Doubles) -> Doubles:
        return np.maximum(light, 0) + self._floor

    def _at_one_px(self, twice_as_far: float, n: int) -> float:
        return float(twice_as_far) * (n / 2 / max(self._trajectory.way_px, 1e-9)) ** _POWER


def _certain_sum(products: Doubles) -> float:
    """Sum less its standard error: what a few wild samples say is not believed."""
    return max(float(products.sum() - products.std() * np.sqrt(products.size)), 0.0) if products.size else 0.0


def hat_means(n_steps: int, n_instants: int) -> Doubles:
    """Means over equal instants of the linear interpolation between equally spaced poses.

    Returns
    -------
    ndarray of shape (n_instants, n_steps + 1), float64
        Share of each pose in each instant; rows sum to 1.
    """
    place = np.arange(n_instants + 1)[:, None] / n_instants * n_steps - np.arange(n_steps + 1)[None]
    place = np.clip(place, -1, 1)
    integral = np.where(place < 0, (1 + place) ** 2 / 2, 1 - (1 - place) ** 2 / 2)
    return np.diff(integral, axis=0) * n_instants / n_steps
