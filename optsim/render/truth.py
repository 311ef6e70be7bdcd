"""The truth: an unbiased Monte-Carlo radiance video, by the cheapest exact method for the scene.

The method depends on what changes (``Scene.kind_of_change``):

- nothing: one picture.
- lamps: one picture for each group of lamps with the same flicker, added in proportion (light is linear).
- movers: the light without movers, B_hi, is rendered once with many samples. At key instants the movers'
  change, F_n - B_n, is rendered with the same n random paths; it is linear in time between. In the movers'
  own pixels primary hits are found at poses chosen by the measured path. Irradiance on matt movers is
  reprojected between few key poses, and all other light is rendered at each pose. These pixels become
  Blocks. With flicker, all this is done for each group of lamps.
- the camera: every slot by itself; on request also where slots must not share their noise.

Samples go where the relative error is largest. All is rendered twice from independent random numbers. The
truth is the mean of these halves, and half their difference shows its noise. Unbiased estimates may be
slightly negative; they stay so in all sums.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, replace
from itertools import pairwise
from typing import Any

import numpy as np

from optsim.core.cache import Cache, hash_of
from optsim.core.code_hash import hash_files
from optsim.core.errors import ConfigError
from optsim.core.extensions import OBJECTS, extension_versions
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats, RadianceVideo, Segment, Timing, View
from optsim.render import moving
from optsim.render.allocation import Statistics
from optsim.render.backend import activate, versions
from optsim.render.difference import Difference
from optsim.render.full import load_slots, slot_image, slot_segment, slot_to_error
from optsim.render.moving import Half
from optsim.render.plan import RenderPlan
from optsim.render.settings import CameraNoise, RenderSettings
from optsim.render.stage import RenderStage, outside_mask
from optsim.render.still import static_light
from optsim.render.stokes import polarised
from optsim.render.trajectories import slots_per_segment
from optsim.scene.scene import Scene

# Samples of the scalar fallback, a fine sample, slot and half.
_PREVIEW_SAMPLES = 2
# Number of earlier key instants whose statistics count.
_REMEMBERED = 8
# Code that decides a render: a change of it makes cached light invalid.
_CODE = ("optsim/scene/*.py", "optsim/render/*.py", "optsim/optics/lens.py")

_Load = Callable[[int, Half], Segment]


def render_truth(
    scene: Scene,
    view: View,
    timing: Timing,
    settings: RenderSettings,
    *,
    cache: Cache,
    noise: CameraNoise | None = None,
    backend: str | None = None,
    azimuth_rad: float | None = None,
    slot_error: float | None = None,
    progress: Progress = silent,
) -> RadianceVideo:
    """Render the truth of a scene, or read it from the cache."""
    if settings.slots_per_segment and timing.slots_per_frame % settings.slots_per_segment:
        raise ConfigError(
            f"render.slots_per_segment: got {settings.slots_per_segment}, expected a divisor of the "
            f"{timing.slots_per_frame} slots of a coded frame"
        )
    if settings.noise_share is not None and noise is None:
        raise ConfigError(
            "render.noise_share: the camera's noise is needed to compare with; cure: leave it unset"
        )
    report = activate(backend)
    # The truth does not depend on the samples a panel pixel.
    look = {**asdict(view), "samples_per_pitch": None, "slot_s": timing.slot_s}
    code = hash_files(_CODE), extension_versions([OBJECTS])
    identity = hash_of(scene.model_dump(mode="json"), look, report.variant, versions(), *code)
    if azimuth_rad is not None:
        identity = hash_of(identity, "twice the analysed component", azimuth_rad)
    plan = RenderPlan(
        scene, view, timing, settings, noise, cache, progress, identity, azimuth_rad=azimuth_rad
    )
    outside = cache.get(plan.key("outside"), lambda: {"outside": outside_mask(scene, view)})["outside"]
    n_instants, n_slots = settings.instants_per_slot, 1
    # All is rendered inside this block; later loads read the cache.
    with polarised(backend) if azimuth_rad is not None else nullcontext():
        if report.preview:
            load, n_instants = _load_preview(plan), 1
        elif slot_error is not None:
            load = _load_alone(plan, slot_error)
        elif scene.kind_of_change() == "camera":
            load = _load_camera(plan)
        elif any(lamp.flicker for lamp in scene.lamps.values()):
            load = _load_lamps(plan)
        else:
            plan = replace(plan, segment_slots=slots_per_segment(plan))
            load, n_slots = _load_movers(plan), plan.segment_slots
    common: dict[str, Any] = {
        "rows": view.rows,
        "cols": view.cols,
        "samples_per_pitch": view.samples_per_pitch,
        "slot_s": timing.slot_s,
        "instants_per_slot": n_instants,
        "slots_per_segment": n_slots,
        "n_slots": timing.n_slots,
        "white_w_m2_sr": scene.white_w_m2_sr,
        "outside": np.array(outside) if outside.any() else None,
    }
    half_difference = RadianceVideo(load=lambda index: load(index, _half_difference), **common)
    return RadianceVideo(load=lambda index: load(index, _mean), half_difference=half_difference, **common)


def _mean(halves: Floats) -> Floats:
    return np.asarray((halves[0] + halves[1]) * np.float32(0.5))


def _half_difference(halves: Floats) -> Floats:
    return np.asarray((halves[0] - halves[1]) * np.float32(0.5))


def _load_movers(plan: RenderPlan) -> _Load:
    """Render the parts that the cache lacks, under steady lamps; return the loader of segments."""
    still = RenderStage(plan.scene, plan.view, movers=False, azimuth_rad=plan.azimuth_rad)
    static = static_light(plan, still)
    n_instants = plan.segment_slots * plan.settings.instants_per_slot
    if not plan.scene.singles():
        return lambda index, half: Segment(half(static), half(static), (), n_instants)
    # Loads three scenes, so only if the cache lacks something.
    difference = functools.cache(lambda: Difference(plan, static))
    n_segments = plan.timing.n_slots // plan.segment_slots
    keys = [_key_instant(plan, difference, index, n_segments + 1) for index in range(n_segments + 1)]
    segments = [_segment(plan, difference, static, index, n_segments) for index in range(n_segments)]

    def load(index: int, half: Half) -> Segment:
        start, stop = (
            half(static + plan.cache.read(key)["change"]) for key in (keys[index], keys[index + 1])
        )
        return moving.assemble(start, stop, plan.cache.read(segments[index]), half, n_instants)

    return load


def _key(plan: RenderPlan, index: int) -> str:
    """Cache key of a key instant."""
    chosen, slot = plan.settings, index * plan.segment_slots
    what = chosen.static_error, chosen.change_error, chosen.key_seeds
    return plan.key("key", slot, plan.segment_slots, *what, plan.stop())


def _key_instant(plan: RenderPlan, difference: Callable[[], Difference], index: int, total: int) -> str:
    """Render the movers' change at a key instant, both halves; return its cache key."""
    time_s, turn = plan.time_s(index * plan.segment_slots), index % plan.settings.key_seeds

    def make() -> dict[str, Floats]:
        # The movers' own pixels are rendered with the segments.
        pixels = np.flatnonzero(~plan.own(time_s))
        pilot = difference().pilot(time_s, pixels) if index == 0 else None
        statistics = pilot or _others(plan, index, turn)
        counts = difference().counts(statistics, pixels, plan.settings.change_error)
        found, statistics = difference().change(time_s, pixels, counts, turn)
        change = np.zeros((2, plan.view.rows * plan.view.cols), np.float32)
        change[:, pixels] = found
        entry = {"change": change.reshape(2, *plan.shape), "tiles": statistics.arrays()}
        return entry | ({"pilot": pilot.arrays()} if pilot else {})

    plan.cache.get(_key(plan, index), make)
    plan.progress("key poses", index + 1, total)
    return _key(plan, index)


