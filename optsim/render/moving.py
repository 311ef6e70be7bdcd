"""The movers' own pixels: first surfaces at many poses, their irradiance carried between few keys.

Poses are chosen by the movers' measured path and integrated over each instant.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.quantities import Block, Doubles, Floats, Ints, Segment
from optsim.render.allocation import Tiles
from optsim.render.carried import Key, between, depths, filled
from optsim.render.difference import Difference
from optsim.render.footprint import faces_of, project, vertices_at
from optsim.render.plan import Plan
from optsim.render.stage import Looks, Stage
from optsim.render.still import halves_tally
from optsim.render.tracks import Track, covered_by, tracks
from optsim.scene.materials import Diffuse

Half = Callable[[Floats], Floats]

_PILOT_SAMPLES = 4
# Rays for first surfaces, a half and pose: cheap, and edges and textures are then less noisy than what is
# carried (no source).
_LOOKS = 8


def pilot(plan: Plan, moving: Stage, time_s: float) -> Tiles:
    """Estimate statistics of the movers' own pixels at an instant, from random numbers of their own."""
    pixels = np.flatnonzero(plan.own(time_s))
    moving.pose(time_s)
    light = moving.radiance(pixels, _PILOT_SAMPLES, plan.seeds("pilot", "movers"))
    return halves_tally(plan, pixels, light, float(_PILOT_SAMPLES))


@dataclass(frozen=True, eq=False)
class KeyPose:
    """What is known of a pose at which some movers have a key.

    Parameters
    ----------
    places : dict
        Of these movers' vertices in the picture, by name: row, column, depth.
    halves : tuple of Key
        Light that they carry from here.
    behind : dict
        Of their tracks, by name: radiance beside what covers it, (half, sample of the track), W m^-2 sr^-1;
        NaN where movers cover all.
    """

    places: dict[str, Doubles]
    halves: tuple[Key, Key]
    behind: dict[str, Floats]


@dataclass(frozen=True, eq=False)
class _Span:
    """A segment being rendered: who moves in it, from which slot, in how many poses altogether."""

    plan: Plan
    difference: Difference
    static: Floats
    first_slot: int
    tracks: list[Track]

    @property
    def n_poses(self) -> int:
        return self.tracks[0].n_steps

    def time_s(self, pose: int) -> float:
        return self.plan.time_s(self.first_slot + self.plan.segment_slots * pose / self.n_poses)

    def due(self, pose: int) -> list[Track]:
        """Tracks that have a pose then."""
        return [track for track in self.tracks if pose * track.n_steps % self.n_poses == 0]

    def due_keys(self, pose: int) -> list[Track]:
        """Tracks that have a key then."""
        return [track for track in self.tracks if pose * track.n_keys % self.n_poses == 0]

    def places(self, name: str, pose: int) -> Doubles:
        """Where a mover's vertices are in the picture: row, column, depth."""
        time_s = self.time_s(pose)
        vertices = vertices_at(self.plan.scene.singles()[name], time_s)
        return project(vertices, self.plan.scene.camera.at(time_s), self.plan.view)

    def per_slot(self, parts: int) -> float:
        return parts / self.plan.segment_slots

    def carries(self, name: str) -> bool:
        """Whether a mover is matt: only then its radiance is reflectance times irradiance."""
        scene = self.plan.scene
        return isinstance(scene.materials[scene.singles()[name].material], Diffuse)


