"""Footage of the dead-leaves model in motion: training material for priors, drawn without a renderer.

The dead-leaves model stacks opaque shapes of power-law sizes at random. It has the scale invariance and the
edges of natural images (Matheron, 1968; Lee, Mumford and Huang, Int. J. Comput. Vis. 41, 35 (2001),
doi:10.1023/A:1011109015675). Here each leaf has a texture. All leaves move with a camera, and some on their
own. Speeds are uniform in their logarithm, and many leaves stand still.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Doubles, Floats, Ints

_SLOTS = 36  # slots of a clip
_POSES = 4  # poses a slot
_RAYS = 4  # samples a pixel and pose
# Range of speeds, pixels per slot: slower is still, faster crosses a patch in a few slots.
_SLOW, _FAST = 0.02, 1.6
_SMALL_PX = 2.5
# Ray positions within a pixel: one list for all, of prime length, so that neighbours differ.
_SHIFTS = 997
_LEAF = np.dtype(
    [
        (name, np.float64)
        for name in (
            *("y", "x", "vy", "vx", "sway_y", "sway_x", "sway_rate", "sway_phase"),
            *("angle", "turn", "swing", "swing_rate", "swing_phase", "pivot", "growth", "parallax"),
            *("radius", "aspect", "power", "lobes", "lobe_size", "lobe_phase"),
            *("ripple", "ripple_wave", "ripple_rate", "ripple_phase"),
            *("texel", "ty", "tx", "gain", "offset", "shade", "shade_rate", "shade_phase"),
        )
    ]
    + [("texture", np.int64)]
)


def dead_leaves(textures: Sequence[Floats], rng: np.random.Generator, *, size: int = 48) -> Floats:
    """Draw one clip.

    Parameters
    ----------
    textures : sequence of ndarray of shape (y, x), float32
        Reflectance maps; at least 32 texels a side.
    rng : numpy.random.Generator
        Generator of all random numbers.
    size : int
        Side of the square picture, pixels.

    Returns
    -------
    ndarray of shape (slot, v, u), float32
        Mean light in each slot; 1 is a white leaf.
    """
    count = int(_evenly(rng, 3, 40))
    leaves = _leaves(count, len(textures), size, rng)
    camera = _camera(rng)
    # Some recordings are linear in light, others encoded; some lenses blur by part of a pixel.
    curve = float(rng.choice([1.0, rng.uniform(0.45, 1.0)]))
    encoded: list[Floats] = [np.power(each, np.float32(curve)) for each in textures]
    maps = [_at_scale(encoded[int(leaf["texture"])], leaf, rng) for leaf in leaves]
    blur = float(rng.uniform(0.0, 0.7) * (rng.random() < 0.5))
    shifts = rng.uniform(-0.5, 0.5, (_SHIFTS, 2)) + blur * rng.standard_normal((_SHIFTS, 2))
    sizes = np.array([each.shape for each in maps])
    starts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]])
    texels = np.concatenate([each.ravel() for each in maps])
    clip = np.zeros((_SLOTS, size, size), np.float32)
    _draw(clip, leaves, camera, texels, starts, sizes, shifts)
    return clip


def _evenly(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _camera(rng: np.random.Generator) -> Doubles:
    """Draw the common motion: velocity (y, x), rotation and growth a slot, shake (amplitude, rate, phase)."""
    if rng.random() < 0.5:
        return np.zeros(7)
    heading, speed = rng.uniform(0, 2 * np.pi), _evenly(rng, _SLOW, _FAST)
    turn, growth = rng.standard_normal(2) * (0.01, 0.004) * (rng.random(2) < 0.3)
    shake = (rng.uniform(0, 2) * (rng.random() < 0.2), rng.uniform(0.05, 0.6), rng.uniform(0, 6.28))
    return np.array([speed * np.sin(heading), speed * np.cos(heading), turn, growth, *shake])


def _leaves(count: int, n_textures: int, size: int, rng: np.random.Generator) -> Any:
    """Leaves from the front to the back; the last one fills the picture."""
    leaves = np.zeros(count + 1, _LEAF)
    alone = rng.uniform(0, 1) ** 2  # share of leaves that move on their own
    steep = rng.uniform(0.5, 2.0)
    largest = size * 0.6
    for leaf in leaves:
        leaf["y"], leaf["x"] = rng.uniform(-0.6, 0.6, 2) * size
        if rng.random() < alone:
            heading, speed = rng.uniform(0, 2 * np.pi), _evenly(rng, _SLOW, _FAST)
            leaf["vy"], leaf["vx"] = speed * np.sin(heading), speed * np.cos(heading)
            if rng.random() < 0.3:
                leaf["sway_y"], leaf["sway_x"] = rng.standard_normal(2) * 3
                leaf["sway_rate"], leaf["sway_phase"] = rng.uniform(0.03, 0.3), rng.uniform(0, 6.28)
            if rng.random() < 0.4:
                leaf["turn"] = rng.standard_normal() * 0.05
            if rng.random() < 0.3:
                leaf["swing"], leaf["swing_rate"] = rng.uniform(0, 0.6), rng.uniform(0.03, 0.3)
                leaf["swing_phase"], leaf["pivot"] = rng.uniform(0, 6.28), rng.uniform(-1, 1)
            if rng.random() < 0.3:
                leaf["growth"] = rng.standard_normal() * 0.01
            if rng.random() < 0.3:
                leaf["ripple"], leaf["ripple_wave"] = rng.uniform(0, 2.5), 2 * np.pi / rng.uniform(10, 50)
                leaf["ripple_rate"], leaf["ripple_phase"] = rng.uniform(0.02, 0.4), rng.uniform(0, 6.28)
        leaf["angle"] = rng.uniform(0, 2 * np.pi)
        leaf["parallax"] = rng.uniform(0.6, 1.4) if rng.random() < 0.5 else 1.0
        # The density of radii is a power law, drawn by the inverse of its distribution.
        ends = np.array([_SMALL_PX, largest]) ** (1 - steep)
        leaf["radius"] = (ends[0] + rng.random() * (ends[1] - ends[0])) ** (1 / (1 - steep))
        leaf["aspect"] = np.exp(rng.uniform(-1.2, 1.2))
        leaf["power"] = rng.choice([2.0, 2.0, 3.0, 16.0])
        leaf["lobes"], leaf["lobe_phase"] = rng.integers(2, 7), rng.uniform(0, 6.28)
        leaf["lobe_size"] = rng.choice([0.0, rng.uniform(0, 0.4)])
        leaf["texture"] = rng.integers(n_textures)
        # Some leaves have the contrast of their texture, some less, some none. Light falls off along them.
        contrast = rng.choice([0.0, 1.0, rng.uniform(0.02, 1)], p=[0.2, 0.3, 0.5])
        leaf["shade"], leaf["shade_phase"] = rng.uniform(0, 0.6), rng.uniform(0, 6.28)
        leaf["shade_rate"] = 2 * np.pi / rng.uniform(30, 200)
        tone = rng.uniform(0.05, 1.0) / (1 + leaf["shade"])
        leaf["gain"], leaf["offset"] = contrast * tone, (1 - contrast) * tone * 0.5
    leaves[-1]["radius"] = 0  # marks the ground
    return leaves


def _at_scale(texture: Floats, leaf: Any, rng: np.random.Generator) -> Floats:
    """Halve a texture until a texel is about a pixel; set the leaf's texels a pixel and its origin."""
    zoom = _evenly(rng, 0.35, 6)
    while zoom > 1.2 and min(texture.shape) >= 32:
        rows, cols = texture.shape[0] // 2 * 2, texture.shape[1] // 2 * 2
        texture = texture[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2).mean(axis=(1, 3))
        zoom /= 2
    leaf["texel"] = zoom
    leaf["ty"], leaf["tx"] = rng.random(2) * texture.shape
    return np.ascontiguousarray(texture, np.float32)


