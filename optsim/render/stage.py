# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
"""A scene loaded once into Mitsuba: it traces paths at any instant, and only vertex buffers change.

``optimize=False`` keeps shape and emitter order, hence every random choice, the same in every process. All
mesh parameters are accessed by :func:`_write_vertices`: Mitsuba 3.10 renames them.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from optsim.core.quantities import Bools, Doubles, Floats, Ints, View
from optsim.render.analyser import twice_analysed
from optsim.render.describe import camera_to_world, describe, parse_static, unit_m
from optsim.render.first_hit import first_hit
from optsim.render.footprint import vertices_at
from optsim.render.lens import on_view
from optsim.render.nearby import Boxes, glowing
from optsim.render.rays import camera_rays, pieces, starts
from optsim.scene.scene import SKY, Scene


@dataclass(frozen=True, eq=False)
class PrimaryHits:
    """First hits of random paths; (n,) each, path by path."""

    shape: Ints  # Index of Mitsuba's shape, -1 without a surface.
    face: Ints  # Index of its triangle.
    weights: Floats  # (n, 2), barycentric weights of the triangle's second and third vertex.
    albedo: Floats  # Reflectance of matt surfaces, 0..1; 0 for all others.
    light: Floats  # Radiance along the whole path, W m^-2 sr^-1; empty if not requested.


class RenderStage:
    """A scene in the active Mitsuba variant, with a view.

    Parameters
    ----------
    scene : Scene
        Scene to load.
    view : View
        Fine grid and field of view.
    movers : bool
        Whether movers are included; the rest is exactly the same without them.
    boxes : Boxes, optional
        Boxes around the movers, for comparing paths with those of another stage.
    glow : bool
        Whether these boxes are visible to all paths and glow.
    azimuth_rad : float, optional
        Only in a polarised variant: radiance is twice the light that a polariser at this azimuth before the
        camera passes, see ``render.analyser``.
    """

    def __init__(
        self,
        scene: Scene,
        view: View,
        *,
        movers: bool = True,
        boxes: Boxes | None = None,
        glow: bool = False,
        azimuth_rad: float | None = None,
    ) -> None:
        import mitsuba as mi

        self.scene, self.view, self._azimuth_rad = scene, view, azimuth_rad
        self._vectorised = not str(mi.variant()).startswith("scalar")
        self._movers = scene.singles() if movers else {}
        static = parse_static(mi, scene)
        with _one_thread():
            content = describe(mi, scene, view, movers=movers, static=static)
            if boxes is not None:
                content["near"] = glowing(mi, boxes, unit_m(scene), shown=glow)
            self._loaded: Any = mi.load_dict(content, optimize=False)
        self._parameters: Any = mi.traverse(self._loaded)
        self._shapes = {str(shape.id()): index for index, shape in enumerate(self._loaded.shapes())}
        self._time_s = 0.0

    @property
    def loaded(self) -> Any:
        """Mitsuba's scene, for other rays; read only."""
        return self._loaded

    def shape_of(self, mover: str) -> int:
        """Index of a mover's shape in Mitsuba's scene."""
        return self._shapes[f"mover_{mover}"]

    def pose(self, time_s: float) -> None:
        """Move the camera and all movers to their positions at a time."""
        if time_s == self._time_s or not (self._movers or self.scene.camera.moves):
            return
        import drjit as dr
        import mitsuba as mi

        # Launches of another pose have other sizes: Dr.Jit's cached allocations would only accumulate.
        dr.flush_malloc_cache()
        unit = unit_m(self.scene)
        for name, mover in self._movers.items():
            _write_vertices(self._parameters, f"mover_{name}", vertices_at(mover, time_s) / unit)
        if self.scene.camera.moves:
            self._parameters["sensor.to_world"] = mi.Transform4f(
                camera_to_world(mi, self.scene.camera.at(time_s), unit).matrix
            )
        with _one_thread():
            self._parameters.update()
            normals = [self._parameters[f"mover_{name}.vertex_normals"] for name in self._movers]
            dr.eval(normals)
            dr.sync_thread()
        self._time_s = time_s

    def radiance(
        self,
        pixels: Ints,
        samples: int | Ints,
        seeds: tuple[int, ...],
        first_sample: int = 0,
        report_share: Callable[[float], None] | None = None,
    ) -> Doubles:
        """Mean of samples in some pixels, one independent estimate for each seed.

        ``report_share`` is called with the share of samples done.

        Returns
        -------
        ndarray of shape (seed, n), float64
            As from :meth:`paths`, the same pixels for every seed.
        """
        counts = np.broadcast_to(np.asarray(samples, np.int64), pixels.shape)
        turns = np.repeat(np.asarray(seeds, np.int64), len(pixels))
        found = self.paths(
            np.tile(pixels, len(seeds)), np.tile(counts, len(seeds)), turns, first_sample, report_share
        )
        return found.reshape(len(seeds), len(pixels))

    def paths(
        self,
        pixels: Ints,
        samples: Ints,
        seeds: Ints,
        first_sample: int | Ints = 0,
        report_share: Callable[[float], None] | None = None,
    ) -> Doubles:
        """Mean radiance over random paths, bitwise independent of other paths in the same call.

        Another call or process repeats it bitwise with LLVM. With CUDA it agrees to a few 1e-8, and rarely a
        path ends elsewhere (seen on an H100; compare Mitsuba issue 1938). The scalar fallback renders only
        whole pictures, with Mitsuba's own sampler.

        Parameters
        ----------
        pixels : ndarray of shape (n,), int64
            Flat indices into the fine grid, row-major; a pixel may occur more than once.
        samples : ndarray of shape (n,), int64
            Paths of each, at least 1.
        seeds : ndarray of shape (n,), int64
            Seed of each.
        first_sample : int or ndarray of shape (n,)
            Number of the first path: calls that continue each other stratify as one.
        report_share : callable, optional
            Called at each launch with the share of pixels done.

        Returns
        -------
        ndarray of shape (n,), float64
            Mean radiance over the pixel and over these paths, W m^-2 sr^-1.
        """
        if not self._vectorised:
            whole = {seed: self.picture(int(samples.max()), int(seed)).ravel() for seed in np.unique(seeds)}
            return np.array([whole[s][p] for s, p in zip(seeds, pixels, strict=True)], np.float64)
        if not len(pixels):
            return np.zeros(0)
        first = np.broadcast_to(np.asarray(first_sample, np.int64), pixels.shape)
        result = np.empty(len(pixels))
        for part in pieces(samples):
            values = self._trace(pixels[part], samples[part], seeds[part], first[part])
            # In float64, as float32 sums of many paths lose precision.
            result[part] = np.add.reduceat(values, starts(samples[part]), dtype=np.float64)
            if report_share is not None:
                report_share(part.stop / len(pixels))
        return result / samples

    def hits(
        self, pixels: Ints, samples: Ints, seeds: Ints, first_sample: int | Ints = 0, *, light: bool
    ) -> PrimaryHits:
        """First hit of each path that :meth:`paths` would trace.

        Parameters
        ----------
        pixels, samples, seeds, first_sample
            As for :meth:`paths`.
        light : bool
            Whether to trace the whole paths too; without it the cost is a small part.
        """
        if not len(pixels):
            return PrimaryHits(pixels, pixels, np.zeros((0, 2), np.float32), *np.zeros((2, 0), np.float32))
        first = np.broadcast_to(np.asarray(first_sample, np.int64), pixels.shape)
        parts = [self._first_hits(pixels[p], samples[p], seeds[p], first[p], light) for p in pieces(samples)]
        found = [np.concatenate(each, axis=-1) for each in zip(*parts, strict=True)]
        shape, face = found[0].astype(np.int64), found[1].astype(np.int64)
        shape[~np.isfinite(found[2])] = -1
        return PrimaryHits(shape, face, found[3].T, found[4], found[5])

    def _trace(self, pixels: Ints, samples: Ints, seeds: Ints, first: Ints) -> Floats:
        """Radiance along random paths, in one launch."""
        import drjit as dr

        values = self._followed(*camera_rays(self._loaded, self.view, pixels, samples, seeds, first))
        dr.eval(values)
        return np.asarray(values.numpy(), np.float32)

    def _followed(self, sampler: Any, ray: Any, weight: Any) -> Any:
        """Radiance along the paths that continue from camera rays."""
        import mitsuba as mi

        light, _, _ = self._loaded.integrator().sample(self._loaded, sampler, ray, None, True)
        if self._azimuth_rad is None:
            return (light * weight)[0]
        seen = twice_analysed(mi, self._loaded, ray, light, self._azimuth_rad)
        return seen * mi.unpolarized_spectrum(weight)[0]

    def _first_hits(self, pixels: Ints, samples: Ints, seeds: Ints, first: Ints, light: bool) -> list[Any]:
        """Shape, face, distance, weights, albedo and perhaps radiance of random paths, in one launch."""
        import drjit as dr
        import mitsuba as mi

        sampler, ray, weight = camera_rays(self._loaded, self.view, pixels, samples, seeds, first)
        met = first_hit(mi, self._loaded, mi.Ray3f(ray), matt_only=True)
        seen = mi.Float(0)
        if light:
            seen = self._followed(sampler, ray, weight)
        found = [met.shape, met.face, met.distance, met.weights, met.albedo, seen]
        dr.eval(found)
        shape, face, distance, weights, albedo, values = (np.asarray(each.numpy()) for each in found)
        return [shape, face, distance, weights.reshape(2, -1), albedo, values if light else values[:0]]

    def picture(self, samples: int, seed: int) -> Floats:
        """Render the whole fine grid by Mitsuba's own loop and sampler, in any variant: (y, x), float32.

        Distortion moves whole samples: each shows the sample of the ideal grid around its centre.
        """
        import mitsuba as mi

        image = np.asarray(mi.render(self._loaded, spp=samples, seed=cast("Any", seed)))
        return np.ascontiguousarray(on_view(image.mean(axis=2), self.view), np.float32)


def outside_mask(scene: Scene, view: View) -> Bools:
    """Find samples that see the sky or a lamp with a picture directly, without movers."""
    pictures = [name for name, lamp in scene.lamps.items() if lamp.picture is not None]
    pictures += [SKY] if scene.sky is not None else []
    if not pictures:
        return np.zeros((view.rows, view.cols), np.bool_)
    # Without other lamps and without bounces, only these are not black.
    alone = scene.only_lamps(pictures).model_copy(update={"max_depth": 1})
    return RenderStage(alone, replace(view, aperture_m=0.0), movers=False).picture(1, 0) > 0


@contextmanager
def _one_thread() -> Generator[None, None, None]:
    """Build trees and normals on one thread, so that every run builds the same.

    With more, Embree's tree may put a ray along an edge on either side, and normals add up in any order.
    With 2 threads 10 of 24 builds of window_room changed 0.3 % of the picture's pixels, with one none of 48.
    For scenes of some thousand triangles one thread is as fast.
    """
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(1)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def _write_vertices(parameters: Any, name: str, vertices_m: Doubles) -> None:
    """Set a mesh's vertices: the only place that names its vertex buffer."""
    parameters[f"{name}.vertex_positions"] = vertices_m.astype(np.float32).ravel()
