"""Resume: results of a stopped run, so that the same command continues after the last whole frame.

Coded frames are stored with the state of the panel after them. Decoded frames are stored as scores only:
these are small, and a report needs more of the last frames alone. All lie in a cache in the run's folder,
under a hash of what determines the numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.calibration.choice import BENCH_FILE
from optsim.core.cache import Arrays, Cache, hash_of
from optsim.core.code_hash import hash_files
from optsim.core.files import content_hash
from optsim.core.quantities import CodedFrame, ExposureCode, PanelState
from optsim.experiment.experiment import Experiment
from optsim.experiment.truth import truth_content
from optsim.metrics import ClassTally, FrameTally, PairTally, UncertaintyTally

UNFINISHED = "unfinished"
"""Folder in a run's, of what is kept for a resume; gone when the run is done."""
FrameScores = list[FrameTally | UncertaintyTally | PairTally | ClassTally]
"""Tallies of one coded frame of all methods; of uncertainty, pairs and classes only where there are any."""
_KINDS = {kind.__name__: kind for kind in (FrameTally, UncertaintyTally, PairTally, ClassTally)}


def unfinished(folder: Path, key: str) -> Cache:
    """Open a folder's results of the run with this key; those of another key count as absent."""
    return Cache(folder / UNFINISHED / key, math.inf)


def cached_shot(
    cache: Cache | None,
    method: str,
    index: int,
    code: ExposureCode,
    take: Callable[[], tuple[CodedFrame, PanelState]],
) -> tuple[CodedFrame, PanelState]:
    """Read a coded frame and the panel after it, or take and store them."""
    if cache is None:
        return take()

    def arrays() -> Arrays:
        frame, panel = take()
        return {
            "dn": frame.dn,
            "negative_light": np.asarray(frame.negative_light),
            "retardance_rad": panel.retardance_rad,
            "levels": panel.levels,
            "slots_displayed": np.asarray(panel.slots_displayed),
        }

    # In memory: the folder is deleted when the run is done.
    found = {name: np.array(array) for name, array in cache.get(_shot_key(method, index), arrays).items()}
    frame = CodedFrame(index, found["dn"], code, int(found["negative_light"]))
    return frame, PanelState(found["retardance_rad"], found["levels"], int(found["slots_displayed"]))


def n_shots(cache: Cache, methods: Sequence[str]) -> int:
    """Count the coded frames, from the first on, that all methods have taken."""
    return cache.n_first(_shot_key(method, index) for index in count() for method in methods) // len(methods)


def keep_scores(cache: Cache, methods: Sequence[str], index: int, scores: FrameScores) -> None:
    """Store the scores of a coded frame of all methods."""
    arrays = {
        f"{methods.index(tally.method)}.{type(tally).__name__}.{name}": np.asarray(value)
        for tally in scores
        for name, value in vars(tally).items()
        if name not in ("method", "index")
    }
    cache.get(_scores_key(methods, index), lambda: arrays)


def cached_scores(cache: Cache, methods: Sequence[str]) -> list[FrameScores]:
    """Read the stored scores of consecutive coded frames, from the first on."""
    n = cache.n_first(_scores_key(methods, index) for index in count())
    return [_scores(cache.read(_scores_key(methods, index)), methods, index) for index in range(n)]


def _scores(arrays: Arrays, methods: Sequence[str], index: int) -> FrameScores:
    tallies: dict[tuple[int, str], dict[str, Any]] = {}
    for path, array in arrays.items():
        place, kind, name = path.split(".")
        tallies.setdefault((int(place), kind), {})[name] = np.array(array)
    return [_KINDS[kind](methods[at], index, **sums) for (at, kind), sums in sorted(tallies.items())]


def _shot_key(method: str, index: int) -> str:
    return hash_of("shot", method, index)


def _scores_key(methods: Sequence[str], index: int) -> str:
    return hash_of("scores", list(methods), index)


def run_key(experiment: Experiment, *further: object) -> str:
    """Hash all that determines the numbers of a run, its code and the content of its files included.

    Parameters
    ----------
    experiment : Experiment
        The experiment; files that it names, priors for example, count by their content.
    *further : object
        Further inputs that JSON can express: renderer, versions of libraries.
    """
    resolved = experiment.model_dump(mode="json")
    named, truth = _named_files(resolved), truth_content(experiment)
    code = hash_files(["optsim/**/*.py", "optsim/**/*.npz"])
    return hash_of(resolved, named, truth, code, *further)


def _named_files(value: object) -> list[str]:
    """Hashes of the files named anywhere in an experiment."""
    if isinstance(value, dict):
        return [found for each in cast("dict[str, object]", value).values() for found in _named_files(each)]
    if isinstance(value, list):
        return [found for each in cast("list[object]", value) for found in _named_files(each)]
    if isinstance(value, str):
        # Most strings are no file names, and some cannot be.
        with suppress(OSError, RuntimeError, ValueError):
            named = Path(value).expanduser()
            # The record of a bench represents the images beside it.
            files = sorted(named.parent.iterdir()) if named.name == BENCH_FILE else [named]
            return [content_hash(each) for each in files if each.is_file()]
    return []
