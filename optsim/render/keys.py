"""Key poses of a segment: the light that movers carry from there, and the light beside them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from optsim.core.quantities import Doubles, Floats, Ints
from optsim.render.allocation import Tiles
from optsim.render.carried import Key, filled, seen_at
from optsim.render.difference import Difference
from optsim.render.footprint import faces_of, project, vertices_at
from optsim.render.plan import Plan
from optsim.render.still import halves_tally
from optsim.render.tracks import Track
from optsim.scene.materials import Diffuse


@dataclass(frozen=True, eq=False)
class Span:
    """A segment being rendered: who moves in it, from which slot on.

    Parameters
    ----------
    plan, difference
        What to render.
    static : ndarray of shape (2, y, x)
        The light without movers.
    first_slot : int
        Where the segment begins.
    tracks : list of Track
        Movers seen in it, the one with the most poses first: these are all poses.
    """

    plan: Plan
    difference: Difference
    static: Floats
    first_slot: int
    tracks: list[Track]

    @property
    def n_poses(self) -> int:
        """Equal steps of the segment."""
        return self.tracks[0].n_steps

    @cached_property
    def times_s(self) -> list[float]:
        """When each pose is."""
        return self.plan.times_s(self.first_slot, self.first_slot + self.plan.segment_slots, self.n_poses)

    def due(self, pose: int) -> list[Track]:
        """Tracks that have a pose then."""
        return [track for track in self.tracks if pose * track.n_steps % self.n_poses == 0]

    def due_keys(self, pose: int) -> list[Track]:
        """Tracks that have a key then."""
        return [track for track in self.tracks if pose * track.n_keys % self.n_poses == 0]

    def between_keys(self, track: Track, pose: int) -> bool:
        """Whether a track has a key then that it might do without."""
        number, rest = divmod(pose * track.n_keys, self.n_poses)
        return rest == 0 and number % 2 == 1

    def places(self, track: Track, pose: int) -> Doubles:
        """Where a mover's vertices are in the picture: row, column, depth."""
        time_s = self.times_s[pose]
        vertices = vertices_at(self.plan.scene.singles()[track.name], time_s)
        return project(vertices, self.plan.scene.camera.at(time_s), self.plan.view)

    def matt(self, track: Track) -> bool:
        """Whether a mover's radiance is reflectance times irradiance, so that it can carry it."""
        scene = self.plan.scene
        return isinstance(scene.materials[scene.singles()[track.name].material], Diffuse)

    def eased(self, target: float, parts: int) -> float:
        """Ease a target for one pose of so many in the segment: the slot's mean must reach the stated one."""
        return target * float(np.sqrt(max(1.0, parts / self.plan.segment_slots)))

    def own_counts(self, own: Tiles, pixels: Ints, parts: int) -> Ints:
        """Share out samples a half over movers' own pixels, at a pose of so many in the segment."""
        target = self.eased(self.plan.settings.moving_error, parts)
        about = self.static.reshape(2, -1)[0, pixels]
        return self.plan.counts(own, pixels, about, target, least=1).astype(np.int64)


@dataclass(frozen=True, eq=False)
class KeyPose:
    """What is known of a pose at which some movers have a key.

    Parameters
    ----------
    places : dict
        Of these movers' vertices in the picture, by name: row, column, depth.
    light : Key
        That they carry from here.
    beside : dict
        Of their tracks, by name: radiance beside what covers it, (half, sample of the track), W m^-2 sr^-1;
        NaN where nothing is known of it in the whole segment.
    """

    places: dict[str, Doubles]
    light: Key
    beside: dict[str, Floats]


def ends(some: list[Track]) -> Ints:
    """Where each track's samples end among all of theirs, but for the last."""
    return np.cumsum([len(track.pixels) for track in some])[:-1]


