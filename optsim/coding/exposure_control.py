"""Exposure control: how long a pixel is to open next, from a frame that has arrived."""

from __future__ import annotations

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import nearest
from optsim.core.quantities import Bytes, CodedFrame, Ints

# A saturated pixel gives only a bound, so its exposure falls by this factor until it measures.
_FALL = 4


def controlled_slots(calibration: Calibration, frame: CodedFrame, target_share: float) -> Ints:
    """Open slots with which each pixel's reading would meet the target: array (v, u), int64.

    The reading is proportional to the exposure, so ``slots = taken * target / reading``, at least one and at
    most the coded slots. ``taken`` are the open slots of this frame's own code: with a latency of several
    frames newer codes have been shown since. A saturated pixel gets a quarter of them. One without a
    measurement gets those of the nearest that has one: open, it would light its neighbours.

    Parameters
    ----------
    calibration : Calibration
        Reads the frame.
    frame : CodedFrame
        The newest that has arrived.
    target_share : float
        Target above black, relative to saturation.
    """
    seen = calibration.observe(frame)
    taken: Ints = np.count_nonzero(frame.code.levels, axis=0)
    target = target_share * (calibration.saturation_dn - calibration.black_dn) / calibration.responsivity_dn
    wanted = taken * target / np.maximum(seen.signal, np.finfo(np.float32).tiny)
    wanted = np.where(seen.saturated, taken / _FALL, wanted)
    slots = np.rint(np.clip(wanted, 1, calibration.coded_slots)).astype(np.int64)
    return slots[nearest(seen.valid)] if seen.valid.any() else slots


def as_levels(runs: Bytes) -> Bytes:
    """Put the slots of pixels' levels first: (v, u, slot) to (slot, v, u)."""
    return np.ascontiguousarray(np.moveaxis(runs, -1, 0))
