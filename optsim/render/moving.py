"""The movers' own pixels: primary hits at many poses, with irradiance reprojected from few key poses.

Poses are chosen by the movers' measured path and integrated over each instant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.core.quantities import Block, Bools, Doubles, Floats, Ints, Segment
from optsim.render.allocation import Statistics
from optsim.render.difference import Difference
from optsim.render.footprint import faces_of
from optsim.render.keys import KeyPose, Span, ends, render_keys
from optsim.render.plan import RenderPlan
from optsim.render.pose_sampling import Trial, assumed
from optsim.render.reprojection import between
from optsim.render.stage import PrimaryHits, RenderStage
from optsim.render.still import halves_tally
from optsim.render.trajectories import PoseDensity, Trajectory, trajectories

Half = Callable[[Floats], Floats]

_PILOT_SAMPLES = 4
# Primary hits a half and slot: they are cheap, and edges and textures are then less noisy than the
# reprojected irradiance. Measured on half_moving: 16 in both halves leave a noise of 3 % in a matt sample's
# reflectance.
_HITS = 8


@dataclass(frozen=True, eq=False)
class MoverHistory:
    """Mover history: statistics and densities from earlier segments."""

    own: Statistics  # Of their own pixels.
    # Mover -> density of poses and keys for the interpolation bound; only for movers seen already.
    density: dict[str, PoseDensity]

    @staticmethod
    def of(arrays: dict[str, Any]) -> MoverHistory:
        """Read them from a segment's arrays."""
        tail = "_density"
        found = {
            key.removesuffix(tail): PoseDensity(*arrays[key].tolist()) for key in arrays if key.endswith(tail)
        }
        return MoverHistory(Statistics.of(arrays["tiles"]), found)

    def arrays(self) -> dict[str, Any]:
        """Write them as arrays."""
        density = {f"{name}_density": np.array([d.poses, d.keys]) for name, d in self.density.items()}
        return {"tiles": self.own.arrays()} | density


def pilot(plan: RenderPlan, moving: RenderStage, time_s: float) -> MoverHistory:
    """Estimate statistics of the movers' own pixels at an instant, from separate random numbers."""
    pixels = np.flatnonzero(plan.own(time_s))
    moving.pose(time_s)
    light = moving.radiance(pixels, _PILOT_SAMPLES, plan.seeds("pilot", "movers"))
    return MoverHistory(halves_tally(plan, pixels, light, float(_PILOT_SAMPLES)), {})


