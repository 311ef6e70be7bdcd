"""Faces of any number of corners, cut into triangles that cover each outline once."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from optsim.core.errors import ConfigError
from optsim.core.quantities import Bools, Doubles, Ints

# Doubled areas below this share of a face's own count as 0.
_FLAT = 1e-9


def check_indices(path: Path, indices: Ints, count: int, what: str = "vertex") -> None:
    """Refuse indices beyond what they count."""
    wrong = indices[(indices < 0) | (indices >= count)]
    if len(wrong):
        raise ConfigError(
            f"{path}: got a face with {what} {wrong[0]}, expected 0 to {count - 1}; "
            "cure: export the model again"
        )


def triangles(points: Doubles, corners: Ints, counts: Ints) -> tuple[Ints, int]:
    """Triangulate faces: places in ``corners`` (m, 3), and how many outlines cross themselves."""
    starts = np.cumsum(counts) - counts
    found, crossed = [np.zeros((0, 3), np.int64)], 0
    for n in np.unique(counts[counts > 2]).tolist():
        faces = np.flatnonzero(counts == n)
        outline = points[corners[starts[faces][:, None] + np.arange(n)]]
        outline = outline - outline[:, :1]
        crosses = np.cross(outline[:, 1:-1], outline[:, 2:])
        # Their sum is twice the area, along Newell's normal.
        normal = crosses.sum(axis=1)
        ahead = np.einsum("fkc,fc->fk", crosses, normal)
        # A fan is kept where all its triangles face as the outline does.
        # So written, a vertex that is not finite stays with the fan, and is found later.
        turned: Bools = (ahead < -_FLAT * (normal**2).sum(axis=1, keepdims=True)).any(axis=1)
        length = np.linalg.norm(crosses, axis=2).sum(axis=1)
        folded: Bools = np.linalg.norm(normal, axis=1) < _FLAT * length
        fan = np.array([(0, place, place + 1) for place in range(1, n - 1)], np.int64)
        plain = faces[~turned | folded]
        found.append((starts[plain][:, None, None] + fan).reshape(-1, 3))
        crossed += int(folded.sum())
        for index in np.flatnonzero(turned & ~folded).tolist():
            cut, crosses_itself = _cut(outline[index], normal[index])
            found.append(starts[faces[index]] + cut)
            crossed += crosses_itself
    return np.concatenate(found), crossed


def _cut(outline: Doubles, normal: Doubles) -> tuple[Ints, bool]:
    """Triangles of one face in its plane, and whether their area is not that of the outline."""
    from mapbox_earcut import triangulate_float64

    # Two axes of the plane, right-handed with the normal.
    across = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(normal, across) / np.linalg.norm(normal)], axis=1)
    flat: Doubles = np.ascontiguousarray(outline @ axes, np.float64)
    cut = triangulate_float64(flat, np.array([len(flat)], np.uint32)).astype(np.int64).reshape(-1, 3)
    (ax, ay), (bx, by) = (flat[cut[:, 1]] - flat[cut[:, 0]]).T, (flat[cut[:, 2]] - flat[cut[:, 0]]).T
    area = ax * by - ay * bx
    cut[area < 0] = cut[area < 0][:, ::-1]
    wanted = float(np.linalg.norm(normal))
    return cut, bool(abs(np.abs(area).sum() - wanted) > 1e-6 * wanted)
