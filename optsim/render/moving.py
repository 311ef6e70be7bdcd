"""The movers' own pixels, at poses chosen by their measured path and integrated over each instant."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from optsim.quantities import Block, Bools, Doubles, Floats, Ints, Segment
from optsim.render.allocation import Tiles
from optsim.render.difference import Difference, Paths
from optsim.render.footprint import cover, faces_of, path_px, vertices_at
from optsim.render.plan import Plan
from optsim.render.stage import Stage
from optsim.render.still import halves_tally

Half = Callable[[Floats], Floats]

# Relative error of linear interpolation between two poses on the movers' own pixels, per fine sample of way
# between them, and the same for what they change elsewhere; measured on window_room, wheel and half_moving
# (``validation/interpolation_bound``): with these, errors were 0.3 to 0.7 of the bound.
ERROR_PER_PX = 0.12
CHANGE_ERROR_PER_PX = 0.0015
_PILOT_SAMPLES = 4
# Numbers of steps to choose from: they have many divisors, so that slower movers share faster ones' poses.
_STEPS = sorted(2**a * 3**b for a in range(15) for b in range(3))


@dataclass(frozen=True, eq=False)
class Track:
    """A mover in a segment: in how many equal steps it goes, and in which samples it is ever seen."""

    name: str
    n_steps: int
    mask: Bools

    @property
    def pixels(self) -> Ints:
        """Flat indices."""
        return np.flatnonzero(self.mask)


def way_px(plan: Plan, name: str, first_slot: float, last_slot: float, margin_px: float = 0.0) -> float:
    """Measure the farthest way that a visible point of a mover goes between two slots, fine samples."""
    mover, pieces = plan.scene.singles()[name], max(1, round(2 * (last_slot - first_slot)))
    times = plan.time_s(first_slot), plan.time_s(last_slot)
    return path_px(mover.vertices, *times, pieces, plan.scene.camera, plan.view, margin_px)


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


def tracks(plan: Plan, first_slot: int, last_slot: int) -> list[Track]:
    """Find the movers seen in a segment, the one with the most poses first."""
    needed: dict[str, float] = {}
    for name in plan.scene.singles():
        way = way_px(plan, name, first_slot, last_slot)
        needed[name] = min(way * ERROR_PER_PX / plan.settings.interpolation_error, _STEPS[-1])
    finest = next(n for n in _STEPS if n >= max(needed.values(), default=0.0))
    steps = {
        name: next(n for n in _STEPS if finest % n == 0 and n >= least) for name, least in needed.items()
    }
    taken = np.zeros(plan.shape, np.bool_)
    found: list[Track] = []
    for name, n_steps in sorted(steps.items(), key=lambda item: (-item[1], item[0])):
        # A sample that two movers cross belongs to the one with more poses: a render shows both anyway.
        times = np.linspace(plan.time_s(first_slot), plan.time_s(last_slot), n_steps + 1)
        mask = _ever_seen(plan, name, times) & ~taken
        taken |= mask
        if mask.any():
            found.append(Track(name, n_steps, mask))
    return found


def _ever_seen(plan: Plan, name: str, instants: Doubles) -> Bools:
    mover = plan.scene.singles()[name]
    mask = np.zeros(plan.shape, np.bool_)
    for instant in instants:
        vertices = vertices_at(mover, float(instant))
        cover(mask, vertices, faces_of(mover), plan.scene.camera, plan.view)
    return mask


def pilot(plan: Plan, moving: Stage, time_s: float) -> Tiles:
    """Estimate statistics of the movers' own pixels at an instant, from random numbers of their own."""
    pixels = np.flatnonzero(plan.own(time_s))
    moving.pose(time_s)
    light = moving.radiance(pixels, _PILOT_SAMPLES, plan.seeds("pilot", "movers"))
    return halves_tally(plan, pixels, light, float(_PILOT_SAMPLES))