def render_segment(
    plan: RenderPlan,
    difference: Difference,
    static: Floats,
    first_slot: int,
    before: MoverHistory,
    change: Sequence[Statistics],
) -> dict[str, Any]:
    """Render all samples touched by a mover during a segment, in each of its instants, both halves.

    On a matt mover the light is its reflectance at the pose times the reprojected irradiance. Beside movers
    it is the static light plus the movers' change, interpolated between keys like the irradiance. Light that
    the keys do not give is rendered at the pose.
    """
    n_instants = plan.segment_slots * plan.settings.instants_per_slot
    bound = plan.settings.interpolation_error

    def density(name: str) -> PoseDensity:
        return before.density.get(name, assumed(bound))

    found = trajectories(plan, first_slot, first_slot + plan.segment_slots, density)
    if not found:
        return before.arrays()
    span = Span(plan, difference, static, first_slot, found)
    keys, own = render_keys(span, before.own, change)
    trials = {trajectory.name: Trial(trajectory, n_instants, plan.floor_w_m2_sr) for trajectory in found}
    for pose in range(span.n_poses + 1):
        due = [trajectory for trajectory in span.due(pose) if len(trajectory.pixels)]
        if not due:
            continue
        covered = plan.own(span.times_s[pose]).ravel()[
            np.concatenate([trajectory.pixels for trajectory in due])
        ]
        seen, coarse, own = _light_at(span, keys, pose, due, covered, own)
        cut = ends(due)
        parts = np.split(seen, cut, axis=1), np.split(coarse, cut, axis=1), np.split(covered, cut)
        for trajectory, light, without, hidden in zip(due, *parts, strict=True):
            trials[trajectory.name].add(pose * trajectory.n_steps // span.n_poses, light, hidden)
            if span.between_keys(trajectory, pose):
                trials[trajectory.name].compare(light, without, hidden)
    measured = {name: trial.density(bound, density(name)) for name, trial in trials.items()}
    arrays = MoverHistory(own, before.density | measured).arrays()
    for trajectory in found:
        if not trajectory.mask.any():
            continue
        rows, cols = (np.flatnonzero(trajectory.mask.any(axis=axis)) for axis in (1, 0))
        arrays |= {
            f"{trajectory.name}_light": trials[trajectory.name].light.astype(np.float32),
            f"{trajectory.name}_mask": trajectory.mask[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1],
            f"{trajectory.name}_corner": np.array([rows[0], cols[0]]),
        }
    return arrays


def _light_at(
    span: Span, keys: dict[int, KeyPose], pose: int, due: list[Trajectory], covered: Bools, own: Statistics
) -> tuple[Doubles, Doubles, Statistics]:
    """Light of some trajectories at a pose, both halves, (2, their samples), and statistics."""
    pixels = np.concatenate([trajectory.pixels for trajectory in due])
    # If some of them have a key here, a second result uses every other key only.
    tried = (1, 2) if any(span.between_keys(trajectory, pose) for trajectory in due) else (1,)
    seen = [
        np.concatenate([_beside_at(span, keys, pose, trajectory, every) for trajectory in due], axis=1)
        for every in tried
    ]
    chosen = np.flatnonzero(covered | np.isnan(seen[0]).any(axis=0))
    if not len(chosen):
        return seen[0], seen[-1], own
    moving = span.difference.moving
    moving.pose(span.times_s[pose])
    seeds = np.repeat(np.asarray(span.plan.seeds("look", span.first_slot), np.int64), len(chosen))
    steps = np.concatenate([np.full(len(trajectory.pixels), trajectory.n_steps) for trajectory in due])[
        chosen
    ]
    rays = np.tile(_hits_a_pose(steps / span.plan.segment_slots), 2)
    # Sample numbers continue from pose to pose, so that those of a slot stratify as one set.
    first = rays * np.tile(pose * steps // span.n_poses, 2)
    hits = moving.hits(np.tile(pixels[chosen], 2), rays, seeds, first, light=False)
    place, starts = np.repeat(np.arange(len(seeds)), rays), np.cumsum(rays) - rays
    met = [
        (trajectory, np.flatnonzero(hits.shape == moving.shape_of(trajectory.name)))
        for trajectory in span.trajectories
    ]
    missed = np.zeros(len(seeds), np.int64)
    for every, light in reversed(list(zip(tried, seen, strict=True))):
        each = light[:, chosen].ravel()[place]
        for trajectory, hit in met:
            if span.matt(trajectory):
                half = place[hit] // len(chosen)
                reprojected = _reprojected(span, keys, pose, trajectory, every, hits, hit, half)
                each[hit] = hits.albedo[hit] * reprojected
        unknown = np.isnan(each)
        each[unknown] = 0.0
        missed = np.add.reduceat(unknown, starts, dtype=np.int64)
        light[:, chosen] = (np.add.reduceat(each, starts) / np.maximum(rays - missed, 1)).reshape(2, -1)
    # A few rays without a known irradiance are left out. A sample with mostly such rays, or with any that
    # meets no matt surface, is rendered completely, from other random numbers.
    shiny = np.zeros(len(place), np.bool_)
    for trajectory, hit in met:
        shiny[hit] = not span.matt(trajectory)
    anew = (np.logical_or.reduceat(shiny, starts) | (2 * missed > rays)).reshape(2, -1).any(axis=0)
    if anew.any():
        at = chosen[anew]
        whole, own = _whole(span, pose, pixels[at], steps[anew], own)
        for light in seen:
            light[:, at] = whole
    return seen[0], seen[-1], own


def _hits_a_pose(poses_a_slot: Doubles) -> Ints:
    """Distribute the primary hits of a slot over its poses: powers of two, which stratify best."""
    return 1 << np.clip(np.rint(np.log2(_HITS / poses_a_slot)), 1, 6).astype(np.int64)


def _whole(span: Span, pose: int, pixels: Ints, steps: Ints, own: Statistics) -> tuple[Doubles, Statistics]:
    """Render the samples of trajectories completely at a pose, both halves, and pool statistics."""
    samples = np.ones(len(pixels), np.int64)
    for n_steps in np.unique(steps):
        here = steps == n_steps
        samples[here] = span.own_counts(own, pixels[here], int(n_steps))
    seeds = np.repeat(np.asarray(span.plan.seeds("whole", span.first_slot, pose), np.int64), len(pixels))
    light = span.difference.moving.paths(np.tile(pixels, 2), np.tile(samples, 2), seeds).reshape(2, -1)
    return light, own.and_then(halves_tally(span.plan, pixels, light, samples.astype(np.float64)))


def _keys_round(
    span: Span, keys: dict[int, KeyPose], pose: int, trajectory: Trajectory, every: int
) -> tuple[KeyPose, KeyPose, float]:
    """Key poses around a pose, from all keys or every other one, and its position between them, 0..1."""
    step = span.n_poses // trajectory.n_keys * every
    before = pose // step * step
    return keys[before], keys[min(before + step, span.n_poses)], (pose - before) / step


def _beside_at(
    span: Span, keys: dict[int, KeyPose], pose: int, trajectory: Trajectory, every: int
) -> Doubles:
    before, after, share = _keys_round(span, keys, pose, trajectory, every)
    return between(before.beside[trajectory.name], after.beside[trajectory.name], share).astype(np.float64)


def _reprojected(
    span: Span,
    keys: dict[int, KeyPose],
    pose: int,
    trajectory: Trajectory,
    every: int,
    hits: PrimaryHits,
    met: Ints,
    half: Ints,
) -> Floats:
    """Irradiance over pi reprojected to primary hits on a mover at a pose; NaN where no key has it."""
    *known, share = _keys_round(span, keys, pose, trajectory, every)
    faces, then = faces_of(span.plan.movers[trajectory.name]), span.places(trajectory, pose)
    first, last = (
        key.light.irradiance(hits, met, half, faces, key.places[trajectory.name], then, span.plan.view)
        for key in known
    )
    return between(first, last, share)


def assemble(start: Floats, stop: Floats, movers: dict[str, Any], half: Half, n_instants: int) -> Segment:
    """Assemble a segment: the base from two key instants, the movers as excess over it."""
    blocks: list[Block] = []
    a = ((np.arange(n_instants, dtype=np.float32) + np.float32(0.5)) / np.float32(n_instants))[:, None]
    for name in [key.removesuffix("_mask") for key in movers if key.endswith("_mask")]:
        mask, light = np.asarray(movers[f"{name}_mask"]), half(movers[f"{name}_light"])
        row, col = (int(v) for v in movers[f"{name}_corner"])
        place = (slice(row, row + mask.shape[0]), slice(col, col + mask.shape[1]))
        excess = np.zeros((n_instants, *mask.shape), np.float32)
        excess[:, mask] = light - ((1 - a) * start[place][mask] + a * stop[place][mask])
        blocks.append(Block(row, col, excess))
    return Segment(start, stop, tuple(blocks), n_instants)
