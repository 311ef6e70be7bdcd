"""Size of each imperfection in a frame, predicted on a small probe camera before anything is rendered."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.camera.effects import ALL, Changes, Effect, switched
from optsim.camera.probe import NOTHING, PLAIN, Probe, compared_with
from optsim.core.threads import one_thread

# More defocus makes no difference to a probe, whose patches are four panel pixels wide.
_LARGEST_BLUR_PX = 8.0
Drift = Mapping[str, Changes | None]
NO_DRIFT: Drift = {}


@dataclass(frozen=True)
class EffectSize:
    """Size of an effect in a frame of the probe.

    Parameters
    ----------
    effect, what : str
        Name, or a key of a drift after ``drift.``, and a few words.
    size : float or None
        Rms change of the frame by the effect as this camera has it, relative to the noise. It is computed
        with the full model, even where numerics are set by hand. None where it needs rendering, no probe
        shows a drift, or every pixel of the probe clips.
    scheme : str or None
        Scheme of the experiment with the largest change; None where no frame changes.
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
        Probe of the camera as calibrated.
    drift : mapping
        Key -> later changes of the probe's camera, or None where no probe shows them.
    """
    together: dict[str, dict[str, Any]] = {}
    for changes in filter(None, drift.values()):
        for part, fields in changes.items():
            together[part] = {**together.get(part, {}), **fields}
    sizes = [size_of(name, probe, together) for name, effect in ALL.items() if not effect.in_scene]
    return sizes + [_size_of_drift(key, probe, changes) for key, changes in drift.items()]


def size_of(name: str, probe: Probe, drift: Changes = NOTHING) -> EffectSize:
    """Predict the size of one effect outside the scene, for a drift of the probe's camera."""
    effect = ALL[name]
    if effect.drifts:
        return largest(name, probe.sizes(_drifting(effect, drift), PLAIN))
    against = probe.mapping if _moves_pixels(effect, probe) else compared_with(name)
    return largest(name, probe.sizes(switched({name: "ideal"}), against))


def largest(effect: str, sizes: Iterable[tuple[float, str]], what: str = "") -> EffectSize:
    """Largest size of an effect over the frames of some schemes; frames that clip everywhere are left out."""
    size, scheme = max((each for each in sizes if math.isfinite(each[0])), default=(None, None))
    return EffectSize(effect, what or ALL[effect].what, size, scheme if size else None)


def _drifting(effect: Effect, drift: Changes) -> Changes:
    """Return the part of a drift that belongs to an effect."""
    return {
        part: {
            key: value
            for key, value in drift.get(part, {}).items()
            if key in fields or key in effect.counts.get(part, ())
        }
        for part, fields in effect.pessimistic.items()
    }


def _size_of_drift(key: str, probe: Probe, changes: Changes | None) -> EffectSize:
    """Predict the size of one key of a drift; unknown where a probe's frame does not change."""
    part, _, name = key.rpartition(".")
    what = "change since the calibration, by itself"
    if changes is None:
        return EffectSize(f"drift.{key}", what, None)
    # The effect that changes the same field tells whether "no change" is a valid answer.
    same = next((e for e, effect in ALL.items() if name in effect.pessimistic.get(part, {})), "")
    found = largest(f"drift.{key}", probe.sizes(changes, PLAIN), what)
    shown = found.size or (ALL[same].drifts if same else False)
    return found if shown else EffectSize(found.effect, what, None)


def size_of_defocus(probe: Probe, blur_px: float) -> EffectSize:
    """Size of defocus if the whole scene had a disc of confusion of this diameter, panel pixels.

    A Gaussian of the disc's variance models it, added to the objective's own. The PSF is the same over the
    field: the error of interpolating it depends on the blur, and would count as defocus.
    """
    lens, diameter_px = probe.camera.objective, min(blur_px, _LARGEST_BLUR_PX)
    sigma_m = diameter_px / 4 * probe.camera.modulator.pitch_m
    blurred = {"objective": {"aberration_m": float(np.hypot(lens.aberration_m, sigma_m))}}
    return largest("depth_of_field", probe.sizes(blurred, PLAIN))


def _moves_pixels(effect: Effect, probe: Probe) -> bool:
    return any(fields.keys() & probe.mapping.get(part, {}).keys() for part, fields in effect.ideal.items())
