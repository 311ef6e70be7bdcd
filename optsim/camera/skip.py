"""What a scene may leave out, a row each: when, at which error, and what that saves.

The full model is the camera with every effect on, before a scene rendered instant by instant. A row states
how much a frame changes without it: rms over pixels that don't saturate, in units of the frame's noise. Most
rows are exact: they leave out what isn't there. Bounds of the others add up, and a row is taken only while
all of them together stay within the tolerance. What saves no time is always modelled.

``optsim run --check-skips`` takes a frame both ways. ``validation/skipping`` holds the bound against the full
model over cameras, lights, codes and tolerances.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import Changes, changed
from optsim.camera.parts.objective import MOVING_WING_SHARE
from optsim.camera.probe import FINEST_FIELD, Illumination, share_beyond_window
from optsim.core.config import Part

# A mover may hide all of a light that covers less than this share of the picture.
_MOST_HIDDEN = 0.06
# Bounds of straight lines in time, over what validation/skipping measured: 0.0001 of a frame's noise in even
# light, at most 0.046 before a window that is too large to be hidden, and beside small lamps 0.3 to 4.7 times
# the electrons that the far part of their PSFs brings, over the noise.
_EVEN, _LARGE_LIGHT, _HIDDEN_LIGHT = 1e-3, 0.06, 7.0
_FINEST_WINGS = 1e-4  # share of the light beyond a PSF's window
_NEVER = math.inf


@dataclass(frozen=True)
class Given:
    """What rules go by; nothing of it needs a render.

    Parameters
    ----------
    camera : CodedCamera
        With all its effects.
    light : Illumination
        White, light rule, and bright lights in the picture.
    change : {"static", "lamps", "movers", "camera"} or None
        What of the scene changes with time (``Scene.kind_of_change``); None of footage.
    flickers, polarised, focused : bool
        Whether lamps flicker, whether the scene is rendered with its polarisation, and whether all of it is
        so sharp that a pinhole renders it (``experiment/focus.py``).
    """

    camera: CodedCamera
    light: Illumination
    change: Literal["static", "lamps", "movers", "camera"] | None = None
    flickers: bool = False
    polarised: bool = False
    focused: bool = False


@dataclass(frozen=True)
class Skip:
    """One thing that may be left out.

    Parameters
    ----------
    name, what, saves : str
        What is left out, and what that saves as measured.
    bound : callable
        Error without it in units of a frame's noise: 0 where it is exact, infinite where it can't be.
    full : Changes or None
        What of the camera models it in full; None where the renderer decides by the same rule.
    """

    name: str
    what: str
    saves: str
    bound: Callable[[Given], float]
    full: Changes | None = None


def _exact(skipped: bool) -> float:
    return 0.0 if skipped else _NEVER


def straight_lines(given: Given) -> float:
    """Bound the error of far light that follows straight lines in time within a segment.

    Only a bright light that comes and goes leaves its line. At worst a small one is hidden as a whole: the
    share :data:`MOVING_WING_SHARE` of its light then changes, much of it close by.
    """
    camera, lights = given.camera, given.light.lights
    hidden = sum(each.light for each in lights if each.share < _MOST_HIDDEN)
    sensor = camera.sensor
    white_e = {row.stage: row.value for row in camera.with_nd(1.0).ledger(given.light.white_w_m2_sr)}[
        "electrons a frame"
    ]
    # The light rule: no more than this fills the well; half of it is a frame's mean.
    frame_e = min(white_e, given.light.saturation_share * sensor.most_e) / 2
    noise_e = math.hypot(math.sqrt(frame_e), sensor.read_noise_e)
    spread = _HIDDEN_LIGHT * MOVING_WING_SHARE * hidden * 2 * frame_e / noise_e
    return (_LARGE_LIGHT if len(lights) else _EVEN) + spread


ALL: tuple[Skip, ...] = (
    Skip(
        "time",
        "pictures of later slots: nothing in the scene changes",
        "all but one render",
        lambda given: _exact(given.change == "static"),
    ),
    Skip(
        "still_light",
        "light that stands still, in all slots but one: movers are rendered as differences from it",
        "render.window_room of optsim bench: time against error beside rendering every slot",
        lambda given: _exact(given.change in ("static", "lamps", "movers")),
    ),
    Skip(
        "lamp_groups",
        "a picture for each group of lamps: none flickers",
        "one render a group",
        lambda given: _exact(given.change is not None and not given.flickers),
    ),
    Skip(
        "polarisation",
        "polarised light paths: nothing polarises, or the camera is told not to look",
        "not measured",
        lambda given: _exact(given.change is not None and not given.polarised),
    ),
    Skip(
        "defocus",
        "depth of field: everything in the picture is sharp within a tenth of a sample",
        "not measured",
        lambda given: _exact(given.change is not None and given.focused),
    ),
    Skip(
        "moving_wings",
        "far parts of the objective's PSF for moving light, instant by instant: straight lines instead",
        "12 to 0.75 s a frame of the prototype",
        straight_lines,
        {"objective": {"moving_wing_share": 0.0}},
    ),
)


@dataclass(frozen=True)
class Choice:
    """What became of a row.

    Parameters
    ----------
    skip, what, saves : str
        As the row says.
    skipped : bool
        Whether it is left out.
    bound : float
        Error in units of a frame's noise; 0 where it is modelled.
    """

    skip: str
    what: str
    saves: str
    skipped: bool
    bound: float


@dataclass(frozen=True)
class Skipping:
    """What an experiment leaves out.

    Parameters
    ----------
    tolerance : float
        Error allowed, in units of a frame's noise.
    choices : tuple of Choice
        One a row.
    camera : CodedCamera
        That models the rest.
    """

    tolerance: float
    choices: tuple[Choice, ...]
    camera: CodedCamera

    @property
    def bound(self) -> float:
        """Sum of the bounds."""
        return sum(choice.bound for choice in self.choices)


def leave_out(given: Given, tolerance: float) -> Skipping:
    """Choose what is left out.

    Parameters
    ----------
    given : Given
        Camera, light and scene. Numbers of the camera set by hand, to other values than their defaults, stay.
    tolerance : float
        Rms error allowed in a frame, relative to its noise; 0 leaves out only what isn't there.
    """
    camera, left, choices = _finest(given.camera), tolerance, list[Choice]()
    for row in ALL:
        if row.full and not _at_default(given.camera, row.full):
            continue
        bound = row.bound(given)
        skipped = bound <= left
        if not skipped and row.full:
            camera = changed(camera, row.full)
        left -= bound if skipped else 0.0
        choices.append(Choice(row.name, row.what, row.saves, skipped, bound if skipped else 0.0))
    return Skipping(tolerance, tuple(choices), camera)


def _finest(camera: CodedCamera) -> CodedCamera:
    """Numerics as fine as they come: coarser ones save no time.

    PSFs reach no farther than twice the length of the panel: there is nothing beyond.
    """
    length = 2 * max(camera.view.rows, camera.view.cols)
    changes: dict[str, dict[str, float]] = {"objective": {}, "relay": {}}
    for part, fields in changes.items():
        if _at_default(camera, {part: {"field_error": 0.0}}):
            fields["field_error"] = FINEST_FIELD
        if _at_default(camera, {part: {"wing_share": 0.0}}):
            fields["wing_share"] = max(_FINEST_WINGS, share_beyond_window(camera, part, length))
    return changed(camera, changes)


def _at_default(camera: CodedCamera, changes: Changes) -> bool:
    """Whether nobody set the fields that some changes are of."""
    for name, fields in changes.items():
        part: Part = getattr(camera, name)
        defaults = type(part).model_fields
        if any(getattr(part, field) != defaults[field].default for field in fields):
            return False
    return True