def _others(plan: RenderPlan, before: int, turn: int) -> Statistics:
    """Pool the statistics of earlier key instants with other random numbers than this turn's."""
    # Samples must not decide their own number: that would be a bias.
    statistics = Statistics.of(plan.cache.read(_key(plan, 0))["pilot"])
    for index in range(max(0, before - _REMEMBERED), before):
        if index % plan.settings.key_seeds != turn:
            statistics = statistics.and_then(Statistics.of(plan.cache.read(_key(plan, index))["tiles"]))
    return statistics


def _segment(
    plan: RenderPlan, difference: Callable[[], Difference], static: Floats, index: int, total: int
) -> str:
    """Render the samples touched by movers in a segment, both halves; return the cache key."""
    chosen, first = plan.settings, index * plan.segment_slots

    def key(first: int) -> str:
        errors = chosen.static_error, chosen.change_error, chosen.moving_error, chosen.interpolation_error
        what = plan.segment_slots, chosen.key_seeds, chosen.instants_per_slot
        return plan.key("movers", first, *what, *errors, plan.stop())

    def make() -> dict[str, Any]:
        if index:
            before = moving.MoverHistory.of(plan.cache.read(key(first - plan.segment_slots)))
        else:
            before = moving.pilot(plan, difference().moving, 0.0)
        change = [_others(plan, index + 1, turn) for turn in range(chosen.key_seeds)]
        return moving.render_segment(plan, difference(), static, first, before, change)

    plan.cache.get(key(first), make)
    plan.progress("movers", index + 1, total)
    return key(first)


