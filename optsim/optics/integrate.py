"""Light times weight, summed over the instants of an exposure; and the slot means that scores compare with.

Light is a segment's linear base plus moving blocks, so an exposure needs no frame per instant: the weights
are summed against the two hat functions of the segment's keys (at panel resolution), each sum multiplies
one key image, and only the blocks are walked instant by instant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optsim.core.compiled import FEW, compiled
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Doubles, Floats, PanelState, Segment, Video
from optsim.core.threads import in_bands
from optsim.optics.fringe_correction import FringeCorrection, fine_weights, relaxed
from optsim.optics.fringing import fine_image


@dataclass(frozen=True, eq=False)
class Shutter:
    """What a panel lets through during an exposure.

    Parameters
    ----------
    weights : ndarray of shape (t, v, u), float32
        Of each panel pixel in each instant.
    borders : ndarray of shape (samples_per_pitch, 3), float64
        Shares of the neighbours' weights in the fine samples of a pixel, from
        :func:`optsim.optics.fringing.border_shares`; beyond the panel's edge the nearest pixel counts.
    fringe_correction : FringeCorrection, optional
        Where these shares are not enough: what the weights of fine samples follow from.
    """

    weights: Floats
    borders: Doubles
    fringe_correction: FringeCorrection | None = None


def integrate_exposure(video: Video, first_slot: int, shutter: Shutter) -> Floats:
    """Radiant exposure behind the panel: the sum over instants of weight x light x duration.

    Parameters
    ----------
    video : Video
        Irradiance on the modulator, W m^-2.
    first_slot : int
        Slot of the video at which the weights begin.
    shutter : Shutter
        What the panel lets through.

    Returns
    -------
    ndarray of shape (y, x), float32
        Energy on the fine grid, J m^-2 (for irradiance in W m^-2).

    Raises
    ------
    ValueCheckError
        When the weights are not whole segments of the video, or of another panel.
    """
    weights, fringe = shutter.weights, shutter.fringe_correction
    n_instants = weights.shape[0]
    if weights.shape[1:] != video.panel_shape or n_instants % video.instants_per_slot:
        raise ValueCheckError(
            f"weights {weights.shape} do not fit a video of panel {video.panel_shape} with "
            f"{video.instants_per_slot} instants a slot; expected (slots * instants_per_slot, v, u)"
        )
    energy = np.zeros((video.rows, video.cols), np.float64)
    last_slot = first_slot + n_instants // video.instants_per_slot
    panel = fringe.start if fringe else None
    for slot, segment in video.segments(first_slot, last_slot):
        first = slot - first_slot
        open_weights = weights[first * video.instants_per_slot :][: segment.n_instants]
        if fringe is None or panel is None:
            _add_segment(energy, segment, open_weights, shutter.borders)
        elif not (segment.blocks or segment.start.any() or segment.stop.any()):
            panel = relaxed(fringe, panel, first, min(first + video.slots_per_segment, len(fringe.levels)))
        elif first < len(fringe.levels):
            # After the last coded slot the shutter is closed.
            open_weights = open_weights[: (len(fringe.levels) - first) * video.instants_per_slot]
            panel = _fine_segment(energy, fringe, segment, open_weights, panel, first)
    energy *= video.slot_s / video.instants_per_slot
    return energy.astype(np.float32)


def _add_segment(energy: Doubles, segment: Segment, weights: Floats, shares: Doubles) -> None:
    if weights.size < FEW:
        _add_small_segment(energy, segment, weights, shares)
        return
    early, late = np.zeros(weights.shape[1:]), np.zeros(weights.shape[1:])

    def sums(first: int, end: int) -> None:
        _hat_sums(weights[:, first:end], early[first:end], late[first:end])

    def light(top: int, bottom: int) -> None:
        _add_base(energy, top, bottom, segment.start, segment.stop, early, late, shares)
        for block in segment.blocks:
            _add_block(energy, top, bottom, block.excess, block.row, block.col, weights, shares)

    in_bands(len(early), sums)
    in_bands(len(energy), light)


def _add_small_segment(energy: Doubles, segment: Segment, weights: Floats, shares: Doubles) -> None:
    rising = (np.arange(segment.n_instants) + 0.5) / segment.n_instants
    for line, key in ((1 - rising, segment.start), (rising, segment.stop)):
        energy += fine_image(np.tensordot(line, weights, 1), shares) * key
    pitch = len(shares)
    for block in segment.blocks:
        _, height, width = block.excess.shape
        row, col = (max(at // pitch - 1, 0) for at in (block.row, block.col))
        # Pixels that the block touches and their neighbours; all instants at a time.
        end, last = (at // pitch + 2 for at in (block.row + height - 1, block.col + width - 1))
        near = np.moveaxis(weights[:, row:end, col:last], 0, -1).astype(np.float64)
        down, across = block.row - row * pitch, block.col - col * pitch
        cells = fine_image(near, shares)[down : down + height, across : across + width]
        window = np.s_[block.row : block.row + height, block.col : block.col + width]
        energy[window] += np.einsum("yxt,tyx->yx", cells, block.excess)


def _fine_segment(
    energy: Doubles,
    fringe: FringeCorrection,
    segment: Segment,
    weights: Floats,
    panel: PanelState,
    first: int,
) -> PanelState:
    """Add a segment's first instants, with the fringe correction; return the panel after them."""
    n, pitch = len(weights), fringe.pitch
    rising = (np.arange(n, dtype=np.float64) + 0.5) / segment.n_instants
    lines = [(1 - rising, segment.start), (rising, segment.stop)]
    if segment.stop is segment.start:
        lines = [(np.ones(n), segment.start)]
    moving = np.zeros(weights.shape[1:], np.bool_)
    for block in segment.blocks:
        _, tall, wide = block.excess.shape
        down, across = ((at, at + size + pitch - 1) for at, size in ((block.row, tall), (block.col, wide)))
        moving[slice(*(at // pitch for at in down)), slice(*(at // pitch for at in across))] = True

    add_products = _add_few_products if weights.size < FEW else _add_products

    def add(sums: Floats, cells: Floats, top: int) -> None:
        height = sums.shape[1]
        for of_key, (_, key) in zip(sums, lines, strict=True):
            energy[top : top + height] += of_key * key[top : top + height]
        for block in segment.blocks:
            above, below = max(block.row, top), min(block.row + block.excess.shape[1], top + height)
            if above < below:
                add_products(energy, above, below, block.excess, block.row, block.col, cells, top)

    keys = np.stack([line for line, _ in lines]).astype(np.float32)
    return fine_weights(fringe, weights, keys, moving, add, panel, first)


def _add_few_products(
    energy: Doubles, above: int, below: int, excess: Floats, row: int, col: int, cells: Floats, top: int
) -> None:
    """As :func:`_add_products`, all rows at a time."""
    columns = slice(col, col + excess.shape[2])
    light, opened = (
        excess[: len(cells), above - row : below - row],
        cells[:, above - top : below - top, columns],
    )
    energy[above:below, columns] += np.einsum("tyx,tyx->yx", light, opened, dtype=np.float64)


# Whole arrays, whose rows are dense, and unsigned places: so this becomes vector code.
@compiled(fastmath=True)
def _add_products(
    energy: Doubles, above: int, below: int, excess: Floats, row: int, col: int, cells: Floats, top: int
) -> None:
    """Add a block's light in the rows from above to below, through cells whose first row is ``top``."""
    left = np.uint64(col)
    for y in range(above, below):
        for t in range(len(cells)):
            for x in range(np.uint64(excess.shape[2])):
                energy[y, left + x] += cells[t, y - top, left + x] * excess[t, y - row, x]


@compiled()
def _hat_sums(weights: Floats, early: Doubles, late: Doubles) -> None:
    """Sum the weights against the falling and the rising line of a segment."""
    n, rows, cols = weights.shape
    for t in range(n):
        share = (t + 0.5) / n
        for v in range(rows):
            for u in range(cols):
                late[v, u] += share * weights[t, v, u]
                early[v, u] += (1 - share) * weights[t, v, u]


@compiled()
def _fine_row(image: Floats | Doubles, y: int, shares: Doubles, first: int, fine: Doubles) -> None:
    """Fine row y of panel values, with the neighbours' shares; ``fine`` begins at panel column ``first``."""
    rows, cols = image.shape
    pitch = shares.shape[0]
    v, part = y // pitch, shares[y % pitch]
    above, below = max(v - 1, 0), min(v + 1, rows - 1)
    u = max(first - 1, 0)
    before = own = part[0] * image[above, u] + part[1] * image[v, u] + part[2] * image[below, u]
    if u < first:
        own = part[0] * image[above, first] + part[1] * image[v, first] + part[2] * image[below, first]
    for cell in range(fine.size // pitch):
        u = min(first + cell + 1, cols - 1)
        after = part[0] * image[above, u] + part[1] * image[v, u] + part[2] * image[below, u]
        for k in range(pitch):
            fine[cell * pitch + k] = shares[k, 0] * before + shares[k, 1] * own + shares[k, 2] * after
        before, own = own, after


@compiled()
def _add_base(
    energy: Doubles,
    top: int,
    bottom: int,
    start: Floats,
    stop: Floats,
    early: Doubles,
    late: Doubles,
    shares: Doubles,
) -> None:
    """Add the base to the rows from top to bottom."""
    width = energy.shape[1]
    first, then = np.empty(width), np.empty(width)
    for y in range(top, bottom):
        _fine_row(early, y, shares, 0, first)
        _fine_row(late, y, shares, 0, then)
        for x in range(width):
            energy[y, x] += first[x] * start[y, x] + then[x] * stop[y, x]


@compiled()
def _add_block(
    energy: Doubles,
    top: int,
    bottom: int,
    excess: Floats,
    row: int,
    col: int,
    weights: Floats,
    shares: Doubles,
) -> None:
    """Add a block to the rows from top to bottom, as far as it has any."""
    pitch = shares.shape[0]
    n, height, width = excess.shape
    first = col // pitch
    fine = np.empty(((col + width - 1) // pitch + 1 - first) * pitch)
    shift = col - first * pitch
    for t in range(n):
        for y in range(max(row, top), min(row + height, bottom)):
            _fine_row(weights[t], y, shares, first, fine)
            for x in range(width):
                energy[y, col + x] += fine[shift + x] * excess[t, y - row, x]


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


def cell_means(image: NDArray[np.floating], pitch: int) -> Doubles:
    """Mean of an image over cells of pitch x pitch samples: shape (y, x) -> (v, u), float64."""
    total = np.zeros((image.shape[0] // pitch, image.shape[1] // pitch))
    # Ten times as fast as one sum over two short axes.
    for y in range(pitch):
        for x in range(pitch):
            total += image[y::pitch, x::pitch]
    return total / pitch**2


@compiled()
def _add_block_means(means: Doubles, excess: Floats, row: int, col: int, pitch: int, n_sub: int) -> None:
    scale = 1.0 / (n_sub * pitch * pitch)
    for t in range(excess.shape[0]):
        for y in range(excess.shape[1]):
            target = means[t // n_sub, (row + y) // pitch]
            for x in range(excess.shape[2]):
                target[(col + x) // pitch] += scale * excess[t, y, x]
