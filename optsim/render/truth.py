"""The truth: an unbiased Monte-Carlo radiance video in which what stands still does not flicker.

Estimator (control variate with common random numbers; J. M. Hammersley and D. C. Handscomb, "Monte Carlo
Methods", Methuen 1964, ch. 5). With B the scene without movers and F the scene with them,

    base at a key instant = B_hi + (F_n - B_n):

B_hi is rendered once with many samples, F_n and B_n with the same n random paths, so that their noise
cancels wherever no path meets a mover. Between key instants the base is linear in time. The movers' own
pixels are rendered directly at poses chosen by their measured path, linear between poses, and integrated
over each instant; they become Blocks. Everything is made twice from independent random numbers: the truth
is the mean of these halves, and half their difference shows its noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.resources import files
from itertools import pairwise
from typing import Any

import numpy as np

from optsim.cache import Cache, hash_of
from optsim.errors import ConfigError
from optsim.progress import Progress, silent
from optsim.quantities import Block, Bools, Doubles, Floats, Ints, RadianceVideo, Segment, Timing, View
from optsim.render.backend import activate, versions
from optsim.render.footprint import cover, path_px
from optsim.render.plain import seed_of, slot_image
from optsim.render.settings import RenderSettings
from optsim.render.stage import Stage, outside_mask
from optsim.scene.scene import Scene

# Lanes in one cached pass of the static light: what an interruption may lose is some seconds.
_PASS_LANES = 12_000_000
# Samples a fine sample, slot and half of the scalar fallback.
_PREVIEW_SAMPLES = 2


@dataclass(frozen=True, eq=False)
class _Plan:
    """What all stages of one truth share."""

    scene: Scene
    view: View
    timing: Timing
    settings: RenderSettings
    cache: Cache
    identity: str
    progress: Progress

    @property
    def pixels(self) -> Any:
        return np.arange(self.view.rows * self.view.cols)

    @property
    def shape(self) -> tuple[int, int, int]:
        return (2, self.view.rows, self.view.cols)

    @property
    def n_segments(self) -> int:
        return self.timing.n_slots // self.settings.slots_per_segment

    def time_s(self, slot: float) -> float:
        return slot * self.timing.slot_s

    def seeds(self, *purpose: object) -> tuple[int, int]:
        """Two independent seeds, of half A and half B."""
        return (
            seed_of(self.settings.seed, *purpose, "A"),
            seed_of(self.settings.seed, *purpose, "B"),
        )

    def key(self, *what: object) -> str:
        return hash_of(self.identity, self.settings.seed, *what)


def render_truth(
    scene: Scene,
    view: View,
    timing: Timing,
    settings: RenderSettings,
    *,
    cache: Cache,
    backend: str | None = None,
    progress: Progress = silent,
) -> RadianceVideo:
    """Render the truth of a scene, or find it in the cache.

    Parameters
    ----------
    scene : Scene
        What to render.
    view : View
        Fine grid and field of view.
    timing : Timing
        Slots; a longer experiment finds the poses of a shorter one.
    settings : RenderSettings
        Sample counts and steps.
    cache : Cache
        Where each finished pass, key instant and segment goes: an interrupted render resumes.
    backend : str, optional
        Mitsuba variant instead of the probed one.
    progress : Progress
        Stages "static light", "key poses" and "movers" (the scalar fallback: "preview").

    Returns
    -------
    RadianceVideo
        Lazy, W m^-2 sr^-1; values may be slightly negative, being unbiased.

    Raises
    ------
    ConfigError
        When the segments don't divide the coded frame.
    BackendError
        When no backend works.
    """
    if timing.slots_per_frame % settings.slots_per_segment:
        raise ConfigError(
            f"render.slots_per_segment: got {settings.slots_per_segment}, expected a divisor of the "
            f"{timing.slots_per_frame} slots of a coded frame"
        )
    report = activate(backend)
    look: list[Any] = [view.rows, view.cols, view.tan_half_width, timing.slot_s]
    identity = hash_of(scene.model_dump(mode="json"), look, report.variant, versions(), _code_hash())
    plan = _Plan(scene, view, timing, settings, cache, identity, progress)
    outside = cache.get(plan.key("outside"), lambda: {"outside": outside_mask(scene, view)})["outside"]
    load = _load_plain(plan) if report.preview else _load_differences(plan)
    common: dict[str, Any] = {
        "rows": view.rows,
        "cols": view.cols,
        "samples_per_pitch": view.samples_per_pitch,
        "slot_s": timing.slot_s,
        "instants_per_slot": 1 if report.preview else settings.instants_per_slot,
        "slots_per_segment": 1 if report.preview else settings.slots_per_segment,
        "n_slots": timing.n_slots,
        "white_w_m2_sr": scene.white_w_m2_sr,
        "outside": np.array(outside) if outside.any() else None,
    }
    noise = RadianceVideo(load=lambda index: load(index, _half_difference), **common)
    return RadianceVideo(load=lambda index: load(index, _mean), half_difference=noise, **common)


_Half = Callable[[Floats], Floats]
_Load = Callable[[int, _Half], Segment]


def _mean(halves: Floats) -> Floats:
    return np.asarray((halves[0] + halves[1]) * np.float32(0.5))


def _half_difference(halves: Floats) -> Floats:
    return np.asarray((halves[0] - halves[1]) * np.float32(0.5))


def _load_differences(plan: _Plan) -> _Load:
    """Render whatever the cache lacks; return how to put a segment together."""
    still = Stage(plan.scene, plan.view, movers=False)
    static = _static_light(plan, still)
    n_instants = plan.settings.slots_per_segment * plan.settings.instants_per_slot
    moving = Stage(plan.scene, plan.view) if plan.scene.singles() else None
    if moving is None:
        return lambda index, half: Segment(half(static), half(static), (), n_instants)
    keys = [_key_pose(plan, still, moving, index) for index in range(plan.n_segments + 1)]
    segments = [_movers(plan, moving, index) for index in range(plan.n_segments)]

    def load(index: int, half: _Half) -> Segment:
        start, stop = (
            half(static + plan.cache.read(key)["change"]) for key in (keys[index], keys[index + 1])
        )
        return assemble(start, stop, plan.cache.read(segments[index]), half, n_instants)

    return load


def _static_light(plan: _Plan, still: Stage) -> Floats:
    """Both halves of the radiance without movers, (2, y, x), pass by pass through the cache."""
    total = plan.settings.static_samples // 2
    size = 1 << max(0, int(np.log2(_PASS_LANES / 2 / len(plan.pixels))))
    size = min(size, total, 256)
    seeds = plan.seeds("static")
    light = np.zeros(plan.shape)
    bounds = [*range(0, total, size), total]
    for first, last in pairwise(bounds):

        def make(first: int = first, count: int = last - first) -> dict[str, Floats]:
            light = still.radiance(plan.pixels, count, seeds, first)
            return {"light": light.reshape(plan.shape).astype(np.float32)}

        entry = plan.cache.get(plan.key("static", first, last), make)
        light += entry["light"].astype(np.float64) * ((last - first) / total)
        plan.progress("static light", last, total)
    return light.astype(np.float32)


def _key_pose(plan: _Plan, still: Stage, moving: Stage, index: int) -> str:
    """Render F_n - B_n of both halves at a key instant; return its place in the cache."""
    n, turn = plan.settings.key_samples // 2, index % plan.settings.key_seeds
    seeds = plan.seeds("key", turn)
    slot = index * plan.settings.slots_per_segment

    def without() -> dict[str, Floats]:
        return {"light": still.radiance(plan.pixels, n, seeds).reshape(plan.shape).astype(np.float32)}

    def make() -> dict[str, Floats]:
        moving.pose(plan.time_s(slot))
        light = moving.radiance(plan.pixels, n, seeds).reshape(plan.shape)
        return {
            "change": (light - plan.cache.get(plan.key("without", n, turn), without)["light"]).astype(
                np.float32
            )
        }

    key = plan.key("key", n, turn, slot)
    plan.cache.get(key, make)
    plan.progress("key poses", index + 1, plan.n_segments + 1)
    return key


def _movers(plan: _Plan, moving: Stage, index: int) -> str:
    """Render the movers' own pixels of a segment, both halves; return its place in the cache."""
    chosen = plan.settings
    first = index * chosen.slots_per_segment
    key = plan.key(
        "movers",
        first,
        chosen.slots_per_segment,
        chosen.mover_samples,
        chosen.max_step_px,
        chosen.instants_per_slot,
    )
    plan.cache.get(key, lambda: _render_movers(plan, moving, first))
    plan.progress("movers", index + 1, plan.n_segments)
    return key


