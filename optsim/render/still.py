"""The light without movers: rendered once, with most samples where it is noisiest.

It is rendered pass by pass through the cache, so an interrupted render resumes.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from optsim.core.quantities import Doubles, Floats, Ints
from optsim.render.allocation import Statistics, tally
from optsim.render.plan import RenderPlan
from optsim.render.stage import RenderStage

_ReportShare = Callable[[float], None]

_PILOT_SAMPLES = 8
_MOST_SAMPLES = 4096
# Samples after which each pass ends: sums of one launch stay short, and an interruption loses little.
_PASSES = (0, 8, 32, 128, 256, 512, 1024, 1536, 2048, 2560, 3072, 3584, 4096)


def halves_tally(plan: RenderPlan, pixels: Ints, light: Doubles, samples: Doubles | float) -> Statistics:
    """Sample statistics of plain estimates: the variance of one sample from the difference of the halves."""
    return tally(plan.shape, pixels, samples * (light[0] - light[1]) ** 2 / 2, light.mean(axis=0))


def static_light(plan: RenderPlan, still: RenderStage) -> Floats:
    """Both halves of the radiance without movers."""
    pixels, target = plan.pixels, plan.settings.static_error

    def pilot() -> dict[str, Floats]:
        report_share = _report_part(plan, "pilot", 0.0, 1.0)
        light = still.radiance(pixels, _PILOT_SAMPLES, plan.seeds("pilot"), report_share=report_share)
        statistics = halves_tally(plan, pixels, light, float(_PILOT_SAMPLES))
        return {"tiles": statistics.arrays(), "light": light.mean(axis=0).astype(np.float32)}

    known = plan.cache.get(plan.key("pilot"), pilot)
    counts = plan.counts(
        Statistics.of(known["tiles"]), pixels, known["light"], target, least=_PASSES[1], most=_MOST_SAMPLES
    )
    total = np.zeros((2, len(pixels)))
    spent, budget = 0.0, float(counts.sum())
    for first, last in pairwise(_PASSES):
        chosen = np.flatnonzero(counts > first)
        if not len(chosen):
            break
        samples = np.minimum(counts[chosen], last).astype(np.int64) - first

        # The share of pixels is about the share of work: pixels with many samples are few.
        report_share = _report_part(plan, "static light", spent / budget, float(samples.sum()) / budget)

        def make(
            chosen: Ints = chosen,
            samples: Ints = samples,
            first: int = first,
            report_share: _ReportShare = report_share,
        ) -> dict[str, Floats]:
            light = still.radiance(pixels[chosen], samples, plan.seeds("static"), first, report_share)
            return {"light": light.astype(np.float32)}

        entry = plan.cache.get(plan.key("static", target, plan.stop(), first, last), make)
        total[:, chosen] += entry["light"].astype(np.float64) * samples
        spent += float(samples.sum())
        plan.progress("static light", round(100 * spent / budget), 100)
    return (total / counts).reshape(2, *plan.shape).astype(np.float32)


def _report_part(plan: RenderPlan, stage: str, before: float, share: float) -> _ReportShare:
    """Convert the progress of a part to that of the whole stage."""

    def report_share(done: float) -> None:
        plan.progress(stage, round(100 * (before + share * done)), 100)

    report_share(0.0)
    return report_share
