"""A quick look at a scene: one small picture, and the sizes of what is in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optsim.core.files import write_png8
from optsim.core.quantities import Doubles, View
from optsim.render.backend import activate
from optsim.render.stage import Stage
from optsim.scene.scene import Scene

_ROWS, _COLS, _TAN = 360, 480, 0.36


def preview(scene: Scene, path: Path, *, time_s: float = 0.0, samples: int = 64) -> None:
    """Write a PNG of 480 x 360 pixels: the field of the prototype's camera, tone by the logarithm.

    Parameters
    ----------
    scene : Scene
        Scene to draw.
    path : Path
        File to write.
    time_s : float
        Instant, s.
    samples : int
        Paths a pixel.

    Raises
    ------
    BackendError
        When no renderer backend works.
    """
    activate()
    stage = Stage(scene.in_band(), View(_ROWS, _COLS, 1, _TAN))
    stage.pose(time_s)
    image = stage.picture(samples, 1).astype(np.float64)
    low, high = np.percentile(image, (2, 99.5))
    low = max(float(low), float(high) * 1e-3, 1e-12)
    share = np.log(np.maximum(image, low) / low) / max(np.log(max(float(high), low * 1.01) / low), 1e-9)
    grey = np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)
    write_png8(path, np.repeat(grey[..., None], 3, axis=2))


def sizes(scene: Scene, time_s: float = 0.0) -> dict[str, tuple[Doubles, Doubles]]:
    """Lowest and highest corner of each object and mover at an instant, m."""
    meshes = {f"object {name}": item.mesh().vertices_m for name, item in scene.still_objects().items()}
    meshes |= {f"mover {name}": mover.vertices(time_s) for name, mover in scene.singles().items()}
    return {name: (points.min(axis=0), points.max(axis=0)) for name, points in meshes.items()}
