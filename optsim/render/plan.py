"""Plan of a truth, shared by all stages: scene, grid, error targets, and cache keys of finished pieces."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from optsim.core.cache import Cache, hash_of
from optsim.core.progress import Progress
from optsim.core.quantities import Bools, Doubles, Floats, Ints, Timing, View
from optsim.render.allocation import MOST, Statistics, allocate, relative_deviation
from optsim.render.footprint import cover, faces_of, vertices_at
from optsim.render.lens import ideal, touched
from optsim.render.settings import CameraNoise, RenderSettings
from optsim.scene.scene import Scene, SingleMover

# Floor of relative errors, added to the radiance, as a share of the declared white. No source: it is 1/100 of
# a picture's white, and the scores' own metrics flatten out about there.
_FLOOR = 0.01


def seed_of(*purpose: object) -> int:
    """Hash a purpose to a 32-bit seed, since neighbouring seeds may give shifted patterns."""
    return int(hash_of(*purpose)[:8], 16)


def measured_error(mean: Floats, half_difference: Floats, white_w_m2_sr: float) -> float:
    """Measure the error of a picture by its halves, as ``RenderSettings`` defines it; (y, x) each."""
    share = half_difference / (np.maximum(mean, 0) + np.float32(_FLOOR * white_w_m2_sr))
    return float(np.sqrt(np.mean(share**2, dtype=np.float64)))


@dataclass(frozen=True, eq=False)
class RenderPlan:
    """Plan of one truth, or of its part by one group of lamps.

    Parameters
    ----------
    scene, view, timing, settings, cache, progress
        As given to ``render_truth``.
    noise : CameraNoise or None
        The camera's noise, if it decides when to stop.
    identity : str
        Hash of everything that decides a path's radiance.
    segment_slots : int
        Slots between key instants.
    azimuth_rad : float, optional
        Azimuth of the polariser before the lens; None for unpolarised light.
    """

    scene: Scene
    view: View
    timing: Timing
    settings: RenderSettings
    noise: CameraNoise | None
    cache: Cache
    progress: Progress
    identity: str
    segment_slots: int = 1
    azimuth_rad: float | None = None

    def lit_by(self, lamps: tuple[str, ...]) -> RenderPlan:
        """Plan of the same truth with these lamps only."""
        return replace(self, scene=self.scene.only_lamps(lamps), identity=hash_of(self.identity, lamps))

    @cached_property
    def still_m(self) -> list[Doubles]:
        """Vertices of static objects, m."""
        return [mesh.vertices_m for mesh in self.scene.still_meshes().values()]

    @cached_property
    def movers(self) -> dict[str, SingleMover]:
        """Movers by name: the scene finds them anew at each call, too slow for each of a thousand."""
        return self.scene.singles()

    @property
    def pixels(self) -> Ints:
        """All fine samples."""
        return np.arange(self.view.rows * self.view.cols)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.view.rows, self.view.cols

    @property
    def floor_w_m2_sr(self) -> float:
        """Added to the radiance wherever an error is relative."""
        return _FLOOR * self.scene.white_w_m2_sr

    def time_s(self, slot: float) -> float:
        """Start of a slot."""
        return slot * self.timing.slot_s

    def times_s(self, first_slot: int, last_slot: int, steps: int) -> list[float]:
        """List the ends of equal steps from the start of one slot to that of another."""
        n_slots = last_slot - first_slot
        return [self.time_s(first_slot + n_slots * step / steps) for step in range(steps + 1)]

    def seeds(self, *purpose: object) -> tuple[int, int]:
        """Two independent seeds, of half A and half B."""
        return seed_of(self.settings.seed, *purpose, "A"), seed_of(self.settings.seed, *purpose, "B")

    def uniform_draws(self, *purpose: object) -> Doubles:
        """Uniform random numbers for both halves and all pixels, (2, n): they assign poses to samples."""
        rng = np.random.Generator(np.random.Philox(seed_of(self.settings.seed, *purpose, "luck")))
        return rng.random((2, self.view.rows * self.view.cols))

    def key(self, *what: object) -> str:
        """Cache key of a piece."""
        return hash_of(self.identity, self.settings.seed, *what)

    def stop(self) -> tuple[float, float, float] | None:
        """Numbers that decide where the camera's noise stops sampling, for cache keys."""
        if self.settings.noise_share is None or self.noise is None:
            return None
        return self.settings.noise_share, self.noise.electrons, self.noise.read_noise_e

    def own(self, *times_s: float, movers: Iterable[str] | None = None) -> Bools:
        """Fine samples in which movers, all or some, may be seen at any of some instants: (y, x)."""
        grid = ideal(self.view)
        singles, mask = self.movers, np.zeros((grid.rows, grid.cols), np.bool_)
        chosen = [singles[name] for name in (singles if movers is None else movers)]
        for time_s in times_s:
            camera = self.scene.camera.at(time_s)
            for mover in chosen:
                cover(mask, vertices_at(mover, time_s), faces_of(mover), camera, self.view)
        return touched(mask, self.view)

    def counts(
        self,
        statistics: Statistics,
        pixels: Ints,
        light: Floats,
        target: float,
        *,
        least: float,
        most: float = MOST,
        cost: Floats | None = None,
    ) -> Floats:
        """Allocate samples a half to some pixels.

        Parameters
        ----------
        statistics : Statistics
            Statistics of other random numbers.
        pixels : ndarray of shape (n,)
            Flat indices.
        light : ndarray of shape (n,)
            Approximate radiance, W m^-2 sr^-1; used only with the camera's noise.
        target : float
            Relative error of both halves together.
        least, most : float
            Limits.
        cost : ndarray of shape (n,), optional
            Relative cost of a sample in each pixel, if it differs.
        """
        deviation = relative_deviation(statistics, self.shape, self.floor_w_m2_sr).ravel()[pixels]
        share, noise = self.settings.noise_share, self.noise
        if share is None or noise is None:
            return allocate(deviation, target, least=least, most=most, cost=cost)
        light = np.maximum(light, 0)
        hidden = share * np.sqrt(light / noise.electrons + (noise.read_noise_e / noise.electrons) ** 2)
        enough = (deviation * (light + self.floor_w_m2_sr) / hidden) ** 2 / 2
        bound = np.exp2(np.ceil(np.log2(np.maximum(enough, 1e-6))))
        most_each = np.minimum(bound, most).astype(np.float32)
        return allocate(deviation, target, least=least, most=most_each, cost=cost)
