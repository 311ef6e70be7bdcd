"""What a run that was stopped has made, in its folder: the same command goes on after the last whole frame.

Coded frames are kept with the state in which they leave the panel. Of what was decoded only the scores are:
they are small, and all that a report asks of any frame but the last ones.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any, cast

import numpy as np

from optsim.calibration.choice import BENCH_FILE
from optsim.core.cache import hash_of
from optsim.core.code_hash import hash_files
from optsim.core.quantities import CodedFrame, ExposureCode, PanelState
from optsim.experiment.experiment import Experiment
from optsim.experiment.truth import truth_content
from optsim.footage.truth import content_hash
from optsim.metrics import FrameTally, PairTally, UncertaintyTally
from optsim.priors.checkpoint import Checkpoint

Shot = tuple[CodedFrame, PanelState]
_SHOT = ("dn", "negative_light", "retardance_rad", "levels", "slots_shown")
_TALLY, _SPREAD, _PAIR = (
    tuple(f.name for f in fields(kind) if f.name not in ("method", "index"))
    for kind in (FrameTally, UncertaintyTally, PairTally)
)


@dataclass(frozen=True, eq=False)
class FrameScores:
    """Tallies of one coded frame of all methods, in the methods' order.

    Parameters
    ----------
    tallies : list of FrameTally
        One a method.
    spreads : list of UncertaintyTally or None
        One a method, None for those that state no uncertainty.
    pairs : list of PairTally or None
        One a method, None for those that aren't set beside the adaptive one.
    """

    tallies: list[FrameTally]
    spreads: list[UncertaintyTally | None]
    pairs: list[PairTally | None]


@dataclass(frozen=True)
class Journal:
    """Keeps each coded frame, and the scores of each, as soon as it is there.

    Parameters
    ----------
    folder : Path or None
        Where; None keeps nothing.
    key : str
        Of the run (:func:`run_key`); what another key wrote is as good as absent.
    """

    folder: Path | None
    key: str

    def shot(self, method: str, index: int, code: ExposureCode, take: Callable[[], Shot]) -> Shot:
        """Recall a coded frame and the panel after it, or take and keep them."""
        page = self._page("shot", index, method)
        found = page.read(*_SHOT)
        if found is None:
            frame, panel = take()
            page.write(
                index,
                dn=frame.dn,
                negative_light=frame.negative_light,
                retardance_rad=panel.retardance_rad,
                levels=panel.levels,
                slots_shown=panel.slots_shown,
            )
            return frame, panel
        dn, negative_light, retardance_rad, levels, slots_shown = found[1]
        frame = CodedFrame(index, dn, code, int(negative_light))
        return frame, PanelState(retardance_rad, levels, int(slots_shown))

    def n_shots(self, methods: Sequence[str]) -> int:
        """Count the coded frames, from the first on, that all methods have taken."""
        done = 0
        while all(self._page("shot", done, method).read() is not None for method in methods):
            done += 1
        return done

    def keep_scores(self, index: int, scores: FrameScores) -> None:
        """Keep what a coded frame of all methods scored."""
        arrays: dict[str, Any] = {}
        of_methods = zip(scores.tallies, scores.spreads, scores.pairs, strict=True)
        for place, (tally, spread, pair) in enumerate(of_methods):
            arrays |= {f"{place}.tally.{name}": getattr(tally, name) for name in _TALLY}
            # Empty stands for none, so that all frames hold the same names.
            arrays |= {f"{place}.spread.{name}": getattr(spread, name, np.empty(0)) for name in _SPREAD}
            arrays |= {f"{place}.pair.{name}": getattr(pair, name, np.empty(0)) for name in _PAIR}
        self._page("scores", index).write(index, **arrays)

    def scores(self, methods: Sequence[str]) -> list[FrameScores]:
        """Recall the scores of the coded frames, from the first on, as far as they go."""
        found: list[FrameScores] = []
        while (scores := self._scores(len(found), methods)) is not None:
            found.append(scores)
        return found

    def _scores(self, index: int, methods: Sequence[str]) -> FrameScores | None:
        kinds = (("tally", _TALLY), ("spread", _SPREAD), ("pair", _PAIR))
        places = range(len(methods))
        names = [f"{place}.{kind}.{name}" for place in places for kind, each in kinds for name in each]
        kept = self._page("scores", index).read(*names)
        if kept is None:
            return None
        found, arrays = FrameScores([], [], []), iter(kept[1])
        for method in methods:
            tally, spread, pair = (list(islice(arrays, len(each))) for _, each in kinds)
            found.tallies.append(FrameTally(method, index, *tally))
            stated, paired = (all(array.size for array in each) for each in (spread, pair))
            found.spreads.append(UncertaintyTally(method, index, *spread) if stated else None)
            found.pairs.append(PairTally(method, index, *pair) if paired else None)
        return found

    def close(self) -> None:
        """Forget everything: the run is done."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _page(self, *place: str | int) -> Checkpoint:
        if self.folder is None:
            return Checkpoint(None, "")
        name = "-".join(f"{p:06d}" if isinstance(p, int) else p for p in place)
        return Checkpoint(self.folder / f"{name}.npz", hash_of(self.key, place))


NOTHING_KEPT = Journal(None, "")


def run_key(experiment: Experiment, *further: object) -> str:
    """Hash of what decides the numbers of a run, its code and the content of its files included.

    Parameters
    ----------
    experiment : Experiment
        What is run; files that it names, priors for example, count by their content.
    *further : object
        What else decides the numbers, anything JSON can say: renderer, versions of libraries.
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
        # Most strings are no names of files, and some cannot be.
        with suppress(OSError, RuntimeError, ValueError):
            named = Path(value).expanduser()
            # The record of a bench stands for the images beside it.
            files = sorted(named.parent.iterdir()) if named.name == BENCH_FILE else [named]
            return [content_hash(each) for each in files if each.is_file()]
    return []
