"""An experiment: scene, camera, and the methods to compare; read from TOML."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import cast

from pydantic import Field, model_validator

from optsim.calibration import Calibration
from optsim.calibration.choice import CalibrationChoice, Operator, ReadingPx, resolve_stored, widest_reading
from optsim.camera.camera import CodedCamera
from optsim.camera.effects import drifted
from optsim.camera.table import check_hardware, find_files, on_hardware
from optsim.coding import Scheme
from optsim.core.config import Part, Table, build, flat, merged, override, read_toml
from optsim.core.errors import ConfigError, GeometryError, unknown_name
from optsim.core.quantities import Timing
from optsim.experiment.drift import drifted_camera
from optsim.experiment.method import Method
from optsim.footage import FootageSource
from optsim.render import RenderSettings
from optsim.scene import load_scene


class SceneChoice(Part):
    """The scene, its variation and its band.

    Parameters
    ----------
    name : str
        A shipped scene (``optsim list scenes``), or the path of a scene's folder.
    variation : str
        A variation named in the scene, or a number, which seeds a random one.
    band : str, optional
        Name of the scene's band that the camera sees; by default the one nearest to 550 nm.
    """

    name: str
    variation: str = Field(default="main", coerce_numbers_to_str=True)
    band: str | None = None


class Source(Part):
    """The truth when it isn't rendered.

    Parameters
    ----------
    footage : FootageSource
        A recording, with the meaning of its numbers.
    """

    footage: FootageSource


class LightRule(Part):
    """The light level of the camera, fixed before any measurement and the same for all methods.

    The neutral density is set so that a percentile of the interior, under the all-on code, reaches a
    share of the measured saturation (a rule of this project for fair comparison; no outside source).

    Parameters
    ----------
    percentile : float
        Percentile of the irradiance on the interior's panel pixels, percent.
    saturation_share : float
        Share of the measured saturation that this percentile reaches.
    """

    percentile: float = Field(default=90.0, gt=0, le=100)
    saturation_share: float = Field(default=0.8, gt=0, le=1)


class Experiment(Part):
    """Everything that determines a result; the same experiment gives the same numbers.

    Parameters
    ----------
    name : str
        Name of the experiment: run folders begin with it.
    description : str
        A sentence for people; nothing depends on it.
    seed : int
        Of all random numbers: the same experiment and seed give the same results.
    n_frames : int
        Coded frames to take; the steady phase begins with frame latency_frames + 4, counted from 0.
    render
        Accuracy of the rendered truth.
    camera
        The camera's parts; ``hardware = "prototype"`` or ``"demo"`` gives the defaults, and
        ``effects`` switches imperfections (``optsim list effects``).
    methods
        The methods to compare, each a scheme with its decoder.
    light
        The rule for the camera's light level.
    scene, source
        The truth: a scene to render, or ``source.footage``, a recording. Exactly one.
    tolerance
        Allowed error of a frame by skipped effects, rms, relative to the frame's
        noise; 0 models everything (see :mod:`optsim.camera.skip`).
    calibration
        Choice of the calibration: ``bench`` (estimated from the virtual laboratory's images), ``true``
        (the simulator's own parameters), ``ideal`` (the paper's equations), or a path: of a
        ``calibration.npz``, of a run folder that holds one, or of a bench folder (of this very camera). The
        light rule uses it, and so do all methods without a ``calibration`` of their own. Relative paths in a
        TOML file start at its folder.
    reading_px
        Side of the readout window of a panel pixel, CCD pixels: 1 for the pixel at its centre, as
        in the paper, 3 for all nine where a panel pixel covers about 3 x 3.
    drift
        Changes of the camera between its calibration and the first frame, as in ``camera``: for
        example ``{ relay = { shift_x_px = 0.4 } }``. The calibration leaves them out.
    drift_per_frame
        Change of numbers of the camera from one coded frame to the next, on top of ``drift``:
        for example ``{ relay = { shift_x_px = 0.02 } }``.
    save_reconstructions
        Names of the methods whose reconstructed videos are written; empty for none.
    """

    name: str = Field(
        pattern=r"^[A-Za-z][A-Za-z0-9_-]*$", description="a letter, then letters, digits, _ and -"
    )
    description: str = ""
    seed: int = Field(default=1, ge=0, lt=2**32)
    n_frames: int = Field(default=10, ge=1, le=10_000)
    scene: SceneChoice | None = None
    source: Source | None = None
    render: RenderSettings = RenderSettings.model_validate({})
    camera: CodedCamera
    tolerance: float = Field(default=0.1, ge=0, le=10)
    methods: tuple[Method, ...] = Field(min_length=1)
    calibration: Operator = "bench"
    reading_px: ReadingPx = 1
    drift: Table = Field(default_factory=dict)
    drift_per_frame: Table = Field(default_factory=dict)
    light: LightRule = LightRule()
    save_reconstructions: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one_truth(self) -> Experiment:
        if (self.scene is None) == (self.source is None):
            got = "neither" if self.scene is None else "both"
            raise ValueError(
                f"scene, source.footage: got {got}, expected exactly one: a scene to render or a recording"
            )
        return self

    @model_validator(mode="after")
    def _within_memory(self) -> Experiment:
        camera = self.camera
        for key, value, most in (
            ("slots_per_frame", camera.slots_per_frame, 1000),
            ("sensor.read_noise_e", camera.sensor.read_noise_e, 1e6),
            ("sensor.dsnu_e", camera.sensor.dsnu_e, 1e6),
            ("relay.shift_y_px", abs(camera.relay.shift_y_px), 1e5),
            ("relay.shift_x_px", abs(camera.relay.shift_x_px), 1e5),
        ):
            if value > most:
                raise ValueError(f"camera.{key}: got {value:g}, expected at most {most:g}; lower it")
        return self

    @model_validator(mode="after")
    def _read_of_their_own(self) -> Experiment:
        widest = widest_reading(self.camera.ratio)
        of_methods = [(f"methods, {m.name!r}: reading_px", m.reading_px or 1) for m in self.methods]
        for key, value in (("reading_px", self.reading_px), *of_methods):
            if value > widest:
                raise ValueError(
                    f"{key}: got {value}, expected at most {widest}: a panel pixel covers "
                    f"{self.camera.ratio:.3g} CCD pixels each way, more would be its neighbours'"
                )
        return self

    @model_validator(mode="after")
    def _names_agree(self) -> Experiment:
        names = [method.name for method in self.methods]
        if len(set(names)) < len(names):
            raise ValueError(f"methods: names must differ, got {names}")
        for name in self.save_reconstructions:
            if name not in names:
                raise ValueError(f"save_reconstructions: {name!r} is none of the methods {names}")
        return self

    def __repr__(self) -> str:
        """Describe it in a line: its keys would fill a page, and ``optsim config show`` prints them."""
        truth = self.scene.name if self.scene is not None else "footage"
        panel = f"{self.camera.panel_cols} x {self.camera.panel_rows} panel pixels"
        return (
            f"<Experiment {self.name!r}: {truth}, {panel}, "
            f"{self.n_frames} coded frames by {', '.join(method.name for method in self.methods)}>"
        )

    __str__ = __repr__

    def only(self, names: Sequence[str]) -> Experiment:
        """Return the experiment with some of its methods, in its own order.

        Raises
        ------
        ConfigError
            For a name that is none of its methods, or no name.
        """
        known = [method.name for method in self.methods]
        for name in names or ("",):
            if name not in known:
                raise unknown_name("method", name, known)
        return self.model_copy(
            update={
                "methods": tuple(method for method in self.methods if method.name in names),
                "save_reconstructions": tuple(n for n in self.save_reconstructions if n in names),
            }
        )

    @property
    def calibration_choice(self) -> CalibrationChoice:
        """Calibration choice of methods without their own."""
        return CalibrationChoice(self.calibration, self.reading_px)

    def choice_of(self, method: Method) -> CalibrationChoice:
        """Return a method's calibration choice: its own, or else the experiment's."""
        return CalibrationChoice(method.calibration or self.calibration, method.reading_px or self.reading_px)

    @property
    def schemes(self) -> dict[str, Scheme]:
        """Schemes of the methods, by method name."""
        return {method.name: method.scheme for method in self.methods}

    @property
    def calibration_choices(self) -> tuple[CalibrationChoice, ...]:
        """All calibration choices, each once; the experiment's own, which sets the light, first."""
        return tuple(dict.fromkeys((self.calibration_choice, *map(self.choice_of, self.methods))))

    def check_methods(self, known: Mapping[CalibrationChoice, Calibration]) -> None:
        """Refuse calibrations that any method cannot work with (:meth:`Method.check`)."""
        for method in self.methods:
            method.check(known[self.choice_of(method)])

    def at_work(self, frame: int = 0) -> CodedCamera:
        """Camera that takes a coded frame: the calibrated one after its drift.

        Raises
        ------
        ConfigError
            When a drift changes an unknown key, or one that truth and calibration depend on.
        """
        return drifted_camera(self.camera, self.drift, self.drift_per_frame, frame)

    @property
    def timing(self) -> Timing:
        """Slots and frames of the whole experiment."""
        return self.camera.timing(self.n_frames)

    def fingerprint(self) -> str:
        """Hash of the resolved experiment, which identifies its run folder."""
        text = json.dumps(self.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def preset_names() -> list[str]:
    """Names of the experiments shipped with the package."""
    return sorted(Path(str(p)).stem for p in files("optsim.presets").iterdir() if p.name.endswith(".toml"))


def experiment_path(name_or_path: str) -> Path:
    """Path of a preset (a bare name) or of a file (anything with a '/' or '.toml').

    Raises
    ------
    ConfigError
        For a bare name that is no preset, or a file that isn't there.
    """
    if "/" in name_or_path or name_or_path.endswith(".toml"):
        if not Path(name_or_path).exists():
            raise ConfigError(
                f"no such file: {name_or_path}; a name without '/' or '.toml' means a preset: "
                f"{', '.join(preset_names())}"
            )
        return Path(name_or_path)
    if name_or_path not in preset_names():
        raise unknown_name("experiment", name_or_path, preset_names())
    return Path(str(files("optsim.presets") / f"{name_or_path}.toml"))


def load_experiment(
    name_or_path: str,
    assignments: Sequence[str] = (),
    *,
    seed: int | None = None,
    check_geometry: bool = True,
    **keys: object,
) -> Experiment:
    """Load an experiment, apply overrides, and check that its geometry fits.

    Parameters
    ----------
    name_or_path : str
        A preset's name or the path of a TOML file.
    assignments : sequence of str
        Overrides such as ``camera.objective.f_number=5.6``.
    seed : int, optional
        Replaces the experiment's seed.
    check_geometry : bool
        False to inspect an experiment that cannot be run.
    **keys
        Overrides by name: ``n_frames=4``, or ``camera={"latency_frames": 3}``, which leaves the other keys of
        the table alone.

    Returns
    -------
    Experiment
        Fully resolved, with every default.

    Raises
    ------
    ConfigError
        For an unknown key or wrong value, an unknown scene, or a band outside the camera's range.
    GeometryError
        When the panel's image does not fit the CCD.
    """
    if isinstance(assignments, str):
        raise ConfigError(f"assignments: got {assignments!r}, expected a list of such texts; put it in []")
    path = experiment_path(name_or_path)
    table = read_toml(path)
    resolve_stored(table, path.parent)
    find_files(table, path.parent)
    table = merged(override(table, list(assignments)), keys)
    if seed is not None:
        table["seed"] = seed
    given = [*assignments, *(f"{key}={value!r}" for key, value in keys.items())]
    where = f"{path.name} with {', '.join(given)}" if given else path.name
    camera: object = table.get("camera", {})
    check_hardware(table, camera, where, Experiment.model_fields)
    by_hand = isinstance(camera, dict) and "wavelength_m" in cast("Table", camera)
    table["camera"] = on_hardware(cast("object", camera))
    _find_footage(table, path.parent)
    experiment = _in_band(build(Experiment, table, where=where), by_hand, where)
    switches: Table = cast("Table", camera).get("effects", {}) if isinstance(camera, dict) else {}
    # A key set by hand has priority here as well.
    drift = merged(drifted(experiment.camera, switches), experiment.drift)
    experiment = experiment.model_copy(update={"drift": drift})
    if check_geometry:
        experiment.camera.geometry().check()
    last = experiment.n_frames - 1 if experiment.drift_per_frame else 0
    for frame in {0, last} if check_geometry and (experiment.drift or last) else ():
        try:
            experiment.at_work(frame).geometry().check()
        except GeometryError as error:
            now = [f"{key} = {value}" for key, value in flat(experiment.drift).items()]
            now += [
                f"{frame} times {key} = {value}" for key, value in flat(experiment.drift_per_frame).items()
            ]
            raise GeometryError(f"after drift of {', '.join(now)}: {error}") from None
    return experiment


def _in_band(experiment: Experiment, by_hand: bool, where: str) -> Experiment:
    """Set the wavelength by the scene's band, or by the camera without one; ConfigError if they disagree."""
    scene, camera = experiment.scene, experiment.camera
    bands = load_scene(scene.name, scene.variation).in_band(scene.band).bands if scene else ()
    if not bands or camera.wavelength_m == bands[0].wavelength_m:
        return experiment
    if by_hand:
        raise ConfigError(
            f"{where}: camera.wavelength_m: got {camera.wavelength_nm:g} nm, but the scene's band "
            f"{bands[0].name!r} is at {bands[0].wavelength_nm:g} nm; drop it, or choose another scene.band"
        )
    table = experiment.model_dump()
    table["camera"]["wavelength_m"] = bands[0].wavelength_m
    return build(Experiment, table, where=where)


def _find_footage(table: Table, folder: Path) -> None:
    """Resolve a relative ``source.footage.path`` against the experiment's own folder."""
    source: object = table.get("source")
    footage: object = cast("Table", source).get("footage") if isinstance(source, dict) else None
    if isinstance(footage, dict) and isinstance(path := cast("Table", footage).get("path"), str):
        found = str(folder / Path(path).expanduser())
        table["source"] = merged(cast("Table", source), {"footage": {"path": found}})
