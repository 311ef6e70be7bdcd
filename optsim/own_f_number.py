"""Every scheme at its own f-number: the second table of a fair comparison, beside that at one for all.

One f-number for all schemes gives those that open a pixel briefly the less light. Here each scheme has the
lens opened, or stopped down, until its own fullest exposure does what the light rule asks of the all-on code:
the interior's percentile reaches the rule's share of saturation. The relay opens with it, or its stop would
keep that light away. f-numbers are those of third stops, and a neutral density takes what is over.

Wavefronts keep their errors in waves and the lens its other aberrations: a faster lens is taken to be as well
corrected, which favours schemes that ask for one and is not validated. Scenes are rendered through each
aperture as far as its depth of field shows. All are scored on the same pixels, those that all methods hold
valid, and regions are those of the shared camera's oracle mask; each is compared with the light on its panel.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from optsim.camera import CodedCamera
from optsim.experiment import Experiment
from optsim.loop import (
    Calibrations,
    Decoded,
    Frames,
    LightLevel,
    calibrate_all,
    capture,
    decode,
    planned,
    set_light,
)
from optsim.metrics import FrameTally
from optsim.metrics.scoring import ScoreRecord
from optsim.progress import Progress, silent
from optsim.quantities import CodedFrame, IrradianceVideo, RadianceVideo
from optsim.scoring import Scorer
from optsim.truth import render_truth

# f/1.4 to f/16, as such lenses can be set (ISO 517 has the full stops); the project's lens has no data sheet.
THIRD_STOPS = tuple(2 ** (k / 6) for k in range(3, 25))


@dataclass(frozen=True, eq=False)
class OwnLight:
    """How schemes compare when each has its own f-number.

    Parameters
    ----------
    f_numbers : dict
        Method name -> f-number of the objective.
    open_shares : dict
        Method name -> largest share of a frame that one of its pixels was open.
    mean_e : dict
        Method name -> photoelectrons a pixel and frame, mean.
    filled : dict
        Method name -> share of saturation that the interior's percentile reaches under its fullest exposure.
    scores : list of ScoreRecord
        Of all methods, as at one f-number for all.
    """

    f_numbers: dict[str, float]
    open_shares: dict[str, float]
    mean_e: dict[str, float]
    filled: dict[str, float]
    scores: list[ScoreRecord]


def open_share(frames: tuple[CodedFrame, ...]) -> float:
    """Largest share of a coded frame's slots in which some pixel is not driven dark."""
    return max(float((frame.code.levels > 0).mean(axis=0).max()) for frame in frames)


def own_f_number(f_number: float, wanted_transmission: float, share: float) -> float:
    """Slowest third stop at which a scheme's fullest exposure gets as much light as the rule asks for.

    Parameters
    ----------
    f_number : float
        At which the rule asks for ``wanted_transmission`` under the all-on code.
    wanted_transmission : float
        Of a neutral density; above 1 where there is too little light.
    share : float
        Of a frame that the scheme's fullest pixel is open.
    """
    most = f_number * math.sqrt(share / wanted_transmission) * (1 + 1e-9)
    return max((stop for stop in THIRD_STOPS if stop <= most), default=THIRD_STOPS[0])


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
    known: Calibrations
    scorer: Scorer

    def decoded(self) -> Iterator[Decoded]:
        return decode(self.experiment, self.frames, self.known)


def _take(
    experiment: Experiment,
    share: float,
    radiance_of: Callable[[Experiment], RadianceVideo],
    progress: Progress,
) -> _Taken:
    """Take all frames of an experiment whose fullest pixel is open for a share of a frame."""
    modelled, _ = planned(experiment)
    known = calibrate_all(modelled)
    for method in modelled.methods:
        method.check(known[modelled.operator_of(method)])
    radiance = radiance_of(experiment)
    camera, light = set_light(modelled, radiance, known[modelled.calibration])
    camera = camera.with_nd(min(1.0, light.wanted_transmission / share))
    truth: IrradianceVideo = camera.form_image(radiance)
    frames = capture(modelled, camera, truth, known, progress)
    return _Taken(modelled, light, frames, known, Scorer(modelled, camera, truth, radiance))


def compare(
    experiment: Experiment,
    radiance_of: Callable[[Experiment], RadianceVideo] = render_truth,
    progress: Progress = silent,
) -> OwnLight:
    """Run an experiment's methods each at its own f-number, and score them together.

    Parameters
    ----------
    experiment : Experiment
        At the f-number that all would share.
    radiance_of : callable
        Gives the truth that an experiment's camera sees; by default it is rendered.
    progress : Progress
        Told of each finished frame.
    """
    shared = _take(experiment, 1.0, radiance_of, progress)
    f_number, wanted = experiment.camera.objective.f_number, shared.light.wanted_transmission
    shares = {name: open_share(frames) for name, frames in shared.frames.items()}
    f_numbers = {name: own_f_number(f_number, wanted, share) for name, share in shares.items()}
    # One camera for all methods that ask for the same light.
    alike: dict[tuple[float, float], list[str]] = {}
    for name, share in shares.items():
        alike.setdefault((f_numbers[name], share), []).append(name)
    taken = [
        _take(at_f_number(experiment, stop, names), share, radiance_of, progress)
        for (stop, share), names in alike.items()
    ]
    videos = [each.decoded() for each in taken]
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
    photons = [row for each in taken for row in each.scorer.photons(each.frames)]
    return OwnLight(
        f_numbers,
        shares,
        {row["method"]: row["mean_e"] for row in photons},
        {name: _filled(each, shares[name]) for each in taken for name in each.frames},
        shared.scorer.board.records(tallies),
    )


def _filled(taken: _Taken, share: float) -> float:
    camera: CodedCamera = taken.scorer.camera
    transmission = camera.objective.nd_transmission / taken.light.nd_transmission
    return taken.light.percentile_dn * transmission * share / taken.light.saturation_dn
