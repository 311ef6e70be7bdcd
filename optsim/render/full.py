"""Render every slot by itself: for a moving camera, for slots without shared noise, for training footage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from optsim.core.progress import Progress, silent
from optsim.core.quantities import Block, Doubles, Floats, Segment, Timing, View
from optsim.render.allocation import MOST, Statistics
from optsim.render.backend import activate
from optsim.render.footprint import path_px
from optsim.render.plan import RenderPlan, measured_error, seed_of
from optsim.render.stage import RenderStage
from optsim.render.still import halves_tally
from optsim.render.trajectories import mover_path_px
from optsim.scene.scene import Scene

_PILOT_SAMPLES = 4
# Relative error of a slot's mean per fine sample of motion between poses. Measured on the movers of
# window_room, wheel and half_moving with poses at the ends of the intervals; at their centres the error is
# about half.
_ERROR_PER_PX = 0.12
# A slot with a target error starts at this multiple of it.
_COARSE = 4.0
# Largest growth of the samples at a time, as coarse pictures measure their error poorly.
_GROWTH = 4.0
# Slightly more samples than needed, so that the next picture is mostly the last (no source).
_SPARE = 1.05
_MOST_PICTURES = 16
# Most samples a pixel and half in one picture: single paths may deviate by 14 times the radiance at 1 %.
_MOST_PURSUED = 2.0**20
# Poses a slot of training footage.
_FOOTAGE_POSES = 2


def poses_per_instant(plan: RenderPlan, slot: int) -> int:
    """Count the poses whose mean is an instant of a slot, by the longest visible path.

    A power of two.
    """
    times_s = plan.times_s(slot, slot + 1, 1)
    paths_px = [path_px(lambda _, v=v: v, times_s, plan.scene.camera, plan.view) for v in plan.still_m]
    paths_px += [mover_path_px(plan, name, slot, slot + 1) for name in plan.movers]
    longest_px = max(paths_px, default=0.0) / plan.settings.instants_per_slot
    needed = longest_px * _ERROR_PER_PX / plan.settings.interpolation_error
    return 1 << max(0, int(np.ceil(np.log2(max(needed, 1e-9)))))


def render_slot(
    plan: RenderPlan, stage: RenderStage, slot: int, n_poses: int, before: Statistics, most: float = MOST
) -> dict[str, Floats]:
    """Render both halves of every instant of a slot, samples allocated by an earlier picture.

    Poses are at the centres of equal parts of an instant, so their mean is its motion blur. A pixel with
    fewer samples than poses gets one random pose of each equal group.
    """
    n_instants, pixels = plan.settings.instants_per_slot, plan.pixels
    target = plan.settings.moving_error * np.sqrt(n_instants)
    dark = np.zeros(len(pixels), np.float32)
    counts = plan.counts(before, pixels, dark, target, least=1, most=most).astype(np.int64)
    size, samples = np.maximum(n_poses // counts, 1), np.maximum(counts // n_poses, 1)
    light = np.zeros((2, n_instants, len(pixels)))
    for instant in range(n_instants):
        uniform_draws = np.stack(
            [plan.uniform_draws("slot", slot, instant, group) for group in range(n_poses)]
        )
        seeds = np.asarray(plan.seeds("slot", slot, instant), np.int64)
        for pose in range(n_poses):
            stage.pose(plan.time_s(slot + (instant + (pose + 0.5) / n_poses) / n_instants))
            group = pose // size
            chance = uniform_draws[group, :, pixels].T
            half, where = np.nonzero(pose % size == np.floor(chance * size))
            # Sample numbers continue from pose to pose, so they stratify as one set.
            seen = stage.paths(where, samples[where], seeds[half], group[where] * samples[where])
            light[half, instant, where] += seen * samples[where] / counts[where]
    statistics = [
        halves_tally(plan, pixels, light[:, i], counts.astype(np.float64)) for i in range(n_instants)
    ]
    return {
        "light": light.reshape(2, n_instants, *plan.shape).astype(np.float32),
        "tiles": np.asarray(np.mean([each.arrays() for each in statistics], axis=0), np.float32),
    }


def load_slots(plan: RenderPlan) -> list[str]:
    """Render the slots that the cache lacks; return the cache keys."""
    stage = RenderStage(plan.scene, plan.view, azimuth_rad=plan.azimuth_rad)
    keys: list[str] = [plan.key("pilot", "slots")]
    chosen = plan.settings
    for slot in range(plan.timing.n_slots):
        what = chosen.moving_error, chosen.interpolation_error, chosen.instants_per_slot, plan.stop()
        keys.append(plan.key("slot", slot, *what))
        if keys[-1] not in plan.cache:
            before = Statistics.of(plan.cache.get(keys[-2], lambda: _pilot(plan, stage))["tiles"])
            n_poses = poses_per_instant(plan, slot)
            plan.cache.get(keys[-1], lambda s=slot, n=n_poses, b=before: render_slot(plan, stage, s, n, b))
        plan.progress("slots", slot + 1, plan.timing.n_slots)
    return keys[1:]


def _pilot(plan: RenderPlan, stage: RenderStage) -> dict[str, Floats]:
    """Render the statistics for allocating the first slot's samples."""
    stage.pose(0.0)
    light = stage.radiance(plan.pixels, _PILOT_SAMPLES, plan.seeds("pilot", "slots"))
    return {"tiles": halves_tally(plan, plan.pixels, light, float(_PILOT_SAMPLES)).arrays()}


