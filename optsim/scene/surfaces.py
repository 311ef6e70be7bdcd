# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""More procedural textures: floors, walls, cloth and paint for rooms, streets and wheels; all seeded, CC0.

Reflectances are those of such materials to a factor of about two (no source; sensible defaults).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from optsim.core.quantities import Doubles


def periodic_blur(image: Doubles, sigma: float | tuple[float, float]) -> Doubles:
    """Blur a periodic image by a Gaussian; sigma in texels."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(gaussian_filter(image, sigma, mode="wrap"))


def _grain(shape: tuple[int, int], sigma: float | tuple[float, float], seed: int) -> Doubles:
    """Periodic blurred noise of zero mean and unit standard deviation; sigma in texels."""
    noise = periodic_blur(np.random.default_rng(seed).standard_normal(shape), sigma)
    return (noise - noise.mean()) / noise.std()


def _centres(rows: int, cols: int) -> tuple[Doubles, Doubles]:
    """Texel centres (x, y) in tiles."""
    y, x = np.indices((rows, cols)) + 0.5
    return x / cols, y / rows


def _cells(size: int, count: int, seed: int) -> tuple[NDArray[np.int64], Doubles]:
    """Periodic Voronoi cells: each texel's cell, and its distance to the cell's edge in texels."""
    seeds = np.random.default_rng(seed).random((count, 2)) * size
    rows, cols = np.indices((size, size))
    places = np.stack([rows.ravel(), cols.ravel()], -1) + 0.5
    # Imported here: it is slow to import, and few scenes need it.
    from scipy.spatial import KDTree

    distance, index = (np.asarray(found) for found in KDTree(seeds, boxsize=size).query(places, k=2))
    edge = (distance[:, 1] - distance[:, 0]) / 2
    return index[:, 0].astype(np.int64).reshape(size, size), edge.reshape(size, size)


def asphalt() -> Doubles:
    """Dark road surface: fine stones and worn patches."""
    return np.clip(0.085 + 0.03 * _grain((256, 256), 0.9, 31) + 0.018 * _grain((256, 256), 14, 32), 0.02, 0.3)


def cobbles() -> Doubles:
    """Paving stones, rounded, of uneven tone with dark joints."""
    cell, edge = _cells(384, 150, 33)
    tone = 0.14 + 0.16 * np.random.default_rng(34).random(150)
    shade = tone[cell] * np.clip(edge / 4, 0.12, 1) * (1 + 0.12 * _grain((384, 384), 1.2, 35))
    return np.clip(shade, 0.01, 0.6)


def terrazzo() -> Doubles:
    """Light and dark stone chips in a grey ground: a floor to polish."""
    cell, edge = _cells(384, 900, 36)
    rng = np.random.default_rng(37)
    tone = np.where(rng.random(900) < 0.45, 0.27, rng.choice([0.04, 0.12, 0.5, 0.62], 900))
    return np.where(edge < 0.8, 0.24, tone[cell]) * (1 + 0.06 * _grain((384, 384), 1, 38))


def parquet() -> Doubles:
    """Wooden floor of short staves in squares, alternately upright and across."""
    n, staves = 512, 6
    rows, cols = np.indices((n, n))
    square = n // 4
    upright = (rows // square + cols // square) % 2 == 0
    along, across = np.where(upright, rows, cols), np.where(upright, cols, rows)
    stave = across // square * staves + (across % square) * staves // square
    number = stave * 101 + along // square * 37 + upright
    tone = 0.7 + 0.6 * np.random.default_rng(39).random(4096)[number % 4096]
    grain = np.where(upright, _grain((n, n), (30, 0.8), 40), _grain((n, n), (0.8, 30), 41))
    joint = ((across % square) * staves % square < staves * 1.3) | (along % square < 1.5)
    return np.clip(np.where(joint, 0.05, 0.27 * tone * (1 + 0.14 * grain)), 0.02, 0.8)


def wallpaper() -> Doubles:
    """Light wall with a dark pattern of lozenges and flowers."""
    x, y = _centres(256, 256)
    lattice = np.abs(np.cos(2 * np.pi * x) + np.cos(2 * np.pi * y)) < 0.1
    a, b = (x + 0.5) % 1 - 0.5, (y + 0.5) % 1 - 0.5
    c, d = x - 0.5, y - 0.5
    flower = np.zeros_like(x, np.bool_)
    for u, v, petals in ((a, b, 6), (c, d, 4)):
        radius, angle = np.hypot(u, v), np.arctan2(v, u)
        flower |= (radius < 0.09 + 0.06 * np.cos(petals * angle)) & (radius > 0.025)
    return np.where(lattice | flower, 0.28, 0.58) * (1 + 0.03 * _grain((256, 256), 1, 42))


def carpet() -> Doubles:
    """Bordered rug with a medallion, for ``fit = true``."""
    x, y = _centres(384, 384)
    rim = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    petals = np.cos(20 * np.pi * x) * np.cos(20 * np.pi * y)
    radius, angle = np.hypot(x - 0.5, y - 0.5), np.arctan2(y - 0.5, x - 0.5)
    middle = np.sin(45 * radius + 1.6 * np.cos(8 * angle))
    image = np.where(middle > 0.15, 0.42, 0.1)
    image = np.where(radius > 0.38, np.where(petals > 0.25, 0.36, 0.14), image)
    image = np.where(rim < 0.1, np.where((x + y) * 24 % 1 < 0.5, 0.5, 0.09), image)
    image = np.where((rim < 0.025) | (np.abs(rim - 0.1) < 0.008), 0.05, image)
    return np.clip(image * (1 + 0.18 * _grain((384, 384), 0.8, 43)), 0.02, 0.8)


def concrete() -> Doubles:
    """Cast wall: cloudy grey with board joints and anchor holes."""
    x, y = _centres(384, 384)
    grey = 0.36 + 0.035 * _grain((384, 384), 20, 44) + 0.02 * _grain((384, 384), 1, 45)
    joint = (y * 2 % 1 < 0.008) | (x < 0.004)
    hole = np.hypot(x % 0.5 - 0.25, y % 0.5 - 0.25) < 0.012
    return np.clip(np.where(hole, 0.05, np.where(joint, 0.16, grey)), 0.02, 0.8)


def facade() -> Doubles:
    """Front of a brick house: two by two dark windows with frames, sills and lintels."""
    n = 512
    x, y = _centres(n, n)
    course = np.floor(y * 32).astype(np.int64)
    shift = x * 16 + 0.5 * (course % 2)
    tone = 0.16 + 0.14 * np.random.default_rng(46).random((32, 16))[course, np.floor(shift).astype(int) % 16]
    joint = (y * 32 % 1 < 0.12) | (shift % 1 < 0.06)
    image = np.where(joint, 0.36, tone) * (1 + 0.06 * _grain((n, n), 1, 47))
    a, b = np.abs(x * 2 % 1 - 0.5), y * 2 % 1
    frame = (a < 0.21) & (np.abs(b - 0.53) < 0.30)
    glass = (a < 0.18) & (np.abs(b - 0.53) < 0.275) & (a > 0.012) & (np.abs(b - 0.62) > 0.01)
    image = np.where((a < 0.26) & (np.abs(b - 0.2) < 0.03), 0.5, image)
    image = np.where((a < 0.24) & (np.abs(b - 0.87) < 0.035), 0.42, image)
    return np.clip(np.where(glass, 0.025, np.where(frame, 0.55, image)), 0.01, 0.9)


def spokes() -> Doubles:
    """Paint of a wheel, bands in v: tyre 0 .. 0.5 (dark, light marks round), metal 0.5 .. 1 (bright)."""
    u, v = _centres(64, 512)
    tyre = np.where((u * 8 % 1 < 0.2) & (np.abs(v - 0.25) < 0.2), 0.75, 0.045)
    return np.where(v < 0.5, tyre, 0.74)


def bodywork() -> Doubles:
    """Paint of a car, bands in v: paint 0 .. 0.5 with a light line, windows 0.5 .. 0.75, lamps 0.75 .. 1."""
    _, v = _centres(256, 16)
    paint = np.where(np.abs(v - 0.36) < 0.02, 0.75, 0.32)
    return np.where(v < 0.5, paint, np.where(v < 0.75, 0.04, 0.85))


SURFACES: dict[str, Callable[[], Doubles]] = {
    "asphalt": asphalt,
    "bodywork": bodywork,
    "carpet": carpet,
    "cobbles": cobbles,
    "concrete": concrete,
    "facade": facade,
    "parquet": parquet,
    "spokes": spokes,
    "terrazzo": terrazzo,
    "wallpaper": wallpaper,
}
