# pyright: reportMissingTypeStubs=false
"""Relaxation of a panel's pixels through the slots of a code: retardance relaxes, light is averaged.

The closed form is that of :mod:`optsim.optics.panel`. Its Si(x) / x and Cin(x) / x^2 are polynomials of x^2:
a loop over polynomials is vectorised, a table look-up is not. Many pixels run in a compiled loop. Few pixels
run together in numpy, since loading the loop would take longer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.special import sici

from optsim.core.compiled import FEW, compiled
from optsim.core.quantities import Bytes, Doubles, Floats, Ints
from optsim.core.threads import in_bands

# A pixel nearer to its target than this has settled: the rest changes a weight by less than 1e-14.
SETTLED_RAD = 1e-7


def si_cin(x: Doubles) -> tuple[Doubles, Doubles]:
    """Sine integral (odd) and the entire cosine integral Cin (even)."""
    size = np.abs(x)
    large = np.maximum(size, 1e-3)
    si, ci = sici(large)
    # gamma + ln x - Ci x loses digits near zero, where two terms of the series are exact to 1e-21.
    cin = np.where(size > 1e-3, np.euler_gamma + np.log(large) - ci, size**2 / 4 - size**4 / 96)
    return np.where(size > 1e-3, np.sign(x) * si, x - x**3 / 18), cin


def _powers(power: int, which: int) -> tuple[float, ...]:
    """Coefficients of an integral over x to a power, in powers of the square of x, from 0 to 2 pi."""

    def smooth(square: Doubles) -> Doubles:
        x = np.sqrt(square)
        return si_cin(x)[which] / x**power

    found = np.polynomial.Chebyshev.interpolate(smooth, 9, domain=[0, 4 * np.pi**2])
    return tuple(found.convert(kind=np.polynomial.Polynomial).coef.tolist())


# Both integrals to 1e-10.
_SI, _CIN = _powers(1, 0), _powers(2, 1)


def _series(coefficients: tuple[float, ...], z: Any) -> Any:
    """Sum of powers of a number or an array."""
    c0, c1, c2, c3, c4, c5, c6, c7, c8, c9 = coefficients
    high = c5 + z * (c6 + z * (c7 + z * (c8 + z * c9)))
    return c0 + z * (c1 + z * (c2 + z * (c3 + z * (c4 + z * high))))


_series_of_one = compiled(fastmath=True)(_series)


class Drive(NamedTuple):
    """Target retardance of levels, its cosine and sine, float64: for a slot (256,), or for all."""

    target: Doubles
    cosine: Doubles
    sine: Doubles


def walk(
    levels: Bytes,
    retardance: Floats,
    displayed: Bytes,
    targets: Doubles,
    taus: Doubles,
    switch_at: Ints,
    early_s: Doubles,
    instant_s: float,
    leaks: Doubles,
    spans: Doubles,
    weights: Floats,
) -> None:
    """Fill the weights of a code's instants, and advance the panel to the end of the last slot."""
    if weights.size < FEW:
        delays_s = np.broadcast_to((switch_at * instant_s + early_s)[:, None], displayed.shape)
        first, alike = _different(levels, retardance, displayed, delays_s)
        each = levels.reshape(len(levels), -1)[:, first], retardance.flat[first], displayed.flat[first]
        lengths_s = instant_s, delays_s.flat[first]
        light, after = _walk_together(*each, targets, taus, *lengths_s, len(weights) // len(levels))
        weights[:] = leaks + spans * light[:, alike].reshape(weights.shape)
        retardance[:], displayed[:] = after[alike].reshape(displayed.shape), levels[-1]
        return

    drives = Drive(targets, np.cos(targets), np.sin(targets))

    def band(first: int, end: int) -> None:
        part = slice(first, end)
        _run(
            levels[:, part], retardance[part], displayed[part], drives, taus, switch_at[part], early_s[part],
            instant_s, leaks, spans, weights[:, part],
        )  # fmt: skip

    in_bands(len(displayed), band)


def _different(levels: Bytes, retardance: Floats, displayed: Bytes, delays_s: Doubles) -> tuple[Ints, Ints]:
    """Find the distinct pixels by level and delay: one of each kind, and the kind of each pixel."""
    # Periodic codes have few kinds, and arrays of few pixels cost little more than the calls.
    course = [
        np.ascontiguousarray(each.reshape(displayed.size, -1)).view(np.uint8)
        for each in (np.moveaxis(levels, 0, -1), displayed, retardance, delays_s)
    ]
    rows = np.concatenate(course, axis=1)
    _, first, alike = np.unique(
        rows.view(f"V{rows.shape[1]}").ravel(), return_index=True, return_inverse=True
    )
    return first, alike


def _walk_together(
    levels: Bytes,
    retardance: Floats,
    displayed: Bytes,
    targets: Doubles,
    taus: Doubles,
    instant_s: float,
    delays_s: Doubles,
    n_sub: int,
) -> tuple[Doubles, Doubles]:
    """Let pixels relax interval by interval, then average the light of all intervals together."""
    n_slots, n_pixels = levels.shape
    # Lengths of an instant before and after a pixel is driven, (instant of a slot, 2, pixel).
    before_s = (delays_s - np.arange(n_sub)[:, None] * instant_s).clip(0, instant_s)
    lengths_s = np.stack([before_s, instant_s - before_s], axis=1)
    # Target in each interval, (slot, 2, pixel).
    slots = np.indices((n_slots, 1))[0]
    before = np.concatenate([displayed[None], levels[:-1]])
    target = np.stack([targets[slots, before], targets[slots + 1, levels]], axis=1)
    gamma = retardance.astype(np.float64)
    steps = np.zeros((n_slots, n_sub, 2, n_pixels))
    for slot, sub, part in np.ndindex(n_slots, n_sub, 2):
        length_s = lengths_s[sub, part]
        if length_s.any():
            step = gamma - target[slot, part]
            step[np.abs(step) < SETTLED_RAD] = 0
            steps[slot, sub, part] = step
            gamma = target[slot, part] + step * np.exp(-paces(step, length_s, taus))
    swept = lengths_s * np.cos(target)[:, None]
    on_the_way = np.flatnonzero(steps)
    where, step = np.unravel_index(on_the_way, steps.shape), steps.ravel()[on_the_way]
    over, across = _relaxed_together(step, lengths_s[where[1:]], taus)
    at = target[where[0], where[2], where[3]]
    swept.ravel()[on_the_way] -= np.cos(at) * over + np.sin(at) * across
    # Rounding must not make light negative.
    light = np.maximum(0.5 - 0.5 * swept.sum(axis=2) / instant_s, 0)
    return light.reshape(-1, n_pixels), gamma


def _relaxed_together(step: Doubles, length_s: Doubles, taus: Doubles) -> tuple[Doubles, Doubles]:
    """As _relax for steps (pixel,): tau times the changes of Cin and of Si."""
    tau, rest = taus[(step >= 0).astype(np.intp)], step * np.exp(-paces(step, length_s, taus))
    both = np.stack([step, rest])
    square = both**2
    si, cin = both * _series(_SI, square), square * _series(_CIN, square)
    return tau * (cin[0] - cin[1]), tau * (si[0] - si[1])


def paces(step: Doubles | Floats, length_s: Doubles, taus: Doubles) -> Doubles:
    """Time over constant for steps: below 0 towards larger retardance, else towards smaller."""
    tau = taus[(step >= 0).astype(np.intp)]
    # Instantaneous for a time constant of 0, except over an interval of no length.
    return np.where(tau > 0, length_s / np.maximum(tau, 1e-30), np.where(length_s > 0, np.inf, 0.0))


@compiled(fastmath=True)
def _relax(
    gamma: Floats, levels: Bytes, drive: Drive, length_s: float, taus: Doubles, asked: Doubles, swept: Doubles
) -> None:
    """Take a row of pixels through an interval, and add the integrals of their cosines over it, s."""
    on = np.exp(-length_s / taus[0]) if taus[0] > 0 else 0.0
    off = np.exp(-length_s / taus[1]) if taus[1] > 0 else 0.0
    # Table look-ups in a loop of their own: the other loop then has neither indices nor branches, and is
    # vectorised.
    for u in range(gamma.size):
        level = levels[u]
        asked[0, u], asked[1, u], asked[2, u] = drive.target[level], drive.cosine[level], drive.sine[level]
    for u in range(gamma.size):
        step = gamma[u] - asked[0, u]
        up = step < 0
        rest, tau = step * (on if up else off), taus[0] if up else taus[1]
        far, near = step * step, rest * rest
        along = step * _series_of_one(_SI, far) - rest * _series_of_one(_SI, near)
        across = far * _series_of_one(_CIN, far) - near * _series_of_one(_CIN, near)
        swept[u] += asked[1, u] * (length_s - tau * across) - asked[2, u] * tau * along
        gamma[u] = asked[0, u] + rest


@compiled()
def _run(
    levels: Bytes,
    retardance: Floats,
    displayed: Bytes,
    drives: Drive,
    taus: Doubles,
    switch_at: Ints,
    early_s: Doubles,
    instant_s: float,
    leaks: Doubles,
    spans: Doubles,
    weights: Floats,
) -> None:
    """Step through the slots; a row is driven in instant ``switch_at``, ``early_s`` after its start."""
    n_slots, rows, cols = levels.shape
    n_sub = weights.shape[0] // n_slots
    swept, asked, half = np.empty(cols), np.empty((3, cols)), 0.5 / instant_s
    for slot in range(n_slots):
        old = Drive(drives.target[slot], drives.cosine[slot], drives.sine[slot])
        new = Drive(drives.target[slot + 1], drives.cosine[slot + 1], drives.sine[slot + 1])
        for v in range(rows):
            for sub in range(n_sub):
                # Lengths before and after the row is driven; one of them is usually zero.
                before_s = early_s[v] if sub == switch_at[v] else instant_s if sub < switch_at[v] else 0.0
                swept[:] = 0
                if before_s > 0:
                    _relax(retardance[v], displayed[v], old, before_s, taus, asked, swept)
                if before_s < instant_s:
                    _relax(retardance[v], levels[slot, v], new, instant_s - before_s, taus, asked, swept)
                row = weights[slot * n_sub + sub, v]
                for u in range(cols):
                    # Rounding must not make light negative.
                    row[u] = leaks[u] + spans[u] * max(0.5 - half * swept[u], 0.0)
            displayed[v] = levels[slot, v]
