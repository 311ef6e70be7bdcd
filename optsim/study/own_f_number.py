"""Every scheme at its own f-number: the second table of a fair comparison, beside that at one for all.

One f-number for all schemes gives those that open a pixel briefly the less light. Here the lens opens for
each scheme until its own fullest exposure does what the light rule asks of the all-on code: the interior's
percentile reaches the rule's share of saturation. Exposures are those that the calibration tells, with the
panel's leak and response. The relay opens with the lens, or its stop would keep that light away. f-numbers
are those of third stops, and a neutral density takes what is over; none is slower than the shared one, since
a density does as well without its diffraction.

Wavefronts keep their errors in waves and the lens its other aberrations: a faster lens is taken to be as well
corrected, which favours schemes that ask for one and is not validated. All see the scene as it is rendered
for the shared aperture: its depth of field is no part of the comparison. All are scored on the same pixels,
those that all methods hold valid, in regions of the shared camera's oracle mask, and against the light on
their own panel.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optsim.calibration import Calibration
from optsim.core.progress import Progress, silent
from optsim.core.quantities import CodedFrame, RadianceVideo
from optsim.experiment.calibrations import Calibrations, calibrate_all
from optsim.experiment.experiment import Experiment
from optsim.experiment.loop import Frames, LightLevel, capture, decode, planned, set_light
from optsim.experiment.scoring import Scorer
from optsim.metrics import FrameTally
from optsim.metrics.records import Score

# From f/1.4, as such lenses can be set; the project's has no data sheet. Slower ones than f/16 nobody shares.
THIRD_STOPS = tuple(2 ** (k / 6) for k in range(3, 25))
# A pixel that was dark before is a little short of one that is on for ever: so much of the light will do.
_ENOUGH = 0.98


@dataclass(frozen=True, eq=False)
class OwnLight:
    """How schemes compare when each has its own f-number; the keys are method names."""

    f_numbers: dict[str, float]  # Of the objective.
    open_shares: dict[str, float]  # Exposure of the fullest pixel, of one that is on for ever.
    mean_e: dict[str, float]  # Photoelectrons a pixel and frame.
    # Share of saturation that the interior's percentile reaches under the fullest exposure.
    filled: dict[str, float]
    scores: list[Score]  # Of all methods, as at one f-number for all.


def open_share(frames: Iterable[CodedFrame], calibration: Calibration) -> float:
    """Exposure of the fullest pixel of any frame, of one that is on for ever: leak and response are in it."""
    panel, most = None, 0.0
    for frame in frames:
        weights, panel = calibration.weights(frame.code, panel)
        most = max(most, float(weights.sum(axis=0)[calibration.valid].max()))
    return most / calibration.coded_slots


def own_f_number(f_number: float, wanted_transmission: float, share: float) -> float:
    """Slowest third stop at which a scheme's fullest exposure gets as much light as the rule asks for."""
    most = f_number * math.sqrt(share / wanted_transmission / _ENOUGH)
    if most >= f_number:
        return f_number
    return max((stop for stop in THIRD_STOPS if stop <= most), default=min(THIRD_STOPS[0], f_number))


def at_f_number(experiment: Experiment, f_number: float, names: list[str]) -> Experiment:
    """Return an experiment of some of its methods behind a lens of another f-number, relay and all."""
    camera = experiment.camera
    cone = f_number * camera.objective.magnification * camera.relay.magnification
    opened = camera.model_copy(
        update={
            "objective": camera.objective.model_copy(update={"f_number": f_number}),
            "relay": camera.relay.model_copy(update={"f_number": min(camera.relay.f_number, cone)}),
        }
    )
    methods = tuple(method for method in experiment.methods if method.name in names)
    kept = tuple(name for name in experiment.save_reconstructions if name in names)
    return experiment.model_copy(update={"camera": opened, "methods": methods, "save_reconstructions": kept})


@dataclass(frozen=True, eq=False)
class _Taken:
    """Some methods' frames through one camera, and all that is needed to decode and score them."""

    experiment: Experiment
    light: LightLevel
    frames: Frames
    calibrations: Calibrations
    scorer: Scorer

    @cached_property
    def open_shares(self) -> dict[str, float]:
        """Exposure of each method's fullest pixel, as the experiment's own calibration tells it."""
        calibrations = self.calibrations[self.experiment.calibration_choice]
        return {name: open_share(frames, calibrations) for name, frames in self.frames.items()}

    @property
    def filled(self) -> float:
        """Share of saturation that the interior's percentile would reach under the all-on code."""
        transmission = self.scorer.camera.objective.nd_transmission / self.light.nd_transmission
        return self.light.percentile_dn * transmission / self.light.saturation_dn


def _take(experiment: Experiment, share: float, radiance: RadianceVideo, progress: Progress) -> _Taken:
    """Take all frames of an experiment whose fullest exposure is a share of one that is on for ever."""
    modelled, _ = planned(experiment)
    calibrations = calibrate_all(modelled)
    modelled.check_methods(calibrations)
    camera, light = set_light(modelled, radiance, calibrations[modelled.calibration_choice])
    camera = camera.with_nd(min(1.0, light.wanted_transmission / share))
    truth = camera.form_image(radiance)
    frames = capture(modelled, camera, truth, calibrations, progress)
    return _Taken(modelled, light, frames, calibrations, Scorer(modelled, camera, truth, radiance))


def compare(experiment: Experiment, radiance: RadianceVideo, *, progress: Progress = silent) -> OwnLight:
    """Run an experiment's methods each at its own f-number, and score them together."""
    shared = _take(experiment, 1.0, radiance, progress)
    f_number, wanted = experiment.camera.objective.f_number, shared.light.wanted_transmission
    shares = shared.open_shares
    f_numbers = {name: own_f_number(f_number, wanted, share) for name, share in shares.items()}
    # One camera for all methods that ask for the same light.
    alike: dict[tuple[float, float], list[str]] = {}
    for name, share in shares.items():
        alike.setdefault((f_numbers[name], round(share, 2)), []).append(name)
    taken = [
        _take(at_f_number(experiment, stop, names), max(shares[name] for name in names), radiance, progress)
        for (stop, _), names in alike.items()
    ]
    videos = [decode(each.experiment, each.frames, each.calibrations) for each in taken]
    tallies: list[FrameTally] = []
    for index in range(experiment.n_frames):
        found = [next(each).videos for each in videos]
        scored = np.logical_and.reduce([video.valid for each in found for video in each.values()])
        moving = shared.scorer.moving(index)
        for each, of_each in zip(taken, found, strict=True):
            reference = each.scorer.reference(index)
            tallies += [
                each.scorer.board.tally(name, video, reference, moving, scored)
                for name, video in of_each.items()
            ]
        progress("decode", index + 1, experiment.n_frames)
    scores = shared.scorer.board.records(tallies)
    photons = [row for each in taken for row in each.scorer.photons(each.frames)]
    # Schemes that look at their frames may have chosen other codes in other light.
    taken_shares = {name: share for each in taken for name, share in each.open_shares.items()}
    return OwnLight(
        f_numbers,
        {name: taken_shares[name] for name in f_numbers},
        {row.method: row.mean_e for row in photons},
        {name: each.filled * share for each in taken for name, share in each.open_shares.items()},
        scores,
    )
