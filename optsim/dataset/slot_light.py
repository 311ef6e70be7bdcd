"""Radiance of one slot rendered directly, by groups of lamps, with equal samples everywhere."""

from __future__ import annotations

from collections import Counter

import numpy as np

from optsim.core.cache import Cache
from optsim.core.progress import silent
from optsim.core.quantities import Doubles
from optsim.experiment.experiment import Experiment
from optsim.experiment.truth import truth_view
from optsim.scene import Scene
from optsim.scene.bands import mono


def named_groups(scene: Scene) -> dict[str, tuple[str, ...]]:
    """Lamps of each light group, by a short name: kind of its flicker, numbered where several share it."""
    groups = scene.light_groups().values()
    kinds = [flicker.kind if (flicker := scene.flicker(lamps[0])) else "steady" for lamps in groups]
    total, seen = Counter(kinds), Counter[str]()
    found: dict[str, tuple[str, ...]] = {}
    for kind, lamps in zip(kinds, groups, strict=True):
        seen[kind] += 1
        found[kind if total[kind] == 1 else f"{kind}{seen[kind]}"] = lamps
    return found


def bright_during(scene: Scene, start_s: float, stop_s: float) -> Scene | None:
    """Scene of one band whose lamps have their mean power over an interval; None if all are dark then."""
    lamps = {
        name: lamp.model_copy(update={"radiance_w_m2_sr": mono(lamp.radiance_w_m2_sr) * gain})
        if (gain := lamp.gain(start_s, stop_s)) > 0
        else lamp.model_copy(update={"lit": False})
        for name, lamp in scene.lamps.items()
    }
    bright = scene.model_copy(update={"lamps": lamps})
    return bright if bright.lit() else None


class SlotLight:
    """Radiance of a slot by groups of lamps, by plain path tracing with equal samples everywhere."""

    def __init__(self, scene: Scene, experiment: Experiment, samples: int) -> None:
        from optsim.render.plan import RenderPlan
        from optsim.render.stage import RenderStage

        view, settings = truth_view(experiment), experiment.render
        self.groups = named_groups(scene)
        self._scene, self._samples = scene, samples
        self._plan = RenderPlan(scene, view, experiment.timing, settings, None, Cache(), silent, "slot light")
        self._stages = {
            name: RenderStage(scene.only_lamps(lamps), view) for name, lamps in self.groups.items()
        }

    def shares(self, slot: int) -> tuple[int, int]:
        """Count the poses of each truth instant in a slot, and samples of each pose."""
        from optsim.render.full import poses_per_instant

        instants = self._plan.settings.instants_per_slot
        poses = max(1, min(poses_per_instant(self._plan, slot), self._samples // instants))
        return poses, -(-self._samples // (poses * instants))

    def samples(self, slot: int) -> int:
        """Count the samples of a fine sample in a slot, for each group: at least those requested."""
        poses, samples = self.shares(slot)
        return poses * samples * self._plan.settings.instants_per_slot

    def gains(self, group: str, slot: int) -> list[float]:
        """Power of a group in each truth instant of a slot, relative to its mean."""
        n, lamp = self._plan.settings.instants_per_slot, self.groups[group][0]
        return [
            self._scene.gain(lamp, self._plan.time_s(slot + i / n), self._plan.time_s(slot + (i + 1) / n))
            for i in range(n)
        ]

    def of(self, slot: int) -> dict[str, Doubles]:
        """Mean radiance over a slot from each group: (y, x), W m^-2 sr^-1, float64."""
        from optsim.render.full import slot_image
        from optsim.render.plan import seed_of

        plan, (poses, samples) = self._plan, self.shares(slot)
        n, slot_s = plan.settings.instants_per_slot, plan.timing.slot_s
        found: dict[str, Doubles] = {}
        for name, stage in self._stages.items():
            found[name] = np.zeros(plan.shape)
            for i, gain in enumerate(self.gains(name, slot)):
                if gain > 0:
                    # All groups use the same random numbers.
                    seeds = (seed_of(plan.settings.seed, "slot light", slot, i),)
                    start_s = plan.time_s(slot + i / n)
                    light = slot_image(stage, start_s, slot_s / n, samples, poses, seeds)
                    found[name] += gain / n * light[0]
        return found
