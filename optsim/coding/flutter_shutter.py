"""Flutter shutter (Raskar et al.): all pixels open and close together by one binary code."""

from __future__ import annotations

from functools import lru_cache
from typing import ClassVar, Literal

import numpy as np

from optsim.coding.periodic import OPEN, PeriodicScheme
from optsim.core.errors import ConfigError
from optsim.core.quantities import Bools, Bytes

# With fewer slots the spectrum of every code has a zero.
_FEWEST = 6
# Length of the padded code, in codes: from 16 slots on the spectrum falls by at most 1 % between two
# frequencies.
_PADDING = 32
# Starting codes of the search: twice as many gain nothing at 28, 36 and 52 slots.
_STARTS = 64
# Frequencies at which exchanges are tried first; this affects only the run time.
_WEAKEST = 96


class FlutterShutter(PeriodicScheme):
    """All pixels equal: half of the coded slots are open, so that motion blur loses no frequency.

    Raskar, Agrawal and Tumblin, "Coded exposure photography: motion deblurring using fluttered shutter", ACM
    Trans. Graph. 25(3), 795 (SIGGRAPH 2006, doi:10.1145/1141911.1141957). Their criterion: among codes with
    half of the chops open, the one whose spectrum, padded with zeros, has the largest minimum. They published
    one of 52 chops from a random search. :func:`flutter_code` finds one for the coded slots, independent of
    the seed. It is the same in every frame. In the coded strobing of Veeraraghavan, Reddy and Raskar (IEEE
    Trans. PAMI 33, 671, 2011) the code continues over frames instead.
    """

    TEMPORAL: ClassVar[bool] = True
    kind: Literal["flutter_shutter"] = "flutter_shutter"

    def tiles(self, slots: int, coded_slots: int, rng: np.random.Generator) -> Bytes:
        """One pixel, the same in all frames.

        Raises
        ------
        ConfigError
            When there are too few coded slots to choose among.
        """
        del rng
        if coded_slots < _FEWEST:
            raise ConfigError(
                f"flutter_shutter: got {coded_slots} coded slots, expected at least {_FEWEST} to choose a "
                "code from; raise camera.slots_per_frame, or take normal_photography"
            )
        levels = np.zeros((1, slots, 1, 1), np.uint8)
        levels[0, :coded_slots, 0, 0] = flutter_code(coded_slots) * np.uint8(OPEN)
        return levels


@lru_cache
def flutter_code(n: int) -> Bools:
    """Choose the code of n chops, n // 2 of them open, the first and last among them."""
    chop = np.arange(n)
    waves = np.exp(-2j * np.pi * np.outer(chop, np.arange(_PADDING * n // 2 + 1)) / (_PADDING * n))
    golden = (np.sqrt(5) - 1) / 2
    codes: list[tuple[float, Bools]] = []
    # Each start opens the chops where a chirp, whose spectrum is flat, is lowest. Then an open and a closed
    # chop are exchanged, the pair that raises the spectrum's minimum most, until none raises it.
    for start in range(1, _STARTS + 1):
        code = np.zeros(n, np.bool_)
        code[[0, -1]] = True
        lowest = np.argsort(np.mod(chop[1:-1] ** 2 * start * golden / n, 1), kind="stable")
        code[1 + lowest[: n // 2 - 2]] = True
        codes.append(_ascended(code, waves))
    return max(codes, key=lambda found: found[0])[1]


def _ascended(code: Bools, waves: np.ndarray) -> tuple[float, Bools]:
    """Minimum magnitude and code, after the exchanges that raise the minimum most."""
    while True:
        spectrum = waves[code].sum(axis=0)
        enough = np.abs(spectrum).min() * (1 + 1e-9)
        opened, closed = 1 + np.flatnonzero(code[1:-1]), np.flatnonzero(~code)
        # Most exchanges leave one of the weakest frequencies weak. Only the others need the whole spectrum.
        weak = np.abs(spectrum).argsort()[:_WEAKEST]
        there = spectrum[weak] - waves[opened][:, weak][:, None] + waves[closed][:, weak]
        i, j = np.nonzero(np.abs(there).min(axis=2) > enough)
        found = np.abs(spectrum - waves[opened[i]] + waves[closed[j]]).min(axis=1)
        if found.max(initial=0) <= enough:
            return float(enough), code
        best = int(found.argmax())
        code = code.copy()
        code[[opened[i[best]], closed[j[best]]]] = False, True
