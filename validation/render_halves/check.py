"""The noise that the two halves of a truth state, against the scatter of independent truths."""

from __future__ import annotations

import tempfile
from pathlib import Path
from unittest import mock

import numpy as np

from optsim.cache import Cache
from optsim.quantities import Doubles, Timing, View
from optsim.render import RenderSettings, render_truth
from optsim.render.plan import Plan
from optsim.scene import load_scene

CLAIM = "the mean square of half the difference of the two halves is the variance of the truth"
ORACLE = (
    "sample variance over 24 truths of other seeds, keys, movers and static light all differing; numpy only"
)
SOURCE = "definition of the variance of a mean of two independent estimates"
# About 1000 samples of 24 seeds with heavy tails: the ratio scatters by 3 %; thrice that.
TOLERANCE = 0.1
FILES = ("optsim/render/*.py",)

_TRUTHS = 24


def measure() -> float:
    return _deviation()


def perturbed() -> float:
    """With half B on the random numbers of half A for the static light."""
    honest = Plan.seeds

    def careless(plan: Plan, *purpose: object) -> tuple[int, int]:
        seeds = honest(plan, *purpose)
        return (seeds[0], seeds[0]) if purpose[0] == "static" else seeds

    with mock.patch.object(Plan, "seeds", careless):
        return _deviation()


def _deviation() -> float:
    scene, view = load_scene("training_mix", "c"), View(27, 36, 3, 0.32)
    images: list[Doubles] = []
    stated: list[Doubles] = []
    for seed in range(_TRUTHS):
        settings = RenderSettings(
            static_error=0.5, change_error=0.5, moving_error=0.8, slots_per_segment=2, seed=seed
        )
        with tempfile.TemporaryDirectory() as folder:
            video = render_truth(scene, view, Timing(1 / 180, 2, 1), settings, cache=Cache(Path(folder)))
            images.append(video.load(0).instant(1).astype(np.float64))
            noise = video.half_difference
            assert noise is not None
            stated.append(noise.load(0).instant(1).astype(np.float64) ** 2)
    found, claimed = np.var(images, axis=0, ddof=1), np.mean(stated, axis=0)
    # The noisiest hundredth of the samples would decide the ratio alone; chosen by the sum of both.
    kept = found + claimed < np.quantile(found + claimed, 0.99)
    return float(claimed[kept].sum() / found[kept].sum() - 1)
