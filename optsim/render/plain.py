"""The plain loop, every slot rendered by itself: training footage, and the scalar fallback."""

from __future__ import annotations

import numpy as np

from optsim.cache import hash_of
from optsim.progress import Progress, silent
from optsim.quantities import Doubles, Floats, Timing, View
from optsim.render.backend import activate
from optsim.render.stage import Stage
from optsim.scene.scene import Scene


def seed_of(*purpose: object) -> int:
    """Hash a purpose to a 32-bit seed, since neighbouring seeds may give shifted patterns."""
    return int(hash_of(*purpose)[:8], 16)


def slot_image(
    stage: Stage, first_s: float, slot_s: float, samples: int, poses: int, seeds: tuple[int, ...]
) -> Doubles:
    """Mean radiance during a slot, from poses at the centres of its equal parts.

    Parameters
    ----------
    stage : Stage
        Scene and view.
    first_s, slot_s : float
        Start and length of the slot.
    samples, poses : int
        Samples of each pose and seed, and poses.
    seeds : tuple of int
        One independent estimate for each.

    Returns
    -------
    ndarray of shape (seed, y, x), float64
    """
    rows, cols = stage.view.rows, stage.view.cols
    total = np.zeros((len(seeds), rows * cols))
    for pose in range(poses):
        stage.pose(first_s + slot_s * (pose + 0.5) / poses)
        turn = tuple(seed_of(seed, pose) for seed in seeds)
        total += stage.radiance(np.arange(rows * cols), samples, turn)
    return (total / poses).reshape(len(seeds), rows, cols)


def render_footage(
    scene: Scene,
    view: View,
    timing: Timing,
    *,
    samples: int = 32,
    poses_per_slot: int = 2,
    seed: int = 0,
    backend: str | None = None,
    progress: Progress = silent,
) -> Floats:
    """Radiance slot means at panel resolution, by the plain loop: footage to train priors on.

    Parameters
    ----------
    scene : Scene
        What to render.
    view : View
        Fine grid; the footage has one sample a panel pixel.
    timing : Timing
        Slots.
    samples : int
        Samples a panel pixel and slot.
    poses_per_slot : int
        Poses whose mean is a slot.
    seed : int
        Of all random numbers.
    backend, progress
        As in ``render_truth``; the stage is called "footage".

    Returns
    -------
    ndarray of shape (slot, v, u), float32
        Mean radiance, W m^-2 sr^-1.
    """
    activate(backend)
    n = view.samples_per_pitch
    stage = Stage(scene, View(view.rows // n, view.cols // n, 1, view.tan_half_width))
    frames = np.empty((timing.n_slots, stage.view.rows, stage.view.cols), np.float32)
    share = max(1, samples // poses_per_slot)
    for slot in range(timing.n_slots):
        seeds = (seed_of(seed, "footage", slot),)
        frames[slot] = slot_image(stage, slot * timing.slot_s, timing.slot_s, share, poses_per_slot, seeds)[0]
        progress("footage", slot + 1, timing.n_slots)
    return frames
