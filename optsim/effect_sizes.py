# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUntypedFunctionDecorator=false
"""How much each imperfection changes a frame, predicted on a small probe before anything is rendered."""

from __future__ import annotations

from dataclasses import dataclass

from threadpoolctl import threadpool_limits

from optsim.effects import ALL, switched
from optsim.probe import Probe


@dataclass(frozen=True)
class EffectSize:
    """What an effect does to a frame of the probe.

    Parameters
    ----------
    effect, what : str
        Name and a few words.
    size : float
        Rms change of the frame by the effect as this camera has it, relative to the noise.
    """

    effect: str
    what: str
    size: float


# As in a plan.
@threadpool_limits.wrap(limits=1)
def effect_sizes(probe: Probe) -> list[EffectSize]:
    """Predict the size of every effect that a probe shows, the largest first."""
    found = [
        EffectSize(name, effect.what, probe.size(switched({name: "ideal"}), {}))
        for name, effect in ALL.items()
        if not effect.in_scene
    ]
    return sorted(found, key=lambda each: -each.size)
