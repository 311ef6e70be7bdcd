"""Spec of a data set: scenes x variations x cameras x seeds, their coding schemes, and the split."""

from __future__ import annotations

import fnmatch
import json
import zlib
from collections import Counter
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from optsim.coding import MotionAdaptive
from optsim.core.config import Part, Table, build, flat, read_toml
from optsim.core.errors import ConfigError, unknown_name
from optsim.core.random_streams import stream
from optsim.dataset.filters import Filter
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.render.settings import RenderSettings
from optsim.scene.variation import is_number

Split = Literal["train", "val", "test"]
SPLITS: tuple[Split, ...] = ("train", "val", "test")
_MOST = 1_000_000


class Share(Part):
    """Scenes and variations held out from training.

    Parameters
    ----------
    val, test
        Either patterns of ``scene/variation``, such as ``["wheel/*", "half_moving/3"]``, or a share of all.
        A hash of their names chooses the share, so that a new one moves no other.
    """

    val: float | tuple[str, ...] = ()
    test: float | tuple[str, ...] = ()

    @model_validator(mode="after")
    def _within_one(self) -> Share:
        shares = [share for share in (self.val, self.test) if isinstance(share, float)]
        if any(not 0 <= share <= 1 for share in shares) or sum(shares) > 1:
            raise ValueError(
                f"got val {self.val}, test {self.test}, expected shares of 0 to 1, at most 1 together"
            )
        return self

    def of(self, scene: str, variation: str) -> Split:
        """Return the split of a scene and variation."""
        name = f"{scene}/{variation}"
        patterns: dict[Split, float | tuple[str, ...]] = {"val": self.val, "test": self.test}
        held: list[Split] = [split for split, listed in patterns.items() if _names(listed, name)]
        if len(held) > 1:
            raise ConfigError(
                f"split: got {name} in val and in test, expected it in one of them; cure: narrower patterns"
            )
        if held:
            return held[0]
        place = zlib.crc32(name.encode()) / 2**32
        test, val = (share if isinstance(share, float) else 0.0 for share in (self.test, self.val))
        return "test" if place < test else "val" if place < test + val else "train"


class TruthNoise(Part):
    """Monte Carlo noise of a split's radiance.

    Parameters
    ----------
    share : float or None
        Root mean square over the picture of sigma over (radiance + 1 % of white), per fine sample; a panel
        pixel's is a third of it. None leaves the experiment's ``[render]`` as it is.
    independent : bool
        Render every slot separately, so that no two share noise, not even where nothing moves.
    """

    share: float | None = Field(default=None, ge=0.001, le=1)
    independent: bool = False

    def settings(self, settings: RenderSettings) -> RenderSettings:
        """Render settings that reach the share."""
        if self.share is None:
            return settings
        # Allocation goes by predictions: what is reached is up to twice its target.
        part = 0.5 * self.share
        parts = {"static_error": part, "change_error": part, "moving_error": part}
        return settings.model_copy(update=parts)


class Noise(Part):
    """Noise of the truth by split; evaluation has little by default.

    Parameters
    ----------
    train, val, test : TruthNoise
        Of each split.
    """

    train: TruthNoise = TruthNoise()
    val: TruthNoise = TruthNoise(share=0.02)
    test: TruthNoise = TruthNoise(share=0.02)

    def of(self, split: Split) -> TruthNoise:
        """Return that of a split."""
        chosen: TruthNoise = getattr(self, split)
        return chosen


