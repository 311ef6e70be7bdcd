"""Random numbers: one stream a purpose, all from an experiment's one seed."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.random import Generator, SeedSequence


def stream(seed: int, *purpose: str | int) -> Generator:
    """Return an independent random stream for a purpose, whatever else is drawn.

    Parameters
    ----------
    seed : int
        The experiment's one seed.
    purpose : str or int
        For example ``"shot", "adaptive", 3``; words are hashed (CRC-32), integers taken as they are.
    """
    words = [zlib.crc32(p.encode()) if isinstance(p, str) else p for p in purpose]
    return np.random.default_rng(SeedSequence([seed, *words]))
