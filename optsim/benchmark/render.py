"""Time of a pose at equal error against the plain loop: update the geometry, ``mi.render``, every pose anew.

The peer gets the same scene, integrator and emitter weights, and Mitsuba's multijitter sampler. Errors are
relative, sqrt(mean((x - truth)^2 / (truth + floor)^2)) over the movers' own pixels and over all others apart:
an average over the picture hides the movers. The truth is two independent halves of 1024 samples kept in
the cache; the product of the differences to each has their variance subtracted by construction. The ratio is
the smaller one of the two regions', of the time that the plain loop needs for our error (its squared error
goes down as one over its samples, measured) to the time of ours.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from optsim.cache import Cache, hash_of
from optsim.progress import Progress, silent
from optsim.quantities import Bools, Doubles, Floats, Timing, View
from optsim.render.allocation import Tiles
from optsim.render.backend import activate, versions
from optsim.render.difference import Difference
from optsim.render.full import render_slot
from optsim.render.moving import pilot, render_pose
from optsim.render.plan import Plan
from optsim.render.settings import RenderSettings
from optsim.render.stage import Stage
from optsim.render.still import halves_tally, static_light
from optsim.scene import load_scene

VIEW = View(rows=200, cols=240, samples_per_pitch=1, tan_half_width=0.32)
# Held back: none is a key instant of any segment length, and none is near another.
POSES_S = (0.2071, 0.5123, 0.8377)
_REFERENCE_SAMPLES = 1024
_PLAIN_SAMPLES = (16, 64)
# Our targets on a ladder, and the one that the record is for: near the plain loop's error with 64 samples.
_LADDER = (0.24, 0.12, 0.06)
_RECORD = 0.12
_ROUNDS = 3
# Poses among which one-off work is shared out in the conditions: a coded experiment of 20 frames.
_SEQUENCE = 720


@dataclass(frozen=True, eq=False)
class _Reference:
    """What is true of a pose: two independent halves, and which pixels are movers' own."""

    halves: Doubles
    own: Bools

    def squared_errors(self, image: Doubles, floor: float) -> Doubles:
        """Unbiased mean squared relative error on the movers' own pixels and on all others."""
        first, second = image - self.halves[0], image - self.halves[1]
        relative = first * second / (np.maximum(self.halves.mean(axis=0), 0) + floor) ** 2
        regions = [region for region in (self.own, ~self.own) if region.any()]
        return np.array([relative[region].mean() for region in regions])


@dataclass(frozen=True, eq=False)
class _Point:
    """A method at one setting: seconds a pose, mean squared relative error by region."""

    seconds: float
    squared: Doubles


def measure(name: str, progress: Progress = silent) -> dict[str, Any]:
    """Measure one scene.

    Parameters
    ----------
    name : str
        ``render.<scene>``.
    progress : Progress
        Told of each piece of work.
    """
    activate()
    scene, cache = load_scene(name.removeprefix("render.")), Cache()
    camera_moves = scene.kind_of_change() == "camera"
    identity = hash_of(scene.model_dump(mode="json"), [VIEW.rows, VIEW.cols, VIEW.tan_half_width], versions())
    # A slot of a microsecond is a pose.
    plan = Plan(scene, VIEW, Timing(1e-6, 1, 1), _settings(_RECORD), None, cache, silent, identity)
    stage = Stage(scene, VIEW)
    references = [_reference(plan, stage, time_s, progress) for time_s in POSES_S]
    plain = {n: _plain(plan, stage, references, n) for n in _PLAIN_SAMPLES}
    progress("plain loop", 1, 1)
    ours: dict[float, _Point] = {}
    one_off_s = 0.0
    for done, target in enumerate(_LADDER):
        if camera_moves:
            ours[target] = _full(plan, stage, references, target)
        else:
            ours[target], spent = _difference(plan, references, target)
            one_off_s = spent if target == _RECORD else one_off_s
        progress("our way", done + 1, len(_LADDER))
    # Squared error times seconds is what the plain loop pays; its samples are independent of each other.
    price = np.mean([point.squared * point.seconds for point in plain.values()], axis=0)
    found = ours[_RECORD]
    ratios = price / found.squared / found.seconds
    amortised = price / found.squared / (found.seconds + one_off_s / _SEQUENCE)
    regions = ("movers", "elsewhere") if len(price) == 2 else ("picture",)
    curve = [
        {"method": method, "setting": float(key), "seconds": point.seconds}
        | {f"error_{r}": float(e) for r, e in zip(regions, _root(point.squared), strict=True)}
        for method, points in (("plain", plain), ("optsim", ours))
        for key, point in points.items()
    ]
    return {
        "name": name,
        "value": 1 / found.seconds,
        "unit": "poses/s",
        "peer": "mi.render every pose",
        "peer_value": 1 / (found.seconds * float(np.min(ratios))),
        "ratio": float(np.min(ratios)),
        "conditions": {
            "grid": f"{VIEW.cols} x {VIEW.rows}",
            "poses_s": list(POSES_S),
            "reference": f"two halves of {_REFERENCE_SAMPLES} samples",
            "ratio_by_region": dict(zip(regions, map(float, ratios), strict=True)),
            "error_by_region": dict(zip(regions, map(float, _root(found.squared)), strict=True)),
            "own_pixels_share": float(np.mean([reference.own.mean() for reference in references])),
            "one_off_s": one_off_s,
            f"ratio_with_one_off_over_{_SEQUENCE}_poses": float(np.min(amortised)),
            "curve": curve,
        },
    }


def _settings(target: float) -> RenderSettings:
    """Targets that share the same error: the static light's part of it is paid once, so it is the smaller."""
    return RenderSettings.model_validate(
        {
            "static_error": 0.4 * target,
            "change_error": 0.85 * target,
            "moving_error": target,
            "key_seeds": 4,
        }
    )


