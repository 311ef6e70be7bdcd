"""Where each mover goes in a segment, and how many poses and keys its way asks for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from optsim.core.quantities import Bools, Ints
from optsim.render.footprint import path_px, vertices_at
from optsim.render.plan import Plan

# Relative error of linear interpolation between key instants, of what movers change where they are not, per
# fine sample of their way. Measured on window_room, wheel and half_moving
# (``validation/interpolation_bound``).
CHANGE_ERROR_PER_PX = 0.0015
# Numbers of steps to choose from: they have many divisors, so that slower movers share faster ones' poses,
# and are even, so that leaving out every other pose shows what interpolation costs.
_STEPS = sorted(2**a * 3**b for a in range(1, 15) for b in range(3))


@dataclass(frozen=True)
class Density:
    """How many poses, and how many key poses, a mover has a fine sample of its way."""

    poses: float
    keys: float


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A mover in a segment.

    Parameters
    ----------
    name : str
        Of the mover.
    way_px : float
        How far it goes, fine samples.
    n_steps : int
        In how many equal steps it goes.
    n_keys : int
        Of how many equal parts the ends are its key poses; divides ``n_steps``.
    mask : ndarray of shape (y, x), bool
        In which samples it is ever seen and none with more steps; maybe nowhere.
    """

    name: str
    way_px: float
    n_steps: int
    n_keys: int
    mask: Bools

    @cached_property
    def pixels(self) -> Ints:
        """Flat indices."""
        return np.flatnonzero(self.mask)


def way_px(plan: Plan, name: str, first_slot: int, last_slot: int, margin_px: float = 0.0) -> float:
    """Measure the farthest way that a visible point of a mover goes from slot to slot, fine samples."""
    mover, times_s = plan.scene.singles()[name], plan.times_s(first_slot, last_slot, last_slot - first_slot)
    return path_px(partial(vertices_at, mover), times_s, plan.scene.camera, plan.view, margin_px)


def slots_per_segment(plan: Plan) -> int:
    """Choose the slots between key instants that the interpolation bound allows, by the fastest mover's way.

    The way is measured in every third slot of the whole experiment, up to a picture's width outside the
    picture: from there shadows and bounce light still arrive.
    """
    per_frame = plan.timing.slots_per_frame
    if plan.settings.slots_per_segment is not None:
        return plan.settings.slots_per_segment
    fastest = max(
        (
            way_px(plan, name, s, s + 1, plan.view.cols)
            for name in plan.scene.singles()
            for s in range(0, plan.timing.n_slots, 3)
        ),
        default=0.0,
    )
    allowed = plan.settings.interpolation_error / CHANGE_ERROR_PER_PX / max(fastest, 1e-9)
    return max(n for n in range(1, per_frame + 1) if per_frame % n == 0 and n <= max(1.0, min(allowed, 18)))


def trajectories(
    plan: Plan, first_slot: int, last_slot: int, density: Callable[[str], Density]
) -> list[Trajectory]:
    """Find the movers seen in a segment, the one with the most poses first.

    Parameters
    ----------
    density : callable
        How dense a mover's poses and keys must be.
    """
    names = list(plan.scene.singles())
    ways = {name: way_px(plan, name, first_slot, last_slot) for name in names}
    needed = {name: min(ways[name] * density(name).poses, _STEPS[-1]) for name in names}
    finest = next(n for n in _STEPS if n >= max(needed.values(), default=0.0))
    steps = {
        name: next(n for n in _STEPS if finest % n == 0 and n >= least) for name, least in needed.items()
    }
    taken = np.zeros(plan.shape, np.bool_)
    found: list[Trajectory] = []
    for name, n_steps in sorted(steps.items(), key=lambda item: (-item[1], item[0])):
        # A sample that two movers cross belongs to the one with more poses: a render shows both anyway.
        n_hits = int(min(max(n_steps, np.ceil(ways[name])), _STEPS[-1]))
        mask = plan.own(*plan.times_s(first_slot, last_slot, n_hits), movers=[name])
        if mask.any():
            reprojected = min(ways[name] * density(name).keys, n_steps)
            n_keys = next(n for n in _STEPS if n_steps % n == 0 and n >= reprojected)
            found.append(Trajectory(name, ways[name], n_steps, n_keys, mask & ~taken))
        taken |= mask
    return found
