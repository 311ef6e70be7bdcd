"""What interpolating in time adds to slot means, against slot means of many poses."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from optsim.core.cache import Cache
from optsim.core.quantities import Bools, Doubles, Ints, RadianceVideo, Timing, View
from optsim.render import RenderSettings, moving, pose_sampling, render_truth
from optsim.render.backend import activate
from optsim.render.footprint import cover
from optsim.render.plan import seed_of
from optsim.render.stage import RenderStage
from optsim.scene import Scene, load_scene

CLAIM = (
    "interpolation between rendered poses adds at most RenderSettings.interpolation_error to the relative "
    "error of slot means, on the movers' own pixels and on all others"
)
ORACLE = (
    "slot means of 16 poses of the whole scene, twice from independent random numbers; products of "
    "differences of two truths that share none, so that no noise is taken for an error; numpy only"
)
SOURCE = "definition of the mean over a slot; E[(X - t)(Y - t)] = (E X - t)(E Y - t) for independent X and Y"
TOLERANCE = 1.0
REASON = "Found error over the bound: the bound itself."
FILES = ("optsim/render/*.py",)

# Soft shadows, spokes, many movers, 10 : 1 bars, a dark rod before a bright wall; a wide and a tight bound.
_CASES = (
    ("window_room", 0.05),
    ("wheel", 0.05),
    ("half_moving", 0.05),
    ("chart", 0.2),
    ("chart", 0.05),
    ("glossy_floor", 0.2),
)
_VIEW = View(100, 120, 1, 0.32)
_TIMING = Timing(1 / 180, 18, 3)
# Slots to look at: some next to key instants, some between them; two in the first segment, whose poses are as
# dense as one assumes, most in the third, whose density was measured.
_SLOTS = (1, 10, 37, 42, 46, 49, 52)
_POSES, _SAMPLES = 16, 16
# So many of the movers' own pixels, and of the others, at random.
_PIXELS = 700


def measure() -> float:
    return max(max(_found(*case)) for case in _CASES)


def perturbed() -> float:
    """Set poses 16 times too far apart; confuse a segment's keys, then its ends: error where it matters."""
    with mock.patch.object(pose_sampling, "_SHARE", pose_sampling._SHARE * 64):
        own = _found("wheel", 0.05)[0]
    keys_round = moving._keys_round

    def confused(*which: Any) -> tuple[Any, Any, float]:
        before, after, share = keys_round(*which)
        return after, before, share

    with mock.patch.object(moving, "_keys_round", confused):
        carried = _found("window_room", 0.05)[0]
    honest = moving.assemble
    with mock.patch.object(moving, "assemble", lambda start, stop, *rest: honest(stop, start, *rest)):
        elsewhere = _found("half_moving", 0.05)[1]
    return min(own, carried, elsewhere)


def _found(name: str, bound: float) -> tuple[float, float]:
    """Error on the movers' own pixels and elsewhere, over the bound."""
    activate()
    scene = load_scene(name)
    # Noise is to be small beside the bound in the mean over 4000 samples, not in each.
    noise = 0.07 if bound < 0.1 else 0.2
    truths: list[list[Doubles]] = []
    for seed in (1, 2):
        settings = RenderSettings(
            static_error=0.03, change_error=noise, moving_error=noise, interpolation_error=bound, seed=seed
        )
        with tempfile.TemporaryDirectory() as folder:
            video = render_truth(scene, _VIEW, _TIMING, settings, cache=Cache(Path(folder)))
            truths.append([_halves(video, slot) for slot in _SLOTS])
    products: list[Doubles] = []
    regions: list[Bools] = []
    for one, other, (pixels, own, theirs) in zip(*truths, _dense(name), strict=True):
        about = np.maximum(theirs.mean(axis=0), 0) + 0.01 * scene.white_w_m2_sr
        pairs = one[:, pixels] / about, other[:, pixels] / about
        first, second = (pair.mean(axis=0) - their / about for pair, their in zip(pairs, theirs, strict=True))
        # Fireflies would drown the rest: a hundredth goes, by how far the halves of one truth disagree. That
        # says nothing of their mean's error, and the two truths' errors are multiplied; had the product of
        # the halves themselves been taken, those left would agree too well.
        noise_squared = sum(np.diff(pair, axis=0)[0] ** 2 for pair in pairs)
        kept = noise_squared <= np.quantile(noise_squared, 0.99)
        products.append((first * second)[kept])
        regions.append(own[kept])
    squared, own = np.concatenate(products), np.concatenate(regions)
    mean = [max(float(squared[region].mean()), 0.0) for region in (own, ~own)]
    return np.sqrt(mean[0]) / bound, np.sqrt(mean[1]) / bound


def _halves(video: RadianceVideo, slot: int) -> Doubles:
    """Both halves of a slot: array of shape (2, sample)."""
    noise = video.half_difference
    assert noise is not None
    segment, place = divmod(slot, video.slots_per_segment)
    mean, off = (v.load(segment).instant(place).ravel().astype(np.float64) for v in (video, noise))
    return np.stack([mean + off, mean - off])


def _own(scene: Scene, slot: int) -> Bools:
    """Fine samples in which a mover may be seen during a slot."""
    own = np.zeros((_VIEW.rows, _VIEW.cols), np.bool_)
    for time_s in (slot + np.linspace(0, 1, 9)) * _TIMING.slot_s:
        for mover in scene.singles().values():
            cover(own, mover.vertices(float(time_s)), mover.rest().faces, scene.camera, _VIEW)
    return own


@cache
def _dense(name: str) -> list[tuple[Ints, Bools, Doubles]]:
    """Pixels of each slot, which of them are movers' own, and two independent means over the slot."""
    scene = load_scene(name)
    stage, found = RenderStage(scene, _VIEW), list[tuple[Ints, Bools, Doubles]]()
    for slot in _SLOTS:
        own, rng = _own(scene, slot).ravel(), np.random.default_rng(slot)
        chosen = [rng.permutation(np.flatnonzero(region))[:_PIXELS] for region in (own, ~own)]
        pixels = np.sort(np.concatenate(chosen))
        total = np.zeros((2, len(pixels)))
        for pose in range(_POSES):
            stage.pose((slot + (pose + 0.5) / _POSES) * _TIMING.slot_s)
            seeds = tuple(seed_of("interpolation_bound", slot, pose, turn) for turn in (0, 1))
            total += stage.radiance(pixels, _SAMPLES, seeds) / _POSES
        found.append((pixels, own[pixels], total))
    return found
