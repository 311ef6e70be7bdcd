"""Pictures of a study's task, cropped to the window where the reconstructions err most."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from markupsafe import Markup

from optsim.core.files import write_png8
from optsim.core.quantities import Floats
from optsim.metrics.error_maps import best_corner
from optsim.report.page import strip
from optsim.report.pictures import enlarge, rgb, tone_curve_for

PICTURES = "pictures.npz"
"""In the folder of a task: name -> (v, u), W m^-2, with the truth as "truth"."""
SAID = "One slot of the last scored frame, one tone curve for all: the window with the largest errors."
_CROP, _SIDE_PX = 3, 320


def cropped(folder: Path, task: str) -> Markup | None:
    """Write the crops of a task beside the page, and return their strip; None without pictures."""
    file = folder / task / PICTURES
    if not file.is_file():
        return None
    with np.load(file) as arrays:
        images: dict[str, Floats] = {key: arrays[key] for key in arrays.files}
    tone = tone_curve_for(np.maximum(images["truth"], 0))
    window = _window(images)
    strips: list[tuple[str, str]] = []
    for key, image in images.items():
        grey = tone.apply(np.maximum(image[window], 0))
        path = Path("pictures") / f"{task.replace('/', '-')}-{key.replace(' ', '-')}.png"
        write_png8(folder / path, rgb(enlarge(grey, max(1, _SIDE_PX // grey.shape[0]))))
        strips.append((path.as_posix(), key))
    return strip(strips)


def _window(images: dict[str, Floats]) -> tuple[slice, slice]:
    """Find the window, a third of the panel each way, with the largest error of any reconstruction."""
    truth = images["truth"]
    error = np.max([np.abs(image - truth) for image in images.values()], axis=0)
    error = np.minimum(error, np.percentile(error, 99))
    rows, cols = (max(1, side // _CROP) for side in error.shape)
    row, col = best_corner(error.astype(np.float64), (rows, cols))
    return slice(row, row + rows), slice(col, col + cols)
