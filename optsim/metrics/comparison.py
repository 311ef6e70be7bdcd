"""Judgement of one score before and after a change: interval, verdict, alarm, smallest detectable loss.

A unit is one coded frame of one seed. Units of the same seed and frame are paired: they share scene, photons
and bench. Frames of a seed count as units of their own unless the seeds scatter more than their frames
explain (F test at 25 %, the preliminary test of Paull, Ann. Math. Statist. 21, 539, 1950); then only seeds
count. Seeds without a partner are compared by their means (Welch). All intervals are Student's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
from scipy import special  # type: ignore[import-untyped]

from optsim.core.quantities import Doubles
from optsim.metrics.student import CONFIDENCE, quantile

"""Probability that no interval of a whole comparison misses its value."""
POWER = 0.9
"""Probability with which the smallest detectable loss raises the alarm."""
_POOL_BELOW = 0.25
# Units without which a change of scatter is not judged.
_LEAST_UNITS = 6

Change = Literal["better", "same", "worse", "cannot tell", "not judged"]
Alarm = Literal["", "warn", "fail"]
Values = Mapping[tuple[int, int], float]
"""Score by (seed, coded frame)."""


@dataclass(frozen=True)
class Advantage:
    """Mean advantage of the second side, with its standard error.

    Parameters
    ----------
    before, after : float
        Mean scores of the units compared.
    advantage : float
        Mean gain in the metric's unit; below 0 the second side is worse.
    error : float or None
        Standard error; None for a single unit.
    freedom : float
        Degrees of freedom of the error.
    seeds, units : int
        Seeds and units compared.
    paired : bool
        Whether both sides share their seeds.
    scatter : float or None
        Standard deviation after over that before; None for few units.
    scatter_p : float
        Probability of such a ratio, or a larger one, without a change.
    """

    before: float
    after: float
    advantage: float
    error: float | None
    freedom: float
    seeds: int
    units: int
    paired: bool
    scatter: float | None
    scatter_p: float


@dataclass(frozen=True)
class Judgement:
    """An estimate against its tolerance."""

    low: float | None  # Interval of the advantage.
    high: float | None
    # Better or worse: significant and beyond the tolerance. Same: the interval lies within it.
    verdict: Change
    # "fail" for worse; "warn" for grown scatter or a loss only significant, or only beyond the tolerance.
    alarm: Alarm
    why: str  # Reason of the alarm; empty without one.
    detectable: float | None  # Loss that raises "fail" with a probability of 90 %.


def row_level(n_rows: int) -> float:
    """Two-sided error probability of each of several intervals so that all hold together (Sidak)."""
    return -math.expm1(math.log(CONFIDENCE) / max(1, n_rows))


def estimate(before: Values, after: Values, higher_is_better: bool) -> Advantage | None:
    """Estimate the advantage of ``after`` from the units that both sides share.

    Parameters
    ----------
    before, after : mapping
        Score by seed and coded frame.
    higher_is_better : bool
        Direction of the metric.

    Returns
    -------
    Estimate or None
        None when nothing can be compared: no common frame.
    """
    sign = 1.0 if higher_is_better else -1.0
    common = sorted(before.keys() & after.keys())
    if common:
        a, b = (np.array([side[unit] for unit in common]) for side in (before, after))
        seeds = np.array([seed for seed, _ in common])
        error, freedom = _paired_error(b - a, seeds)
        scatter, p = _paired_scatter(a, b, np.array([frame for _, frame in common]), len(set(seeds)))
        counts = len(set(seeds.tolist())), len(common)
    else:
        frames = sorted({f for _, f in before} & {f for _, f in after})
        a, b = (_seed_means(side, frames) for side in (before, after))
        if not a.size or not b.size:
            return None
        error, freedom = _welch(a, b)
        scatter, p = _free_scatter(a, b)
        counts = min(a.size, b.size), min(a.size, b.size)
    return Advantage(
        before=float(a.mean()),
        after=float(b.mean()),
        # Never a negative zero.
        advantage=sign * float(b.mean() - a.mean()) + 0.0,
        error=error,
        freedom=freedom,
        seeds=counts[0],
        units=counts[1],
        paired=bool(common),
        scatter=scatter,
        scatter_p=p,
    )


def judge(found: Advantage, tolerance: float | None, level: float, *, either_way: bool = False) -> Judgement:
    """Judge an estimate against the tolerance of its metric.

    Parameters
    ----------
    found : Estimate
        From :func:`estimate`.
    tolerance : float or None
        Loss that is accepted, in the metric's unit; None for a metric that decides nothing.
    level : float
        Two-sided error probability of the interval, from :func:`row_level`.
    either_way : bool
        Whether a gain beyond the tolerance is a fault too, as of a reading that has one right value.
    """
    if found.error is None:
        moved = tolerance is not None and _loss(found, either_way) > tolerance
        why = "moved beyond the tolerance in a single sample" if moved else ""
        unit: Change = "not judged" if tolerance is None else "cannot tell"
        return Judgement(None, None, unit, "warn" if moved else "", why, None)
    far = quantile(found.freedom, 1 - level / 2) * found.error
    low, high = found.advantage - far, found.advantage + far
    if tolerance is None:
        return Judgement(low, high, "not judged", "", "", None)
    detectable = max(tolerance, far) + quantile(found.freedom, POWER) * found.error
    significant, beyond = not low <= 0 <= high, abs(found.advantage) > tolerance
    if significant and beyond:
        verdict: Change = "better" if found.advantage > 0 and not either_way else "worse"
    else:
        verdict = "same" if -tolerance <= low and high <= tolerance else "cannot tell"
    alarm, why = _alarm(found, tolerance, level, verdict, significant, _loss(found, either_way))
    return Judgement(low, high, verdict, alarm, why, detectable)


def _loss(found: Advantage, either_way: bool) -> float:
    return abs(found.advantage) if either_way else -found.advantage


def _alarm(
    found: Advantage, tolerance: float, level: float, verdict: Change, significant: bool, loss: float
) -> tuple[Alarm, str]:
    grown = found.scatter is not None and found.scatter > 1 and found.scatter_p < level
    scatter = f"scatter grew {found.scatter:.1f} times" if grown else ""
    if verdict == "worse":
        return "fail", f"mean shifted, {scatter}" if grown else "mean shifted"
    if loss > tolerance:
        return "warn", scatter or "moved beyond the tolerance, not significant"
    if significant and loss > tolerance / 2:
        return "warn", scatter or "significant, within the tolerance"
    return ("warn", scatter) if grown else ("", "")


def _f_survival(ratio: float, over: float, under: float) -> float:
    return float(cast("float", special.fdtrc(over, under, ratio)))


def _paired_error(differences: Doubles, seeds: Doubles) -> tuple[float | None, float]:
    """Find the standard error of the mean difference and its freedom: of seeds, or of all units."""
    n = differences.size
    if n < 2:
        return None, 0.0
    alone = float(np.std(differences, ddof=1)) / math.sqrt(n)
    names, places, counts = np.unique(seeds, return_inverse=True, return_counts=True)
    k = names.size
    if k < 2:
        return alone, n - 1.0
    means = np.bincount(places, differences) / counts
    between = float((counts * (means - differences.mean()) ** 2).sum()) / (k - 1)
    of_seeds = math.sqrt(between / n), k - 1.0
    if n == k:
        return of_seeds
    within = float(((differences - means[places]) ** 2).sum()) / (n - k)
    if between <= within or _f_survival(between / within if within else math.inf, k - 1, n - k) > _POOL_BELOW:
        return alone, n - 1.0
    return of_seeds


def _seed_means(side: Values, frames: list[int]) -> Doubles:
    """Means over the common frames, of the seeds that have them all."""
    seeds = sorted({seed for seed, _ in side})
    whole = [seed for seed in seeds if all((seed, frame) in side for frame in frames)] if frames else []
    return np.array([math.fsum(side[seed, frame] for frame in frames) / len(frames) for seed in whole])


def _welch(a: Doubles, b: Doubles) -> tuple[float | None, float]:
    if min(a.size, b.size) < 2:
        return None, 0.0
    parts = [float(np.var(side, ddof=1)) / side.size for side in (a, b)]
    total = sum(parts)
    if not total:
        return 0.0, a.size + b.size - 2.0
    return math.sqrt(total), total**2 / sum(p**2 / (s.size - 1) for p, s in zip(parts, (a, b), strict=True))


def _paired_scatter(a: Doubles, b: Doubles, frames: Doubles, k: int) -> tuple[float | None, float]:
    """Ratio of paired standard deviations and its probability (Pitman and Morgan), content taken out."""
    n, freedom = a.size, float(a.size - 2)
    if n < _LEAST_UNITS:
        return None, 1.0
    if k > 1:
        _, places, counts = np.unique(frames, return_inverse=True, return_counts=True)
        a, b = (side - (np.bincount(places, side) / counts)[places] for side in (a, b))
        freedom -= counts.size - 1
    spread = [float(np.std(side, ddof=1)) for side in (a, b)]
    total, difference = a + b, b - a
    if freedom < 2 or not min(spread) or not np.std(difference):
        return None, 1.0
    r = min(float(np.corrcoef(total, difference)[0, 1]), 1 - 1e-12)
    t = r * math.sqrt(freedom / (1 - r**2)) if abs(r) < 1 else math.copysign(math.inf, r)
    return spread[1] / spread[0], 1 - float(cast("float", special.stdtr(freedom, t)))


def _free_scatter(a: Doubles, b: Doubles) -> tuple[float | None, float]:
    if min(a.size, b.size) < _LEAST_UNITS or not np.std(a):
        return None, 1.0
    ratio = float(np.var(b, ddof=1) / np.var(a, ddof=1))
    return math.sqrt(ratio), _f_survival(ratio, b.size - 1, a.size - 1)
