# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""Blind registration: how far the panel's image has moved since the calibration, from coded frames alone.

Frames of static light with different codes must agree on that light. Read beside its centre, a panel pixel
has its neighbour's light too, which follows the neighbour's code, and the frames disagree. The search moves
them back until they agree best. Frames that took no part in it decide whether that is believed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import (
    LEAST_EXPOSURE,
    DemixedFrame,
    SaturationPrior,
    demix,
    demixed_frames,
    noise_variance,
)
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bools, CodedFrame, Doubles, Floats, Words

# Relative error of a predicted frame beside noise, by fringing for example. A sensible default.
_MODEL_ERROR = 0.1
# Residuals count in full up to so many standard deviations: light that moves must not decide.
_BOUND_SIGMAS = 3.0
# A pixel tells where it is if the exposures beside it differ by this share of its own.
_LEAST_CONTRAST = 0.2
# The search begins on a lattice of shifts so far away, and so far apart, panel pixels; on so many frames.
_REACH, _STEP, _FEW_FRAMES = 2.0, 0.5, 3
# Shifts of the lattice so far from the best one are others, panel pixels. Frames that agree no better than
# this are not understood; where they were moved back rightly, the demo's were at 0.04 to 0.15.
_ELSEWHERE, _MOST_LEFT = 1.0, 0.25
# A line at the panel's edge is dark below this share of that so many lines inside; sensible defaults.
_DARK, _INSIDE = 0.2, 3
# Share of a panel pixel's light that each one beside it gains, over f (1 - f), where frames are read a
# fraction f between CCD pixels: of the virtual camera, whose image is made of cells as large as these.
_BLUR = 0.055
# The first steps of its two rounds from there, panel pixels, and what ends them, CCD pixels and residual.
_FIRST_STEPS, _LAST_STEP_PX, _LAST_GAIN, _MOST_TRIALS = (0.1, 0.03), 0.01, 1e-5, 100
# Held-out frames are compared in squares of the panel, panel pixels. Few squares or pixels tell nothing.
_SQUARE_PX, _FEWEST_SQUARES, _FEWEST_PIXELS = 6, 8, 5
# Standard errors over the squares by which the residual must fall.
_SIGMAS = 3.0
# Those of a rotation beside a believed shift, and of a shift against the best one elsewhere: a rotation taken
# for real by chance, once in 15, is as small as its error.
_MORE_SIGMAS = 1.5
_FEWEST_FRAMES = 4


@dataclass(frozen=True)
class Registration:
    """Rigid displacement of the panel's image on the CCD since the calibration."""

    shift_y_px: float = 0.0  # Of its middle, CCD pixels.
    shift_x_px: float = 0.0
    rotation_rad: float = 0.0  # About the CCD's middle, from x towards y.

    def now(self, y: Doubles, x: Doubles, ccd_shape: tuple[int, int]) -> tuple[Doubles, Doubles]:
        """Where the light of CCD pixels is now; pixel centres are whole numbers."""
        down, right = y + 0.5 - ccd_shape[0] / 2, x + 0.5 - ccd_shape[1] / 2
        return (
            y + self.shift_y_px + self.rotation_rad * right,
            x + self.shift_x_px - self.rotation_rad * down,
        )


NOT_MOVED = Registration()


@dataclass(frozen=True)
class Blind:
    """Outcome of a blind registration.

    Parameters
    ----------
    registration : Registration
        What is believed; :data:`NOT_MOVED` where nothing is.
    before, after : float
        Residual of the frames that were held out, without and with it, 0 to 1.
    sigmas : float
        By how many of its standard errors it fell, or would have.
    why : str
        Why nothing is believed; empty where something is.
    """

    registration: Registration = NOT_MOVED
    before: float = 0.0
    after: float = 0.0
    sigmas: float = 0.0
    why: str = ""


