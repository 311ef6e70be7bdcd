"""A scene: camera pose, lamps, still objects and movers, read from ``scenes/<name>/scene.toml``."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from optsim.core.config import Part, Table, build, read_toml
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.extensions import AS_IT_IS, OBJECTS, or_offered
from optsim.scene.bands import MONO_NM, Bands, colour_by_band, tables, taken
from optsim.scene.camera_pose import CameraPose
from optsim.scene.crowd import Crowd, Single
from optsim.scene.geometry import Mesh, merge
from optsim.scene.inside import warn_if_inside
from optsim.scene.keyframed import Keyframed, KeyframedObjects, keyframed_objects
from optsim.scene.lamps import Flicker, Lamp, flicker_key
from optsim.scene.materials import Diffuse, Material, Plastic, Principled, polarises
from optsim.scene.mesh_objects import AnimatedModel, VertexSequence
from optsim.scene.model_tables import model_table, with_models
from optsim.scene.movers import BouncingBall, Card, Fan, Pendulum
from optsim.scene.parts import StillObject
from optsim.scene.populate import with_population
from optsim.scene.sky import PictureSky, Sky, SunSky, with_sky
from optsim.scene.static_shapes import StaticShapes, read_static
from optsim.scene.textures import PHOTOGRAPHS, photograph
from optsim.scene.variation import extremes, named_variations, varied
from optsim.scene.vehicle import Car, CarBody, Wheel
from optsim.scene.walker import Walker

Mover = Annotated[
    Walker
    | Fan
    | Pendulum
    | BouncingBall
    | Card
    | Wheel
    | CarBody
    | Car
    | Crowd
    | Keyframed
    | VertexSequence
    | AnimatedModel,
    Field(discriminator="kind"),
    or_offered(OBJECTS, Part),
    AS_IT_IS,
]

# Movers of the renderer: each has ``material``, ``rest()`` and ``vertices(time_s)``.
SingleMover = Single | Wheel | CarBody | KeyframedObjects | VertexSequence | AnimatedModel

# Name of the sky among the lamps.
SKY = "sky"


class Scene(Part):
    """All input of a renderer, in SI; names are free and only used in messages and caches.

    Parameters
    ----------
    name, variation : str
        Folder name, and name of the variation.
    description : str
        One line.
    white_w_m2_sr : float
        Declared white: the radiance that scores use as their peak.
    max_depth : int
        Longest light path, in segments.
    camera : CameraPose
        The camera's pose and motion; its field of view belongs to the camera (``View``).
    bands : tuple of Band
        Spectral bands; one at a time is rendered, see :meth:`in_band`. In a file ``"srgb"`` stands for three
        of the names R, G and B at the wavelengths of the sRGB primaries. None: a single one at 550 nm.
    materials, lamps, objects, movers : dict
        By name. Objects named by a keyframed mover move, all others are still.
    sky : PictureSky, SunSky or None
        Light from all around; lamps may be left out then.
    static : StaticShapes or None
        More still shapes; in ``scene.toml`` the name of a file in Mitsuba's XML beside it.
    reserved : bool
        Reserved for testing: no prior may be trained on it.
    owners, categories : dict
        Part -> object, and object -> category, as ``object/NAME`` or ``mover/NAME``; set by reading a file.
    """

    name: str
    variation: str = "main"
    description: str = ""
    white_w_m2_sr: float = Field(gt=0)
    max_depth: int = Field(7, ge=2, le=64)
    camera: CameraPose
    bands: Bands = ()
    materials: dict[str, Material]
    lamps: dict[str, Lamp] = Field(default={})
    sky: Sky | None = None
    objects: dict[str, StillObject] = Field(default={})
    movers: dict[str, Mover] = Field(default={})
    static: StaticShapes | None = None
    reserved: bool = False
    owners: dict[str, str] = Field(default={}, exclude=True)
    categories: dict[str, str] = Field(default={}, exclude=True)

    @field_validator("materials")
    @classmethod
    def _colours_by_band(cls, materials: dict[str, Material], info: ValidationInfo) -> dict[str, Material]:
        found = dict(materials)
        for name, material in materials.items():
            if isinstance(material, Diffuse | Plastic | Principled) and material.colour is not None:
                if "reflectance" in material.model_fields_set:
                    raise ValueError(f"{name}: got colour and reflectance, expected one of the two; drop one")
                share = colour_by_band(material.colour, info.data.get("bands", ()))
                found[name] = material.model_copy(update={"reflectance": share, "colour": None})
        return found

    @field_validator("movers")
    @classmethod
    def _no_crowds_inside(cls, movers: dict[str, Mover]) -> dict[str, Mover]:
        members: dict[str, Mover] = {}
        for name, mover in movers.items():
            if isinstance(mover, Crowd | Car):
                members |= {f"{name}_{key}": single for key, single in mover.members().items()}
            else:
                members[name] = mover
        return members

    @model_validator(mode="after")
    def _one_is_lit(self) -> Scene:
        if not self.lamps and self.sky is None:
            raise ValueError("lamps: missing, and no [sky] either; cure: add a table [lamps.NAME], or [sky]")
        if not any(light.lit for light in self._lights().values()):
            raise ValueError(
                "lamps: no lamp is lit, so there is no light at all; cure: set lit = true for at least one"
            )
        if self.sky is not None and SKY in self.lamps:
            raise ValueError("lamps.sky: the name is taken by [sky]; cure: rename the lamp")
        if not (self.lamps or self.objects or self.movers or self.static):
            raise ValueError("objects: got none, so there is nothing under the sky; cure: add an object")
        return self

    @model_validator(mode="after")
    def _keyframed_objects_exist(self) -> Scene:
        owner: dict[str, str] = {}
        for name, motion in self._motions().items():
            for key in motion.objects:
                if key not in self.objects:
                    known = self.objects or ["(none declared)"]
                    raise ValueError(f"movers.{name}.objects: {unknown_name('object', key, known)}")
                if key in owner:
                    raise ValueError(
                        f"movers.{name}.objects: {key!r} is named twice, by {owner[key]!r} and {name!r}; "
                        "cure: let one mover carry it"
                    )
                owner[key] = name
            if clash := sorted(set(keyframed_objects(name, motion, self.objects)) & set(self.movers)):
                raise ValueError(
                    f"movers.{name}: its part {clash[0]!r} has the name of another mover; cure: rename one"
                )
        return self

    @model_validator(mode="after")
    def _tables_name_the_bands(self) -> Scene:
        names = [band.name for band in self.bands]
        if len(set(names)) < len(names):
            raise ValueError(f"bands: names must differ, got {', '.join(names)}")
        parts = {f"materials.{name}": material for name, material in self.materials.items()}
        parts |= {f"lamps.{name}": lamp for name, lamp in self.lamps.items()}
        parts |= {} if self.sky is None else {SKY: self.sky}
        for place, part in parts.items():
            for key, table in tables(part).items():
                where = f"{place}.{key}"
                if strange := [band for band in table if band not in names]:
                    raise ValueError(
                        f"{where}: {unknown_name('band', strange[0], names or ['(none declared)'])}"
                    )
                if missing := [band for band in names if band not in table]:
                    raise ValueError(
                        f"{where}: got no value for band {missing[0]!r}; cure: give one for each of "
                        f"{', '.join(names)}, or one number for all"
                    )
        return self

    @model_validator(mode="after")
    def _materials_exist(self) -> Scene:
        users = [*self.objects.items(), *self.singles().items()]
        for name, user in users:
            if user.material not in self.materials:
                known = self.materials or ["(none declared)"]
                raise ValueError(f"{name}: {unknown_name('material', user.material, known)}")
        return self

    def singles(self) -> dict[str, SingleMover]:
        """Return the movers by name; those with several parts are resolved into them."""
        found: dict[str, SingleMover] = {}
        for name, mover in self.movers.items():
            if isinstance(mover, Keyframed):
                found |= keyframed_objects(name, mover, self.objects)
            elif not isinstance(mover, Crowd | Car):
                found[name] = mover
        return found

    def _motions(self) -> dict[str, Keyframed]:
        return {name: mover for name, mover in self.movers.items() if isinstance(mover, Keyframed)}

    def kind_of_change(self) -> Literal["static", "lamps", "movers", "camera"]:
        """Kind of change with time, the most far-reaching one: camera, movers, lamps, or none.

        A scene of kind ``movers`` may have flickering lamps too, and one of kind ``camera`` anything.
        """
        if self.camera.moves:
            return "camera"
        if self.singles():
            return "movers"
        return "lamps" if any(lamp.lit and lamp.flicker for lamp in self.lamps.values()) else "static"

    def polarising(self) -> tuple[str, ...]:
        """List the possible polarisers of light: materials in use, and the file of shapes."""
        used = {item.material for item in (*self.still_objects().values(), *self.singles().values())}
        found = [name for name in sorted(used) if polarises(self.materials[name])]
        if self.static is not None and self.static.polarises():
            found.append(self.static.name)
        return tuple(found)

    def light_groups(self) -> dict[str, tuple[str, ...]]:
        """Group the lit lamps by their flicker: all lamps of a group have the same ``gain``.

        Returns
        -------
        dict
            Group -> sorted names of its lamps. ``steady`` comes first, if any, then one key a flicker, in the
            order of the lamps' names. The sky is steady, and named ``sky``.
        """
        groups: dict[str, tuple[str, ...]] = {}
        for name in sorted(self._lights(), key=lambda name: (self.flicker(name) is not None, name)):
            if self._lights()[name].lit:
                lamp = self.lamps.get(name)
                key = "steady" if lamp is None else flicker_key(lamp)
                groups[key] = (*groups.get(key, ()), name)
        return groups

    def lit(self) -> list[str]:
        """Names of the lamps that emit, and ``sky`` if it does."""
        return [name for name, light in self._lights().items() if light.lit]

    def flicker(self, name: str) -> Flicker | None:
        """Flicker of a lamp; the sky has none."""
        return self.lamps[name].flicker if name in self.lamps else None

    def gain(self, name: str, start_s: float, stop_s: float) -> float:
        """Mean radiance of a lamp over an interval, relative to its own mean; 1 for the sky."""
        return self.lamps[name].gain(start_s, stop_s) if name in self.lamps else 1.0

    def _lights(self) -> dict[str, Lamp | PictureSky | SunSky]:
        """Lamps, and the sky as one of them."""
        return {**self.lamps, **({} if self.sky is None else {SKY: self.sky})}

    def in_band(self, name: str | None = None) -> Scene:
        """Return the scene in one of its bands: every table by band becomes that band's number.

        Parameters
        ----------
        name : str, optional
            Name of the band; by default the one nearest to 550 nm. A scene without bands is returned
            unchanged.

        Raises
        ------
        ConfigError
            For a band that the scene doesn't have.
        """
        if not self.bands:
            if name is not None:
                raise ConfigError(
                    f"scene.band: got {name!r}, but {self.name!r} has no bands; leave scene.band out"
                )
            return self
        if name is None:
            band = min(self.bands, key=lambda band: abs(band.wavelength_nm - MONO_NM))
        elif not (found := [band for band in self.bands if band.name == name]):
            raise unknown_name(f"scene.band of {self.name}", name, [band.name for band in self.bands])
        else:
            band = found[0]
        return self.model_copy(
            update={
                "bands": (band,),
                "materials": {key: taken(part, band.name) for key, part in self.materials.items()},
                "lamps": {key: taken(part, band.name) for key, part in self.lamps.items()},
                "sky": None if self.sky is None else taken(self.sky, band.name),
            }
        )

    def only_lamps(self, names: Iterable[str]) -> Scene:
        """Return the same scene with only these lamps lit; the others stay as black rectangles.

        Parameters
        ----------
        names : iterable of str
            At least one lamp, or ``sky``; an unlit one becomes lit.

        Raises
        ------
        ConfigError
            For no name, or an unknown one.
        """
        wanted = set(names)
        if not wanted:
            known = ", ".join(self._lights())
            raise ConfigError(f"only_lamps: got no name, expected at least one of: {known}")
        if strange := sorted(wanted - set(self._lights())):
            raise unknown_name("lamp", strange[0], self._lights())
        lamps = {name: lamp.model_copy(update={"lit": name in wanted}) for name, lamp in self.lamps.items()}
        sky = None if self.sky is None else self.sky.model_copy(update={"lit": SKY in wanted})
        return self.model_copy(update={"lamps": lamps, "sky": sky})

    def still_objects(self) -> dict[str, StillObject]:
        """Return the objects of no mover, in the order of the file."""
        moving = {key for motion in self._motions().values() for key in motion.objects}
        return {key: item for key, item in self.objects.items() if key not in moving}

    def still_meshes(self) -> dict[str, Mesh]:
        """One mesh a material, of all objects that never move: fewer shapes trace faster."""
        groups: dict[str, list[Mesh]] = {}
        for item in self.still_objects().values():
            groups.setdefault(item.material, []).append(item.mesh())
        return {material: merge(meshes) for material, meshes in groups.items()}


def scenes_folder() -> Path:
    """Folder of the shipped scenes: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    shipped = package / "shipped_scenes"
    return shipped if shipped.is_dir() else package.parent / "scenes"


