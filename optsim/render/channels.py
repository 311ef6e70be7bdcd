# pyright: reportUnknownMemberType=false
"""A scene in three bands: one path for all of them in Mitsuba's variant of three channels, or a path each."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np

from optsim.core.quantities import Doubles, Ints, View
from optsim.render.backend import activate
from optsim.render.nearby import Boxes
from optsim.render.rays import camera_rays, pieces, starts
from optsim.render.stage import RenderStage
from optsim.scene.bands import Band
from optsim.scene.scene import Scene

# Added to the base of what has a coat or gloss: about the reflectance of its colourless first surface.
_GLOSS = 0.04


@contextmanager
def three_channels(scene: Scene, backend: str | None = None) -> Generator[None]:
    """Switch Mitsuba to the variant of three channels of the chosen backend for a block, where it serves.

    It doesn't for the scalar fallback, which renders whole pictures, and for a file of shapes: the colours in
    it are Mitsuba's own, and count by their luminance in every band. A later block may use what was loaded.
    """
    report = activate(backend)
    if report.preview or scene.static is not None:
        yield
        return
    import mitsuba as mi

    mi.set_variant(report.variant.replace("_mono", "_rgb"))
    try:
        yield
    finally:
        mi.set_variant(report.variant)


class Channels:
    """A scene on stage in three bands; all calls inside of :func:`three_channels`."""

    def __init__(
        self,
        scene: Scene,
        bands: tuple[Band, ...],
        view: View,
        *,
        movers: bool,
        boxes: Boxes | None = None,
        glow: bool = False,
    ) -> None:
        import mitsuba as mi

        variant = str(mi.variant())
        self._view, self._vectorised = view, not variant.startswith("scalar")
        self._at_once = variant.endswith("_ad_rgb")
        seen = [scene.in_band(band.name) for band in bands]
        if self._at_once:
            seen = [scene.model_copy(update={"bands": bands})]
        self._stages = [RenderStage(each, view, movers=movers, boxes=boxes, glow=glow) for each in seen]

    def pose(self, time_s: float) -> None:
        """Move the camera and all movers to their positions at a time."""
        for stage in self._stages:
            stage.pose(time_s)

    def radiance(self, samples: Ints, seeds: Ints, first: Ints) -> Doubles:
        """Sum of the radiance of random paths, with the same random numbers in all bands."""
        total, pixels = np.zeros((3, len(samples))), np.flatnonzero(samples)
        some = pixels, samples[pixels], seeds[pixels], first[pixels]
        if self._at_once:
            total[:, pixels] = self._sums(_followed, *some)
        elif len(pixels):
            total[:, pixels] = np.stack([stage.paths(*some) for stage in self._stages]) * some[1]
        return total

    def reflectances(self, pixels: Ints, rays: int, seed: int) -> Doubles:
        """Mean reflectance at the first surface along random rays, gloss roughly: (band, n); 0: none."""
        counts, seeds = np.full_like(pixels, rays), np.full_like(pixels, seed)
        if self._at_once:
            return self._sums(_reflectance, pixels, counts, seeds, np.zeros_like(pixels)) / rays
        if not self._vectorised:
            return np.zeros((3, len(pixels)))
        found = [stage.hits(pixels, counts, seeds, light=False).albedo for stage in self._stages]
        return np.stack(found).reshape(3, -1, rays).mean(axis=2, dtype=np.float64)

    def _sums(self, what: Any, pixels: Ints, counts: Ints, seeds: Ints, first: Ints) -> Doubles:
        """Sum of a function of random camera rays, (band, n)."""
        import drjit as dr
        import mitsuba as mi

        total, loaded = np.zeros((3, len(pixels))), self._stages[0].loaded
        if not len(pixels):
            return total
        for part in pieces(counts):
            rays = camera_rays(loaded, self._view, pixels[part], counts[part], seeds[part], first[part])
            values = what(mi, loaded, *rays)
            dr.eval(values)
            found = np.asarray(values.numpy(), np.float32)
            total[:, part] = np.add.reduceat(found, starts(counts[part]), axis=1, dtype=np.float64)
        return total


def _followed(_mi: Any, loaded: Any, sampler: Any, ray: Any, weight: Any) -> Any:
    """Radiance along whole paths."""
    light, _, _ = loaded.integrator().sample(loaded, sampler, ray, None, True)
    return light * weight


def _reflectance(mi: Any, loaded: Any, _sampler: Any, ray: Any, _weight: Any) -> Any:
    """Reflectance at the first surface."""
    import drjit as dr

    surface = loaded.ray_intersect(mi.Ray3f(ray), mi.RayFlags.All, True)
    hit = surface.is_valid()
    material = surface.bsdf()
    matt, *bases = (
        material.eval_attribute(name, surface, hit)
        for name in ("reflectance", "diffuse_reflectance", "base_color")
    )
    coated = bases[0] + bases[1]
    # Metals and cut-outs name no reflectance.
    other = dr.clip(material.eval_diffuse_reflectance(surface, hit), 0, 1)
    found = dr.select(dr.max(coated) > 0, coated + _GLOSS, dr.select(dr.max(matt) > 0, matt, other))
    return dr.select(hit, found, mi.Color3f(0))
