# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportMissingTypeStubs=false
# pyright: reportUnknownArgumentType=false, reportMissingImports=false
"""Patches per second of matching pursuit, against SPAMS (Mairal et al., JMLR 11, 2010; C++)."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats, Ints
from optsim.decoding.sparse.matching_pursuit import pursue

_MEASUREMENTS = 64
_ATOMS = 20
_ROUNDS = 5
# Patches of a job, as the decoder hands them to its threads: enough to share what a matrix costs.
_BLOCK = 512
_PATCHES = {2000: 16_384, 5000: 8192, 10_000: 4096}


def measure(name: str, _: Progress = silent) -> dict[str, Any]:
    """Code random patches over a random dictionary measured by a tile-periodic code.

    Parameters
    ----------
    name : str
        ``omp.k<atoms of the dictionary>``.
    """
    width = int(name.removeprefix("omp.k"))
    rng = np.random.default_rng(width)
    matrix, signals = _problem(rng, width, _PATCHES[width])
    workers = os.cpu_count() or 1
    _ours(matrix, signals[:64], workers)
    rounds: list[Callable[[], Any]] = [lambda: _ours(matrix, signals, workers)]
    unit = matrix
    note = "the peer is missing; it comes with the extra 'benchmark': pip install 'optsim[benchmark]'"
    exact: Any = None
    try:
        import spams
    except ImportError:
        pass
    else:
        columns, atoms = np.asfortranarray(signals.T), np.asfortranarray(matrix)
        peer: Any = spams.omp
        rounds.append(lambda: peer(columns, atoms, L=_ATOMS, eps=0.0, numThreads=workers))
        # Not timed: in single precision SPAMS loses a tie of 1e-7 in some 10 000 patches, and in double one
        # as fine as the lengths of atoms in single precision, which it takes for 1.
        unit = matrix / np.linalg.norm(matrix.astype(float), axis=0)
        exact = peer(columns.astype(float), np.asfortranarray(unit), L=_ATOMS, eps=0.0, numThreads=workers)
        note = (
            f"same patches, atoms and threads, in turn, best of {_ROUNDS}; residuals against SPAMS in double"
        )
    seconds, codes = _in_turn(rounds)
    value, peer_value, difference = len(signals) / seconds[0], None, None
    if exact is not None:
        peer_value = len(signals) / seconds[1]
        theirs = np.linalg.norm(signals - (unit @ exact.toarray()).T, axis=1)
        ours = _residuals(matrix, signals, *codes[0])
        difference = float(np.abs(ours - theirs / np.linalg.norm(signals, axis=1)).max())
    return {
        "name": name,
        "value": value,
        "unit": "patches/s",
        "peer": "SPAMS omp",
        "peer_value": peer_value,
        "ratio": value / peer_value if peer_value else None,
        "conditions": {
            "measurements": _MEASUREMENTS,
            "atoms": _ATOMS,
            "dictionary": width,
            "patches": len(signals),
            "threads": workers,
            "max_rel_residual_diff": difference,
            # Of a plain product of the matrix with a vector for each atom picked.
            "gflop_s_per_thread": 2e-9 * _MEASUREMENTS * width * _ATOMS * value / workers,
            "note": note,
        },
    }


def _problem(rng: np.random.Generator, width: int, n: int) -> tuple[Floats, Floats]:
    """Smooth random atoms seen through one phase of a tile of bumps, and noisy sparse mixtures of them."""
    slots, bump = 36, 3
    starts = rng.permutation(np.rint(np.linspace(0, slots - bump, _MEASUREMENTS)).astype(int))
    atoms = np.cumsum(rng.standard_normal((slots, _MEASUREMENTS, width)).astype(np.float32), axis=0)
    rows = np.stack([atoms[first : first + bump, m].sum(axis=0) for m, first in enumerate(starts)])
    matrix = np.ascontiguousarray(rows / np.linalg.norm(rows, axis=0), np.float32)
    codes = rng.standard_normal((n, width)).astype(np.float32) * (rng.random((n, width)) < _ATOMS / width)
    signals = codes @ matrix.T + 0.1 * rng.standard_normal((n, _MEASUREMENTS))
    return matrix, signals.astype(np.float32)


def _ours(matrix: Floats, signals: Floats, workers: int) -> tuple[Ints, Floats]:
    support = np.empty((len(signals), _ATOMS), np.int64)
    amounts = np.empty((len(signals), _ATOMS), np.float32)
    stop = np.zeros(len(signals), np.float32)

    def run(first: int) -> None:
        part = slice(first, first + _BLOCK)
        pursue(matrix, signals[part], stop[part], support[part], amounts[part])

    with ThreadPoolExecutor(workers) as pool:
        for done in [pool.submit(run, first) for first in range(0, len(signals), _BLOCK)]:
            done.result()
    return support, amounts


def _residuals(matrix: Floats, signals: Floats, support: Ints, amounts: Floats) -> Floats:
    """Relative residual of each patch."""
    rest = signals.copy()
    for atom, amount in zip(support.T, amounts.T, strict=True):
        rest -= (amount * matrix[:, atom]).T
    return np.linalg.norm(rest, axis=1) / np.linalg.norm(signals, axis=1)


def _in_turn(works: Sequence[Callable[[], Any]]) -> tuple[list[float], list[Any]]:
    """Shortest time of each work, done one after the other for some rounds, and its last result."""
    seconds, results = [np.inf] * len(works), [None] * len(works)
    for _ in range(_ROUNDS):
        for k, work in enumerate(works):
            start = time.perf_counter()
            results[k] = work()
            seconds[k] = min(seconds[k], time.perf_counter() - start)
    return seconds, results
