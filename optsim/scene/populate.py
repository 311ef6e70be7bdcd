"""Objects drawn at random into a region: ``[populate.NAME]`` becomes objects and movers of the scene.

Every object draws from streams of its own, one an aspect (objects, textures, motion). So one more object, or
another motion, leaves all others bitwise as they are.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, cast

import numpy as np
from pydantic import Field, field_validator, model_validator

from optsim.core.cache import hash_of
from optsim.core.config import Part, Table, build
from optsim.core.errors import ConfigError
from optsim.core.files import read_record
from optsim.core.quantities import Doubles
from optsim.scene.fields import Positive, Share, Vector
from optsim.scene.models import FORMATS, inside
from optsim.scene.solids import SHAPES, Shape, reach, widest
from optsim.scene.variation import number_of

# Tries for a free place, and instants at which two bounding spheres must be apart, s.
_TRIES = 200
GRAVITY_M_S2 = 9.81
_INSTANTS_S = np.linspace(0.0, 0.5, 11)
_Pair = tuple[float, float]


class Population(Part):
    """Random objects in a region.

    Parameters
    ----------
    count : (int, int)
        Fewest and most objects.
    region_m : (vector, vector)
        Lowest and highest corner of the region of their middles; on the ground of their bases.
    shapes : tuple of str
        Solids to draw from, see :mod:`optsim.scene.solids`; by default all, and none beside models.
    models : tuple of str
        Model files to draw from, too, or folders of such; paths relative to the scene's folder.
    up : {"x", "y", "z"} or None
        Axis of OBJ, PLY and STL models that points up; glTF has y by its own rule.
    size_m : (float, float)
        Smallest and largest of their largest sides, m; of models, of their heights.
    category : str or None
        Category of all; by default a solid's shape, or the name of a model's file.
    materials : tuple of str
        Materials of the scene to draw from; models keep their own if there is none.
    resting : bool
        Stand on the lower side of the region, upright, at a random yaw; otherwise they are in the air, turned
        at random.
    moving_share : float
        Share of the objects that move.
    speed_m_s : (float, float)
        Slowest and fastest speed of these at time 0; resting ones move along the ground.
    rise_m_s : (float, float)
        Upward velocity on top of it.
    spin_hz : (float, float)
        Slowest and fastest spin, about a random axis; resting ones spin about the vertical.
    falling : bool
        Whether those in the air fall, by 9.81 m/s^2.
    physics : bool
        Whether all of them fall and collide, from the velocity and spin that are drawn; ``optsim scene drop``
        writes their poses into the scene's folder.
    restitution, friction : float
        Share of the speed that a bounce returns, and coefficient of sliding friction (no source).
    """

    count: tuple[int, int]
    region_m: tuple[Vector, Vector]
    shapes: tuple[Shape, ...] | None = None
    models: tuple[str, ...] = ()
    up: Literal["x", "y", "z"] | None = None
    size_m: tuple[Positive, Positive]
    category: str | None = None
    materials: tuple[str, ...] = ()
    resting: bool = False
    moving_share: Share = 1.0
    speed_m_s: _Pair = (0.0, 0.0)
    rise_m_s: _Pair = (0.0, 0.0)
    spin_hz: _Pair = (0.0, 0.0)
    falling: bool = False
    physics: bool = False
    restitution: Share = 0.4
    friction: float = Field(default=0.5, ge=0)

    @field_validator("count", "size_m", "speed_m_s", "rise_m_s", "spin_hz")
    @classmethod
    def _low_first(cls, pair: _Pair) -> _Pair:
        if pair[0] > pair[1]:
            raise ValueError(f"got {list(pair)}, expected the low end first")
        return pair

    @property
    def solids(self) -> tuple[Shape, ...]:
        """Solids to draw from, those by default included."""
        return self.shapes if self.shapes is not None else () if self.models else SHAPES

    @model_validator(mode="after")
    def _something_to_draw(self) -> Population:
        if not 0 <= self.count[0] <= self.count[1] <= 1000:
            raise ValueError(f"count: got {list(self.count)}, expected 0 to 1000")
        if not (self.solids or self.models):
            raise ValueError("got neither shapes nor models, expected one of them")
        if self.solids and not self.materials:
            raise ValueError("materials: got none, expected names of the scene's materials, for the shapes")
        if any(low > high for low, high in zip(*self.region_m, strict=True)):
            raise ValueError(
                f"region_m: got {[list(c) for c in self.region_m]}, expected the lowest corner first"
            )
        return self


def with_population(table: Table, variation: str, folder: Path, where: str, *, physics: bool = True) -> Table:
    """Draw the objects of all populations; with ``physics`` those that fall take their stored poses."""
    listed = table.get("populate")
    if listed is None:
        return table
    if not isinstance(listed, Mapping):
        raise ConfigError(f"{where}: populate: got {listed!r}, expected tables [populate.NAME]")
    objects, movers = dict(table.get("objects", {})), dict(table.get("movers", {}))
    falling: list[str] = []
    for name, stated in cast("Table", listed).items():
        population = build(Population, stated, where=f"{where}: populate.{name}")
        made = _drawn(population, str(table.get("name", "")), name, variation, folder, where)
        if clash := sorted({*made} & {*objects}):
            raise ConfigError(
                f"{where}: populate.{name}: object {clash[0]!r} is there already; cure: rename one"
            )
        for key, (item, motion) in made.items():
            objects[key] = item
            if motion is not None:
                movers[key] = motion
        falling += made if population.physics else []
    rest = {key: value for key, value in table.items() if key != "populate"}
    whole = {**rest, "objects": objects, "movers": movers}
    if falling and physics:
        poses = _poses(folder / "physics" / f"{variation}.json", drawn_for(whole), variation, where)
        movers |= {key: {"kind": "keyframed", "objects": [key], **poses[key]} for key in falling}
    return whole


def drawn_for(table: Table) -> str:
    """Hash of drawn objects and their first motions: poses belong to these alone."""
    return hash_of(repr((table["objects"], table["movers"])))


def _poses(path: Path, drawn: str, variation: str, where: str) -> Table:
    record = read_record(path) if path.is_file() else {}
    if record.get("made_for") != drawn:
        got = "poses of other objects" if record else "no poses"
        raise ConfigError(
            f"{where}: populate: physics: got {got} in {path}, expected those of these objects; "
            f"cure: optsim scene drop {path.parents[1]} --variation {variation}"
        )
    return record["movers"]


def _drawn(
    population: Population, scene: str, name: str, variation: str, folder: Path, where: str
) -> dict[str, tuple[Table, Table | None]]:
    """Objects and their motions, by name."""
    kinds: list[str] = [*population.solids, *_models(population, folder, f"{where}: populate.{name}")]

    def stream(aspect: Literal["objects", "textures", "motion"], *place: int) -> np.random.Generator:
        words = [zlib.crc32(text.encode()) for text in (scene, name, aspect)]
        return np.random.default_rng([*words, number_of(variation, aspect), *place])

    low, high = (np.asarray(corner) for corner in population.region_m)
    found: dict[str, tuple[Table, Table | None]] = {}
    spheres: list[tuple[Doubles, float]] = []
    for index in range(int(stream("objects").integers(*population.count, endpoint=True))):
        key = f"{name}_{index}"
        looks = stream("textures", index)
        material = (
            population.materials[int(looks.integers(len(population.materials)))]
            if population.materials
            else None
        )
        for attempt in range(_TRIES):
            rng = stream("objects", index, attempt)
            kind, size = kinds[int(rng.integers(len(kinds)))], float(rng.uniform(*population.size_m))
            place, yaw = rng.uniform(low, high), float(rng.uniform(0, 2 * np.pi))
            if population.resting:
                place[2] = low[2]
            turned = [0.0, 0.0, yaw] if population.resting else [*rng.uniform(0, 2 * np.pi, 2).tolist(), yaw]
            height, radius = size / widest(kind), size * reach(kind)
            motion = _motion(population, stream("motion", index), key, place)
            path = _path(motion, place, height if population.resting else 0.0)
            if all(np.linalg.norm(path - other, axis=1).min() > radius + its for other, its in spheres):
                break
        else:
            raise ConfigError(
                f"{where}: populate.{name}: got no free place for object {index + 1}, expected room; "
                "cure: fewer objects, smaller ones, or a larger region"
            )
        spheres.append((path, radius))
        item: Table = {"position_m": place.tolist(), "rotation_rad": turned, "height_m": height}
        if kind in SHAPES:
            item |= {"kind": "solid", "shape": kind, "material": material}
        else:
            item |= {"kind": "mesh", "file": kind} | ({} if material is None else {"material": material})
            item |= {} if FORMATS[Path(kind).suffix.lower()] else {"up": population.up}
        item |= {"category": population.category} if population.category else {}
        item["anchor"] = "base" if population.resting else "middle"
        found[key] = item, motion
    return found


def _motion(population: Population, rng: np.random.Generator, key: str, place: Doubles) -> Table | None:
    """Draw how an object moves; None for one that stands still."""
    moves = rng.random() < population.moving_share
    if not (moves or population.physics):
        return None
    speed, heading = float(rng.uniform(*population.speed_m_s)), float(rng.uniform(0, 2 * np.pi))
    rise, spin = float(rng.uniform(*population.rise_m_s)), float(rng.uniform(*population.spin_hz))
    axis = rng.standard_normal(3)
    speed, rise, spin = (speed, rise, spin) if moves else (0.0, 0.0, 0.0)
    velocity = [speed * np.cos(heading), speed * np.sin(heading), 0.0 if population.resting else rise]
    falls = population.falling and not population.resting
    return {
        "kind": "keyframed",
        "objects": [key],
        "velocity_m_s": [float(v) for v in velocity],
        "acceleration_m_s2": [0.0, 0.0, -GRAVITY_M_S2 if falls else 0.0],
        "spin_axis": [0.0, 0.0, 1.0] if population.resting else axis.tolist(),
        "spin_center_m": place.tolist(),
        "spin_hz": spin,
    }


def _path(motion: Table | None, place: Doubles, height: float) -> Doubles:
    """Middle of an object at the instants at which it must be clear of the others."""
    middle = place + np.array([0, 0, height / 2])
    if motion is None:
        return np.repeat(middle[None], len(_INSTANTS_S), axis=0)
    v, a = np.asarray(motion["velocity_m_s"]), np.asarray(motion["acceleration_m_s2"])
    return middle + v * _INSTANTS_S[:, None] + a / 2 * _INSTANTS_S[:, None] ** 2


def _models(population: Population, folder: Path, where: str) -> list[str]:
    """Names of model files, those of folders included."""
    found: list[str] = []
    for name in population.models:
        path = inside(folder, name, f"{where}.models", or_folder=True)
        files = sorted(p.name for p in path.iterdir() if p.suffix.lower() in FORMATS) if path.is_dir() else []
        if path.is_dir() and not files:
            raise ConfigError(f"{where}.models: got {name!r}, a folder without models ({', '.join(FORMATS)})")
        found += [f"{name}/{file}" for file in files] or [name]
    for file in found:
        suffix = Path(file).suffix.lower()
        if suffix not in FORMATS:
            raise ConfigError(f"{where}.models: got {file!r}, expected one of {', '.join(FORMATS)}")
        if FORMATS[suffix] is None and population.up is None:
            raise ConfigError(
                f'{where}.up: got none, expected x, y or z, as {suffix} files differ; cure: up = "z"'
            )
    return found
