# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""Light times weight, summed over the instants of an exposure; and the slot means that scores compare with.

Light is a segment's linear base plus moving blocks, so an exposure needs no frame per instant: the weights
are summed against the two hat functions of the segment's keys (at panel resolution), each sum multiplies
one key image, and only the blocks are walked instant by instant.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from optsim.errors import ValueCheckError
from optsim.quantities import Doubles, Floats, Video


def integrate_exposure(video: Video, first_slot: int, weights: Floats) -> Floats:
    """Radiant exposure behind the panel: the sum over instants of weight x light x duration.

    Parameters
    ----------
    video : Video
        Irradiance on the modulator, W m^-2.
    first_slot : int
        Slot of the video at which the weights begin.
    weights : ndarray of shape (t, v, u), float32
        Weight of each panel pixel in each instant.

    Returns
    -------
    ndarray of shape (y, x), float32
        Energy on the fine grid, J m^-2 (for irradiance in W m^-2).

    Raises
    ------
    ValueCheckError
        When the weights are not whole segments of the video, or of another panel.
    """
    n_instants = weights.shape[0]
    if weights.shape[1:] != video.panel_shape or n_instants % video.instants_per_slot:
        raise ValueCheckError(
            f"weights {weights.shape} do not fit a video of panel {video.panel_shape} with "
            f"{video.instants_per_slot} instants a slot; expected (slots * instants_per_slot, v, u)"
        )
    pitch = video.samples_per_pitch
    energy = np.zeros((video.rows, video.cols), np.float64)
    last_slot = first_slot + n_instants // video.instants_per_slot
    for slot, segment in video.segments(first_slot, last_slot):
        first = (slot - first_slot) * video.instants_per_slot
        part = weights[first : first + segment.n_instants]
        share = (np.arange(segment.n_instants) + 0.5) / segment.n_instants
        total = part.sum(axis=0, dtype=np.float64)
        late = np.zeros_like(total)
        for instant, a in enumerate(share):
            late += a * part[instant]
        _add_base(energy, segment.start, segment.stop, total - late, late, pitch)
        for block in segment.blocks:
            _add_block(energy, block.excess, block.row, block.col, part, pitch)
    energy *= video.slot_s / video.instants_per_slot
    return energy.astype(np.float32)


@njit(nogil=True, cache=True)
def _add_base(
    energy: Doubles, start: Floats, stop: Floats, early: Doubles, late: Doubles, pitch: int
) -> None:
    for y in range(energy.shape[0]):
        v = y // pitch
        for u in range(early.shape[1]):
            a, b = early[v, u], late[v, u]
            for x in range(u * pitch, (u + 1) * pitch):
                energy[y, x] += a * start[y, x] + b * stop[y, x]


@njit(nogil=True, cache=True)
def _add_block(energy: Doubles, excess: Floats, row: int, col: int, weights: Floats, pitch: int) -> None:
    for t in range(excess.shape[0]):
        for y in range(excess.shape[1]):
            weight = weights[t, (row + y) // pitch]
            target = energy[row + y]
            for x in range(excess.shape[2]):
                target[col + x] += weight[(col + x) // pitch] * excess[t, y, x]


def slot_means(video: Video, first_slot: int, n_slots: int) -> Floats:
    """Mean light in each slot over the full pitch cell of every panel pixel.

    Parameters
    ----------
    video : Video
        Light on the fine grid.
    first_slot, n_slots : int
        Slots wanted: whole segments of the video.

    Returns
    -------
    ndarray of shape (slot, v, u), float32
        In the unit of the video.
    """
    means = np.zeros((n_slots, *video.panel_shape), np.float64)
    pitch, n_sub = video.samples_per_pitch, video.instants_per_slot
    for slot, segment in video.segments(first_slot, first_slot + n_slots):
        start = cell_means(segment.start, pitch)
        stop = start if segment.stop is segment.start else cell_means(segment.stop, pitch)
        n = video.slots_per_segment
        for k in range(n):
            # The mean of a linear base over a slot is its value in the middle of the slot.
            a = (k + 0.5) / n
            means[slot - first_slot + k] = (1 - a) * start + a * stop
        part = means[slot - first_slot : slot - first_slot + n]
        for block in segment.blocks:
            _add_block_means(part, block.excess, block.row, block.col, pitch, n_sub)
    return means.astype(np.float32)


def cell_means(image: Floats, pitch: int) -> Doubles:
    """Mean of an image over cells of pitch x pitch samples: shape (y, x) -> (v, u), float64."""
    rows, cols = image.shape
    cells = image.reshape(rows // pitch, pitch, cols // pitch, pitch)
    return cells.sum(axis=(1, 3), dtype=np.float64) / pitch**2


@njit(nogil=True, cache=True)
def _add_block_means(means: Doubles, excess: Floats, row: int, col: int, pitch: int, n_sub: int) -> None:
    scale = 1.0 / (n_sub * pitch * pitch)
    for t in range(excess.shape[0]):
        for y in range(excess.shape[1]):
            target = means[t // n_sub, (row + y) // pitch]
            for x in range(excess.shape[2]):
                target[(col + x) // pitch] += scale * excess[t, y, x]
