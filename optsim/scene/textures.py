# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""Textures by name: reflectance maps (0 .. 1, linear) and the bright outside (relative radiance).

Photographs come from the scikit-image wheel (its ``data`` folder; only files inside the wheel, nothing is
downloaded). They are read as 8-bit sRGB and made linear. The others are procedural and seeded. Row 0 of every
map is its lower edge, since texture v points up.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from importlib.resources import files
from importlib.resources.abc import Traversable

import numpy as np

from optsim.core.errors import ConfigError, unknown_name
from optsim.core.quantities import Doubles, Floats
from optsim.scene.bands import Channel
from optsim.scene.charts import CHARTS
from optsim.scene.surfaces import SURFACES, periodic_blur

PHOTOGRAPHS = {
    "astronaut": "astronaut.png",
    "brick": "brick.png",
    "cameraman": "camera.png",
    "cat": "chelsea.png",
    "coins": "coins.png",
    "coffee": "coffee.png",
    "grass": "grass.png",
    "gravel": "gravel.png",
    "hubble": "hubble_deep_field.jpg",
    "moon": "moon.png",
    "page": "page.png",
    "rocket": "rocket.jpg",
    "text": "text.png",
}


def _noise(size: int, scales: tuple[float, ...], seed: int) -> Doubles:
    """Periodic noise in [0, 1]: Gaussian blurs of white noise, scales in texels, equal weights."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size))
    for scale in scales:
        layer = periodic_blur(rng.standard_normal((size, size)), scale)
        total += layer / layer.std()
    total -= total.min()
    return total / total.max()


def _checker() -> Doubles:
    cell = (np.indices((256, 256)) // 128).sum(0) % 2
    return np.clip(np.where(cell == 1, 0.72, 0.16) * (0.85 + 0.3 * _noise(256, (2, 8, 30), 3)), 0, 1)


def _planks() -> Doubles:
    rows, cols = np.indices((512, 512))
    grain = periodic_blur(np.random.default_rng(5).standard_normal((512, 512)), (0.8, 40))
    tone = 0.75 + 0.5 * np.random.default_rng(6).random(8)[rows // 64]
    shade = 0.38 * tone * (1 + 0.22 * grain / grain.std())
    return np.clip(np.where((rows % 64 < 2) | ((cols + rows // 64 * 190) % 512 < 2), 0.06, shade), 0.03, 0.9)


def _books() -> Doubles:
    """Three shelves of books: upright spines of random width and tone with title bars."""
    rng = np.random.default_rng(11)
    image = np.full((384, 384), 0.03)
    for shelf in range(3):
        low, col = shelf * 128 + 10, 4
        while col < 370:
            width, height = int(rng.integers(7, 20)), int(rng.integers(72, 108))
            tone = 0.08 + 0.75 * rng.random() ** 1.6
            spine = image[low : low + height, col : col + width - 1]
            spine[:] = tone
            spine[int(height * 0.62) : int(height * 0.8), 2:-2] = 0.9 if tone < 0.4 else 0.08
            spine[5:8] *= 0.4
            col += width
        image[shelf * 128 : shelf * 128 + 9] = 0.3
    return image


def _poster() -> Doubles:
    """Draw a test chart: rings, wedges, bars of several periods and a grey staircase on white."""
    y, x = np.indices((512, 512)) / 512
    image = np.full((512, 512), 0.85)
    radius, angle = np.hypot(x - 0.5, y - 0.64), np.arctan2(y - 0.64, x - 0.5)
    star = radius < 0.27
    image[star] = np.where(np.sin(28 * angle[star]) > 0, 0.82, 0.04)
    image[(radius > 0.29) & (radius < 0.31)] = 0.05
    for i, period in enumerate((0.08, 0.056, 0.04, 0.028, 0.02, 0.014)):
        bars = (np.abs(x - 0.13 - 0.148 * i) < 0.06) & (np.abs(y - 0.24) < 0.06)
        image[bars & ((x / period) % 1 < 0.5)] = 0.04
    for i in range(8):
        image[(np.abs(x - 0.115 - 0.11 * i) < 0.055) & (np.abs(y - 0.1) < 0.05)] = 0.03 * 1.62**i
    return image


def _stripes() -> Doubles:
    rows = np.indices((128, 128))[0]
    return np.where(rows % 32 < 14, 0.08, 0.7) * (0.9 + 0.2 * _noise(128, (1, 4), 8))


def _rings() -> Doubles:
    y, x = np.indices((256, 256)) / 256 - 0.5
    return np.where(np.sin(60 * np.hypot(x, y)) > 0, 0.75, 0.1) * (0.8 + 0.4 * _noise(256, (2, 6), 9))


def _blades() -> Doubles:
    """For a limb's texture: bright with dark bars along it."""
    v = np.indices((128, 64))[0] / 128
    return np.where((v * 7) % 1 < 0.3, 0.1, 0.78)


