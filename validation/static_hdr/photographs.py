"""Sharp HDR pictures: photographs of the scikit-image wheel, spread over decades.

Taken for the logarithm of radiance, a photograph's tones give pictures whose dark parts are as detailed as
their bright ones, which made scenes rarely are.
"""

from __future__ import annotations

from importlib.resources import files

import numpy as np
from PIL import Image

PHOTOGRAPHS = (
    "astronaut.png",
    "brick.png",
    "camera.png",
    "chelsea.png",
    "coffee.png",
    "coins.png",
    "grass.png",
    "gravel.png",
    "hubble_deep_field.jpg",
    "moon.png",
    "motorcycle_left.png",
    "rocket.jpg",
)
_SHRINK = 2  # photographs are sharper at half their size


def photograph(name: str, rows: int, cols: int, decades: float) -> np.ndarray:
    """Radiance, (rows, cols), up to 1: the middle of a photograph at half its size, or as it fits."""
    with Image.open(str(files("skimage.data") / name)) as opened:
        grey = opened.convert("L")
    width, height = grey.size
    scale = max(cols / width, rows / height, 1 / _SHRINK)
    size = max(round(width * scale), cols), max(round(height * scale), rows)
    tones = np.asarray(grey.resize(size, Image.Resampling.BOX), float) / 255
    top, left = (tones.shape[0] - rows) // 2, (tones.shape[1] - cols) // 2
    return 10.0 ** (decades * (tones[top : top + rows, left : left + cols] - 1))
