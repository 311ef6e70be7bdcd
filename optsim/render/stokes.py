# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Polarised radiance: the Stokes vector that reaches each fine sample, in a Mitsuba variant of its own.

Conventions (R. A. Chipman, W.-S. T. Lam and G. Young, *Polarized Light and Optical Systems*, CRC Press 2018,
chapter 3, as in ``forward.mueller``), all as one looks at the upright picture, hence against the light:

- S1 > 0: the field swings along the picture's rows, horizontally; a level floor's gloss has S1 > 0.
- S2 > 0: along the diagonal from the lower left to the upper right.
- S3 > 0: the field at one place turns clockwise (right circular).

The frame is the sample's own: x is perpendicular to its ray and to the camera's vertical. Away from the axis
it leans against the picture by at most the angle that perspective leans upright lines.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np

from optsim.errors import BackendError
from optsim.quantities import Floats, View
from optsim.render.backend import activate
from optsim.render.sampler import pixel_sampler
from optsim.render.stage import Stage
from optsim.scene.scene import Scene

# Bounds the memory of one launch (about 100 bytes a lane).
_MAX_LANES = 4 << 20


@contextmanager
def polarised(backend: str | None = None) -> Generator[Any]:
    """Make the polarised twin of the chosen backend Mitsuba's variant for a block; yield ``mitsuba``.

    A scene belongs to the variant that loaded it: those loaded before live on untouched and are valid again
    after the block; those loaded inside must not leave it. The variant is the whole process's, so no other
    thread may render meanwhile.

    Raises
    ------
    BackendError
        When only the scalar fallback works, which has no polarised twin in one band.
    """
    report = activate(backend)
    if report.preview:
        raise BackendError(
            f"the Stokes pass needs llvm_ad_mono or cuda_ad_mono, but only {report.variant} works here: "
            f"{report.reason}"
        )
    import mitsuba as mi

    mi.set_variant(f"{report.variant}_polarized")
    try:
        yield mi
    finally:
        mi.set_variant(report.variant)


def render_stokes(
    scene: Scene, view: View, time_s: float, samples: int, seed: int, *, backend: str | None = None
) -> Floats:
    """Render the Stokes vector of one instant.

    S0 differs from the unpolarised render by what polarised light does at its second gloss: the unpolarised
    renderer takes the light between two mirrors for unpolarised (measured on ``glossy_floor``: no difference
    of the mean beyond its noise of 0.04 %, blocks of 120 samples within 3 %, noise included). Flickering
    lamps have their mean radiance.

    Parameters
    ----------
    scene : Scene
        What to render.
    view : View
        Fine grid and field of view.
    time_s : float
        The instant, s.
    samples : int
        Paths a fine sample.
    seed : int
        Of all random numbers.
    backend : str, optional
        Mitsuba variant whose polarised twin renders, instead of the probed one.

    Returns
    -------
    ndarray of shape (4, y, x), float32
        S0, S1, S2, S3, W m^-2 sr^-1; signs as the module says.

    Raises
    ------
    BackendError
        When no vectorised backend works.
    """
    with polarised(backend) as mi:
        stage = Stage(scene, view)
        stage.pose(time_s)
        return stokes_image(mi, stage.loaded, samples, seed, max_depth=scene.max_depth)


def stokes_image(mi: Any, loaded: Any, samples: int, seed: int, *, max_depth: int) -> Floats:
    """Render the Stokes vector of a scene loaded inside :func:`polarised`, array (4, y, x), float32.

    Not by Mitsuba's own film: two threads add to it in either order, so its last digit may change.
    """
    path = {"type": "path", "max_depth": max_depth, "rr_depth": max_depth}
    integrator = mi.load_dict(path)
    cols, rows = loaded.sensors()[0].film().size()
    size = max(1, min(samples, _MAX_LANES // (rows * cols)))
    total = np.zeros((4, rows * cols))
    for first in range(0, samples, size):
        count = min(size, samples - first)
        seen = _stokes_paths(mi, loaded, integrator, count, seed, first)
        total += seen.reshape(4, -1, count).sum(axis=2, dtype=np.float64)
    return (total / samples).reshape(4, rows, cols).astype(np.float32)


def _stokes_paths(mi: Any, loaded: Any, integrator: Any, count: int, seed: int, first: int) -> Floats:
    """Stokes vectors (4, n) of random paths, in one launch: ``count`` paths of each pixel, pixel by pixel."""
    import drjit as dr

    def opaque(number: int) -> Any:
        """Let no number be part of the program, which would be compiled anew for each."""
        return dr.opaque(mi.UInt32, number)

    sensor = loaded.sensors()[0]
    cols, rows = sensor.film().size()
    lane = dr.arange(mi.UInt32, rows * cols * count)
    pixel = lane // opaque(count)
    sampler: Any = pixel_sampler(mi, dr)()
    sampler.start(opaque(seed), pixel, lane - pixel * opaque(count) + opaque(first))
    row = pixel // opaque(cols)
    corner = mi.Point2f(mi.Float(pixel - row * cols), mi.Float(row))
    position = (corner + sampler.next_2d()) / mi.Point2f(cols, rows)
    ray, _ = sensor.sample_ray_differential(0.0, 0.0, position, mi.Point2f(0.5))
    light, _, _ = integrator.sample(loaded, sampler, ray, None, True)
    level = dr.cross(ray.d, sensor.world_transform() @ mi.Vector3f(0, 1, 0))
    turned = mi.mueller.rotate_stokes_basis(-ray.d, mi.mueller.stokes_basis(-ray.d), level) @ light
    # Lamps are unpolarised, so the first column is the light; its one band comes as three equal colours.
    seen = [turned[component, 0][0] for component in range(4)]
    dr.eval(seen)
    return np.stack([np.asarray(each.numpy(), np.float32) for each in seen])