@compiled()
def _draw(
    clip: Floats, leaves: Any, camera: Doubles, texels: Floats, starts: Ints, sizes: Ints, shifts: Doubles
) -> None:
    """Sum samples; leaves from the front to the back, each in its own rotated frame."""
    slots, rows, cols = clip.shape
    count = len(leaves)
    place = np.empty((count, 6))
    share = np.float32(1 / (_POSES * _RAYS))
    number = 0
    for slot in range(slots):
        for pose in range(_POSES):
            time = slot + (pose + 0.5) / _POSES - slots / 2
            _pose(leaves, camera, time, place)
            for v in range(rows):
                for u in range(cols):
                    for _ in range(_RAYS):
                        y = v + 0.5 + shifts[number, 0] - rows / 2
                        x = u + 0.5 + shifts[number, 1] - cols / 2
                        number = (number + 1) % len(shifts)
                        light = _light(y, x, time, leaves, place, texels, starts, sizes)
                        clip[slot, v, u] += share * light


@compiled()
def _pose(leaves: Any, camera: Doubles, time: float, place: Doubles) -> None:
    """Fill each leaf's centre (y, x), cosine and sine of its angle, inverse size and reach squared."""
    turn, grown = camera[2] * time, np.exp(camera[3] * time)
    shake = camera[4] * np.sin(camera[5] * time + camera[6])
    for n in range(len(leaves)):
        leaf = leaves[n]
        sway = np.sin(leaf.sway_rate * time + leaf.sway_phase)
        y = leaf.y + leaf.vy * time + leaf.sway_y * sway
        x = leaf.x + leaf.vx * time + leaf.sway_x * sway
        moved = leaf.parallax * time
        y += camera[0] * moved + shake
        x += camera[1] * moved + shake * 0.5
        angle = leaf.angle + leaf.turn * time
        bent = leaf.swing * np.sin(leaf.swing_rate * time + leaf.swing_phase)
        # Swinging is about a pivot off the centre.
        arm = leaf.pivot * leaf.radius
        y += arm * (np.sin(angle) - np.sin(angle + bent))
        x += arm * (np.cos(angle) - np.cos(angle + bent))
        size = grown * np.exp(leaf.growth * time)
        place[n, 0] = grown * (np.cos(turn) * y - np.sin(turn) * x)
        place[n, 1] = grown * (np.sin(turn) * y + np.cos(turn) * x)
        place[n, 2] = np.cos(angle + bent - turn)
        place[n, 3] = np.sin(angle + bent - turn)
        place[n, 4] = 1 / size
        reach = 1.5 * max(leaf.aspect, 1 / leaf.aspect) ** 0.5 * leaf.radius * size + leaf.ripple
        place[n, 5] = reach**2


