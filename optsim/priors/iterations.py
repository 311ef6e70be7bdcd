"""Iterations whose states are kept in a cache: a stop loses one iteration at most."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from optsim.core.cache import Arrays, Cache, hash_of
from optsim.core.code_hash import hash_files
from optsim.core.progress import Progress, silent
from optsim.core.quantities import Floats

# Another code learns otherwise: its states are no start.
_CODE = ("optsim/priors/*.py",)


def iterate(
    step: Callable[[Arrays], Arrays],
    state: Arrays,
    iterations: int,
    *,
    key: str = "",
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Arrays:
    """Iterate from a state, or continue after the last state in the cache."""
    cache = None if checkpoint is None else Cache(checkpoint)
    keys = [hash_of("iteration", key, number) for number in range(iterations)]
    done = 0 if cache is None else cache.n_first(keys)
    if cache is not None and done:
        # Arrays in memory instead of on disk.
        state = {name: np.array(array) for name, array in cache.read(keys[done - 1]).items()}
    progress("train", done, iterations)
    for number in range(done, iterations):
        state = step(state)
        if cache is not None:
            cache.get(keys[number], lambda made=state: made)
        progress("train", number + 1, iterations)
    return state


def learning_key(signals: Floats, *settings: object) -> str:
    """Hash of training numbers of any shape, and of settings that JSON can express."""
    content = hashlib.sha256(np.ascontiguousarray(signals).reshape(-1).data).hexdigest()
    return hash_of(content, signals.shape, *settings, hash_files(_CODE))
