"""The closed loop: codes are chosen from earlier frames, frames are taken, then decoded.

All methods see the same truth, light and camera and draw the same random code. Each has its own stream of
photons, and may have its own calibration.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

import numpy as np

from optsim.calibration import Calibration
from optsim.camera.camera import CodedCamera
from optsim.camera.skip import Skipping, leave_out
from optsim.core.cache import Cache
from optsim.core.errors import ConfigError
from optsim.core.progress import Progress, silent
from optsim.core.quantities import (
    CodedFrame,
    Floats,
    IrradianceVideo,
    PanelState,
    RadianceVideo,
    Reconstruction,
)
from optsim.core.random_streams import stream
from optsim.experiment.calibrations import Calibrations, calibrate_all
from optsim.experiment.experiment import Experiment, Method
from optsim.experiment.resume import cached_shot
from optsim.experiment.truth import given
from optsim.optics.integrate import cell_means

Frames = dict[str, tuple[CodedFrame, ...]]
Expose = Callable[..., tuple[CodedFrame, PanelState]]  # as CodedCamera.expose


@dataclass(frozen=True, eq=False)
class LightLevel:
    """Result of the light rule.

    Parameters
    ----------
    nd_transmission : float
        Transmission of the neutral density, at most 1.
    wanted_transmission : float
        Transmission that the rule requires; above 1 the scene is too dark for the rule and the camera runs
        open.
    percentile_dn : float
        The interior's percentile under the all-on code with this density, DN above black.
    saturation_dn : float
        Median measured saturation threshold, DN above black.
    """

    nd_transmission: float
    wanted_transmission: float
    percentile_dn: float
    saturation_dn: float


def planned(experiment: Experiment) -> tuple[Experiment, Skipping]:
    """Return the experiment with the camera planned for its tolerance, and the plan."""
    skipping = leave_out(given(experiment), experiment.tolerance)
    return experiment.model_copy(update={"camera": skipping.camera}), skipping


def set_light(
    experiment: Experiment, radiance: RadianceVideo, calibration: Calibration
) -> tuple[CodedCamera, LightLevel]:
    """Choose the neutral density by the experiment's rule, from the truth at time 0.

    Returns
    -------
    camera : CodedCamera
        The experiment's camera at work, behind the chosen density.
    light : LightLevel
        The chosen level and the numbers behind it.
    """
    open_camera = experiment.at_work().with_nd(1.0)
    truth = open_camera.form_image(radiance)
    step = truth.samples_per_pitch
    irradiance = cell_means(truth.load(0).start, step)
    inside = calibration.valid.copy()
    if radiance.outside is not None:
        inside &= cell_means(radiance.outside.astype(np.float32), step) == 0
    if not inside.any():
        raise ConfigError("light: the scene has no interior to expose for; choose a scene with one")
    # responsivity holds the shading that irradiance on the modulator already has: divide one out
    all_on_dn = calibration.responsivity_dn / truth.shading * irradiance * calibration.coded_slots
    percentile = float(np.percentile(all_on_dn[inside], experiment.light.percentile))
    saturation = float(np.median((calibration.saturation_dn - calibration.black_dn)[calibration.valid]))
    wanted = experiment.light.saturation_share * saturation / percentile
    nd = min(1.0, wanted)
    return open_camera.with_nd(nd), LightLevel(nd, wanted, percentile * nd, saturation)


@dataclass(frozen=True, eq=False)
class Shot:
    """One coded frame as taken."""

    frame: CodedFrame
    before: PanelState | None  # The panel when the frame begins; None at the start of the experiment.


def shots(
    experiment: Experiment,
    method: Method,
    camera: CodedCamera,
    truth: IrradianceVideo,
    calibration: Calibration,
    cache: Cache | None = None,
    expose: Expose | None = None,
) -> Iterator[Shot]:
    """Take the coded frames of one method, each on demand; arguments as in :func:`capture`."""
    # One stream for all: different tiles shift scores by more than the registered margin, and claims compare
    # schemes.
    state: Any = method.scheme.init(calibration, stream(experiment.seed, "code"))
    frames: list[CodedFrame] = []
    panel: PanelState | None = None
    for index in range(experiment.n_frames):
        before = panel
        arrived = frames[: max(0, index - camera.latency_frames + 1)]
        code, state = method.scheme.next(index, arrived, state)
        photons = stream(experiment.seed, "shot", method.name, index)
        now = expose or camera.expose
        if experiment.drift_per_frame:
            now = experiment.at_work(index).with_nd(camera.objective.nd_transmission).expose
        take = partial(now, truth, index, code, before, photons)
        frame, panel = cached_shot(cache, method.name, index, code, take)
        frames.append(frame)
        yield Shot(frame, before)


def capture(
    experiment: Experiment,
    camera: CodedCamera,
    truth: IrradianceVideo,
    calibrations: Calibrations,
    progress: Progress = silent,
    cache: Cache | None = None,
    expose: Expose | None = None,
) -> Frames:
    """Take all coded frames of all methods, frame by frame in lockstep so that truth is computed once.

    Parameters
    ----------
    experiment : Experiment
        Methods, number of frames and seed.
    camera : CodedCamera
        The true camera, behind its neutral density.
    truth : IrradianceVideo
        Light on the modulator.
    calibrations : dict
        Calibrations of the schemes, from :func:`calibrate_all`.
    progress : Progress
        Called after each coded frame.
    cache : Cache, optional
        Cache of an earlier stopped run of the same experiment; each frame is stored there.
    expose : callable, optional
        Takes each frame instead of the camera, with the same result.

    Returns
    -------
    dict
        Method name -> its coded frames.
    """
    running = {
        m.name: shots(experiment, m, camera, truth, calibrations[experiment.choice_of(m)], cache, expose)
        for m in experiment.methods
    }
    frames: dict[str, list[CodedFrame]] = {name: [] for name in running}
    for index in range(experiment.n_frames):
        for name, taken in running.items():
            frames[name].append(next(taken).frame)
        progress("capture", index + 1, experiment.n_frames)
    return {name: tuple(taken) for name, taken in frames.items()}


@dataclass(frozen=True, eq=False)
class Decoded:
    """One coded frame, decoded by all methods; the keys are their names."""

    index: int
    videos: dict[str, Reconstruction]
    seconds: dict[str, float]  # Wall time of the decoder.


def decode(
    experiment: Experiment,
    frames: Frames,
    calibrations: Calibrations,
    first: int = 0,
    again: Collection[int] = (),
) -> Iterator[Decoded]:
    """Decode frame by frame, in their order; causal, without access to the truth.

    Frames before ``first`` that ``again`` does not name are decoded only as far as later ones depend on them,
    and not returned.
    """
    running: dict[str, Iterator[Reconstruction]] = {}
    for m in experiment.methods:
        asked = _marked(frames[m.name], first, again)
        running[m.name] = m.decoder.decode(asked, calibrations[experiment.choice_of(m)])
    for index in range(len(next(iter(frames.values())))):
        videos: dict[str, Reconstruction] = {}
        seconds: dict[str, float] = {}
        for name, decoder in running.items():
            start = time.perf_counter()
            videos[name] = next(decoder)
            seconds[name] = time.perf_counter() - start
        if index >= first or index in again:
            yield Decoded(index, videos, seconds)


def _marked(frames: Sequence[CodedFrame], first: int, again: Collection[int]) -> Iterator[CodedFrame]:
    """Mark the frames that are not returned, and remove their request for video, which takes long."""
    for frame in frames:
        if frame.index >= first or frame.index in again:
            yield frame
        else:
            still = replace(frame.code, moving=np.zeros_like(frame.code.moving))
            yield replace(frame, code=still, earlier=True)


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """A whole run in memory: for small experiments and notebooks; ``optsim run`` streams to disk instead.

    Parameters
    ----------
    experiment : Experiment
        The experiment as run: its camera is the planned one.
    plan : Skipping
        Models and skipped effects.
    camera : CodedCamera
        The camera with the neutral density of the light rule.
    light : LightLevel
        Result of the light rule.
    calibrations : dict
        :class:`~optsim.calibration.choice.CalibrationChoice` -> calibration.
    truth : IrradianceVideo
        Light on the modulator; lazy.
    radiance : RadianceVideo
        The scene; lazy.
    frames : dict
        Method name -> coded frames.
    reconstructions : dict
        Method name -> reconstructions, one a coded frame.
    """

    experiment: Experiment
    plan: Skipping
    camera: CodedCamera
    light: LightLevel
    calibrations: Calibrations
    truth: IrradianceVideo
    radiance: RadianceVideo
    frames: Frames
    reconstructions: dict[str, tuple[Reconstruction, ...]]

    @property
    def calibration(self) -> Calibration:
        """Calibration of the light rule, and of every method without its own."""
        return self.calibrations[self.experiment.calibration_choice]

    def reference(self, index: int) -> Floats:
        """Ideal reconstruction: mean irradiance a slot and pitch cell, array (slot, v, u)."""
        return self.camera.reference(self.truth, index)

    def __repr__(self) -> str:
        """Describe it in a line: its arrays would fill pages."""
        names = ", ".join(self.frames)
        return f"<Result of {self.experiment.name!r}: {self.experiment.n_frames} coded frames by {names}>"


def run(experiment: Experiment, radiance: RadianceVideo, *, progress: Progress = silent) -> Result:
    """Run an experiment in memory: calibrate, set the light, capture, decode."""
    given = cast("object", radiance)
    if not isinstance(given, RadianceVideo):
        raise ConfigError(
            f"radiance: got {type(given).__name__}, expected a RadianceVideo; cure: render_truth(experiment)"
        )
    experiment, plan = planned(experiment)
    calibrations = calibrate_all(experiment)
    experiment.check_methods(calibrations)
    camera, light = set_light(experiment, radiance, calibrations[experiment.calibration_choice])
    truth = camera.form_image(radiance)
    frames = capture(experiment, camera, truth, calibrations, progress)
    videos: dict[str, list[Reconstruction]] = {m.name: [] for m in experiment.methods}
    for decoded in decode(experiment, frames, calibrations):
        for name, video in decoded.videos.items():
            videos[name].append(video)
        progress("decode", decoded.index + 1, experiment.n_frames)
    return Result(
        experiment,
        plan,
        camera,
        light,
        calibrations,
        truth,
        radiance,
        frames,
        {name: tuple(video) for name, video in videos.items()},
    )