def registered_blind(frames: Sequence[CodedFrame], calibration: Calibration) -> Blind:
    """Search for the panel's image in the coded frames themselves.

    Every other frame is searched: for a shift, then for a rotation with it. Each is believed if the residual
    of the frames between falls by more than its scatter over the panel. A magnification is not searched for:
    on a film of 24 x 32 panel pixels, moving back by the true one scored lower than leaving the frames.

    Parameters
    ----------
    frames : sequence of CodedFrame
        A recording, in its order.
    calibration : Calibration
        Of the camera before its image moved.
    """
    if len(frames) < _FEWEST_FRAMES:
        return Blind(why=f"got {len(frames)} frames, expected at least {_FEWEST_FRAMES}")
    try:
        samples = [sample for _, sample in demixed_frames(frames, calibration, "undone")]
    except ConfigError as error:
        return Blind(why=str(error))

    def searched(at: Registration) -> _Agreement:
        return _agreement(frames[1::2], samples[1::2], calibration, at)

    def held_out(at: Registration) -> dict[tuple[int, int], float]:
        return _agreement(frames[::2], samples[::2], calibration, at).squares()

    start = held_out(NOT_MOVED)
    if min(len(start), len(searched(NOT_MOVED).squares())) < _FEWEST_SQUARES:
        return Blind(why="neighbours have the same exposures, and nothing tells where they are")
    outcome = Blind(before=_mean(start), after=_mean(start))
    lattice = np.arange(-_REACH, _REACH + _STEP / 2, _STEP) * calibration.ratio
    trials: list[Registration] = [Registration(float(y), float(x)) for y in lattice for x in lattice]
    few = slice(1, 2 * _FEW_FRAMES, 2)
    coarse = [_agreement(frames[few], samples[few], calibration, at).residual for at in trials]
    # The code repeats, so a shift that takes a dark side of the CCD for the panel may score best.
    order = [trials[int(k)] for k in np.argsort(coarse)]
    lit = (at for at in order if not _dark_side(frames[few], calibration, at))
    best = next(lit, order[0])
    far_px = _ELSEWHERE * calibration.ratio
    rival = next((at for at in lit if _apart_px(at, best) > far_px), None)
    for n_free in (2, 3):
        best = _refined(lambda at: searched(at).residual, best, n_free, calibration)
        old, new = held_out(outcome.registration), held_out(best)
        sigmas = _fallen_sigmas(old, new)
        if sigmas > (_SIGMAS if n_free == 2 or outcome.registration == NOT_MOVED else _MORE_SIGMAS):
            outcome = replace(outcome, registration=best, after=_mean(new), sigmas=sigmas)
        elif outcome.registration == NOT_MOVED:
            outcome = replace(outcome, sigmas=sigmas)
    found = outcome.registration
    if found == NOT_MOVED:
        disagree = "" if outcome.before < _MOST_LEFT else ", and they disagree: not found"
        return replace(outcome, why=f"no movement explains the held-out frames better than none{disagree}")
    reach_px = (_REACH + _STEP) * calibration.ratio
    why = ""
    if outcome.after > _MOST_LEFT:
        why = f"not found: moved back, the held-out frames still disagree by {outcome.after:.2f}"
    elif max(abs(found.shift_y_px), abs(found.shift_x_px)) > reach_px:
        why = f"not found: the best shift is beyond the {reach_px:g} CCD pixels that were searched"
    elif _dark_side(frames, calibration, found):
        why = "not found: moved back, a side of the panel is dark: the code repeats, and it lies farther away"
    elif rival is not None:
        rival = _refined(lambda at: searched(at).residual, rival, 2, calibration)
        if _fallen_sigmas(held_out(rival), held_out(found)) < _MORE_SIGMAS:
            why = (
                f"not found: a shift by {rival.shift_y_px:+.1f} rows and {rival.shift_x_px:+.1f} columns of "
                f"the CCD explains the frames as well as {found.shift_y_px:+.1f} and {found.shift_x_px:+.1f}"
            )
    return replace(outcome, registration=NOT_MOVED, after=outcome.before, why=why) if why else outcome


def _apart_px(one: Registration, other: Registration) -> float:
    return math.hypot(one.shift_y_px - other.shift_y_px, one.shift_x_px - other.shift_x_px)


def _dark_side(frames: Sequence[CodedFrame], calibration: Calibration, at: Registration) -> bool:
    """Whether one of the panel's outermost lines has hardly any light beside that farther in."""
    light = sum(calibration.observe(frame).signal for frame in moved_back(frames, calibration, at))
    sides = [np.swapaxes(np.asarray(light), 0, axis)[::way] for axis in (0, 1) for way in (1, -1)]
    return any(side[0].mean() < _DARK * side[_INSIDE].mean() for side in sides)


