# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUntypedFunctionDecorator=false
"""How much each imperfection changes a frame, predicted on small probes before anything is rendered."""

from __future__ import annotations

import math
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
    """

    effect: str
    what: str
    size: float | None


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
    near = probes.near

    def found(name: str, effect: Effect) -> float:
        if effect.drifts:
            return probes.size(_over(PLAIN, _drifting(effect, near, drift)), PLAIN)
        against = near.mapping if _moves_pixels(effect, near) else compared_with(name)
        return probes.size(_over(against, switched({name: "ideal"})), against, shown_on(name))

    sizes = {name: found(name, effect) for name, effect in ALL.items() if not effect.in_scene}
    return [
        EffectSize(name, ALL[name].what, size if math.isfinite(size) else None)
        for name, size in sizes.items()
    ]


def _drifting(effect: Effect, probe: Probe, drift: Changes) -> Changes:
    """Return what of a drift is an effect's, as a change of the probe's camera."""
    return {
        part: {
            key: getattr(getattr(probe.camera, part), key) + drift[part][key]
            for key in fields.keys() & drift.get(part, {}).keys()
        }
        for part, fields in effect.pessimistic.items()
    }


def size_of_defocus(probes: Probes, blur_px: float) -> float:
    """Size of what a disc of confusion changes, of a diameter in panel pixels, were all of the scene so.

    A Gaussian of the disc's variance stands for it, as part of the objective's own. The PSF is taken as the
    same all over the field: what interpolating it misplaces depends on the blur, and would count as defocus.
    """
    lens, diameter_px = probes.near.camera.objective, min(blur_px, _LARGEST_BLUR_PX)
    sigma_m = diameter_px / 4 * probes.near.camera.modulator.pitch_m
    blurred = {"objective": {"aberration_m": float(np.hypot(lens.aberration_m, sigma_m))}}
    return probes.size(_over(PLAIN, blurred), PLAIN)


def _moves_pixels(effect: Effect, probe: Probe) -> bool:
    return any(fields.keys() & probe.mapping.get(part, {}).keys() for part, fields in effect.ideal.items())


def _over(under: Changes, over: Changes) -> Changes:
    """Both changes; where they meet, those that are over."""
    return {part: {**under.get(part, {}), **over.get(part, {})} for part in dict.fromkeys((*under, *over))}