def slot_to_error(
    groups: Sequence[tuple[RenderPlan, RenderStage, Floats]], slot: int, error: float
) -> dict[str, Floats]:
    """Render a slot by itself, with its own random numbers, until its target error is reached."""
    pooled, worth, more = np.zeros(1), 0.0, (_COARSE * error) ** -2
    statistics = [
        Statistics.of(
            plan.cache.get(plan.key("pilot", "slots"), lambda p=plan, s=stage: _pilot(p, s))["tiles"]
        )
        for plan, stage, _ in groups
    ]
    for turn in range(_MOST_PICTURES):
        light = np.zeros(1)
        for group, (plan, stage, gains) in enumerate(groups):
            # The camera's noise does not stop it: the picture is also for other cameras.
            seed = seed_of(plan.settings.seed, "alone", turn)
            asked = {"moving_error": more**-0.5, "noise_share": None, "seed": seed}
            aimed = replace(plan, settings=plan.settings.model_copy(update=asked))
            n_poses = poses_per_instant(plan, slot)
            picture = render_slot(aimed, stage, slot, n_poses, statistics[group], _MOST_PURSUED)
            light = light + gains[:, None, None] * picture["light"].astype(np.float64)
            statistics[group] = Statistics.of(picture["tiles"])
        # Weighted by allocated samples.
        pooled, worth = (worth * pooled + more * light) / (worth + more), worth + more
        a, b = pooled.mean(axis=1).astype(np.float32)
        reached = measured_error((a + b) / 2, (a - b) / 2, groups[0][0].scene.white_w_m2_sr)
        # Of the whole picture: stopping by a pixel's own error favours low estimates, a bias.
        if reached <= error:
            break
        more = worth * (min(_SPARE * (reached / error) ** 2, _GROWTH) - 1)
    return {"light": pooled.astype(np.float32)}


def slot_segment(images: Floats) -> Segment:
    """Make one slot a segment: its mean, and the instants' differences from it if there are several."""
    mean = images.mean(axis=0, dtype=np.float64).astype(np.float32)
    blocks = (Block(0, 0, images - mean),) if len(images) > 1 else ()
    return Segment(mean, mean, blocks, len(images))


def slot_image(
    stage: RenderStage, first_s: float, slot_s: float, samples: int, poses: int, seeds: tuple[int, ...]
) -> Doubles:
    """Mean radiance during a slot, from poses at the centres of its equal parts, all pixels equal.

    Parameters
    ----------
    stage : Stage
        Scene and view.
    first_s, slot_s : float
        Start and length of the slot.
    samples, poses : int
        Samples of each pose and seed, and poses.
    seeds : tuple of int
        Seeds, one for each independent estimate.

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
    seed: int = 0,
    backend: str | None = None,
    progress: Progress = silent,
) -> Floats:
    """Slot means of radiance at panel resolution, by a plain loop: training footage for priors."""
    activate(backend)
    n = view.samples_per_pitch
    stage = RenderStage(scene, replace(view, rows=view.rows // n, cols=view.cols // n, samples_per_pitch=1))
    frames = np.empty((timing.n_slots, stage.view.rows, stage.view.cols), np.float32)
    share = max(1, samples // _FOOTAGE_POSES)
    for slot in range(timing.n_slots):
        seeds = (seed_of(seed, "footage", slot),)
        frames[slot] = slot_image(stage, slot * timing.slot_s, timing.slot_s, share, _FOOTAGE_POSES, seeds)[0]
        progress("footage", slot + 1, timing.n_slots)
    return frames