class DatasetSpec(Part):
    """A data set, before it is built.

    Parameters
    ----------
    name, description : str
        Name and description for people.
    licence : str
        SPDX name of the licence that the builder gives it.
    experiment : str
        Preset or TOML file; it gives camera, timing, render settings, calibration, schemes and decoders.
    n_frames : int
        Coded frames a sequence; each has ``camera.slots_per_frame`` slots of truth.
    scenes : dict
        Scene -> its variations: names, numbers, and ranges of numbers such as ``"0:100"``, end excluded.
    cameras : dict
        Name -> changes of the experiment's camera, as in its TOML file.
    schemes : tuple of str
        Names of the experiment's methods that take coded frames; with none, truth alone.
    seeds : tuple of int
        Seeds of photons, codes and the laboratory: each takes all coded frames anew from the same truth. Each
        sequence draws codes and photons of its own from a seed; the calibration is common.
    same_draws : bool
        Draw codes and photons once a seed for the whole set, instead of anew for each sequence.
    reconstruct : bool
        Decode the coded frames too.
    half : bool
        Radiance, normals and albedo in 16 bit; depth, flow, ids and noise never.
    split : Share
        The part held out.
    noise : Noise
        Monte Carlo noise of the truth, by split.
    filter : Filter
        Ranges of what is measured in a sequence; one outside of any is dropped once it is made.
    """

    name: str = Field(
        pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", description="a letter, then letters, digits, _ and -"
    )
    description: str = ""
    licence: str = "CC0-1.0"
    experiment: str = "demo"
    n_frames: int = Field(default=1, ge=1, le=10_000)
    scenes: dict[str, tuple[str, ...]] = Field(min_length=1)
    cameras: dict[str, Table] = Field(default={"main": {}}, min_length=1)
    schemes: tuple[str, ...] = ()
    seeds: tuple[int, ...] = Field(default=(1,), min_length=1)
    same_draws: bool = False
    reconstruct: bool = False
    half: bool = False
    split: Share = Share()
    noise: Noise = Noise()
    filter: Filter = Filter()

    @field_validator("scenes", mode="before")
    @classmethod
    def _written_out(cls, scenes: object) -> object:
        if not isinstance(scenes, dict):
            return scenes
        return {str(name): _variations(name, listed) for name, listed in scenes.items()}  # pyright: ignore

    def sequences(self) -> list[SequencePlan]:
        """List all sequences, in the order of the spec.

        Raises
        ------
        ConfigError
            For an overlapping split, or more sequences than anyone builds.
        """
        n = len(self.cameras) * sum(len(variations) for variations in self.scenes.values())
        if n > _MOST:
            raise ConfigError(f"scenes, cameras: got {n} sequences, expected at most {_MOST}; split the spec")
        return [
            SequencePlan(self.split.of(plain(scene), variation), scene, variation, camera)
            for scene, variations in self.scenes.items()
            for variation in variations
            for camera in self.cameras
        ]

    def experiment_of(self, sequence: SequencePlan, seed: int) -> Experiment:
        """Resolve the experiment of a sequence with a seed.

        Raises
        ------
        ConfigError
            For an unknown scene, variation, scheme or camera key.
        """
        changes = {f"camera.{key}": value for key, value in flat(self.cameras[sequence.camera]).items()}
        scene = {
            "scene.name": sequence.scene,
            "scene.variation": sequence.variation,
            "n_frames": self.n_frames,
        }
        assignments = [f"{key}={json.dumps(value)}" for key, value in {**scene, **changes}.items()]
        loaded = load_experiment(self.experiment, assignments, seed=seed)
        methods = {method.name: method for method in loaded.methods}
        for name in self.schemes:
            if name not in methods:
                raise unknown_name("scheme of the experiment", name, list(methods))
        chosen = tuple(methods[name] for name in self.schemes) or loaded.methods
        render = self.noise.of(sequence.split).settings(loaded.render)
        return loaded.model_copy(update={"methods": chosen, "save_reconstructions": (), "render": render})

    def draws_of(self, sequence: SequencePlan, seed: int) -> int:
        """Seed of the codes and photons of a sequence, whatever its split."""
        if self.same_draws:
            return seed
        return int(stream(seed, "sequence", sequence.name.partition("/")[2]).integers(2**32))


@dataclass(frozen=True)
class SequencePlan:
    """One sequence: a scene in a variation and a camera, by their names in the spec."""

    split: Split
    scene: str
    variation: str
    camera: str

    @property
    def name(self) -> str:
        """Folder relative to the data set's."""
        return f"{self.split}/{plain(self.scene)}-{self.variation.replace(',', '_')}-{self.camera}"


def dataset_names() -> list[str]:
    """Names of the shipped specs."""
    folder = files("optsim.presets") / "datasets"
    return sorted(Path(str(p)).stem for p in folder.iterdir() if p.name.endswith(".toml"))


def load_spec(name_or_path: str) -> DatasetSpec:
    """Read a spec: a shipped one by its name, or a TOML file; paths in it start at its folder.

    Raises
    ------
    ConfigError
        For an unknown name or key, or a bad value.
    """
    if "/" not in name_or_path and not name_or_path.endswith(".toml"):
        if name_or_path not in dataset_names():
            raise unknown_name("data set", name_or_path, dataset_names())
        path = Path(str(files("optsim.presets") / "datasets" / f"{name_or_path}.toml"))
    else:
        path = Path(name_or_path)
    table = read_toml(path)
    spec = build(DatasetSpec, table, where=path.name)
    beside = {"experiment": _beside(spec.experiment, path.parent)}
    scenes = {_beside(name, path.parent): variations for name, variations in spec.scenes.items()}
    return spec.model_copy(update={**beside, "scenes": scenes})


