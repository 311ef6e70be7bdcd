"""Trajectories of the movers in a segment, and the poses and keys that their path lengths require."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from optsim.core.quantities import Bools, Ints
from optsim.render.footprint import path_px, vertices_at
from optsim.render.plan import RenderPlan

# Relative error of linear interpolation between key instants, in the light that movers change elsewhere, per
# fine sample of their path. Measured on window_room, wheel and half_moving
# (``validation/interpolation_bound``).
CHANGE_ERROR_PER_PX = 0.0015
# Choices for the number of steps. They have many divisors, so that slower movers share poses with faster
# ones. They are even, so that leaving out every other pose measures the interpolation error.
_STEPS = sorted(2**a * 3**b for a in range(1, 15) for b in range(3))


@dataclass(frozen=True)
class PoseDensity:
    """Poses and key poses of a mover per fine sample of its path."""

    poses: float
    keys: float


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Trajectory of a mover in a segment."""

    name: str  # Of the mover.
    length_px: float  # Of its path, fine samples.
    n_steps: int  # Equal steps.
    n_keys: int  # Equal parts between key poses; divides ``n_steps``.
    # (y, x), samples in which it may be seen, without those of movers with more steps; may be empty.
    mask: Bools

    @cached_property
    def pixels(self) -> Ints:
        """Flat indices of the mask."""
        return np.flatnonzero(self.mask)


def mover_path_px(
    plan: RenderPlan, name: str, first_slot: int, last_slot: int, margin_px: float = 0.0
) -> float:
    """Measure the longest path of a mover's visible point between two slots, fine samples."""
    mover, times_s = plan.movers[name], plan.times_s(first_slot, last_slot, last_slot - first_slot)
    return path_px(partial(vertices_at, mover), times_s, plan.scene.camera, plan.view, margin_px)


def slots_per_segment(plan: RenderPlan) -> int:
    """Choose the slots between key instants by the interpolation bound and the fastest mover's path."""
    per_frame = plan.timing.slots_per_frame
    if plan.settings.slots_per_segment is not None:
        return plan.settings.slots_per_segment
    fastest = max(
        (
            # Up to a picture's width outside: shadows and bounce light still arrive from there.
            mover_path_px(plan, name, s, s + 1, plan.view.cols)
            for name in plan.movers
            for s in range(0, plan.timing.n_slots, 3)
        ),
        default=0.0,
    )
    allowed = plan.settings.interpolation_error / CHANGE_ERROR_PER_PX / max(fastest, 1e-9)
    return max(n for n in range(1, per_frame + 1) if per_frame % n == 0 and n <= max(1.0, min(allowed, 18)))


def trajectories(
    plan: RenderPlan, first_slot: int, last_slot: int, density: Callable[[str], PoseDensity]
) -> list[Trajectory]:
    """Find the movers seen in a segment, the one with the most poses first."""
    names = list(plan.movers)
    lengths_px = {name: mover_path_px(plan, name, first_slot, last_slot) for name in names}
    needed = {name: min(lengths_px[name] * density(name).poses, _STEPS[-1]) for name in names}
    finest = next(n for n in _STEPS if n >= max(needed.values(), default=0.0))
    steps = {
        name: next(n for n in _STEPS if finest % n == 0 and n >= least) for name, least in needed.items()
    }
    taken = np.zeros(plan.shape, np.bool_)
    found: list[Trajectory] = []
    for name, n_steps in sorted(steps.items(), key=lambda item: (-item[1], item[0])):
        # A sample crossed by two movers belongs to the one with more poses: a render shows both anyway.
        n_hits = int(min(max(n_steps, np.ceil(lengths_px[name])), _STEPS[-1]))
        mask = plan.own(*plan.times_s(first_slot, last_slot, n_hits), movers=[name])
        if mask.any():
            reprojected = min(lengths_px[name] * density(name).keys, n_steps)
            n_keys = next(n for n in _STEPS if n_steps % n == 0 and n >= reprojected)
            found.append(Trajectory(name, lengths_px[name], n_steps, n_keys, mask & ~taken))
        taken |= mask
    return found