@dataclass(frozen=True, eq=False)
class _Track:
    """A mover in a segment: how many equal steps, which samples are its own, how often each is traced."""

    name: str
    n_steps: int
    mask: Bools
    samples: int

    @property
    def pixels(self) -> Ints:
        return np.flatnonzero(self.mask)


def _render_movers(plan: _Plan, moving: Stage, first_slot: int) -> dict[str, Any]:
    """Radiance of the movers' own samples in each instant of a segment, both halves."""
    chosen = plan.settings
    times = plan.time_s(first_slot), plan.time_s(first_slot + chosen.slots_per_segment)
    tracks = _tracks(plan, times)
    if not tracks:
        return {"none": np.zeros(0)}
    finest = tracks[0].n_steps
    n_instants = chosen.slots_per_segment * chosen.instants_per_slot
    light = [np.zeros((2, n_instants, len(track.pixels))) for track in tracks]
    share = [hat_means(track.n_steps, n_instants) for track in tracks]
    for pose in range(finest + 1):
        moving.pose(times[0] + (times[1] - times[0]) * pose / finest)
        # Steps are powers of two: a mover with fewer of them is due at every so many poses.
        due = [i for i, track in enumerate(tracks) if pose * track.n_steps % finest == 0]
        pixels = [tracks[i].pixels for i in due]
        samples = np.concatenate(
            [np.full(len(p), tracks[i].samples) for i, p in zip(due, pixels, strict=True)]
        )
        seen = moving.radiance(np.concatenate(pixels), samples, plan.seeds("mover", first_slot, pose))
        parts = np.split(seen, np.cumsum([len(p) for p in pixels])[:-1], axis=1)
        for i, part in zip(due, parts, strict=True):
            weights = share[i][:, pose * tracks[i].n_steps // finest]
            for instant in np.flatnonzero(weights):
                light[i][:, instant] += weights[instant] * part
    arrays: dict[str, Any] = {}
    for track, values in zip(tracks, light, strict=True):
        rows, cols = (np.flatnonzero(track.mask.any(axis=axis)) for axis in (1, 0))
        arrays |= {
            f"{track.name}_light": values.astype(np.float32),
            f"{track.name}_mask": track.mask[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1],
            f"{track.name}_corner": np.array([rows[0], cols[0]]),
        }
    return arrays


def _tracks(plan: _Plan, times: tuple[float, float]) -> list[_Track]:
    """Find the movers seen in a segment, the one with the most poses first."""
    steps = {name: _n_steps(plan, name, times) for name in plan.scene.singles()}
    taken = np.zeros(plan.shape[1:], np.bool_)
    tracks: list[_Track] = []
    for name, n_steps in sorted(steps.items(), key=lambda item: (-item[1], item[0])):
        # A sample that two movers cross belongs to the one with more poses: a render shows both anyway.
        mask = _footprint(plan, name, np.linspace(*times, n_steps + 1)) & ~taken
        taken |= mask
        if mask.any():
            per_slot = max(1.0, n_steps / plan.settings.slots_per_segment)
            tracks.append(
                _Track(name, n_steps, mask, max(1, round(plan.settings.mover_samples / 2 / per_slot)))
            )
    return tracks


def _n_steps(plan: _Plan, name: str, times: tuple[float, float]) -> int:
    """Count steps in a segment, a power of two, so that no visible point goes too far in one."""
    way = path_px(
        plan.scene.singles()[name].vertices,
        *times,
        2 * plan.settings.slots_per_segment,
        plan.scene.camera,
        plan.view,
    )
    return 1 << max(0, int(np.ceil(np.log2(max(way, 1e-9) / plan.settings.max_step_px))))


def _footprint(plan: _Plan, name: str, instants: Doubles) -> Bools:
    """Fine samples in which a mover is seen, or that it uncovers, at any of its poses."""
    mover = plan.scene.singles()[name]
    faces = mover.rest().faces
    mask = np.zeros(plan.shape[1:], np.bool_)
    for instant in instants:
        cover(mask, mover.vertices(float(instant)), faces, plan.scene.camera, plan.view)
    return mask


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


def assemble(start: Floats, stop: Floats, movers: dict[str, Any], half: _Half, n_instants: int) -> Segment:
    """Put a segment together: the base from two key instants, the movers as excess over it.

    Parameters
    ----------
    start, stop : ndarray of shape (y, x), float32
        Base at the ends.
    movers : dict
        ``<name>_light`` (half, t, sample), ``<name>_mask`` (y, x) and ``<name>_corner`` (row, col).
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


def _load_plain(plan: _Plan) -> _Load:
    """Render the scalar fallback: every slot by itself with few samples, one pose a slot."""
    stage = Stage(plan.scene, plan.view)
    keys = [plan.key("preview", slot) for slot in range(plan.timing.n_slots)]
    for slot, key in enumerate(keys):

        def make(slot: int = slot) -> dict[str, Floats]:
            seeds = plan.seeds("preview", slot)
            light = slot_image(stage, plan.time_s(slot), plan.timing.slot_s, _PREVIEW_SAMPLES, 1, seeds)
            return {"light": light.astype(np.float32)}

        plan.cache.get(key, make)
        plan.progress("preview", slot + 1, len(keys))

    def load(index: int, half: _Half) -> Segment:
        image = half(plan.cache.read(keys[index])["light"])
        return Segment(image, image, (), 1)

    return load


def _code_hash() -> str:
    """Hash of the code that decides a render, so that an old cache never answers for new code."""
    rooms = [files("optsim") / room for room in ("scene", "render")]
    sources = sorted(
        (item for room in rooms for item in room.iterdir() if item.name.endswith(".py")), key=lambda i: i.name
    )
    return hash_of(*(source.read_text(encoding="utf-8") for source in sources))