def _root(squared: Doubles) -> Doubles:
    """Root of an unbiased estimate, which noise may have made negative."""
    return np.sqrt(np.maximum(squared, 0))


def _reference(plan: Plan, stage: Stage, time_s: float, progress: Progress) -> _Reference:
    """Render both halves of the truth in passes of 128 samples, or find them in the cache."""

    def make() -> dict[str, Doubles]:
        stage.pose(time_s)
        total = np.zeros((2, len(plan.pixels)))
        for first in range(0, _REFERENCE_SAMPLES, 128):
            total += stage.radiance(plan.pixels, 128, plan.seeds("reference", time_s), first)
            progress(f"reference at {time_s} s", first + 128, _REFERENCE_SAMPLES)
        return {"halves": total / (_REFERENCE_SAMPLES // 128)}

    key = plan.key("bench reference", time_s, _REFERENCE_SAMPLES)
    halves = np.array(plan.cache.get(key, make)["halves"])
    return _Reference(halves, plan.own(time_s).ravel())


def _mean(plan: Plan, references: list[_Reference], renders: list[tuple[float, Doubles]]) -> _Point:
    """Average over poses of the shortest time, and of the squared errors."""
    seconds = [t for t, _ in renders]
    squared = [r.squared_errors(x, plan.floor_w_m2_sr) for r, (_, x) in zip(references, renders, strict=True)]
    return _Point(float(np.mean(seconds)), np.mean(squared, axis=0))


def _plain(plan: Plan, stage: Stage, references: list[_Reference], samples: int) -> _Point:
    points: list[_Point] = []
    for turn in range(_ROUNDS):
        renders: list[tuple[float, Doubles]] = []
        for time_s in POSES_S:
            start = time.perf_counter()
            stage.pose(time_s)
            image = stage.picture(samples, plan.seeds("plain", turn, time_s)[0])
            renders.append((time.perf_counter() - start, image.ravel().astype(np.float64)))
        points.append(_mean(plan, references, renders))
    return _best(points)


def _best(points: list[_Point]) -> _Point:
    """Shortest time, mean of the squared errors: other work on the machine only ever adds time."""
    return _Point(min(p.seconds for p in points), np.mean([p.squared for p in points], axis=0))


def _full(plan: Plan, stage: Stage, references: list[_Reference], target: float) -> _Point:
    """Render the whole picture, samples allocated by the pose before."""
    points: list[_Point] = []
    for turn in range(_ROUNDS):
        renders: list[tuple[float, Doubles]] = []
        for time_s in POSES_S:
            # The statistics are those of a slot of the camera before.
            near = _replaced(plan, target, turn)
            stage.pose(time_s - 1 / 180)
            light = stage.radiance(plan.pixels, 16, plan.seeds("before", turn, time_s))
            before = halves_tally(plan, plan.pixels, light, 16.0)
            start = time.perf_counter()
            found = render_slot(near, stage, round(time_s * 1e6), before)["light"]
            renders.append((time.perf_counter() - start, found.mean(axis=(0, 1)).ravel().astype(np.float64)))
        points.append(_mean(plan, references, renders))
    return _best(points)


def _difference(plan: Plan, references: list[_Reference], target: float) -> tuple[_Point, float]:
    """Render what changed; also the seconds of work that is done once a sequence."""
    points: list[_Point] = []
    once: list[float] = []
    for turn in range(_ROUNDS):
        near = _replaced(plan, target, turn)
        static, spent = _static(near)
        difference = Difference(near, static)
        ones, renders = np.ones(len(plan.pixels)), list[tuple[float, Doubles]]()
        first_s = 0.0
        for time_s in POSES_S:
            before_s = time_s - 1 / 180
            elsewhere = np.flatnonzero(~near.own(before_s))
            own, change = pilot(near, difference.moving, before_s), difference.pilot(before_s, elsewhere)
            # Poses before leave statistics, and the paths without movers that a sequence traces only once.
            for pose in (0, 1, 2):
                start = time.perf_counter()
                _, own, later = _pose(near, difference, static, before_s, (turn, pose), ones, own, change)
                first_s = max(first_s, time.perf_counter() - start)
                change = change.and_then(later)
            start = time.perf_counter()
            light, _, _ = _pose(near, difference, static, time_s, (turn, 2), ones, own, change)
            renders.append((time.perf_counter() - start, light.mean(axis=0)))
        once.append(spent + near.settings.key_seeds * max(0.0, first_s - renders[-1][0]))
        points.append(_mean(plan, references, renders))
    return _best(points), min(once)


def _static(plan: Plan) -> tuple[Floats, float]:
    """Light without movers, and the seconds that it took when it was made, perhaps in an earlier run."""

    def make() -> dict[str, Floats]:
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            static = static_light(
                replace(plan, cache=Cache(Path(folder))), Stage(plan.scene, VIEW, movers=False)
            )
        return {"static": static, "seconds": np.array([time.perf_counter() - start], np.float32)}

    found = plan.cache.get(plan.key("bench static", plan.settings.static_error), make)
    return np.array(found["static"]), float(found["seconds"][0])


def _pose(
    plan: Plan,
    difference: Difference,
    static: Floats,
    time_s: float,
    which: tuple[int, int],
    ones: Doubles,
    own: Tiles,
    change: Tiles,
) -> tuple[Doubles, Tiles, Tiles]:
    return render_pose(plan, difference, static, time_s, which, plan.pixels, ones, own, change)


def _replaced(plan: Plan, target: float, turn: int) -> Plan:
    """Plan with other targets and other random numbers, whose pieces stay out of the cache of renders."""
    settings = _settings(target).model_copy(update={"seed": turn + 1})
    return replace(plan, settings=settings)
