"""A quick look at a scene: one small picture, and the sizes of what is in it."""

from __future__ import annotations

import numpy as np

from optsim.core.quantities import Doubles, Floats, View
from optsim.render.backend import activate
from optsim.render.channels import Channels, three_channels
from optsim.render.stage import RenderStage
from optsim.scene.scene import Scene

_ROWS, _COLS, _TAN = 360, 480, 0.36


def preview(scene: Scene, *, time_s: float = 0.0, samples: int = 64) -> Floats:
    """Render 480 x 360 pixels: the field of the prototype's camera.

    Parameters
    ----------
    scene : Scene
        Scene to draw, with all its bands.
    time_s : float
        Instant, s.
    samples : int
        Paths a pixel.

    Returns
    -------
    ndarray of shape (y, x, band), float32
        Radiance, W m^-2 sr^-1: R, G and B if the scene's bands see these, otherwise one band.

    Raises
    ------
    BackendError
        When no renderer backend works.
    """
    activate()
    view = View(_ROWS, _COLS, 1, _TAN)
    if [band.channel for band in scene.bands] == [*"RGB"]:
        with three_channels(scene):
            channels = Channels(scene, scene.bands, view, movers=True)
            channels.pose(time_s)
            counts = np.full(_ROWS * _COLS, samples)
            light = channels.radiance(counts, np.ones_like(counts), np.zeros_like(counts)) / samples
        return np.ascontiguousarray(light.T.reshape(_ROWS, _COLS, 3), np.float32)
    stage = RenderStage(scene.in_band(), view)
    stage.pose(time_s)
    return stage.picture(samples, 1)[..., None]


def sizes(scene: Scene, time_s: float = 0.0) -> dict[str, tuple[Doubles, Doubles]]:
    """Lowest and highest corner of each object and mover at an instant, m."""
    meshes = {f"object {name}": item.mesh().vertices_m for name, item in scene.still_objects().items()}
    meshes |= {f"mover {name}": mover.vertices(time_s) for name, mover in scene.singles().items()}
    return {name: (points.min(axis=0), points.max(axis=0)) for name, points in meshes.items()}
