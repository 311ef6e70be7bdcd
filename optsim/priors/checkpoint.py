"""Where learning has come to, in a file: what a stop would lose otherwise."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim import __version__
from optsim.core.cache import hash_of
from optsim.core.errors import StorageError
from optsim.core.files import atomic
from optsim.core.foreign.npz import npz_array
from optsim.core.quantities import Floats

_STEP, _KEY = "step", "key"


@dataclass(frozen=True)
class Checkpoint:
    """The state after an iteration, and a hash of everything that decided it.

    Parameters
    ----------
    path : Path or None
        An .npz file, replaced as a whole: an interrupted write leaves the one before. None: nothing is kept.
    key : str
        Hash of everything that decides the state; what another key wrote is as good as absent.
    """

    path: Path | None
    key: str

    def read(self, *names: str) -> tuple[int, list[NDArray[Any]]] | None:
        """Return the iterations done and the named arrays after them; None if there are none of ours."""
        if self.path is None:
            return None
        # None yet, or none that can be read: then it is made again, which costs time only.
        if not self.path.is_file():
            return None
        try:
            if str(npz_array(self.path, _KEY)) != self.key:
                return None
            return int(npz_array(self.path, _STEP)), [npz_array(self.path, name) for name in names]
        except (StorageError, ValueError, TypeError):
            return None

    def write(self, step: int, **state: Any) -> None:
        """Keep the state after ``step`` iterations instead of the one before.

        Raises
        ------
        StorageError
            When the file cannot be written.
        """
        if self.path is None:
            return
        about: dict[str, Any] = {_STEP: step, _KEY: self.key}
        with atomic(self.path) as temporary, temporary.open("wb") as stream:
            np.savez(stream, **about, **state)


def open_checkpoint(path: Path | None, signals: Floats, *settings: object) -> Checkpoint:
    """Checkpoint of what is learned from very these numbers, of any shape, with these settings.

    Parameters
    ----------
    path : Path or None
        Its file; None keeps nothing.
    signals : ndarray
        What is learned from: other footage, another seed or another way to draw patches are other numbers.
    *settings : object
        The rest, anything JSON can say.
    """
    if path is None:
        return Checkpoint(None, "")
    content = hashlib.sha256(np.ascontiguousarray(signals).reshape(-1).data).hexdigest()
    return Checkpoint(path, hash_of(content, signals.shape, *settings, __version__))


def checkpoint_path(out: Path) -> Path:
    """Where the state of learning ``out`` is kept: ``mine.partial.npz`` beside ``mine.npz``."""
    return out.with_suffix(".partial.npz")
