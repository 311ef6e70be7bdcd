"""The walk of a panel's pixels through the slots of a code: retardance relaxes, light is averaged.

The closed form is that of :mod:`optsim.forward.panel`, with Si and Cin from its table. Many pixels walk one
by one in a compiled loop, few of them all together: loading the loop would take longer.
"""

from __future__ import annotations

import numpy as np

from optsim.forward.bands import in_bands
from optsim.forward.compiled import FEW, compiled
from optsim.quantities import Bytes, Doubles, Floats, Ints

TABLE_CELLS = 4096
# Nearer than this to its target a pixel stays there: it changes a weight by less than 1e-14.
_SETTLED_RAD = 1e-7


def walk(
    levels: Bytes,
    retardance: Floats,
    shown: Bytes,
    targets: Doubles,
    taus: Doubles,
    turn: Ints,
    early_s: Doubles,
    instant_s: float,
    leaks: Doubles,
    spans: Doubles,
    table: Doubles,
    weights: Floats,
) -> None:
    """Fill the weights of a code's instants, and bring the panel to where the last slot ends.

    Parameters
    ----------
    levels : ndarray of shape (slot, v, u), uint8
        Drive levels.
    retardance, shown : ndarray of shape (v, u), float32 and uint8
        Of the panel when the first slot begins, rad, and the level that it shows then; changed in place.
    targets : ndarray of shape (slot + 1, 256), float64
        Retardance that each level asks for in the slot before the first, and in each slot, rad.
    taus : ndarray of shape (2,), float64
        Time constants towards larger and towards smaller retardance, s.
    turn, early_s : ndarray of shape (v,), int64 and float64
        Instant of a slot in which each row turns to the slot's level, and how long after its start, s.
    instant_s : float
        Duration of an instant, s.
    leaks, spans : ndarray of shape (u,), float64
        Weight of a dark pixel, and what a retardance of pi adds to it.
    table : ndarray of shape (TABLE_CELLS + 1, 2), float64
        Si and Cin from 0 to 2 pi.
    weights : ndarray of shape (slot * instants_per_slot, v, u), float32
        Filled.
    """
    if weights.size < FEW:
        _walk_together(
            levels, retardance, shown, targets, taus, turn * instant_s + early_s, instant_s, leaks, spans,
            table, weights,
        )  # fmt: skip
        return

    def band(first: int, end: int) -> None:
        part = slice(first, end)
        _run(
            levels[:, part], retardance[part], shown[part], targets, np.cos(targets), np.sin(targets), taus,
            turn[part], early_s[part], instant_s, leaks, spans, table, weights[:, part],
        )  # fmt: skip

    in_bands(len(shown), band)


def _walk_together(
    levels: Bytes,
    retardance: Floats,
    shown: Bytes,
    targets: Doubles,
    taus: Doubles,
    delays_s: Doubles,
    instant_s: float,
    leaks: Doubles,
    spans: Doubles,
    table: Doubles,
    weights: Floats,
) -> None:
    """Take all pixels through an instant at a time."""
    n_sub = len(weights) // len(levels)
    cosines, sines = np.cos(targets), np.sin(targets)
    # Lengths of an instant before and after each row's turn, (instant of a slot, v, u).
    before_s = (delays_s[:, None] - np.arange(n_sub)[:, None, None] * instant_s).clip(0, instant_s)
    before_s = np.broadcast_to(before_s, (n_sub, *shown.shape))
    gamma = retardance.ravel()
    for slot, new in enumerate(levels):
        for sub in range(n_sub):
            swept = np.zeros(gamma.shape)
            for level, at, length_s in (
                (shown.ravel(), slot, before_s[sub].ravel()),
                (new.ravel(), slot + 1, instant_s - before_s[sub].ravel()),
            ):
                if not length_s.any():
                    continue
                cosine, step = cosines[at, level], gamma - targets[at, level]
                part = cosine * length_s
                on_the_way = np.flatnonzero(np.abs(step) >= _SETTLED_RAD)
                some, step = level[on_the_way], step[on_the_way]
                rest, over, across = _relax_together(step, length_s[on_the_way], taus, table)
                gamma[on_the_way] = targets[at, some] + rest
                part[on_the_way] -= cosine[on_the_way] * over + sines[at, some] * across
                swept += part
            # Dark is dark: the table's error must not make light negative.
            light = np.maximum(0.5 - 0.5 * swept / instant_s, 0).reshape(shown.shape)
            weights[slot * n_sub + sub] = leaks + spans * light
        shown[:] = new
    retardance[:] = gamma.reshape(retardance.shape)


