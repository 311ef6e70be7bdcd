# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUntypedFunctionDecorator=false
"""How much each imperfection changes a frame, predicted on a small probe before anything is rendered."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from threadpoolctl import threadpool_limits

from optsim.effects import ALL, Effect, switched
from optsim.forward.bands import side_by_side
from optsim.probe import FULL_RIMS, NOTHING, Probe


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

    def found(name: str, effect: Effect) -> EffectSize:
        against = FULL_RIMS if name == "fringing" else NOTHING
        return EffectSize(name, effect.what, probe.size(switched({name: "ideal"}), against))

    # The frame with all of them comes first: each is compared with it.
    probe.size(NOTHING, NOTHING)
    sizes = side_by_side(partial(found, *each) for each in ALL.items() if not each[1].in_scene)
    return sorted(sizes, key=lambda each: -each.size)