def render_segment(
    plan: Plan,
    difference: Difference,
    static: Floats,
    first_slot: int,
    own: Tiles,
    change: Sequence[Tiles],
) -> dict[str, Any]:
    """Render all samples that a mover touches during a segment, in each of its instants, both halves.

    Where a matt mover is seen at a pose: its reflectance there times the irradiance that it carries; where
    none is: the static light plus what the movers change there, interpolated between keys like the
    irradiance. What is not known from the keys is rendered at the pose.

    Parameters
    ----------
    plan, difference, static
        What to render, and the light without movers (2, y, x).
    first_slot : int
        Where the segment begins.
    own : Tiles
        Statistics of the movers' own pixels at earlier poses.
    change : sequence of Tiles
        For each set of random numbers: statistics, from other sets, of what movers change elsewhere.

    Returns
    -------
    dict of arrays
        ``<name>_light`` (half, t, sample), ``<name>_mask`` (y, x), ``<name>_corner`` (row, col), and
        ``tiles`` for the next segment.
    """
    n_instants = plan.segment_slots * plan.settings.instants_per_slot
    found = tracks(plan, first_slot, first_slot + plan.segment_slots)
    if not found:
        return {"tiles": own.arrays()}
    span = _Span(plan, difference, static, first_slot, found)
    keys, own = _render_keys(span, own, change)
    light = {track.name: np.zeros((2, n_instants, len(track.pixels))) for track in found}
    shares = {track.name: hat_means(track.n_steps, n_instants) for track in found}
    for pose in range(span.n_poses + 1):
        due = [track for track in span.due(pose) if len(track.pixels)]
        if not due:
            continue
        seen, own = _look(span, keys, pose, due, own)
        for track, part in zip(due, np.split(seen, _ends(due), axis=1), strict=True):
            weights = shares[track.name][:, pose * track.n_steps // span.n_poses]
            for instant in np.flatnonzero(weights):
                light[track.name][:, instant] += weights[instant] * part
    arrays: dict[str, Any] = {"tiles": own.arrays()}
    for track in found:
        if not track.mask.any():
            continue
        rows, cols = (np.flatnonzero(track.mask.any(axis=axis)) for axis in (1, 0))
        arrays |= {
            f"{track.name}_light": light[track.name].astype(np.float32),
            f"{track.name}_mask": track.mask[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1],
            f"{track.name}_corner": np.array([rows[0], cols[0]]),
        }
    return arrays


def _ends(some: list[Track]) -> Ints:
    """Where each track's samples end among all of theirs, but for the last."""
    return np.cumsum([len(track.pixels) for track in some])[:-1]


def _eased(target: float, per_slot: float) -> float:
    """Target for one pose: it is the slot's mean that must reach the stated one."""
    return target * float(np.sqrt(max(1.0, per_slot)))


def _render_keys(span: _Span, own: Tiles, change: Sequence[Tiles]) -> tuple[dict[int, KeyPose], Tiles]:
    """Render the key poses of all movers."""
    poses = [pose for pose in range(span.n_poses + 1) if span.due_keys(pose)]
    target = span.plan.settings.change_error
    # Samples behind the movers, the same for all keys of a turn: then what is traced without movers is traced
    # once.
    counts = [
        {
            track.name: span.difference.counts(
                tiles, track.pixels, _eased(target, span.per_slot(track.n_keys))
            )
            for track in span.tracks
        }
        for tiles in change[: len(poses)]
    ]
    pixels = np.concatenate([track.pixels for track in span.tracks])
    for turn, wanted in enumerate(counts):
        span.difference.trace_without(turn, pixels, np.concatenate(list(wanted.values())))
    keys: dict[int, KeyPose] = {}
    for number, pose in enumerate(poses):
        turn = number % len(change)
        places = {track.name: span.places(track.name, pose) for track in span.due_keys(pose)}
        halves, own = _key_light(span, pose, places, own)
        behind = _behind(span, pose, turn, counts[turn], halves)
        keys[pose] = KeyPose(places, halves, behind)
    for track in span.tracks:
        mine = [keys[pose].behind for pose in poses if track.name in keys[pose].behind]
        without = span.static.reshape(2, -1)[:, track.pixels]
        each = np.stack([behind[track.name] for behind in mine])
        known = filled(each, without, track.mask, span.plan.floor_w_m2_sr)
        for behind, light in zip(mine, known, strict=True):
            behind[track.name] = light
    return keys, own


def _behind(
    span: _Span, pose: int, turn: int, counts: dict[str, Floats], halves: tuple[Key, Key]
) -> dict[str, Floats]:
    """Radiance beside the movers at a pose, in tracks that have a key then; NaN where movers cover all."""
    due, time_s = span.due_keys(pose), span.time_s(pose)
    pixels = np.concatenate([track.pixels for track in due])
    bare = np.flatnonzero(~span.plan.own(time_s).ravel()[pixels])
    samples = np.concatenate([counts[track.name] for track in due])[bare]
    change, _ = span.difference.change(time_s, pixels[bare], samples, turn)
    movers = [span.difference.moving.shape_of(track.name) for track in span.tracks]
    # Where a mover covers a part of a sample, some of the paths to it go past.
    light = np.stack([half.beside(movers)[pixels] for half in halves])
    light[:, bare] = span.static.reshape(2, -1)[:, pixels[bare]] + change
    return dict(zip((track.name for track in due), np.split(light, _ends(due), axis=1), strict=True))


def _key_light(
    span: _Span, pose: int, places: dict[str, Doubles], own: Tiles
) -> tuple[tuple[Key, Key], Tiles]:
    """Follow whole paths where movers are that have a key at a pose; both halves, and their statistics."""
    plan, time_s, moving = span.plan, span.time_s(pose), span.difference.moving
    wanted = np.zeros(plan.view.rows * plan.view.cols, np.int64)
    for track in span.due_keys(pose):
        if span.carries(track.name):
            pixels = np.flatnonzero(covered_by(plan, track.name, time_s))
            target = _eased(plan.settings.moving_error, span.per_slot(track.n_keys))
            counts = _own_counts(span, own, pixels, target)
            wanted[pixels] = np.maximum(wanted[pixels], counts)
    pixels = np.flatnonzero(wanted)
    samples = wanted[pixels]
    first = np.concatenate([[0], np.cumsum(wanted)])
    moving.pose(time_s)
    seeds = np.asarray(plan.seeds("mover", span.first_slot, pose), np.int64)
    looks = moving.looks(np.tile(pixels, 2), np.tile(samples, 2), np.repeat(seeds, len(pixels)), light=True)
    depth = np.full(len(looks.shape), np.nan, np.float32)
    for name, here in places.items():
        hit = np.flatnonzero(looks.shape == moving.shape_of(name))
        depth[hit] = depths(looks, hit, faces_of(plan.scene.singles()[name]), here)
    halves = [slice(0, first[-1]), slice(first[-1], None)]
    a, b = (Key(first, looks.shape[h], depth[h], looks.albedo[h], looks.light[h]) for h in halves)
    if len(pixels):
        sums = [np.add.reduceat(half.light, first[pixels], dtype=np.float64) / samples for half in (a, b)]
        own = own.and_then(halves_tally(plan, pixels, np.stack(sums), samples.astype(np.float64)))
    return (a, b), own


def _own_counts(span: _Span, own: Tiles, pixels: Ints, target: float) -> Ints:
    about = span.static.reshape(2, -1)[0, pixels]
    return span.plan.counts(own, pixels, about, target, least=1).astype(np.int64)


def _look(
    span: _Span, keys: dict[int, KeyPose], pose: int, due: list[Track], own: Tiles
) -> tuple[Doubles, Tiles]:
    """Find both halves of some tracks at a pose, (2, samples of these tracks), and statistics."""
    pixels = np.concatenate([track.pixels for track in due])
    seen = np.concatenate([_behind_at(span, keys, pose, track) for track in due], axis=1)
    covered = span.plan.own(span.time_s(pose)).ravel()[pixels]
    chosen = np.flatnonzero(covered | np.isnan(seen).any(axis=0))
    if not len(chosen):
        return seen, own
    span.difference.moving.pose(span.time_s(pose))
    seeds = np.repeat(np.asarray(span.plan.seeds("look", span.first_slot, pose), np.int64), len(chosen))
    rays = np.full(len(seeds), _LOOKS)
    looks = span.difference.moving.looks(np.tile(pixels[chosen], 2), rays, seeds, light=False)
    place = np.repeat(np.arange(len(seeds)), _LOOKS)
    light = seen[:, chosen].ravel()[place]
    shiny = np.zeros(len(place), np.bool_)
    for track in span.tracks:
        hit = np.flatnonzero(looks.shape == span.difference.moving.shape_of(track.name))
        shiny[hit] = not span.carries(track.name)
        if len(hit) and span.carries(track.name):
            for half in (0, 1):
                mine = hit[place[hit] // len(chosen) == half]
                light[mine] = looks.albedo[mine] * _carried(span, keys, pose, track, half, looks, mine)
    unknown = np.isnan(light)
    light[unknown] = 0.0
    missed = unknown.reshape(-1, _LOOKS).sum(axis=1)
    known = np.maximum(_LOOKS - missed, 1)
    seen[:, chosen] = (light.reshape(-1, _LOOKS).sum(axis=1) / known).reshape(2, -1)
    # A few rays to what no key knows are left out. Where most are, or any that meet no matt surface, all is
    # rendered, from other random numbers.
    anew = shiny.reshape(-1, _LOOKS).any(axis=1) | (2 * missed > _LOOKS)
    at = chosen[anew.reshape(2, -1).any(axis=0)]
    if len(at):
        rates = np.concatenate([np.full(len(t.pixels), span.per_slot(t.n_steps)) for t in due])[at]
        seen[:, at], own = _whole(span, pose, pixels[at], rates, own)
    return seen, own


def _whole(span: _Span, pose: int, pixels: Ints, rates: Doubles, own: Tiles) -> tuple[Doubles, Tiles]:
    """Render samples at a pose as they are, both halves, and pool their statistics."""
    plan = span.plan
    samples = np.ones(len(pixels), np.int64)
    for rate in np.unique(rates):
        here = rates == rate
        samples[here] = _own_counts(span, own, pixels[here], _eased(plan.settings.moving_error, float(rate)))
    seeds = np.repeat(np.asarray(plan.seeds("whole", span.first_slot, pose), np.int64), len(pixels))
    light = span.difference.moving.paths(np.tile(pixels, 2), np.tile(samples, 2), seeds).reshape(2, -1)
    return light, own.and_then(halves_tally(plan, pixels, light, samples.astype(np.float64)))


def _ends_of(span: _Span, parts: int, pose: int) -> tuple[int, int, float]:
    """Key poses round a pose, and how far it is from one to the other, 0..1."""
    step = span.n_poses // parts
    before = pose // step * step
    return before, min(before + step, span.n_poses), (pose - before) / step


def _behind_at(span: _Span, keys: dict[int, KeyPose], pose: int, track: Track) -> Doubles:
    before, after, share = _ends_of(span, track.n_keys, pose)
    ends = keys[before].behind[track.name], keys[after].behind[track.name]
    return between(*ends, share).astype(np.float64)


def _carried(
    span: _Span, keys: dict[int, KeyPose], pose: int, track: Track, half: int, looks: Looks, hits: Ints
) -> Floats:
    """Irradiance over pi that a mover carries at a pose to where looks hit it; NaN where no key knows."""
    before, after, share = _ends_of(span, track.n_keys, pose)
    faces, then = faces_of(span.plan.scene.singles()[track.name]), span.places(track.name, pose)
    ends: list[Floats] = []
    for key in (keys[before], keys[after]):
        here = key.places[track.name]
        ends.append(key.halves[half].irradiance(looks, hits, faces, here, then, span.plan.view))
    return between(ends[0], ends[1], share)


def hat_means(n_steps: int, n_instants: int) -> Doubles:
    """Means over equal instants of the linear interpolation between equally spaced poses.

    Returns
    -------
    ndarray of shape (n_instants, n_steps + 1), float64
        Share of each pose in each instant; rows sum to 1.
    """
    place = np.arange(n_instants + 1)[:, None] / n_instants * n_steps - np.arange(n_steps + 1)[None]
    place = np.clip(place, -1, 1)
    integral = np.where(place < 0, (1 + place) ** 2 / 2, 1 - (1 - place) ** 2 / 2)
    return np.diff(integral, axis=0) * n_instants / n_steps


def assemble(start: Floats, stop: Floats, movers: dict[str, Any], half: Half, n_instants: int) -> Segment:
    """Put a segment together: the base from two key instants, the movers as excess over it.

    Parameters
    ----------
    start, stop : ndarray of shape (y, x), float32
        Base at the ends.
    movers : dict
        As from :func:`render_segment`.
    half : callable
        How the two halves become one.
    n_instants : int
        Instants in the segment.
    """
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
