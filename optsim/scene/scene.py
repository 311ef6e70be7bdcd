"""A scene: camera pose, lamps, still objects and movers, read from ``scenes/<name>/scene.toml``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, cast

from pydantic import Field, field_validator, model_validator

from optsim.config import Part, Table, build, read_toml
from optsim.errors import unknown_name
from optsim.scene.crowd import Crowd, Single
from optsim.scene.geometry import Mesh, merge
from optsim.scene.movers import BouncingBall, Card, Fan, Pendulum
from optsim.scene.parts import CameraPose, Lamp, Material, StillObject
from optsim.scene.walker import Walker

Mover = Annotated[Walker | Fan | Pendulum | BouncingBall | Card | Crowd, Field(discriminator="kind")]


class Scene(Part):
    """Everything that a renderer must know, in SI; names are free and only used in messages and caches.

    Parameters
    ----------
    name, variation : str
        Folder name, and which of its variations this is.
    description : str
        One line.
    white_w_m2_sr : float
        Declared white: the radiance that scores take as their peak.
    max_depth : int
        Longest light path, in segments.
    camera : CameraPose
        The camera's pose; its field of view is the camera's own business (``View``).
    materials, lamps, objects, movers : dict
        By name.
    """

    name: str
    variation: str = "main"
    description: str = ""
    white_w_m2_sr: float = Field(gt=0)
    max_depth: int = Field(7, ge=2, le=64)
    camera: CameraPose
    materials: dict[str, Material]
    lamps: dict[str, Lamp] = Field(min_length=1)
    objects: dict[str, StillObject] = Field(default={})
    movers: dict[str, Mover] = Field(default={})

    @field_validator("movers")
    @classmethod
    def _no_crowds_inside(cls, movers: dict[str, Mover]) -> dict[str, Mover]:
        members: dict[str, Mover] = {}
        for name, mover in movers.items():
            if isinstance(mover, Crowd):
                members |= {f"{name}_{key}": single for key, single in mover.members().items()}
            else:
                members[name] = mover
        return members

    @model_validator(mode="after")
    def _materials_exist(self) -> Scene:
        users = [*self.objects.items(), *self.singles().items()]
        for name, user in users:
            if user.material not in self.materials:
                known = self.materials or ["(none declared)"]
                raise ValueError(f"{name}: {unknown_name('material', user.material, known)}")
        return self

    def singles(self) -> dict[str, Single]:
        """Return the movers by name, crowds resolved into their members."""
        return {name: mover for name, mover in self.movers.items() if not isinstance(mover, Crowd)}

    def still_meshes(self) -> dict[str, Mesh]:
        """One mesh a material, of all objects that never move: fewer shapes trace faster."""
        groups: dict[str, list[Mesh]] = {}
        for item in self.objects.values():
            groups.setdefault(item.material, []).append(item.mesh())
        return {material: merge(meshes) for material, meshes in groups.items()}


def scenes_folder() -> Path:
    """Where the shipped scenes are: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    shipped = package / "shipped_scenes"
    return shipped if shipped.is_dir() else package.parent / "scenes"


def list_scenes() -> dict[str, tuple[str, ...]]:
    """Shipped scenes and their variations, ``main`` first."""
    found: dict[str, tuple[str, ...]] = {}
    for path in sorted(scenes_folder().glob("*/scene.toml")):
        found[path.parent.name] = ("main", *_variations(read_toml(path)))
    return found


def load_scene(name_or_path: str | Path, variation: str = "main") -> Scene:
    """Read a scene and one of its variations.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a shipped scene, a folder with a ``scene.toml``, or such a file.
    variation : str
        ``main``, or a table of overrides under ``[variations.<name>]``.

    Raises
    ------
    ConfigError
        For an unknown scene, variation, key, kind, material or texture, no lamp, or a number out of range.
    """
    text = str(name_or_path)
    if "/" in text or text.endswith(".toml"):
        path = Path(text)
        path = path / "scene.toml" if path.is_dir() else path
    elif text in list_scenes():
        path = scenes_folder() / text / "scene.toml"
    else:
        raise unknown_name("scene", text, list_scenes())
    table = read_toml(path)
    variations = _variations(table)
    table.pop("variations", None)
    if variation != "main":
        if variation not in variations:
            raise unknown_name(f"variation of {text}", variation, ["main", *variations])
        table = merged(table, variations[variation])
    return build(Scene, table | {"variation": variation}, where=str(path))


def merged(table: Mapping[str, Any], changes: Mapping[str, Any]) -> Table:
    """Table with nested changes laid over it; a name mapped to the empty string is removed."""
    result = dict(table)
    for key, value in changes.items():
        if value == "":
            result.pop(key, None)
        elif isinstance(value, Mapping) and isinstance(result.get(key), Mapping):
            result[key] = merged(result[key], cast("Table", value))
        else:
            result[key] = value
    return result


def _variations(table: Table) -> dict[str, Table]:
    return cast("dict[str, Table]", table.get("variations", {}))