def _fallen_sigmas(old: dict[tuple[int, int], float], new: dict[tuple[int, int], float]) -> float:
    """Give by how many standard errors over the squares the residual fell; 0 with too few of them."""
    gains = np.array([old[place] - new[place] for place in old if place in new])
    if len(gains) < _FEWEST_SQUARES:
        return 0.0
    return float(gains.mean() / max(gains.std(ddof=1) / np.sqrt(len(gains)), 1e-12))


def moved_back(
    frames: Sequence[CodedFrame], calibration: Calibration, registration: Registration
) -> tuple[CodedFrame, ...]:
    """Interpolate frames to where the calibration expects the panel's image.

    Only pixels that the calibration reads are filled. Black level and gain of single CCD pixels no longer fit
    there. Beside a saturated pixel all count as saturated.

    Parameters
    ----------
    frames : sequence of CodedFrame
        As taken.
    calibration : Calibration
        Of the camera before its image moved.
    registration : Registration
        How far it has moved.
    """
    if registration == NOT_MOVED:
        return tuple(frames)
    row, col = _read_pixels(calibration)
    place = registration.now(row.astype(np.float64), col.astype(np.float64), calibration.ccd_shape)
    limit, full_dn = float(calibration.saturation_dn.min()), float(np.ceil(calibration.saturation_dn.max()))
    found: list[CodedFrame] = []
    for frame in frames:
        dn: Words = np.zeros_like(frame.dn)
        dn[row, col] = _interpolated(frame.dn, place, limit, full_dn)
        found.append(replace(frame, dn=dn))
    return tuple(found)


def _read_pixels(calibration: Calibration) -> tuple[Any, Any]:
    """Rows and columns of the CCD pixels in all readout windows."""
    read = np.zeros(calibration.ccd_shape, np.bool_)
    half = calibration.reading_px // 2
    for down in range(-half, half + 1):
        for right in range(-half, half + 1):
            read[
                (calibration.centre_row + down).clip(0, read.shape[0] - 1),
                (calibration.centre_col + right).clip(0, read.shape[1] - 1),
            ] = True
    rows, cols = np.nonzero(read)
    return rows, cols


def _interpolated(dn: Words, place: tuple[Doubles, Doubles], limit: float, full_dn: float) -> Words:
    """Read a frame between its pixels by a cubic spline; saturated where a pixel beside the place is."""
    from scipy import ndimage

    read = cast("Callable[..., Floats]", ndimage.map_coordinates)
    light = read(dn.astype(np.float32), place, order=3, mode="nearest")
    whole = np.rint(np.clip(light, 0, np.iinfo(dn.dtype).max))
    full = dn >= limit
    if full.any():
        beside = read(full.astype(np.float32), place, order=1, mode="nearest") > 0
        whole = np.where(beside, max(full_dn, float(dn.max())), np.minimum(whole, limit - 1))
    return whole.astype(dn.dtype)


@dataclass(frozen=True, eq=False)
class _Agreement:
    """How far frames disagree on one static light, 0 to 1, and the pixels that can tell: (frame, v, u)."""

    losses: Doubles
    telling: Bools

    @property
    def residual(self) -> float:
        """Mean of the losses; 1 where no pixel tells anything."""
        return float(self.losses[self.telling].mean()) if self.telling.any() else 1.0

    def squares(self) -> dict[tuple[int, int], float]:
        """Residual of each square of the panel that tells something."""
        _, rows, cols = self.losses.shape
        found: dict[tuple[int, int], float] = {}
        for v in range(0, rows, _SQUARE_PX):
            for u in range(0, cols, _SQUARE_PX):
                square = slice(None), slice(v, v + _SQUARE_PX), slice(u, u + _SQUARE_PX)
                if np.count_nonzero(self.telling[square]) >= _FEWEST_PIXELS:
                    found[v, u] = float(self.losses[square][self.telling[square]].mean())
        return found