@compiled()
def _light(
    y: float,
    x: float,
    time: float,
    leaves: Any,
    place: Doubles,
    texels: Floats,
    starts: Ints,
    sizes: Ints,
) -> float:
    """Light of the foremost leaf at a point."""
    for n in range(len(leaves)):
        leaf = leaves[n]
        dy, dx = y - place[n, 0], x - place[n, 1]
        if leaf.radius > 0 and dy * dy + dx * dx > place[n, 5]:
            continue
        b = (place[n, 2] * dy - place[n, 3] * dx) * place[n, 4]
        a = (place[n, 3] * dy + place[n, 2] * dx) * place[n, 4]
        if leaf.ripple > 0:
            b += leaf.ripple * np.sin(leaf.ripple_wave * a - leaf.ripple_rate * time + leaf.ripple_phase)
        if leaf.radius > 0:
            stretch = leaf.aspect**0.5
            p, q = abs(a / (leaf.radius * stretch)), abs(b * stretch / leaf.radius)
            edge = 1.0
            if leaf.lobe_size > 0:
                edge += leaf.lobe_size * np.sin(leaf.lobes * np.arctan2(b, a) + leaf.lobe_phase)
            if leaf.power == 2.0:
                outside = p * p + q * q > edge * edge
            else:
                outside = p**leaf.power + q**leaf.power > edge**leaf.power
            if outside:
                continue
        high, wide = sizes[n]
        ty, tx = (leaf.ty + b * leaf.texel) % high, (leaf.tx + a * leaf.texel) % wide
        i, j = int(ty), int(tx)
        fy, fx = ty - i, tx - j
        i, j = i % high, j % wide
        k, m = (i + 1) % high, (j + 1) % wide
        first = starts[n]
        upper = (1 - fx) * texels[first + i * wide + j] + fx * texels[first + i * wide + m]
        lower = (1 - fx) * texels[first + k * wide + j] + fx * texels[first + k * wide + m]
        shade = 1 + leaf.shade * np.sin(leaf.shade_rate * a + leaf.shade_phase)
        return shade * (leaf.offset + leaf.gain * ((1 - fy) * upper + fy * lower))
    return 0.0
