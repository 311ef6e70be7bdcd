# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUntypedFunctionDecorator=false
"""How much each imperfection changes a frame, predicted on small probes before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from optsim.effects import ALL, Changes, Effect, switched
from optsim.forward.bands import one_thread
from optsim.probe import NOTHING, PLAIN, Probe, Probes, compared_with, shown_on

# A scene out of focus by more looks no different to a probe, whose patches are four panel pixels wide.
_LARGEST_BLUR_PX = 8.0


@dataclass(frozen=True)
class EffectSize:
    """What an effect does to a frame of the probe.

    Parameters
    ----------
    effect, what : str
        Name and a few words.
    size : float or None
        Rms change of the frame by the effect as this camera has it, relative to the noise, by the full model
        of what it asks for even where numerics are set by hand; None where only rendering would tell, or
        every pixel of the probe clips.
    scheme : str or None
        Name of that of the experiment whose frame it changes so much: others change less. None where it
        changes none.
    """

    effect: str
    what: str
    size: float | None
    scheme: str | None = None


@one_thread()
def effect_sizes(probes: Probes, drift: Changes = NOTHING) -> list[EffectSize]:
    """Predict the size of every effect that probes show.

    Parameters
    ----------
    probes : Probes
        Of the camera as it was calibrated.
    drift : mapping
        By how much fields of its parts have changed since.
    """
    return [size_of(name, probes, drift) for name, effect in ALL.items() if not effect.in_scene]


def size_of(name: str, probes: Probes, drift: Changes = NOTHING) -> EffectSize:
    """Predict the size of one effect that is not in the scene; arguments as of :func:`effect_sizes`."""
    effect, near = ALL[name], probes.near
    if effect.drifts:
        return largest(name, probes.sizes(_drifting(effect, near, drift), PLAIN))
    against = near.mapping if _moves_pixels(effect, near) else compared_with(name)
    return largest(name, probes.sizes(switched({name: "ideal"}), against, shown_on(name)))


def largest(effect: str, sizes: Iterable[tuple[float, str]]) -> EffectSize:
    """Largest of an effect's sizes in the frames of some schemes, of those that don't clip everywhere."""
    size, scheme = max((each for each in sizes if math.isfinite(each[0])), default=(None, None))
    return EffectSize(effect, ALL[effect].what, size, scheme if size else None)


def _drifting(effect: Effect, probe: Probe, drift: Changes) -> Changes:
    """Return what of a drift is an effect's, as a change of the probe's camera."""
    return {
        part: {
            key: getattr(getattr(probe.camera, part), key) + drift[part][key]
            for key in fields.keys() & drift.get(part, {}).keys()
        }
        for part, fields in effect.pessimistic.items()
    }


def size_of_defocus(probes: Probes, blur_px: float) -> EffectSize:
    """Say how much a disc of confusion, of a diameter in panel pixels, changes, were all of the scene so.

    A Gaussian of the disc's variance stands for it, as part of the objective's own. The PSF is taken as the
    same all over the field: what interpolating it misplaces depends on the blur, and would count as defocus.
    """
    lens, diameter_px = probes.near.camera.objective, min(blur_px, _LARGEST_BLUR_PX)
    sigma_m = diameter_px / 4 * probes.near.camera.modulator.pitch_m
    blurred = {"objective": {"aberration_m": float(np.hypot(lens.aberration_m, sigma_m))}}
    return largest("depth_of_field", probes.sizes(blurred, PLAIN))


def _moves_pixels(effect: Effect, probe: Probe) -> bool:
    return any(fields.keys() & probe.mapping.get(part, {}).keys() for part, fields in effect.ideal.items())