def _beside(name: str, folder: Path) -> str:
    """Resolve a path against the spec's own folder; a bare name is a shipped one."""
    is_path = "/" in name or name.endswith(".toml")
    return str((folder / Path(name).expanduser()).absolute()) if is_path else name


def plain(scene: str) -> str:
    """Name of a scene in the names of its sequences."""
    return Path(scene).stem if "/" not in scene else Path(scene.removesuffix("/scene.toml")).name


def _names(listed: float | tuple[str, ...], name: str) -> bool:
    """Whether patterns, if patterns are listed, match a name."""
    return isinstance(listed, tuple) and any(fnmatch.fnmatchcase(name, pattern) for pattern in listed)


def _variations(scene: object, listed: object) -> Any:
    if not isinstance(listed, list | tuple):
        return listed
    found: list[str] = []
    for item in listed:  # pyright: ignore[reportUnknownVariableType]
        text = str(item)  # pyright: ignore[reportUnknownArgumentType]
        first, colon, last = text.partition(":")
        if colon and first.isdecimal() and last.isdecimal():
            if not int(first) < int(last) <= int(first) + _MOST:
                raise ValueError(
                    f"{scene}: got {text!r}, expected FIRST:LAST, LAST not included, as 0:100, at most "
                    f"{_MOST} variations"
                )
            found += [str(number) for number in range(int(first), int(last))]
        else:
            found.append(text)
    if not found or len(set(found)) < len(found):
        raise ValueError(
            f"{scene}: got {len(found)} variations, {len(set(found))} different, expected one or more"
        )
    return found


def check_spec(spec: DatasetSpec) -> None:
    """Check for obstacles to a build, before it starts.

    Raises
    ------
    ConfigError, GeometryError
        The first problem found.
    """
    sequences = spec.sequences()
    names = Counter(sequence.name for sequence in sequences)
    if twice := [name for name, n in names.items() if n > 1]:
        raise ConfigError(f"scenes, cameras: got {twice[0]} twice, expected folders that differ; rename one")
    _check_shares(spec.split, Counter[str](sequence.split for sequence in sequences))
    checked = set[tuple[str, str, str]]()
    for sequence in sequences:
        # All numbers of a scene draw from ranges whose ends are checked when the scene is read.
        kind = "number" if is_number(sequence.variation) else sequence.variation
        if (sequence.scene, kind, sequence.camera) not in checked:
            checked.add((sequence.scene, kind, sequence.camera))
            if spec.experiment_of(sequence, spec.seeds[0]).drift_per_frame:
                raise ConfigError(
                    "experiment: got drift_per_frame, expected one camera for all frames, as the arrays of a "
                    "set describe it; fix: leave it out"
                )


def _check_shares(shares: Share, counts: Counter[str]) -> None:
    """Refuse shares of which a small set has none."""
    given = {"val": shares.val, "test": shares.test}
    shared = {split: share for split, share in given.items() if isinstance(share, float)}
    rest = {"train": 1 - sum(shared.values())} if shared else {}
    for split, share in (shared | rest).items():
        if share > 0 and not counts[split]:
            raise ConfigError(
                f"split.{split}: got a share of {share:g}, which is none of the {counts.total()} sequences, "
                'expected one or more; cure: more variations, or patterns such as test = ["wheel/2"]'
            )


def remarks(spec: DatasetSpec) -> list[str]:
    """Say what a set lacks that its spec may lead one to expect, without building it.

    An adaptive scheme needs two frames that arrived before its first adapted one, and is steady two frames
    after its merging phase begins (see ``Experiment.n_frames``).
    """
    found: dict[str, None] = {}
    for camera in spec.cameras if spec.schemes else ():
        first = next(each for each in spec.sequences() if each.camera == camera)
        experiment = spec.experiment_of(first, spec.seeds[0])
        adapted, steady = (experiment.camera.latency_frames + n for n in (2, 5))
        for name, scheme in experiment.schemes.items():
            if isinstance(scheme, MotionAdaptive) and spec.n_frames < steady:
                lacks = (
                    f"is its {scheme.first_frames} code in all {spec.n_frames} frames"
                    if spec.n_frames < adapted
                    else "has no steady frame"
                )
                said = f"its first adapted frame is number {adapted}, its first steady one number {steady}"
                found[f"n_frames = {spec.n_frames}: {name} {lacks}; {said}"] = None
    return list(found)
