# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportMissingTypeStubs=false
# pyright: reportUnknownArgumentType=false, reportMissingImports=false
"""Patches per second of matching pursuit, against SPAMS (Mairal et al., JMLR 11, 2010; C++)."""

from __future__ import annotations

import os
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from optsim.progress import Progress, silent
from optsim.quantities import Floats, Ints
from optsim.reconstruct.matching_pursuit import pursue

_MEASUREMENTS = 64
_ATOMS = 20
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
    seconds, codes = _best(lambda: _ours(matrix, signals, workers))
    ours = _residuals(matrix, signals, *codes)
    peer_value: float | None = None
    difference: float | None = None
    note = "the peer is missing; it comes with the extra 'bench': pip install 'optsim[bench]'"
    try:
        import spams
    except ImportError:
        pass
    else:
        columns, atoms = np.asfortranarray(signals.T), np.asfortranarray(matrix)
        peer: Any = spams.omp
        peer_seconds, found = _best(lambda: peer(columns, atoms, L=_ATOMS, eps=0.0, numThreads=workers))
        theirs = np.linalg.norm(signals - (matrix @ found.toarray()).T, axis=1) / np.linalg.norm(
            signals, axis=1
        )
        peer_value = len(signals) / peer_seconds
        difference = float(np.abs(ours - theirs).max())
        note = "same patches, same atoms, same number of threads, best of three in the same run"
    value = len(signals) / seconds
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
    edges = np.linspace(0, len(signals), workers + 1).astype(int)
    width = matrix.shape[1]

    def run(first: int, last: int) -> None:
        gram, known = np.empty((width, width), np.float32), np.zeros(width, np.bool_)
        part = slice(first, last)
        pursue(matrix, signals[part], stop[part], gram, known, support[part], amounts[part])

    with ThreadPoolExecutor(workers) as pool:
        for done in [pool.submit(run, *ends) for ends in pairwise(edges)]:
            done.result()
    return support, amounts


def _residuals(matrix: Floats, signals: Floats, support: Ints, amounts: Floats) -> Floats:
    """Relative residual of each patch."""
    rest = signals.copy()
    for atom, amount in zip(support.T, amounts.T, strict=True):
        rest -= (amount * matrix[:, atom]).T
    return np.linalg.norm(rest, axis=1) / np.linalg.norm(signals, axis=1)


def _best(work: Any, rounds: int = 3) -> tuple[float, Any]:
    """Shortest time of a few rounds, and the last result."""
    seconds, result = np.inf, None
    for _ in range(rounds):
        start = time.perf_counter()
        result = work()
        seconds = min(seconds, time.perf_counter() - start)
    return seconds, result