def render_keys(span: Span, own: Tiles, change: Sequence[Tiles]) -> tuple[dict[int, KeyPose], Tiles]:
    """Render the key poses of all movers.

    Parameters
    ----------
    span : Span
        The segment.
    own, change
        As for :func:`optsim.render.moving.render_segment`.

    Returns
    -------
    keys : dict
        By pose.
    own : Tiles
        With what these poses showed.
    """
    poses = [pose for pose in range(span.n_poses + 1) if span.due_keys(pose)]
    counts = _counts_beside(span, change[: len(poses)])
    places: dict[int, dict[str, Doubles]] = {}
    light: dict[int, Key] = {}
    beside: dict[int, dict[str, Floats]] = {}
    for number, pose in enumerate(poses):
        turn = number % len(change)
        places[pose] = {track.name: span.places(track, pose) for track in span.due_keys(pose)}
        found, seen, own = _own_light(span, pose, places[pose], own)
        beside[pose] = _beside(span, pose, turn, counts[turn], found)
        bent = span.plan.view.aperture_m or span.plan.view.distortion
        light[pose] = found.by_place(*seen) if bent else found
    for track in span.tracks:
        mine = [pose for pose in poses if track.name in beside[pose]]
        without = span.static.reshape(2, -1)[:, track.pixels]
        each = np.stack([beside[pose][track.name] for pose in mine])
        known = filled(each, without, track.mask, span.plan.floor_w_m2_sr)
        for pose, there in zip(mine, known, strict=True):
            beside[pose][track.name] = there
    return {pose: KeyPose(places[pose], light[pose], beside[pose]) for pose in poses}, own


def _counts_beside(span: Span, change: Sequence[Tiles]) -> list[dict[str, Floats]]:
    """Share out samples beside the movers, for each turn by track; trace their paths without movers.

    They are the same for all keys of a turn: then what is traced without movers is traced once.
    """
    target = span.plan.settings.change_error
    pixels = np.concatenate([track.pixels for track in span.tracks])
    counts: list[dict[str, Floats]] = []
    for turn, tiles in enumerate(change):
        wanted = {
            track.name: span.difference.counts(tiles, track.pixels, span.eased(target, track.n_keys))
            for track in span.tracks
        }
        span.difference.trace_without(turn, pixels, np.concatenate(list(wanted.values())))
        counts.append(wanted)
    return counts


def _own_light(span: Span, pose: int, places: dict[str, Doubles], own: Tiles) -> tuple[Key, Doubles, Tiles]:
    """Follow whole paths where movers are that have a key at a pose, and pool their statistics.

    Also say where in the ideal image it is what each path met, row and column; NaN if it is no such mover.
    """
    plan, time_s, moving = span.plan, span.times_s[pose], span.difference.moving
    wanted = np.zeros(plan.view.rows * plan.view.cols, np.int64)
    for track in filter(span.matt, span.due_keys(pose)):
        pixels = np.flatnonzero(plan.own(time_s, movers=[track.name]))
        wanted[pixels] = np.maximum(wanted[pixels], span.own_counts(own, pixels, track.n_keys))
    pixels = np.flatnonzero(wanted)
    samples = np.tile(wanted[pixels], 2)
    moving.pose(time_s)
    seeds = np.asarray(plan.seeds("mover", span.first_slot, pose), np.int64)
    looks = moving.looks(np.tile(pixels, 2), samples, np.repeat(seeds, len(pixels)), light=True)
    met = np.full((len(looks.shape), 3), np.nan)
    for name, here in places.items():
        hit = np.flatnonzero(looks.shape == moving.shape_of(name))
        met[hit] = seen_at(looks, hit, faces_of(plan.scene.singles()[name]), here)
    if len(pixels):
        sums = np.add.reduceat(looks.light, np.cumsum(samples) - samples, dtype=np.float64)
        light = (sums / samples).reshape(2, -1)
        own = own.and_then(halves_tally(plan, pixels, light, wanted[pixels].astype(np.float64)))
    first = np.concatenate([[0], np.cumsum(np.tile(wanted, 2))])
    depth = met[:, 2].astype(np.float32)
    key = Key((0, 0), plan.shape, first, looks.shape, depth, looks.albedo, looks.light)
    return key, met[:, :2].T, own


def _beside(span: Span, pose: int, turn: int, counts: dict[str, Floats], light: Key) -> dict[str, Floats]:
    """Radiance beside the movers at a pose, in tracks that have a key then; NaN where movers cover all."""
    due, time_s = span.due_keys(pose), span.times_s[pose]
    pixels = np.concatenate([track.pixels for track in due])
    bare = np.flatnonzero(~span.plan.own(time_s).ravel()[pixels])
    samples = np.concatenate([counts[track.name] for track in due])[bare]
    change, _ = span.difference.change(time_s, pixels[bare], samples, turn)
    # Where a mover covers a part of a sample, some of the paths to it go past.
    found = light.beside([span.difference.moving.shape_of(track.name) for track in span.tracks])[:, pixels]
    found[:, bare] = span.static.reshape(2, -1)[:, pixels[bare]] + change
    return dict(zip((track.name for track in due), np.split(found, ends(due), axis=1), strict=True))