def _load_lamps(plan: RenderPlan) -> _Load:
    """Render each group of lamps with the same flicker; a slot adds them at their brightness."""
    n_instants = plan.settings.instants_per_slot
    groups: list[tuple[str, RenderPlan, _Load]] = []
    for names in plan.scene.light_groups().values():
        lit = plan.lit_by(names)
        lit = replace(lit, segment_slots=slots_per_segment(lit))
        # Successive slots read the same segment.
        groups.append((names[0], lit, functools.lru_cache(maxsize=2)(_load_movers(lit))))

    def load(slot: int, half: Half) -> Segment:
        images = np.zeros((n_instants, *plan.shape), np.float32)
        for name, lit, load_group in groups:
            segment = load_group(slot // lit.segment_slots, half)
            first = slot % lit.segment_slots * n_instants
            for i, gain in enumerate(_gains(plan, name, slot)):
                images[i] += gain * segment.instant(first + i)
        return slot_segment(images)

    return load


def _load_camera(plan: RenderPlan) -> _Load:
    """Render every slot by itself, with each group of lamps at its brightness."""
    groups = plan.scene.light_groups().values()
    keys = [(names[0], load_slots(plan.lit_by(names) if len(groups) > 1 else plan)) for names in groups]

    def load(slot: int, half: Half) -> Segment:
        lit = [
            half(plan.cache.read(slots[slot])["light"]) * _gains(plan, name, slot)[:, None, None]
            for name, slots in keys
        ]
        return slot_segment(np.asarray(np.sum(lit, axis=0), np.float32))

    return load


def _load_alone(plan: RenderPlan, error: float) -> _Load:
    """Render a slot when it is read, with independent noise in every pixel."""
    chosen, names = plan.settings, list(plan.scene.light_groups().values())
    lit = [plan.lit_by(each) if len(names) > 1 else plan for each in names]

    @functools.cache
    def stage(group: int) -> RenderStage:
        return RenderStage(lit[group].scene, plan.view)

    def load(slot: int, half: Half) -> Segment:
        def make() -> dict[str, Floats]:
            groups = [(lit[i], stage(i), _gains(plan, each[0], slot)) for i, each in enumerate(names)]
            return slot_to_error(groups, slot, error)

        what = error, chosen.interpolation_error, chosen.instants_per_slot
        return slot_segment(half(plan.cache.get(plan.key("alone", slot, *what), make)["light"]))

    return load


def _gains(plan: RenderPlan, lamp: str, slot: int) -> Floats:
    """Relative brightness of a lamp in each instant of a slot."""
    n = plan.settings.instants_per_slot
    edges = [plan.time_s(slot + i / n) for i in range(n + 1)]
    return np.array([plan.scene.gain(lamp, *ends) for ends in pairwise(edges)], np.float32)


def _load_preview(plan: RenderPlan) -> _Load:
    """Render the scalar fallback: every slot by itself with few samples, one pose a slot."""
    groups = plan.scene.light_groups().values()
    stages = [(names[0], RenderStage(plan.scene.only_lamps(names), plan.view)) for names in groups]
    keys = [plan.key("preview", slot) for slot in range(plan.timing.n_slots)]
    for slot, key in enumerate(keys):

        def make(slot: int = slot) -> dict[str, Floats]:
            seeds, slot_s = plan.seeds("preview", slot), plan.timing.slot_s
            light = sum(
                plan.scene.gain(lamp, plan.time_s(slot), plan.time_s(slot + 1))
                * slot_image(stage, plan.time_s(slot), slot_s, _PREVIEW_SAMPLES, 1, seeds)
                for lamp, stage in stages
            )
            return {"light": np.asarray(light, np.float32)}

        plan.cache.get(key, make)
        plan.progress("preview", slot + 1, len(keys))

    def load(index: int, half: Half) -> Segment:
        image = half(plan.cache.read(keys[index])["light"])
        return Segment(image, image, (), 1)

    return load