def render_segment(
    plan: Plan,
    difference: Difference,
    static: Floats,
    first_slot: int,
    own: Tiles,
    change: Sequence[Tiles],
) -> dict[str, Any]:
    """Render all samples that a mover touches during a segment, in each of its instants, both halves.

    Where a mover is at a pose it is rendered as it is; where it only passes at another pose, the static
    light plus what the movers change there.

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
    n_slots = plan.segment_slots
    n_instants = n_slots * plan.settings.instants_per_slot
    found = tracks(plan, first_slot, first_slot + n_slots)
    if not found:
        return {"tiles": own.arrays()}
    finest = found[0].n_steps
    rates = [track.n_steps / n_slots for track in found]
    # Samples for where movers only pass, the same for all poses of a turn: then what is traced without movers
    # is traced once.
    passing = [
        [
            difference.counts(tiles, track.pixels, _eased(plan.settings.change_error, rate))
            for track, rate in zip(found, rates, strict=True)
        ]
        for tiles in change[: finest + 1]
    ]
    pixels = np.concatenate([track.pixels for track in found])
    for turn, counts in enumerate(passing):
        difference.trace_without(turn, pixels, np.concatenate(counts))
    light = [np.zeros((2, n_instants, len(track.pixels))) for track in found]
    shares = [hat_means(track.n_steps, n_instants) for track in found]
    for pose in range(finest + 1):
        due = [i for i, track in enumerate(found) if pose * track.n_steps % finest == 0]
        asked = Asked(
            np.concatenate([found[i].pixels for i in due]),
            np.concatenate([np.full(len(found[i].pixels), rates[i]) for i in due]),
            np.concatenate([passing[pose % len(change)][i] for i in due]),
        )
        time_s = plan.time_s(first_slot + n_slots * pose / finest)
        seen, own = render_pose(plan, difference, static, time_s, (first_slot, pose), asked, own)
        parts = np.split(seen, np.cumsum([len(found[i].pixels) for i in due])[:-1], axis=1)
        for i, part in zip(due, parts, strict=True):
            weights = shares[i][:, pose * found[i].n_steps // finest]
            for instant in np.flatnonzero(weights):
                light[i][:, instant] += weights[instant] * part
    arrays: dict[str, Any] = {"tiles": own.arrays()}
    for track, values in zip(found, light, strict=True):
        rows, cols = (np.flatnonzero(track.mask.any(axis=axis)) for axis in (1, 0))
        arrays |= {
            f"{track.name}_light": values.astype(np.float32),
            f"{track.name}_mask": track.mask[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1],
            f"{track.name}_corner": np.array([rows[0], cols[0]]),
        }
    return arrays


@dataclass(frozen=True, eq=False)
class Asked:
    """Pixels to render at a pose; (n,) each.

    Parameters
    ----------
    pixels : ndarray, int64
        Flat indices.
    poses_per_slot : ndarray, float64
        How many poses share the work of a slot there.
    passing : ndarray, float32
        Samples a half where no mover is at this pose.
    """

    pixels: Ints
    poses_per_slot: Doubles
    passing: Floats


def _eased(target: float, poses_per_slot: float) -> float:
    """Target for one pose: it is the slot's mean that must reach the stated one."""
    return target * float(np.sqrt(max(1.0, poses_per_slot)))


def render_pose(
    plan: Plan,
    difference: Difference,
    static: Floats,
    time_s: float,
    which: tuple[int, int],
    asked: Asked,
    own: Tiles,
) -> tuple[Doubles, Tiles]:
    """Render both halves of some pixels at one pose.

    Parameters
    ----------
    plan, difference, static
        What to render, and the light without movers (2, y, x).
    time_s : float
        The instant.
    which : (int, int)
        First slot of the segment and number of the pose: they make the random numbers.
    asked : Asked
        The pixels.
    own : Tiles
        Statistics of the movers' own pixels at earlier poses.

    Returns
    -------
    light : ndarray of shape (2, n), float64
        Radiance, W m^-2 sr^-1.
    own : Tiles
        Statistics, those of this pose pooled with earlier ones.
    """
    pixels = asked.pixels
    seen = static.reshape(2, -1)[:, pixels].astype(np.float64)
    covered = plan.own(time_s).ravel()[pixels]
    passing, chosen = np.flatnonzero(~covered), np.flatnonzero(covered)
    samples = np.ones(len(chosen), np.int64)
    for rate in np.unique(asked.poses_per_slot[chosen]):
        here = asked.poses_per_slot[chosen] == rate
        at, target = chosen[here], _eased(plan.settings.moving_error, rate)
        samples[here] = plan.counts(own, pixels[at], seen[0, at].astype(np.float32), target, least=1)
    seeds = np.repeat(np.asarray(plan.seeds("mover", *which), np.int64), len(chosen))
    whole = Paths(np.tile(pixels[chosen], 2), np.tile(samples, 2), seeds)
    turn = which[1] % plan.settings.key_seeds
    found, _, light = difference.change(time_s, pixels[passing], asked.passing[passing], turn, besides=whole)
    seen[:, passing] += found
    seen[:, chosen] = light.reshape(2, -1)
    if len(chosen):
        tiles = halves_tally(plan, pixels[chosen], seen[:, chosen], samples.astype(np.float64))
        own = own.and_then(tiles)
    return seen, own


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
