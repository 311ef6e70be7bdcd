"""Key poses of a segment: irradiance on movers for reprojection, and the light beside the movers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optsim.core.quantities import Doubles, Floats, Ints
from optsim.render.allocation import Statistics
from optsim.render.difference import Difference
from optsim.render.footprint import faces_of, project, vertices_at
from optsim.render.plan import RenderPlan
from optsim.render.reprojection import KeyPoseLight, filled, seen_at
from optsim.render.still import halves_tally
from optsim.render.trajectories import Trajectory
from optsim.scene.materials import Diffuse


@dataclass(frozen=True, eq=False)
class Span:
    """A segment being rendered: its movers and its first slot."""

    plan: RenderPlan
    difference: Difference
    static: Floats  # (2, y, x), light without movers.
    first_slot: int  # Of the segment.
    # Visible movers, the one with the most poses first: its poses include all others.
    trajectories: list[Trajectory]

    @property
    def n_poses(self) -> int:
        """Number of equal steps of the segment."""
        return self.trajectories[0].n_steps

    @cached_property
    def times_s(self) -> list[float]:
        """Instants of the poses."""
        return self.plan.times_s(self.first_slot, self.first_slot + self.plan.segment_slots, self.n_poses)

    def due(self, pose: int) -> list[Trajectory]:
        """Trajectories with a pose there."""
        return [
            trajectory for trajectory in self.trajectories if pose * trajectory.n_steps % self.n_poses == 0
        ]

    def due_keys(self, pose: int) -> list[Trajectory]:
        """Trajectories with a key pose there."""
        return [
            trajectory for trajectory in self.trajectories if pose * trajectory.n_keys % self.n_poses == 0
        ]

    def between_keys(self, trajectory: Trajectory, pose: int) -> bool:
        """Whether a trajectory has a key pose there that is left out when every other key is used."""
        number, rest = divmod(pose * trajectory.n_keys, self.n_poses)
        return rest == 0 and number % 2 == 1

    def places(self, trajectory: Trajectory, pose: int) -> Doubles:
        """Positions of a mover's vertices in the picture: row, column, depth."""
        time_s = self.times_s[pose]
        vertices = vertices_at(self.plan.movers[trajectory.name], time_s)
        return project(vertices, self.plan.scene.camera.at(time_s), self.plan.view)

    def matt(self, trajectory: Trajectory) -> bool:
        """Whether a mover is matt: radiance is reflectance times irradiance, which can be reprojected."""
        scene = self.plan.scene
        material = scene.materials[self.plan.movers[trajectory.name].material]
        # A normal map changes irradiance finer than key poses know it.
        return isinstance(material, Diffuse) and material.normal_map is None

    def eased(self, target: float, parts: int) -> float:
        """Relax a target for one of several poses: only the slot's mean must reach the stated one."""
        return target * float(np.sqrt(max(1.0, parts / self.plan.segment_slots)))

    def own_counts(self, own: Statistics, pixels: Ints, parts: int) -> Ints:
        """Allocate samples a half to movers' own pixels, at one of several poses in the segment."""
        target = self.eased(self.plan.settings.moving_error, parts)
        about = self.static.reshape(2, -1)[0, pixels]
        return self.plan.counts(own, pixels, about, target, least=1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class KeyPose:
    """Light at a key pose of some movers."""

    places: dict[str, Doubles]  # Mover -> positions of its vertices in the picture: row, column, depth.
    light: KeyPoseLight  # Irradiance on them, for reprojection.
    # Trajectory -> radiance beside it, (half, sample), W m^-2 sr^-1; NaN if unknown in the whole segment.
    beside: dict[str, Floats]


def ends(some: list[Trajectory]) -> Ints:
    """Find the ends of each trajectory's samples in their concatenation, except the last."""
    return np.cumsum([len(trajectory.pixels) for trajectory in some])[:-1]


def render_keys(
    span: Span, own: Statistics, change: Sequence[Statistics]
) -> tuple[dict[int, KeyPose], Statistics]:
    """Render the key poses of all movers."""
    poses = [pose for pose in range(span.n_poses + 1) if span.due_keys(pose)]
    counts = _counts_beside(span, change[: len(poses)])
    places: dict[int, dict[str, Doubles]] = {}
    light: dict[int, KeyPoseLight] = {}
    beside: dict[int, dict[str, Floats]] = {}
    for number, pose in enumerate(poses):
        turn = number % len(change)
        places[pose] = {trajectory.name: span.places(trajectory, pose) for trajectory in span.due_keys(pose)}
        found, seen, own = _own_light(span, pose, places[pose], own)
        beside[pose] = _beside(span, pose, turn, counts[turn], found)
        bent = span.plan.view.aperture_m or span.plan.view.distortion
        light[pose] = found.by_place(*seen) if bent else found
    for trajectory in span.trajectories:
        mine = [pose for pose in poses if trajectory.name in beside[pose]]
        without = span.static.reshape(2, -1)[:, trajectory.pixels]
        each = np.stack([beside[pose][trajectory.name] for pose in mine])
        known = filled(each, without, trajectory.mask, span.plan.floor_w_m2_sr)
        for pose, there in zip(mine, known, strict=True):
            beside[pose][trajectory.name] = there
    return {pose: KeyPose(places[pose], light[pose], beside[pose]) for pose in poses}, own


def _counts_beside(span: Span, change: Sequence[Statistics]) -> list[dict[str, Floats]]:
    """Allocate samples beside the movers, for each turn by trajectory; trace their paths without movers."""
    target = span.plan.settings.change_error
    pixels = np.concatenate([trajectory.pixels for trajectory in span.trajectories])
    counts: list[dict[str, Floats]] = []
    for turn, statistics in enumerate(change):
        wanted = {
            trajectory.name: span.difference.counts(
                statistics, trajectory.pixels, span.eased(target, trajectory.n_keys)
            )
            for trajectory in span.trajectories
        }
        # Once: they are the same for all keys of a turn.
        span.difference.trace_without(turn, pixels, np.concatenate(list(wanted.values())))
        counts.append(wanted)
    return counts


def _own_light(
    span: Span, pose: int, places: dict[str, Doubles], own: Statistics
) -> tuple[KeyPoseLight, Doubles, Statistics]:
    """Trace whole paths where movers have a key pose, and pool their statistics."""
    plan, time_s, moving = span.plan, span.times_s[pose], span.difference.moving
    wanted = np.zeros(plan.view.rows * plan.view.cols, np.int64)
    for trajectory in filter(span.matt, span.due_keys(pose)):
        pixels = np.flatnonzero(plan.own(time_s, movers=[trajectory.name]))
        wanted[pixels] = np.maximum(wanted[pixels], span.own_counts(own, pixels, trajectory.n_keys))
    pixels = np.flatnonzero(wanted)
    samples = np.tile(wanted[pixels], 2)
    moving.pose(time_s)
    seeds = np.asarray(plan.seeds("mover", span.first_slot, pose), np.int64)
    hits = moving.hits(np.tile(pixels, 2), samples, np.repeat(seeds, len(pixels)), light=True)
    # First hit of each path in the ideal image, row and column; NaN if it is no such mover.
    met = np.full((len(hits.shape), 3), np.nan)
    for name, here in places.items():
        hit = np.flatnonzero(hits.shape == moving.shape_of(name))
        met[hit] = seen_at(hits, hit, faces_of(plan.movers[name]), here)
    if len(pixels):
        sums = np.add.reduceat(hits.light, np.cumsum(samples) - samples, dtype=np.float64)
        light = (sums / samples).reshape(2, -1)
        own = own.and_then(halves_tally(plan, pixels, light, wanted[pixels].astype(np.float64)))
    first = np.concatenate([[0], np.cumsum(np.tile(wanted, 2))])
    depth = met[:, 2].astype(np.float32)
    key = KeyPoseLight((0, 0), plan.shape, first, hits.shape, depth, hits.albedo, hits.light)
    return key, met[:, :2].T, own


def _beside(
    span: Span, pose: int, turn: int, counts: dict[str, Floats], light: KeyPoseLight
) -> dict[str, Floats]:
    """Radiance beside the movers at a key pose of some trajectories; NaN where movers cover all."""
    due, time_s = span.due_keys(pose), span.times_s[pose]
    pixels = np.concatenate([trajectory.pixels for trajectory in due])
    bare = np.flatnonzero(~span.plan.own(time_s).ravel()[pixels])
    samples = np.concatenate([counts[trajectory.name] for trajectory in due])[bare]
    change, _ = span.difference.change(time_s, pixels[bare], samples, turn)
    # If a mover covers part of a sample, some of its paths pass the mover.
    found = light.beside(
        [span.difference.moving.shape_of(trajectory.name) for trajectory in span.trajectories]
    )[:, pixels]
    found[:, bare] = span.static.reshape(2, -1)[:, pixels[bare]] + change
    return dict(zip((trajectory.name for trajectory in due), np.split(found, ends(due), axis=1), strict=True))
