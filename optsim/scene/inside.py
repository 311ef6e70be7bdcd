"""A camera inside of an object by mistake: it sees nothing but the object's back."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from optsim.core.quantities import Doubles
from optsim.scene.materials import Glass, Principled

# Share of all directions in which a surface must lie; an open one has less.
_ALL_AROUND = 0.99


def warn_if_inside(scene: Any) -> None:
    """Remark that at time 0 a closed, opaque object surrounds the camera, smaller than the way to its target.

    ``scene`` is a Scene, whose module calls this one. A room, or a car that the camera rides in,
    is as large as this way or larger, so it is no mistake.
    """
    camera = np.asarray(scene.camera.position_m)
    for name, parts in _by_owner(scene).items():
        vertices = [np.asarray(part.vertices_m) - camera for part in parts]
        low, high = (np.array([f(each, axis=0) for each in vertices]) for f in (np.min, np.max))
        low, high = low.min(axis=0), high.max(axis=0)
        if (low >= 0).any() or (high <= 0).any() or (high - low).max() >= scene.camera.distance_m:
            continue
        turns = sum(_turns(each[part.faces]) for each, part in zip(vertices, parts, strict=True))
        if abs(turns) > _ALL_AROUND:
            warnings.warn(
                f"{scene.name}: camera.position_m lies inside {name}, which hides the scene; cure: move one "
                "of the two, if this is not meant",
                stacklevel=2,
            )


def _by_owner(scene: Any) -> dict[str, list[Any]]:
    """Meshes at time 0 of what light does not pass, those of one model together."""
    found: dict[str, list[Any]] = {}
    meshes = {f"object/{name}": (item.material, item.mesh) for name, item in scene.still_objects().items()}
    meshes |= {f"mover/{name}": (item.material, item.rest) for name, item in scene.singles().items()}
    for name, (key, make) in meshes.items():
        material = scene.materials[key]
        if not isinstance(material, Glass) and not (
            isinstance(material, Principled) and material.opacity < 1
        ):
            found.setdefault(scene.owners.get(name, name), []).append(make())
    return {name.replace("/", "s.", 1): parts for name, parts in found.items()}


def _turns(triangles: Doubles) -> float:
    """Solid angle of triangles (n, 3, 3) at the origin over 4 pi, signed.

    A. van Oosterom, J. Strackee, "The solid angle of a plane triangle", IEEE Trans. Biomed. Eng. 30 (1983).
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    x, y, z = (np.linalg.norm(each, axis=1) for each in (a, b, c))
    ab, bc, ca = ((p * q).sum(axis=1) for p, q in ((a, b), (b, c), (c, a)))
    volume = (a * np.cross(b, c)).sum(axis=1)
    return float(np.arctan2(volume, x * y * z + ab * z + bc * x + ca * y).sum() / (2 * np.pi))