def _relax_together(
    step: Doubles, length_s: Doubles, taus: Doubles, table: Doubles
) -> tuple[Doubles, Doubles, Doubles]:
    """As _relax for steps (pixel,): what is left of them, and tau times the changes of Cin and of Si."""
    tau, rest = taus[(step >= 0).astype(np.intp)], step * np.exp(-paces(step, length_s, taus))
    size = np.abs(np.concatenate([step, rest])) * (TABLE_CELLS / (2 * np.pi))
    cell = np.minimum(size.astype(np.intp), TABLE_CELLS - 1)
    low = table[cell]
    found = low + (size - cell)[:, None] * (table[cell + 1] - low)
    si, cin = (found[: len(step)] - found[len(step) :]).T
    return rest, tau * cin, tau * np.sign(step) * si


def paces(step: Doubles | Floats, length_s: Doubles, taus: Doubles) -> Doubles:
    """Time over constant for steps: below 0 towards larger retardance, else towards smaller."""
    tau = taus[(step >= 0).astype(np.intp)]
    # At once, where a time constant is nothing; but not in no time.
    return np.where(tau > 0, length_s / np.maximum(tau, 1e-30), np.where(length_s > 0, np.inf, 0.0))


@compiled()
def _relax(
    gamma: float,
    target: float,
    cosine: float,
    sine: float,
    length_s: float,
    decays: tuple[float, float],
    taus: Doubles,
    table: Doubles,
) -> tuple[float, float]:
    """Retardance after an interval, and the integral of its cosine over it, s."""
    step = gamma - target
    if abs(step) < _SETTLED_RAD:
        return gamma, cosine * length_s
    side = 0 if step < 0 else 1
    rest = step * decays[side]
    si_step, cin_step = _look_up(abs(step), table)
    si_rest, cin_rest = _look_up(abs(rest), table)
    si = si_step - si_rest if step > 0 else si_rest - si_step
    return target + rest, cosine * (length_s - taus[side] * (cin_step - cin_rest)) - sine * taus[side] * si


@compiled()
def _look_up(size: float, table: Doubles) -> tuple[float, float]:
    place = size * (TABLE_CELLS / (2 * np.pi))
    cell = min(int(place), TABLE_CELLS - 1)
    part = place - cell
    si = table[cell, 0] + part * (table[cell + 1, 0] - table[cell, 0])
    return si, table[cell, 1] + part * (table[cell + 1, 1] - table[cell, 1])


@compiled()
def _decays(length_s: float, taus: Doubles) -> tuple[float, float]:
    on = np.exp(-length_s / taus[0]) if taus[0] > 0 else 0.0
    return on, np.exp(-length_s / taus[1]) if taus[1] > 0 else 0.0


@compiled()
def _run(
    levels: Bytes,
    retardance: Floats,
    shown: Bytes,
    targets: Doubles,
    cosines: Doubles,
    sines: Doubles,
    taus: Doubles,
    turn: Ints,
    early_s: Doubles,
    instant_s: float,
    leaks: Doubles,
    spans: Doubles,
    table: Doubles,
    weights: Floats,
) -> None:
    """Walk through the slots; a row's turn comes in instant ``turn``, ``early_s`` after its start."""
    n_slots, rows, cols = levels.shape
    n_sub = weights.shape[0] // n_slots
    whole = _decays(instant_s, taus)
    for slot in range(n_slots):
        for v in range(rows):
            split = _decays(early_s[v], taus), _decays(instant_s - early_s[v], taus)
            for sub in range(n_sub):
                row = weights[slot * n_sub + sub, v]
                # Lengths before and after the row's turn, of which one is usually nothing.
                if sub == turn[v]:
                    first_s, then_s, first, then = early_s[v], instant_s - early_s[v], split[0], split[1]
                elif sub < turn[v]:
                    first_s, then_s, first, then = instant_s, 0.0, whole, whole
                else:
                    first_s, then_s, first, then = 0.0, instant_s, whole, whole
                for u in range(cols):
                    gamma, cosine = float(retardance[v, u]), 0.0
                    if first_s > 0:
                        old = shown[v, u]
                        gamma, cosine = _relax(
                            gamma, targets[slot, old], cosines[slot, old], sines[slot, old],
                            first_s, first, taus, table,
                        )  # fmt: skip
                    if then_s > 0:
                        new = levels[slot, v, u]
                        gamma, after = _relax(
                            gamma, targets[slot + 1, new], cosines[slot + 1, new], sines[slot + 1, new],
                            then_s, then, taus, table,
                        )  # fmt: skip
                        cosine += after
                    retardance[v, u] = gamma
                    # Dark is dark: the table's error must not make light negative.
                    row[u] = leaks[u] + spans[u] * max(0.5 - 0.5 * cosine / instant_s, 0.0)
            for u in range(cols):
                shown[v, u] = levels[slot, v, u]