def _quarters() -> Doubles:
    """For a ball: light and dark gores, so that its rotation shows."""
    rows, cols = np.indices((128, 256))
    return np.where((cols // 32 + rows // 32) % 2 == 0, 0.78, 0.07)


def _leaf() -> Doubles:
    y, x = np.indices((128, 64)) / 64
    vein = (np.abs(x - 0.5) < 0.05) | (np.abs((y + np.abs(x - 0.5) * 1.2) % 0.25) < 0.04)
    return np.where(vein, 0.34, 0.16) * (0.8 + 0.4 * _noise(128, (2, 5), 10)[:, :64])


def _fabric() -> Doubles:
    rows, cols = np.indices((128, 128))
    weave = 0.5 + 0.25 * np.sin(rows * np.pi / 4) + 0.25 * np.sin(cols * np.pi / 4)
    return 0.1 + 0.35 * weave * (0.6 + 0.8 * _noise(128, (3, 12), 12))


def _marble() -> Doubles:
    turbulence = _noise(256, (4, 10, 24), 13)
    return 0.2 + 0.6 * np.abs(np.sin(14 * turbulence))


def _speckle() -> Doubles:
    return np.where(_noise(256, (2.5,), 14) > 0.55, 0.8, 0.12)


def _wardrobe() -> Doubles:
    """Draw a walker's clothes: five bands in v: skin, shirt, trousers, shoes, hair."""
    image = np.empty((500, 256))
    x = np.indices((100, 256))
    fine = _noise(256, (1, 3), 15)[:100]
    image[:100] = 0.42 + 0.06 * fine
    image[100:200] = np.where((x[0] + 2) % 20 < 10, 0.7, 0.1)
    image[200:300] = 0.1 + 0.2 * fine + 0.08 * np.sin(x[1] * np.pi / 4 + x[0] * np.pi / 4)
    image[300:400] = np.where(x[0] < 80, 0.05, 0.6)
    image[400:] = 0.03 + 0.05 * fine
    return image


def _street() -> Doubles:
    """Draw an outside view: sky with clouds over two rows of facades, trees and a road; relative radiance."""
    # A sunny day: cloud and sky 1, sunlit stucco 0.4, shaded stone 0.07, foliage 0.03 (no source).
    from scipy.ndimage import zoom

    n = 480
    y, x = np.indices((n, n)) / n
    rng = np.random.default_rng(21)
    billows: Doubles = np.asarray(zoom(_noise(160, (5, 12, 26), 22), 3, order=1))
    cloud = np.clip((billows - 0.5) * 3.2, 0, 1)
    image = 0.5 + 0.25 * (1 - y) + 0.55 * cloud
    image += 1.2 * np.exp(-((x - 0.16) ** 2 + (y - 0.93) ** 2) / 0.012)

    def facade(
        left: float, right: float, top: float, tone: float, glass: float, floors: int, axes: int
    ) -> None:
        here = (x >= left) & (x < right) & (y < top)
        image[here] = tone * (0.94 + 0.12 * rng.random(here.sum()))
        a, b = (x - left) / (right - left) * axes % 1, y / top * floors % 1
        image[here & (a > 0.28) & (a < 0.72) & (b > 0.24) & (b < 0.8)] = glass
        image[here & (a > 0.28) & (a < 0.72) & (np.abs(b - 0.52) < 0.025)] = tone * 0.8
        image[here & (a > 0.22) & (a < 0.78) & (b > 0.16) & (b < 0.24)] = tone * 1.35
        image[here & (y > top - 0.018)] = tone * 1.5

    facade(0.00, 0.30, 0.60, 0.09, 0.02, 6, 4)
    facade(0.30, 0.62, 0.50, 0.34, 0.04, 5, 5)
    facade(0.62, 0.80, 0.68, 0.13, 0.03, 8, 3)
    facade(0.80, 1.00, 0.46, 0.42, 0.05, 5, 3)
    foliage: Doubles = np.asarray(zoom(_noise(160, (1.5, 4), 23), 3, order=1))
    for center, radius in ((0.22, 0.15), (0.66, 0.12), (0.96, 0.14)):
        crown = np.hypot(x - center, (y - 0.2) * 0.9) < radius * (0.75 + 0.5 * foliage)
        image[crown] = 0.015 + 0.07 * foliage[crown] ** 2
        image[(np.abs(x - center) < 0.012) & (y < 0.16)] = 0.012
    road = y < 0.07
    image[road] = 0.11 + 0.03 * foliage[road]
    image[road & (np.abs(y - 0.035) < 0.004) & ((x * 9) % 1 < 0.6)] = 0.3
    return image


PROCEDURAL: dict[str, Callable[[], Doubles]] = {
    "blades": _blades,
    "books": _books,
    "checker": _checker,
    "fabric": _fabric,
    "leaf": _leaf,
    "marble": _marble,
    "planks": _planks,
    "poster": _poster,
    "quarters": _quarters,
    "rings": _rings,
    "speckle": _speckle,
    "stripes": _stripes,
    "wardrobe": _wardrobe,
    **CHARTS,
    **SURFACES,
}
OUTSIDES: dict[str, Callable[[], Doubles]] = {"street": _street}


def check_texture(name: str) -> str:
    """Return the name of a reflectance texture, or raise a ConfigError with the nearest valid one."""
    if name not in PHOTOGRAPHS and name not in PROCEDURAL:
        raise unknown_name("texture", name, [*PHOTOGRAPHS, *PROCEDURAL])
    return name


def photograph(name: str) -> Traversable:
    """Find the file of a photograph."""
    path = files("skimage") / "data" / PHOTOGRAPHS[name]
    if not path.is_file():
        raise ConfigError(
            f"texture {name!r}: {PHOTOGRAPHS[name]} is not in the installed scikit-image; "
            "cure: install the scikit-image wheel from PyPI, or choose a procedural texture: "
            + ", ".join(PROCEDURAL)
        )
    return path


@functools.cache
def reflectance_map(name: str, channel: Channel | None = None) -> Floats:
    """Reflectance of a texture: array of shape (y, x), float32, row 0 at the lower edge.

    Only photographs have colour; without a channel they count by their luma.

    Raises
    ------
    ConfigError
        For an unknown name, or a photograph that the installed scikit-image does not include.
    """
    if check_texture(name) in PROCEDURAL:
        return np.clip(PROCEDURAL[name](), 0, 0.95).astype(np.float32)
    from PIL import Image

    with photograph(name).open("rb") as stream, Image.open(stream) as picture:
        mode = picture.convert("L" if channel is None else "RGB")
        grey = np.asarray(mode.getchannel(channel or "L"), np.float64)[::-1] / 255
    # Paper and paint reflect 3 to 90 %: the photograph's black and white, not the renderer's 0 and 1.
    return (0.03 + 0.87 * grey**2.2).astype(np.float32)


@functools.cache
def outside_map(name: str) -> Floats:
    """Relative radiance of an outside, array of shape (y, x), float32, row 0 at the lower edge."""
    if name not in OUTSIDES:
        raise unknown_name("outside", name, OUTSIDES)
    return OUTSIDES[name]().astype(np.float32)