def _agreement(
    frames: Sequence[CodedFrame],
    samples: Sequence[DemixedFrame],
    calibration: Calibration,
    at: Registration,
) -> _Agreement:
    """Compare frames, moved back, with the static light that explains all of them best."""
    signals: list[Floats] = []
    measured: list[Floats] = []
    usable: list[Bools] = []
    unknown = SaturationPrior.unknown(calibration.shape)
    back = moved_back(frames, calibration, at)
    calibration = _blurred(calibration, at)
    for frame, sample in zip(back, samples, strict=True):
        # The weights, which take longest, do not depend on where the frame is read.
        seen = calibration.observe(frame)
        moved = replace(sample, measured=seen.signal, signal=seen.signal, saturated=seen.saturated)
        demixed = demix(calibration, moved, unknown)
        signals.append(demixed.signal)
        measured.append(demixed.measured)
        usable.append(
            demixed.valid & ~demixed.saturated & ~demixed.tainted & (sample.exposure > LEAST_EXPOSURE)
        )
    exposure, use = np.stack([sample.exposure for sample in samples]), np.stack(usable)

    def variance(light: Floats | Doubles) -> Doubles:
        return noise_variance(calibration, light.astype(np.float32)) + (_MODEL_ERROR * light) ** 2

    signal = np.where(use, np.stack(signals), 0)
    rough = np.maximum(signal.sum(axis=0) / np.maximum((exposure * use).sum(axis=0), LEAST_EXPOSURE), 0)
    weight = use / variance(rough * exposure)
    pooled = (weight * exposure * signal).sum(axis=0) / np.maximum((weight * exposure**2).sum(axis=0), 1e-30)
    direct = (np.maximum(pooled, 0) * exposure).astype(np.float32)
    mixed = np.stack([calibration.mix(light) for light in direct])
    squared = (np.stack(measured) - mixed).astype(np.float64) ** 2 / variance(mixed)
    apart = np.max([np.abs(np.gradient(exposure, axis=axis)) for axis in (1, 2)], axis=0)
    return _Agreement(squared / (squared + _BOUND_SIGMAS**2), use & (apart > _LEAST_CONTRAST / 2 * exposure))


def _blurred(calibration: Calibration, at: Registration) -> Calibration:
    """Return the calibration with what reading between CCD pixels adds to its crosstalk."""
    reach, centres = calibration.reach, (calibration.centre_row, calibration.centre_col)
    if at == NOT_MOVED or not reach:
        return calibration
    now = at.now(centres[0].astype(np.float64), centres[1].astype(np.float64), calibration.ccd_shape)
    kernels = calibration.crosstalk.copy()
    for axis, (new, old) in enumerate(zip(now, centres, strict=True)):
        between = np.abs(new - old - np.rint(new - old))
        gain = (_BLUR * between * (1 - between)).astype(np.float32)
        along = np.moveaxis(kernels, 2 + axis, 2)[:, :, :, reach]
        along[:, :, reach] -= 2 * gain
        along[:, :, reach - 1] += gain
        along[:, :, reach + 1] += gain
    return replace(calibration, crosstalk=kernels)


def _refined(
    residual: Callable[[Registration], float], begin: Registration, n_free: int, calibration: Calibration
) -> Registration:
    """Registration of least residual near another, by a simplex over its first parameters."""
    from scipy.optimize import minimize

    # As displacements at the longer side's middle, all parameters are CCD pixels.
    reach = max(calibration.ccd_shape) / 2
    start = [begin.shift_y_px, begin.shift_x_px, begin.rotation_rad * reach][:n_free]

    def of(place: Sequence[float]) -> Registration:
        shift_y, shift_x, *turned = (float(each) for each in place)
        return Registration(shift_y, shift_x, *(each / reach for each in turned))

    def trial(place: Sequence[float]) -> float:
        return residual(of(place))

    ends = {"xatol": _LAST_STEP_PX, "fatol": _LAST_GAIN, "maxfev": _MOST_TRIALS}
    # The residual has edges at whole pixels, where a simplex gets stuck: a second one starts from its end.
    for step in _FIRST_STEPS:
        corners = np.concatenate([np.zeros((1, n_free)), step * calibration.ratio * np.eye(n_free)])
        options = {**ends, "initial_simplex": np.array(start) + corners}
        start = cast("Any", minimize)(trial, start, method="Nelder-Mead", options=options).x
    return of(start)


def _mean(squares: dict[tuple[int, int], float]) -> float:
    return float(np.mean(list(squares.values())))
