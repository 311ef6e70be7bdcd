"""Radiance of a slot in several bands: few random paths for all of them, and the truth of one band.

With C and Y the estimates of a band and of the seen band by the same paths, and T the truth of the seen band,

    C + k (T - Y)

is an unbiased estimate of the band for any k that does not depend on these paths (a control variate, see
``difference``). k is the ratio of the reflectances at the first surface, from other rays, times that of the
lamps' light. A matt surface lit by lamps alone then has no noise but that of k T.

Outside of the movers' own pixels most paths of a slot are those of the scene without movers. Only those that
come near a mover (``nearby``) are traced in a slot. The same paths without movers are subtracted, and an
estimate from many paths, rendered once, is added: again a control variate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optsim.core.cache import Cache
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Bools, Doubles, Floats, Ints, Timing, View
from optsim.render.channels import Channels, three_channels
from optsim.render.full import poses_per_instant
from optsim.render.nearby import boxes_around
from optsim.render.plan import RenderPlan, measured_error, seed_of
from optsim.render.settings import RenderSettings
from optsim.scene.bands import Band
from optsim.scene.bright import light_ratio
from optsim.scene.scene import Scene

# Over the samples of a slot: those of what stands still, rendered once, those of the movers' own pixels, and
# those of slots that share nothing.
_STILL_FACTOR, _OWN_FACTOR, _ALONE_FACTOR = 4, 4, 16
# Most poses of a half: they are at random times, so that even few are unbiased.
_POSES = 2
# Rays of a pixel that find its reflectances: once for what stands still, and at each pose.
_STILL_RAYS, _RAYS = 8, 4
# Added to reflectances before their ratio is taken, since black has none.
_BLACK = 1e-6
# Memory of the slots that are rendered at a time: a change of Mitsuba's variant takes 0.2 s.
_BATCH_BYTES = 256e6


@dataclass(frozen=True, eq=False)
class BandPictures:
    """Slot means of radiance by band."""

    w_m2_sr: dict[str, Floats]  # (y, x); unbiased, so it may be slightly negative.
    # Besides the truth's: rms over the picture of the standard deviation over (radiance + 1 % of white).
    own_noise: dict[str, float]
    # The whole noise, in the same measure; None where that of the truth is unknown.
    noise: dict[str, float | None]


@dataclass(frozen=True, eq=False)
class _Still:
    """The scene without movers under one group of lamps."""

    light: Floats  # (half, band, n), mean of many paths.
    paths: Floats  # (instant, half, band, n), mean of the few paths that every slot takes.
    near: Bools  # (instant, half, n), where one of these may meet a mover.


class BandLight:
    """Renderer of the slots of a scene in all its bands.

    Parameters
    ----------
    scene : Scene
        The scene with all its bands, at least two.
    seen : str
        Band whose truth is given.
    view, timing, settings
        As for ``render_truth``.
    slots : sequence of int
        Slots that will be asked for, in this order.
    samples : int
        Samples of a fine sample in a slot, both halves together. The movers' own pixels get four times as
        many, and so does what stands still, once.
    shared : bool
        Whether slots may share the noise of what stands still. Otherwise every slot takes 16 times as many.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Stage "bands".
    """

    def __init__(
        self,
        scene: Scene,
        seen: str,
        view: View,
        timing: Timing,
        settings: RenderSettings,
        slots: Sequence[int],
        samples: int,
        *,
        shared: bool = True,
        backend: str | None = None,
        progress: Progress = silent,
    ) -> None:
        self._names, self._seen = [band.name for band in scene.bands], seen
        self._scene, self._slots, self._backend, self._progress = scene, list(slots), backend, progress
        self._rendered: dict[int, dict[str, tuple[Floats, Floats]]] = {}
        self._plan = RenderPlan(
            scene.in_band(seen), view, timing, settings, None, Cache(), silent, "bands of a slot"
        )
        self._keeps = shared and not scene.camera.moves
        self.samples = samples if shared else samples * _ALONE_FACTOR
        self._threes: list[_ThreeBands] = []

    def of(self, slot: int, truth: Floats, half_difference: Floats | None = None) -> BandPictures:
        """Render a slot.

        Parameters
        ----------
        slot : int
            Index of the slot.
        truth : ndarray of shape (y, x), float32
            Mean radiance of the slot in the seen band.
        half_difference : ndarray of shape (y, x), float32, optional
            Half the difference of its two halves, for the whole noise.
        """
        white = self._plan.scene.white_w_m2_sr

        def error(light: Floats, half: Floats | Doubles) -> float:
            return measured_error(light, half.astype(np.float32), white)

        def whole(light: Floats, factor: Floats | float, own: float) -> float | None:
            return (
                None if half_difference is None else math.hypot(own, error(light, factor * half_difference))
            )

        light, own, noise = {self._seen: truth}, {self._seen: 0.0}, {self._seen: whole(truth, 1.0, 0.0)}
        if slot not in self._rendered:
            self._render_from(slot)
        for name, (rest, factor) in self._rendered.pop(slot).items():
            light[name] = factor * truth + rest.mean(axis=0)
            own[name] = error(light[name], (rest[0] - rest[1]) / 2)
            noise[name] = whole(light[name], factor, own[name])
        light, own, noise = ({name: each[name] for name in self._names} for each in (light, own, noise))
        return BandPictures(light, own, noise)

    def _render_from(self, slot: int) -> None:
        """Render a slot and those after it, as many as the memory takes."""
        rows, cols = self._plan.shape
        bytes_each = 12 * (len(self._names) - 1) * rows * cols
        first = self._slots.index(slot) if slot in self._slots else 0
        batch = [slot, *self._slots[first + 1 :]][: max(1, int(_BATCH_BYTES / bytes_each))]
        with three_channels(self._scene, self._backend):
            self._threes = self._threes or self._loaded()
            for each in batch:
                self._rendered[each] = {}
                for three in self._threes:
                    self._rendered[each] |= three.slot(each)
                self._progress("bands", self._slots.index(each) + 1, len(self._slots))

    def _loaded(self) -> list[_ThreeBands]:
        first = next(band for band in self._scene.bands if band.name == self._seen)
        others = [band for band in self._scene.bands if band.name != self._seen]
        # A launch has three channels: the last one may hold a band twice.
        pairs = [(others[i], others[min(i + 1, len(others) - 1)]) for i in range(0, len(others), 2)]
        return [
            _ThreeBands(self._scene, (first, *pair), self._plan, self.samples, keeps=self._keeps)
            for pair in pairs
        ]


class _ThreeBands:
    """Three bands, the seen one first, by groups of lamps with the same flicker."""

    def __init__(
        self,
        scene: Scene,
        bands: tuple[Band, ...],
        plan: RenderPlan,
        samples: int,
        *,
        keeps: bool,
    ) -> None:
        self._bands, self._plan, self._keeps = bands, plan, keeps
        self._groups = [(names[0], scene.only_lamps(names)) for names in scene.light_groups().values()]
        self._traced = bool(plan.scene.singles()) or not keeps
        self._few = max(1, samples // (2 * plan.settings.instants_per_slot))
        self._many = self._few * (_OWN_FACTOR if keeps else 1)
        self._boxes = None
        if self._traced:
            if keeps:
                times_s = [plan.time_s(slot) for slot in range(plan.timing.n_slots + 1)]
                self._boxes = boxes_around(plan.scene, np.asarray(times_s), plan.view.aperture_m / 2)
            self._stages = [self._loaded(lit, movers=True) for _, lit in self._groups]
        if keeps:
            self._still = [self._without_movers(lit) for _, lit in self._groups]
            seed = seed_of(plan.settings.seed, "band reflectances")
            empty = self._loaded(scene, movers=False)
            self._reflectances = empty.reflectances(plan.pixels, _STILL_RAYS, seed)
        self._lamps = np.array([light_ratio(scene, band, bands[0]) for band in bands])[:, None]

    def slot(self, slot: int) -> dict[str, tuple[Floats, Floats]]:
        """For each band but the first: halves of the rest, (half, y, x), and the truth's factor, (y, x)."""
        plan, instants = self._plan, self._plan.settings.instants_per_slot
        light, anew = np.zeros((2, 3, len(plan.pixels))), self._anew(slot)
        shares = self._reflectances.copy() if self._keeps else np.zeros_like(light[0])
        for instant in range(instants):
            ends = [plan.time_s(slot + (instant + edge) / instants) for edge in (0, 1)]
            for group, (lamp, _) in enumerate(self._groups):
                gain = plan.scene.gain(lamp, *ends) / instants
                if gain > 0:
                    for half in (0, 1):
                        light[half] += gain * self._instant(group, slot, instant, half, anew)
        if self._traced and anew.any():
            shares[:, anew] = self._seen_reflectances(slot, np.flatnonzero(anew))
        factors = (self._lamps * (shares + _BLACK) / (shares[0] + _BLACK)).astype(np.float32)
        rest = (light - factors * light[:, :1]).astype(np.float32)
        return {
            band.name: (rest[:, number].reshape(2, *plan.shape), factors[number].reshape(plan.shape))
            for number, band in enumerate(self._bands[1:], start=1)
        }

    def _anew(self, slot: int) -> Bools:
        """Fine samples that the scene without movers says nothing about, (n,)."""
        if self._keeps:
            return self._plan.own(*self._plan.times_s(slot, slot + 1, 1)).ravel()
        return np.ones(len(self._plan.pixels), np.bool_)

    def _loaded(self, scene: Scene, *, movers: bool, glow: bool = False) -> Channels:
        return Channels(scene, self._bands, self._plan.view, movers=movers, boxes=self._boxes, glow=glow)

    def _instant(self, group: int, slot: int, instant: int, half: int, anew: Bools) -> Doubles:
        """Mean over an instant of a slot under one group of lamps, (band, n)."""
        light = np.zeros((3, len(anew)))
        near, still = np.full_like(anew, self._traced), self._still[group] if self._keeps else None
        if self._traced:
            rng, times_s = self._times_s(slot, instant, half)
            inside = self._boxes is not None and all(self._boxes.hold(self._plan.scene, t) for t in times_s)
            if still is not None and inside:
                near = still.near[instant, half]
            light = self._posed(group, slot, instant, half, np.where(anew, 2, near), rng, times_s)
        if still is not None:
            known = still.light[half] - np.where(near, still.paths[instant, half], 0.0)
            light += np.where(anew, 0.0, known)
        return light

    def _posed(
        self,
        group: int,
        slot: int,
        instant: int,
        half: int,
        kind: Ints,
        rng: np.random.Generator,
        times_s: Doubles,
    ) -> Doubles:
        """Mean over the poses of an instant, (band, n): no, few or many samples by the kind, 0 to 2."""
        total = np.zeros((3, len(kind)))
        n_all = np.array([0, self._few, self._many])
        # A sample takes a random pose of its equal part of them.
        places: list[Ints] = [
            np.floor((np.arange(n) + rng.random(n)) / n * len(times_s)).astype(np.int64)
            for n in (0, self._few, self._many)
        ]
        chosen = np.array([np.bincount(each, minlength=len(times_s)) for each in places])
        first = instant * n_all
        shared, fresh = (self._plan.seeds("bands", *more)[half] for more in ((), (slot,)))
        seeds = np.array([shared, shared, fresh])
        for pose, time_s in enumerate(times_s):
            if chosen[:, pose].any():
                self._stages[group].pose(float(time_s))
                each = chosen[kind, pose], seeds[kind], first[kind]
                total += self._stages[group].radiance(*each)
            first = first + chosen[:, pose]
        return total / np.maximum(n_all, 1)[kind]

    def _times_s(self, slot: int, instant: int, purpose: int) -> tuple[np.random.Generator, Doubles]:
        """Choose times of poses, random in equal parts of an instant: even few of them are unbiased."""
        instants = self._plan.settings.instants_per_slot
        poses = min(self._many, _POSES, poses_per_instant(self._plan, slot))
        rng = np.random.default_rng([seed_of(self._plan.settings.seed, "band poses"), slot, instant, purpose])
        share = (np.arange(poses) + rng.random(poses)) / poses
        return rng, (slot + (instant + share) / instants) * self._plan.timing.slot_s

    def _without_movers(self, lit: Scene) -> _Still:
        plan, few, instants = self._plan, self._few, self._plan.settings.instants_per_slot
        empty = self._loaded(lit, movers=False)

        def mean(stage: Channels, samples: int, first: int) -> Floats:
            same = np.ones_like(plan.pixels)
            each = (stage.radiance(samples * same, seed * same, first * same) for seed in plan.seeds("bands"))
            return (np.stack([*each]) / samples).astype(np.float32)

        paths = np.stack([mean(empty, few, instant * few) for instant in range(instants)])
        near = np.ones((instants, 2, len(plan.pixels)), np.bool_)
        if self._boxes is not None:
            # A path whose radiance changes by the glow meets a box.
            glow = self._loaded(lit, movers=False, glow=True)
            lit_up = np.stack([mean(glow, few, instant * few) for instant in range(instants)])
            near = (lit_up != paths).any(axis=2)
        rest = mean(empty, few * instants * (_STILL_FACTOR - 1), few * instants)
        light = (paths.mean(axis=0) + (_STILL_FACTOR - 1) * rest) / np.float32(_STILL_FACTOR)
        return _Still(light, paths, near)

    def _seen_reflectances(self, slot: int, pixels: Ints) -> Doubles:
        """Mean reflectances of some pixels over the poses of a slot, by other rays than the paths'."""
        total, count = np.zeros((3, len(pixels))), 0
        for instant in range(self._plan.settings.instants_per_slot):
            for pose, time_s in enumerate(self._times_s(slot, instant, 2)[1]):
                seed = seed_of(self._plan.settings.seed, "band reflectances", slot, instant, pose)
                self._stages[0].pose(float(time_s))
                total += self._stages[0].reflectances(pixels, _RAYS, seed)
                count += 1
        return total / count