def list_scenes() -> dict[str, tuple[str, ...]]:
    """Shipped scenes and their variations, ``main`` first."""
    return {name: ("main", *named_variations(read_toml(path))) for name, path in _shipped().items()}


def _shipped() -> dict[str, Path]:
    return {path.parent.name: path for path in sorted(scenes_folder().glob("*/scene.toml"))}


def load_scene(name_or_path: str | Path, variation: str = "main", *, physics: bool = True) -> Scene:
    """Read a scene and one of its variations.

    Parameters
    ----------
    name_or_path : str or Path
        Name of a shipped scene, a folder with a ``scene.toml``, or such a file.
    variation : str
        ``main``, a table of overrides under ``[variations.<name>]``, or a whole number as text: every key of
        ``[ranges]`` is drawn anew, by the scene's name and this number alone.
    physics : bool
        Whether populations with physics take the poses that ``optsim scene drop`` wrote.

    Raises
    ------
    ConfigError
        For an unknown scene, variation, key, kind, material, texture or object, a missing photograph, no
        lamp, or a bad shapes file. Also for a number out of range, even at an end of a range that this
        variation does not reach.
    """
    text = str(name_or_path)
    if "/" in text or text.endswith(".toml"):
        path = Path(text)
        path = path / "scene.toml" if path.is_dir() else path
    elif (found := _shipped().get(text)) is not None:
        path = found
    else:
        raise unknown_name("scene", text, _shipped())
    table = read_toml(path)
    static = table.get("static")
    if isinstance(static, str):
        table["static"] = read_static(path.parent, static)
    for extreme in extremes(table, str(path)):
        end = f"{path}, at an end of its ranges"
        build(Scene, _expanded(extreme, "0", path.parent, end, physics=False), where=end)
    chosen = varied(table, variation, str(path))
    chosen = _expanded(chosen, variation, path.parent, str(path), physics=physics)
    scene = build(Scene, chosen | {"variation": variation}, where=str(path))
    for material in scene.materials.values():
        if isinstance(material, Diffuse | Plastic) and material.texture in PHOTOGRAPHS:
            photograph(material.texture)
    warn_if_inside(scene)
    return scene


def _expanded(table: Table, variation: str, folder: Path, where: str, *, physics: bool) -> Table:
    """Draw the populations of a scene's table, expand its models and find the picture of its sky."""
    table = with_population(table, variation, folder, where, physics=physics)
    return with_models(with_sky(table, folder, where), folder, where)


def model_scene(path: Path) -> Scene:
    """Make a scene that shows a model from a file, its size in the file's own unit."""
    return build(Scene, with_models(model_table(path), path.resolve().parent, str(path)), where=str(path))
