# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUntypedFunctionDecorator=false
"""The plan: what an experiment doesn't need isn't modelled, up to a stated error.

The full model is the camera with every effect on and its numerics as fine as they come. Each short cut makes
one thing coarser, or leaves it out, where that saves time; what costs nothing is always modelled. The size of
each is predicted on two small, plain probes whose panels show the experiment's codes, in units of a frame's
noise, for the scheme with the largest; systematic effects don't average out, so sizes add up linearly. Each
short cut is given an equal share of the tolerance and taken as far as that goes; what is left over goes to
them in their order, those first that save most.

Not planned is how many instants a slot of the truth has (``render.instants_per_slot``): how fast anything
moves only a render tells. ``explain`` lists what one instant costs.

The claim that what is skipped stays below the tolerance is measured in ``validation/skipping``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeGuard

from optsim.camera.camera import SAMPLES_PER_PITCH, CodedCamera
from optsim.camera.effects import ALL, Changes, changed
from optsim.camera.parts.objective import MOVING_WING_SHARE
from optsim.camera.probe import (
    FINEST_FIELD,
    PLAIN,
    Illumination,
    Probes,
    Schemes,
    Which,
    compared_with,
    far_pixel,
    make_probes,
    share_beyond_window,
    shown_on,
)
from optsim.core.config import Part
from optsim.optics.bands import one_thread, side_by_side

# Scenes differ from the probe's: what is predicted is doubled.
_MARGIN = 2.0
# What passes may hide all of a light of less than this share of the picture; so much light, over that of a
# picture in declared white, then changes a frame by some hundredths of its noise. No probe's frame shows it.
_MOST_HIDDEN, _LEAST_LIGHT = 0.06, 0.02


@dataclass(frozen=True)
class Coarser:
    """A field of a part that may have another value, and the model be coarser.

    Parameters
    ----------
    what : str
        In a few words.
    part, field : str
        Of the camera, and its field.
    values : tuple
        From the full model to the cheapest: shares of the light, or names.
    """

    what: str
    part: Literal["objective", "relay", "modulator"]
    field: Literal["field_error", "wing_share", "moving_wing_share", "rim_model"]
    values: tuple[float, ...] | tuple[str, ...]

    @property
    def steps(self) -> tuple[tuple[str, Changes], ...]:
        """From the full model to the cheapest, with the words that name each."""
        return tuple(
            (
                value if isinstance(value, str) else f"within {100 * value:g} %",
                {self.part: {self.field: value}},
            )
            for value in self.values
        )


@dataclass(frozen=True)
class LeftOut:
    """An effect that may be left out.

    Parameters
    ----------
    effect : str
        Its name.
    """

    effect: str

    @property
    def what(self) -> str:
        """In a few words."""
        return ALL[self.effect].what

    @property
    def steps(self) -> tuple[tuple[str, Changes], ...]:
        """With the effect and without it, with the words that name each."""
        return (("modelled", {}), ("skipped", ALL[self.effect].ideal))


_FIELD = (FINEST_FIELD, 0.01, 0.02, 0.05, 0.1, 1.0)
_WINGS = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2)
# Those first that save most time at the prototype's scale.
SHORT_CUTS: dict[str, Coarser | LeftOut] = {
    "moving_wings": Coarser(
        "far wings of moving light, and with them its glare, along straight lines in time: share in them",
        "objective",
        "moving_wing_share",
        (0.0, MOVING_WING_SHARE),
    ),
    "fringing_rims": Coarser(
        "rims of panel pixels under fringing fields: by fine or coarse quadrature, or weights mixed",
        "modulator",
        "rim_model",
        ("fine", "coarse", "mixed"),
    ),
    "objective_field": Coarser(
        "PSF of the objective over the field: share of a point's light that may be misplaced",
        "objective",
        "field_error",
        _FIELD,
    ),
    "objective_wings": Coarser(
        "far wings of the objective's PSF: share of the light that they may lose",
        "objective",
        "wing_share",
        _WINGS,
    ),
    "relay_field": Coarser(
        "PSF of the relay over the field: share of a point's light that may be misplaced",
        "relay",
        "field_error",
        _FIELD,
    ),
    "relay_wings": Coarser(
        "far wings of the relay's PSF: share of the light that they may lose",
        "relay",
        "wing_share",
        _WINGS,
    ),
    "objective_blur": LeftOut("objective_blur"),
    "relay_blur": LeftOut("relay_blur"),
    "response": LeftOut("response"),
    "ghost": LeftOut("ghost"),
    "smear": LeftOut("smear"),
}


@dataclass(frozen=True)
class Choice:
    """How one thing is modelled.

    Parameters
    ----------
    short_cut, what : str
        Name and a few words.
    choice : str
        ``modelled``, ``skipped``, or within what share of the light.
    full : bool
        Whether that is the full model.
    size : float
        Rms change that it makes in a frame against the full model, relative to the noise; predicted.
    """

    short_cut: str
    what: str
    choice: str
    full: bool
    size: float


@dataclass(frozen=True)
class CameraPlan:
    """What is modelled how, and the camera that does so.

    Parameters
    ----------
    tolerance : float
        Rms error allowed in a frame, relative to its noise.
    choices : tuple of Choice
        One a short cut.
    camera : CodedCamera
        As planned.
    probes : Probes
        By which it was found.
    """

    tolerance: float
    choices: tuple[Choice, ...]
    camera: CodedCamera
    probes: Probes

    @property
    def predicted(self) -> float:
        """Sum of the sizes."""
        return sum(choice.size for choice in self.choices)


def plan_camera(camera: CodedCamera, light: Illumination, schemes: Schemes, tolerance: float) -> CameraPlan:
    """Choose how finely a camera must be modelled.

    Parameters
    ----------
    camera : CodedCamera
        With all its effects. Numerics set by hand, to other values than their defaults, stay.
    light : Illumination
        What the experiment's scene is like.
    schemes : mapping
        Name -> scheme of the experiment: none of their frames may err by more.
    tolerance : float
        Rms error allowed in a frame, relative to its noise; 0 models everything.
    """
    open_to_choice = {
        name: _predictable(camera, cut, light)
        for name, cut in SHORT_CUTS.items()
        if not _by_hand(camera, cut)
    }
    planned = camera
    for cut in open_to_choice.values():
        planned = changed(planned, cut.steps[0][1])
    probes = make_probes(changed(planned, PLAIN), light, schemes)
    # The frames with everything, which all others are compared with.
    both = probes.near, probes.far
    side_by_side(partial(each.noise_e, name) for name in probes.far.schemes for each in both)
    ladders = {
        name: _Ladder(name, cut, probes, light.bright is not None) for name, cut in open_to_choice.items()
    }
    with one_thread():
        chosen = _steps(ladders, tolerance)
    for name, step in chosen.items():
        planned = changed(planned, ladders[name].cut.steps[step][1])
    choices = [ladders[name].choice(step) for name, step in chosen.items()]
    return CameraPlan(tolerance, tuple(choices), planned, probes)


def _steps(ladders: dict[str, _Ladder], tolerance: float) -> dict[str, int]:
    """Cheapest steps that together stay within a tolerance: an equal share each, then what is left over."""
    chosen = dict.fromkeys(ladders, 0)
    if tolerance <= 0:
        return chosen
    share = tolerance / len(ladders)
    for name, ladder in ladders.items():
        chosen[name] = ladder.farthest(share)
    left = tolerance - sum(ladders[name].size(step) for name, step in chosen.items())
    for name, ladder in ladders.items():
        now = ladder.size(chosen[name])
        chosen[name] = max(chosen[name], ladder.farthest(now + left))
        left -= ladder.size(chosen[name]) - now
    return chosen


@dataclass(frozen=True, eq=False)
class _Ladder:
    """A short cut with the sizes of its steps, each found when it is asked for."""

    name: str
    cut: Coarser | LeftOut
    probes: Probes
    lit: bool  # by a bright light in the picture

    def size(self, step: int) -> float:
        return max(self._sizes(step))

    def _fits(self, step: int, limit: float) -> bool:
        return all(size <= limit for size in self._sizes(step))

    def _sizes(self, step: int) -> Iterator[float]:
        """One a scheme: the first that is too large tells enough."""
        if step == 0:
            yield 0.0
            return
        changes, of = self.cut.steps[step][1], compared_with(self.name)
        for size, _ in self.probes.sizes(changes, of, self._on(step)):
            yield _MARGIN * self._times * size

    def _on(self, step: int) -> tuple[Which, ...]:
        cut, near = self.cut, self.probes.near
        if self.name == "moving_wings":
            # Those that begin farther off than what moves there is long land all over the picture.
            begin = share_beyond_window(near.camera, "objective", near.camera.view.rows // 3)
            return ("near", "far") if begin > MOVING_WING_SHARE else ("near",)
        if not _of_wings(cut):
            return shown_on(self.name)
        # They reach over the whole panel; a near probe has no room for those that lose least.
        has_room = float(cut.values[step]) > getattr(near.camera, cut.part).wing_share
        return ("near", "far") if has_room else ("far",)

    @property
    def _times(self) -> int:
        # A probe's patch moves in a part of the frame. Others may move in all of it: at worst that adds up.
        if self.name == "moving_wings":
            return self.probes.near.parts
        # Of the picture up to four times as much is as far off from a light in a corner.
        return 2 if self.lit and _of_wings(self.cut) else 1

    def farthest(self, limit: float) -> int:
        """Cheapest step whose size is within a limit, by bisection: cheaper steps err more."""
        within, beyond = 0, len(self.cut.steps)
        while beyond - within > 1:
            step = (within + beyond) // 2
            within, beyond = (step, beyond) if self._fits(step, limit) else (within, step)
        return within

    def choice(self, step: int) -> Choice:
        return Choice(self.name, self.cut.what, self.cut.steps[step][0], step == 0, self.size(step))


def _of_wings(cut: Coarser | LeftOut) -> TypeGuard[Coarser]:
    return isinstance(cut, Coarser) and cut.field == "wing_share"


def _predictable(camera: CodedCamera, cut: Coarser | LeftOut, light: Illumination) -> Coarser | LeftOut:
    """Leave out steps whose size no probe tells.

    Beside a small lamp, which something may hide, those of moving light's wings and of rims. Beside any
    bright light those whose wings begin within a pixel of the far probe, where a near one's light is not what
    it is in truth; and those whose wings would reach farther than twice the length of the panel.
    """
    hidden = any(each.share < _MOST_HIDDEN and each.light > _LEAST_LIGHT for each in light.lights)
    if hidden and isinstance(cut, Coarser) and cut.field in ("moving_wing_share", "rim_model"):
        return Coarser(cut.what, cut.part, cut.field, cut.values[:1])
    if not _of_wings(cut):
        return cut
    shares = [float(share) for share in cut.values]
    least = share_beyond_window(camera, cut.part, 2 * max(camera.view.rows, camera.view.cols))
    fitting = [share for share in shares if share >= least] or shares[-1:]
    if light.bright is None:
        return replace(cut, values=tuple(fitting))
    most = share_beyond_window(camera, cut.part, far_pixel(camera) * SAMPLES_PER_PITCH)
    return replace(cut, values=tuple(share for share in fitting if share <= most) or tuple(fitting[:1]))


def _by_hand(camera: CodedCamera, cut: Coarser | LeftOut) -> bool:
    """Whether the one field of a short cut isn't at its default any more."""
    if isinstance(cut, LeftOut):
        return False
    part: Part = getattr(camera, cut.part)
    return bool(getattr(part, cut.field) != type(part).model_fields[cut.field].default)
