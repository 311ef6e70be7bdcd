"""Skip table: effects that may be left out for a scene, with the rule, the error bound and the saving.

The full model is the camera with every effect on and a scene rendered instant by instant. A row bounds the
change of a frame without it: rms over pixels that don't saturate, in units of the frame's noise. Most rows
are exact: they leave out effects that are absent. The other bounds add up, and their sum stays within the
tolerance. An effect that costs no time is always modelled.

``optsim run --check-skips`` takes a frame both ways. ``validation/skipping`` compares the bound with the full
model over cameras, lights, codes and tolerances.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import Changes, changed
from optsim.camera.parts.objective import MOVING_TAIL_SHARE
from optsim.camera.probe import FINEST_FIELD, Illumination, share_beyond_window
from optsim.core.config import Part

# A mover may hide a whole light that covers less than this share of the picture.
_MOST_HIDDEN = 0.06
# Bounds of straight lines in time, above the values measured in validation/skipping. In even light that was
# 0.0001 of a frame's noise, before a window too large to be hidden at most 0.046. Beside small lamps it was
# 0.3 to 4.7 times the electrons in their PSF tails, over the noise.
_EVEN, _LARGE_LIGHT, _HIDDEN_LIGHT = 1e-3, 0.06, 7.0
_FINEST_TAILS = 1e-4  # share of the light beyond a PSF's window
_NEVER = math.inf


@dataclass(frozen=True)
class Given:
    """Inputs of the rules; none needs a render.

    Parameters
    ----------
    camera : CodedCamera
        Camera with all its effects.
    light : Illumination
        Declared white, light rule, and bright lights in the picture.
    change : {"static", "lamps", "movers", "camera"} or None
        Kind of change in the scene (``Scene.kind_of_change``); None for footage.
    flickers, polarised, focused : bool
        Whether lamps flicker, whether the scene is rendered with its polarisation, and whether it is sharp
        enough to be rendered by a pinhole (``experiment/focus.py``).
    """

    camera: CodedCamera
    light: Illumination
    change: Literal["static", "lamps", "movers", "camera"] | None = None
    flickers: bool = False
    polarised: bool = False
    focused: bool = False


@dataclass(frozen=True)
class Skip:
    """One row of the skip table: an effect left out, its error bound and the measured saving."""

    name: str
    what: str
    saves: str
    # In units of a frame's noise: 0 if exact, infinite if it must be modelled.
    bound: Callable[[Given], float]
    # Changes of the camera that model it in full; None where the renderer decides by the same rule.
    full: Changes | None = None


def _exact(skipped: bool) -> float:
    return 0.0 if skipped else _NEVER


def straight_lines(given: Given) -> float:
    """Bound the error of putting the light of PSF tails on straight lines in time within a segment.

    Only a bright light that appears or disappears deviates from its line. In the worst case a small one is
    hidden as a whole: the share :data:`MOVING_TAIL_SHARE` of its light then changes, much of it close by.
    """
    camera, lights = given.camera, given.light.lights
    hidden = sum(each.light for each in lights if each.share < _MOST_HIDDEN)
    sensor = camera.sensor
    white_e = {row.stage: row.value for row in camera.with_nd(1.0).ledger(given.light.white_w_m2_sr)}[
        "electrons a frame"
    ]
    # The light rule limits the signal to this share of the well; a frame's mean is half of it.
    frame_e = min(white_e, given.light.saturation_share * sensor.most_e) / 2
    noise_e = math.hypot(math.sqrt(frame_e), sensor.read_noise_e)
    spread = _HIDDEN_LIGHT * MOVING_TAIL_SHARE * hidden * 2 * frame_e / noise_e
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
        "the light without movers, in all slots but one: movers are rendered as differences from it",
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
        "polarised light paths: nothing polarises, or the camera is set to ignore it",
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
        "moving_tails",
        "far parts of the objective's PSF for moving light, instant by instant: straight lines instead",
        "12 to 0.75 s a frame of the prototype",
        straight_lines,
        {"objective": {"moving_tail_share": 0.0}},
    ),
)


@dataclass(frozen=True)
class Choice:
    """Decision for a row of the skip table."""

    skip: str
    what: str
    saves: str
    skipped: bool  # Whether it is left out.
    bound: float  # Error in units of a frame's noise; 0 where it is modelled.


@dataclass(frozen=True)
class Skipping:
    """Decisions of the skip table for an experiment.

    Parameters
    ----------
    tolerance : float
        Error allowed, in units of a frame's noise.
    choices : tuple of Choice
        One a row.
    camera : CodedCamera
        Camera that models the rest.
    """

    tolerance: float
    choices: tuple[Choice, ...]
    camera: CodedCamera

    @property
    def bound(self) -> float:
        """Sum of the bounds."""
        return sum(choice.bound for choice in self.choices)


def leave_out(given: Given, tolerance: float) -> Skipping:
    """Decide which effects are left out.

    Parameters
    ----------
    given : Given
        Camera, light and scene. Camera values other than the defaults are kept.
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
    """Set the finest numerics: coarser ones save no time."""
    # PSF windows end at twice the length of the panel: no light is collected beyond.
    length = 2 * max(camera.view.rows, camera.view.cols)
    changes: dict[str, dict[str, float]] = {"objective": {}, "relay": {}}
    for part, fields in changes.items():
        if _at_default(camera, {part: {"field_error": 0.0}}):
            fields["field_error"] = FINEST_FIELD
        if _at_default(camera, {part: {"tail_share": 0.0}}):
            fields["tail_share"] = max(_FINEST_TAILS, share_beyond_window(camera, part, length))
    return changed(camera, changes)


def _at_default(camera: CodedCamera, changes: Changes) -> bool:
    """Whether the changed fields still have their defaults."""
    for name, fields in changes.items():
        part: Part = getattr(camera, name)
        defaults = type(part).model_fields
        if any(getattr(part, field) != defaults[field].default for field in fields):
            return False
    return True
