"""Truth by differences against the plain path tracer, mean against mean."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from scipy import stats

from optsim.core.cache import Cache
from optsim.core.quantities import Doubles, RadianceVideo, Timing, View
from optsim.render import RenderSettings, difference, render_truth
from optsim.render.backend import activate
from optsim.render.footprint import cover
from optsim.render.nearby import Boxes, boxes_around
from optsim.render.plan import seed_of
from optsim.render.stage import RenderStage
from optsim.scene import Scene, load_scene
from optsim.scene.lamps import Lamp

CLAIM = (
    "truth by differences, with samples allocated by earlier poses and paths skipped, averages to what a "
    "plain path tracer renders: in every region, on pixels that movers touch, elsewhere, and over the picture"
)
ORACLE = (
    "Mitsuba's own render loop, film and multijitter sampler, the whole scene at every pose: no boxes, no "
    "differences, no allocation; means over one coded frame's time, in standard errors; numpy and scipy only"
)
SOURCE = "Student, Biometrika 6, 1-25 (1908); Z. Sidak, J. Am. Stat. Assoc. 62, 626-633 (1967)"
# In standard errors: right code fails once in 10 000 versions of its random numbers.
FALSE_ALARM = 1e-4
FILES = ("optsim/render/*.py",)

_SCENES = ("window_room", "half_moving")
_VIEW = View(27, 36, 3, 0.32)
_REGION = 9
# Every slot has key instants of its own; every eighth has the random numbers of earlier ones.
_TIMING, _KEY_SEEDS = Timing(1 / 180, 24, 1), 8
# Plain renders: two at each of so many poses, with so many samples (a square).
_POSES, _SAMPLES = 48, 100
# Errors smaller than this share of the radiance aren't looked for: interpolation in a slot, float32.
_FLOOR = 2e-3
# Regions of both pictures, and three larger ones of each: what movers touch, all else, the picture.
_TESTS = len(_SCENES) * (_VIEW.rows // _REGION * (_VIEW.cols // _REGION) + 3)
_FREEDOM = 20
REASON = (
    "Quantile of Student's t that the worst of all regions exceeds at the stated false-alarm rate; a "
    "region's standard error sums 2 x 81 squares of pixels, unequally noisy: worth at least 20 equal ones."
)
TOLERANCE = float(stats.t.isf((1 - (1 - FALSE_ALARM) ** (1 / _TESTS)) / 2, _FREEDOM))


def measure() -> float:
    return _worst(_SCENES)


def perturbed() -> float:
    """Make two mistakes, too small boxes and another scene without movers: the smaller deviation."""
    found: list[float] = []
    for mistake in (_small_boxes(), _brighter_lamps()):
        with mistake:
            found.append(_worst(_SCENES[-1:]))
    return min(found)


@contextmanager
def _small_boxes() -> Iterator[None]:
    """Skip paths that do meet a mover: boxes hold only the middle tenth of where movers go."""

    def shrunken(*where: Any) -> Boxes | None:
        boxes = boxes_around(*where)
        assert boxes is not None
        low, high = dict(boxes.low_m), dict(boxes.high_m)
        for name in low:
            middle, half = (low[name] + high[name]) / 2, (high[name] - low[name]) / 20
            low[name], high[name] = middle - half, middle + half
        return replace(boxes, low_m=low, high_m=high)

    with (
        mock.patch.object(difference, "boxes_around", shrunken),
        mock.patch.object(Boxes, "hold", return_value=True),
    ):
        yield


@contextmanager
def _brighter_lamps() -> Iterator[None]:
    """Take B_n of a scene whose lamps are a tenth brighter than where B_hi and F_n come from."""
    honest = difference.RenderStage

    def careless(scene: Scene, *rest: Any, movers: bool = True, **more: Any) -> RenderStage:
        if not movers:
            lamps = {name: _brighter(lamp) for name, lamp in scene.lamps.items()}
            scene = scene.model_copy(update={"lamps": lamps})
        return honest(scene, *rest, movers=movers, **more)

    with mock.patch.object(difference, "RenderStage", careless):
        yield


def _brighter(lamp: Lamp) -> Lamp:
    radiance: Any = lamp.radiance_w_m2_sr
    if isinstance(radiance, dict):
        brighter: Any = {band: 1.1 * value for band, value in radiance.items()}
    else:
        brighter = 1.1 * radiance
    return lamp.model_copy(update={"radiance_w_m2_sr": brighter})


def _worst(names: tuple[str, ...]) -> float:
    activate()
    return max(float(np.abs(_deviations(load_scene(name))).max()) for name in names)


def _deviations(scene: Scene) -> Doubles:
    """Difference of the two means in each region, over its standard error."""
    masks = _masks(scene)
    about, variance = _plain(scene.name)
    light, half_difference = _truth(scene)
    # Pixels have random numbers of their own, and so have halves; slots share some.
    variance = masks**2 @ variance + masks**2 @ half_difference**2
    about = masks @ about
    return (masks @ light - about) / np.sqrt(variance + (_FLOOR * about) ** 2)


@cache
def _plain(name: str) -> tuple[Doubles, Doubles]:
    """Mean of plain renders over the same time, and its variance, per fine sample."""
    plain = RenderStage(load_scene(name), _VIEW)
    images = np.empty((2, _POSES, _VIEW.rows * _VIEW.cols))
    for pose in range(_POSES):
        plain.pose((pose + 0.5) / _POSES * _TIMING.n_slots * _TIMING.slot_s)
        for turn in (0, 1):
            images[turn, pose] = plain.picture(_SAMPLES, seed_of("difference_unbiased", pose, turn)).ravel()
    return images.mean(axis=(0, 1)), ((images[0] - images[1]) ** 2).sum(axis=0) / (2 * _POSES) ** 2


def _truth(scene: Scene) -> tuple[Doubles, Doubles]:
    """Mean over all slots of the truth and of half the difference of its halves, per fine sample."""
    settings = RenderSettings(
        static_error=0.01,
        change_error=0.1,
        moving_error=0.15,
        interpolation_error=0.03,
        slots_per_segment=1,
        key_seeds=_KEY_SEEDS,
    )
    with tempfile.TemporaryDirectory() as folder:
        video = render_truth(scene, _VIEW, _TIMING, settings, cache=Cache(Path(folder)))
        noise = video.half_difference
        assert noise is not None
        return _mean(video), _mean(noise)


def _mean(video: RadianceVideo) -> Doubles:
    slots = [video.load(slot).instant(0).ravel().astype(np.float64) for slot in range(_TIMING.n_slots)]
    return np.mean(slots, axis=0)


def _masks(scene: Scene) -> Doubles:
    """Regions as rows of weights that average: (region, sample)."""
    own = np.zeros((_VIEW.rows, _VIEW.cols), np.bool_)
    for time_s in np.linspace(0, _TIMING.n_slots * _TIMING.slot_s, 2 * _TIMING.n_slots + 1):
        for mover in scene.singles().values():
            cover(own, mover.vertices(float(time_s)), mover.rest().faces, scene.camera, _VIEW)
    y, x = np.indices(own.shape) // _REGION
    regions = [(y == i) & (x == j) for i in range(y.max() + 1) for j in range(x.max() + 1)]
    masks = np.stack([*regions, own, ~own, own | True]).reshape(-1, own.size).astype(np.float64)
    return masks / np.maximum(masks.sum(axis=1, keepdims=True), 1)
