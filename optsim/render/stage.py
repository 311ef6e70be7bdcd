# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""A scene loaded once into Mitsuba; afterwards only vertex buffers change.

``optimize=False`` keeps shape and emitter order, hence every random choice, the same in every process.
All mesh parameters are behind :func:`_write_vertices`: Mitsuba 3.10 renames them.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from optsim.quantities import Bools, Doubles, Floats, Ints, View
from optsim.render.describe import describe
from optsim.render.sampler import pixel_sampler
from optsim.scene.scene import Scene

# Bounds the memory of one launch (about 100 bytes a lane).
_MAX_LANES = 4 << 20


class Stage:
    """A scene in the active Mitsuba variant, seen through a view.

    Parameters
    ----------
    scene : Scene
        What to load.
    view : View
        Fine grid and field of view.
    movers : bool
        Whether the movers are on stage; without them the rest is exactly the same.
    """

    def __init__(self, scene: Scene, view: View, *, movers: bool = True) -> None:
        import mitsuba as mi

        self.scene, self.view = scene, view
        self._vectorised = not str(mi.variant()).startswith("scalar")
        self._movers = scene.singles() if movers else {}
        content = describe(mi, scene, view, movers=movers)
        self._loaded: Any = mi.load_dict(content, optimize=False)
        self._parameters: Any = mi.traverse(self._loaded)
        self._time_s = 0.0

    def pose(self, time_s: float) -> None:
        """Put all movers where they are at a time."""
        if self._movers and time_s != self._time_s:
            for name, mover in self._movers.items():
                _write_vertices(self._parameters, f"mover_{name}", mover.vertices(time_s))
            self._parameters.update()
            self._time_s = time_s

    def radiance(
        self, pixels: Ints, samples: int | Ints, seeds: tuple[int, ...], first_sample: int = 0
    ) -> Doubles:
        """Mean of samples in some pixels, bitwise the same whichever other pixels are asked for.

        The scalar fallback knows only whole pictures, with Mitsuba's own sampler.

        Parameters
        ----------
        pixels : ndarray of shape (n,), int64
            Flat indices into the fine grid, row-major.
        samples : int or ndarray of shape (n,)
            Samples a pixel and seed.
        seeds : tuple of int
            One independent estimate for each.
        first_sample : int
            Number of the first sample: passes that continue each other stratify as one.

        Returns
        -------
        ndarray of shape (seed, n), float64
            Mean radiance over the pixel and over these samples, W m^-2 sr^-1.
        """
        counts = np.broadcast_to(np.asarray(samples, np.int64), pixels.shape)
        if not self._vectorised:
            whole = [self.picture(int(counts.max()), seed).ravel()[pixels] for seed in seeds]
            return np.stack(whole).astype(np.float64)
        step = max(1, _MAX_LANES // (int(counts.max()) * len(seeds)))
        result = np.empty((len(seeds), len(pixels)))
        for low in range(0, len(pixels), step):
            part = slice(low, low + step)
            result[:, part] = self._sums(pixels[part], counts[part], seeds, first_sample)
        return result / counts

    def _sums(self, pixels: Ints, counts: Ints, seeds: tuple[int, ...], first_sample: int) -> Doubles:
        """Launch once, one lane a sample; summed in float64, as float32 sums of many samples lose digits."""
        starts = np.cumsum(counts) - counts
        index = np.arange(counts.sum()) - np.repeat(starts, counts) + first_sample
        values = self._trace(
            np.tile(np.repeat(pixels, counts), len(seeds)),
            np.tile(index, len(seeds)),
            np.repeat(np.asarray(seeds, np.uint32), len(index)),
        )
        return np.add.reduceat(values.reshape(len(seeds), -1), starts, axis=1, dtype=np.float64)

    def _trace(self, pixels: Ints, indices: Ints, seeds: NDArray[np.uint32]) -> Floats:
        """Radiance along one random path for each (pixel, sample number, seed)."""
        import drjit as dr
        import mitsuba as mi

        pixel = mi.UInt32(pixels.astype(np.uint32))
        sampler: Any = pixel_sampler(mi, dr)()
        sampler.start(mi.UInt32(seeds), pixel, mi.UInt32(indices.astype(np.uint32)))
        row = pixel // self.view.cols
        corner = mi.Point2f(mi.Float(pixel - row * self.view.cols), mi.Float(row))
        position = (corner + sampler.next_2d()) / mi.Point2f(self.view.cols, self.view.rows)
        ray, weight = self._loaded.sensors()[0].sample_ray_differential(0.0, 0.0, position, mi.Point2f(0.5))
        light, _, _ = self._loaded.integrator().sample(self._loaded, sampler, ray, None, True)
        values = (light * weight)[0]
        dr.eval(values)
        return np.asarray(values.numpy(), np.float32)

    def picture(self, samples: int, seed: int) -> Floats:
        """Render the whole fine grid by Mitsuba's own loop, in any variant: (y, x), float32."""
        import mitsuba as mi

        image = np.asarray(mi.render(self._loaded, spp=samples, seed=cast("Any", seed)))
        return np.ascontiguousarray(image.mean(axis=2), np.float32)


def outside_mask(scene: Scene, view: View) -> Bools:
    """Where a lamp with a picture (the bright outside) is seen directly when nothing moves.

    Returns
    -------
    ndarray of shape (y, x), bool
        By one ray at a random place in each fine sample.
    """
    pictures = {name: lamp for name, lamp in scene.lamps.items() if lamp.picture is not None}
    if not pictures:
        return np.zeros((view.rows, view.cols), np.bool_)
    # Without other lamps and without bounces, only what emits a picture is not black.
    alone = scene.model_copy(update={"lamps": pictures, "max_depth": 1})
    return Stage(alone, view, movers=False).picture(1, 0) > 0


def _write_vertices(parameters: Any, name: str, vertices_m: Doubles) -> None:
    """Set a mesh's vertices: the one place that names its vertex buffer."""
    parameters[f"{name}.vertex_positions"] = vertices_m.astype(np.float32).ravel()
