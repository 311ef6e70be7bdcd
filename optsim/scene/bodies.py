"""Bodies: objects as people count them, each with all its parts, whatever their materials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from optsim.scene.fields import Vector
from optsim.scene.keyframed import Keyframed, keyframed_objects
from optsim.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Body:
    """One object: a still one, or all that a mover carries."""

    parts: Mapping[str, Any]  # object/NAME -> still object, mover/NAME -> single mover
    category: str
    turn_rad: Vector  # of its own axes at time 0: about x, then y, then z


def bodies(scene: Scene) -> dict[str, Body]:
    """Find the bodies of a scene by name; lamps and the shapes of the scene's own file are none."""
    parts: dict[str, dict[str, Any]] = {}
    stated: dict[str, str] = {}
    for key, item in scene.still_objects().items():
        parts.setdefault(_owner(scene, f"object/{key}"), {})[f"object/{key}"] = item
    for key, mover in scene.movers.items():
        owner, singles = _owner(scene, f"mover/{key}"), {key: mover}
        if isinstance(mover, Keyframed):
            singles = keyframed_objects(key, mover, scene.objects)
            for name in mover.objects:
                if said := scene.categories.get(_owner(scene, f"object/{name}")):
                    stated[owner] = said
        parts.setdefault(owner, {}).update({f"mover/{name}": single for name, single in singles.items()})
    stated |= scene.categories
    firsts = {name: _whole(next(iter(items.values()))) for name, items in parts.items()}
    return {
        name: Body(items, stated.get(name) or _kind(firsts[name]), _turn(firsts[name]))
        for name, items in parts.items()
    }


def _owner(scene: Scene, part: str) -> str:
    return scene.owners.get(part, part)


def _kind(item: Any) -> str:
    file, shape = getattr(item, "file", None), getattr(item, "shape", None)
    return Path(file).stem if file else shape or str(item.kind)


def _turn(item: Any) -> Vector:
    return getattr(item, "rotation_rad", (0.0, 0.0, getattr(item, "yaw_rad", 0.0)))


def _whole(item: Any) -> Any:
    """Return the first object that a mover carries, or the part itself."""
    return item.items[0] if hasattr(item, "items") else item
