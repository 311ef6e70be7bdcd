# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUntypedFunctionDecorator=false
"""How much each imperfection changes a frame, predicted on a small probe before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.camera.effects import ALL, Changes, Effect, switched
from optsim.camera.probe import NOTHING, PLAIN, Probe, compared_with
from optsim.core.threads import one_thread

# A scene out of focus by more looks no different to a probe, whose patches are four panel pixels wide.
_LARGEST_BLUR_PX = 8.0
Drift = Mapping[str, Changes | None]
NO_DRIFT: Drift = {}


@dataclass(frozen=True)
class EffectSize:
    """What an effect does to a frame of the probe.

    Parameters
    ----------
    effect, what : str
        Name, or a key of a drift after ``drift.``, and a few words.
    size : float or None
        Rms change of the frame by the effect as this camera has it, relative to the noise, by the full model
        of what it asks for even where numerics are set by hand; None where only rendering would tell, no
        probe shows a drift, or every pixel of the probe clips.
    scheme : str or None
        Name of that of the experiment whose frame it changes so much: others change less. None where it
        changes none.
    """

    effect: str
    what: str
    size: float | None
    scheme: str | None = None


@one_thread()
def effect_sizes(probe: Probe, drift: Drift = NO_DRIFT) -> list[EffectSize]:
    """Predict the size of every effect that the probe shows, and of each key of a drift.

    Parameters
    ----------
    probe : Probe
        Of the camera as it was calibrated.
    drift : mapping
        Key -> what of the probe's camera has changed since, or None where no probe tells.
    """
    together: dict[str, dict[str, Any]] = {}
    for changes in filter(None, drift.values()):
        for part, fields in changes.items():
            together[part] = {**together.get(part, {}), **fields}
    sizes = [size_of(name, probe, together) for name, effect in ALL.items() if not effect.in_scene]
    return sizes + [_size_of_drift(key, probe, changes) for key, changes in drift.items()]


def size_of(name: str, probe: Probe, drift: Changes = NOTHING) -> EffectSize:
    """Predict the size of one effect that is not in the scene, of a drift of the probe's camera."""
    effect = ALL[name]
    if effect.drifts:
        return largest(name, probe.sizes(_drifting(effect, drift), PLAIN))
    against = probe.mapping if _moves_pixels(effect, probe) else compared_with(name)
    return largest(name, probe.sizes(switched({name: "ideal"}), against))


def largest(effect: str, sizes: Iterable[tuple[float, str]], what: str = "") -> EffectSize:
    """Largest of an effect's sizes in the frames of some schemes, of those that don't clip everywhere."""
    size, scheme = max((each for each in sizes if math.isfinite(each[0])), default=(None, None))
    return EffectSize(effect, what or ALL[effect].what, size, scheme if size else None)


def _drifting(effect: Effect, drift: Changes) -> Changes:
    """Return what of a drift is an effect's."""
    return {
        part: {
            key: value
            for key, value in drift.get(part, {}).items()
            if key in fields or key in effect.counts.get(part, ())
        }
        for part, fields in effect.pessimistic.items()
    }


def _size_of_drift(key: str, probe: Probe, changes: Changes | None) -> EffectSize:
    """Predict the size of one key of a drift; unknown where a probe's frame stays as it is."""
    part, _, name = key.rpartition(".")
    what = "change since the calibration, by itself"
    if changes is None:
        return EffectSize(f"drift.{key}", what, None)
    # Of an effect that changes the same field it is known whether no change is an answer.
    same = next((e for e, effect in ALL.items() if name in effect.pessimistic.get(part, {})), "")
    found = largest(f"drift.{key}", probe.sizes(changes, PLAIN), what)
    shown = found.size or (ALL[same].drifts if same else False)
    return found if shown else EffectSize(found.effect, what, None)


def size_of_defocus(probe: Probe, blur_px: float) -> EffectSize:
    """Say how much a disc of confusion, of a diameter in panel pixels, changes, were all of the scene so.

    A Gaussian of the disc's variance stands for it, as part of the objective's own. The PSF is taken as the
    same all over the field: what interpolating it misplaces depends on the blur, and would count as defocus.
    """
    lens, diameter_px = probe.camera.objective, min(blur_px, _LARGEST_BLUR_PX)
    sigma_m = diameter_px / 4 * probe.camera.modulator.pitch_m
    blurred = {"objective": {"aberration_m": float(np.hypot(lens.aberration_m, sigma_m))}}
    return largest("depth_of_field", probe.sizes(blurred, PLAIN))


def _moves_pixels(effect: Effect, probe: Probe) -> bool:
    return any(fields.keys() & probe.mapping.get(part, {}).keys() for part, fields in effect.ideal.items())
