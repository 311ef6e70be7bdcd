"""From a coded image to a video, patch by patch: measurement matrices, sparse codes, overlapping sums.

Everything is on the panel grid; a patch is named by its first row and column.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from optsim.core.compiled import compiled
from optsim.core.quantities import Floats, Ints
from optsim.core.threads import side_by_side
from optsim.decoding.coded_images import CodedImage
from optsim.decoding.shared_weights import SharedWeights
from optsim.decoding.sparse.matching_pursuit import pursue
from optsim.priors.dictionary import Dictionary

_STRIP = 16
# Sensible, no source: 0.08 dB better on moving photographs than no threshold, 0.4 to 0.6 are equal; it
# matters most for one shutter for all pixels, through which most atoms are invisible.
_HARDLY = 0.6
# Patches of a job: enough to share the cost of a matrix, few enough to keep all cores busy.
_OWN_BLOCK, _SHARED_BLOCK = 256, 2048


@dataclass(frozen=True, eq=False)
class PatchCoder:
    """A dictionary arranged for measuring, used for all frames of a video."""

    by_pixel: Floats  # (pixel, slot, atom): a row of a measurement matrix is a short sum of contiguous rows.
    sums: Floats  # (pixel, atom), sums over the slots, for the leak in every slot.
    atoms: Floats  # (atom, v, u, slot).

    @classmethod
    def of(cls, dictionary: Dictionary) -> PatchCoder:
        """Arrange a dictionary for measuring."""
        n_atoms, _, _, slots = dictionary.atoms.shape
        flat = dictionary.atoms.reshape(n_atoms, -1, slots)
        by_pixel = np.ascontiguousarray(np.moveaxis(flat, 0, -1))
        return cls(by_pixel, by_pixel.sum(axis=1), dictionary.atoms)

    def encode(
        self,
        image: CodedImage,
        corners: Ints,
        shared: SharedWeights,
        *,
        cap: int,
        noise_gain: float,
    ) -> tuple[Ints, Floats]:
        """Sparse codes of the patches at ``corners``; those that share their weights share one matrix."""
        patch = self.atoms.shape[1]
        support = np.empty((len(corners), cap), np.int64)
        amounts = np.empty((len(corners), cap), np.float32)

        def run(number: int, members: Ints) -> None:
            signals, stop = _gather(image.signal, image.variance, corners[members], patch)
            stop *= np.float32(noise_gain**2)
            codes = np.empty((len(members), cap), np.int64), np.empty((len(members), cap), np.float32)
            if number < 0:
                _encode_own(self.by_pixel, self.sums, image.weights, corners[members], signals, stop, *codes)
            else:
                _encode_shared(self.by_pixel, self.sums, shared.weights(number), signals, stop, *codes)
            support[members], amounts[members] = codes

        jobs: list[tuple[int, Ints]] = []
        for number in np.unique(shared.phase):
            members = np.flatnonzero(shared.phase == number)
            block = _OWN_BLOCK if number < 0 else _SHARED_BLOCK
            jobs += [(number, members[first : first + block]) for first in range(0, len(members), block)]
        side_by_side(lambda n=int(n), members=members: run(n, members) for n, members in jobs)
        return support, amounts

    def paint(
        self, corners: Ints, support: Ints, amounts: Floats, shape: tuple[int, int]
    ) -> tuple[Floats, Floats]:
        """Add up the patches where they overlap."""
        total = np.zeros((*shape, self.atoms.shape[3]), np.float32)
        count = np.zeros(shape, np.float32)

        def run(first: int) -> None:
            _paint(self.atoms, corners, support, amounts, first, min(first + _STRIP, shape[0]), total, count)

        # Strips share no pixel and each pixel adds its patches in raster order: same sums for any workers.
        side_by_side(lambda first=first: run(first) for first in range(0, shape[0], _STRIP))
        return total, count


@compiled()
def _gather(signal: Floats, variance: Floats, corners: Ints, patch: int) -> tuple[Floats, Floats]:
    """Signals of shape (p, pixel) and the expected squared noise of each."""
    n = len(corners)
    signals = np.empty((n, patch * patch), np.float32)
    noise = np.zeros(n, np.float32)
    for p in range(n):
        v0, u0 = corners[p]
        for v in range(patch):
            for u in range(patch):
                signals[p, v * patch + u] = signal[v0 + v, u0 + u]
                noise[p] += variance[v0 + v, u0 + u]
    return signals, noise


@compiled(fastmath={"reassoc", "contract", "nsz"})
def measurement_matrix(
    by_pixel: Floats, sums: Floats, weights: Floats, matrix: Floats, lengths: Floats
) -> None:
    """Measured atoms for weights of shape (pixel, slot), as unit columns and their lengths."""
    lengths[:] = 0
    for m in range(weights.shape[0]):
        row = matrix[m]
        # Most slots have the same weight (the leak of a dark panel): they cost one row.
        least = weights[m].min()
        for k in range(len(row)):
            row[k] = least * sums[m, k]
        floor = least + np.float32(1e-5) * weights[m].max()
        for t in range(weights.shape[1]):
            if weights[m, t] > floor:
                extra = weights[m, t] - least
                atoms = by_pixel[m, t]
                for k in range(len(row)):
                    row[k] += extra * atoms[k]
        for k in range(len(row)):
            lengths[k] += row[k] * row[k]
    for k in range(len(lengths)):
        lengths[k] = np.sqrt(lengths[k])
    # Hardly measured atoms, zero columns: noise and the residual of others would be amplified.
    least_length = np.float32(_HARDLY) * np.median(lengths)
    for k in range(len(lengths)):
        if lengths[k] < least_length or lengths[k] == 0:
            lengths[k] = np.float32(np.inf)
    for m in range(weights.shape[0]):
        row = matrix[m]
        for k in range(len(row)):
            row[k] /= lengths[k]


@compiled()
def _rescale(support: Ints, amounts: Floats, lengths: Floats) -> None:
    for p in range(support.shape[0]):
        for j in range(support.shape[1]):
            if support[p, j] >= 0:
                amounts[p, j] /= lengths[support[p, j]]


@compiled()
def _encode_shared(
    by_pixel: Floats,
    sums: Floats,
    weights: Floats,
    signals: Floats,
    stop: Floats,
    support: Ints,
    amounts: Floats,
) -> None:
    width = sums.shape[1]
    matrix, lengths = np.empty(sums.shape, np.float32), np.empty(width, np.float32)
    measurement_matrix(by_pixel, sums, weights, matrix, lengths)
    pursue(matrix, signals, stop, support, amounts)
    _rescale(support, amounts, lengths)


@compiled()
def _encode_own(
    by_pixel: Floats,
    sums: Floats,
    weights: Floats,
    corners: Ints,
    signals: Floats,
    stop: Floats,
    support: Ints,
    amounts: Floats,
) -> None:
    width = sums.shape[1]
    patch = int(np.sqrt(sums.shape[0]))
    matrix, lengths = np.empty(sums.shape, np.float32), np.empty(width, np.float32)
    own = np.empty((patch * patch, weights.shape[2]), np.float32)
    for p in range(len(corners)):
        v0, u0 = corners[p]
        for v in range(patch):
            own[v * patch : (v + 1) * patch] = weights[v0 + v, u0 : u0 + patch]
        measurement_matrix(by_pixel, sums, own, matrix, lengths)
        one = slice(p, p + 1)
        pursue(matrix, signals[one], stop[one], support[one], amounts[one])
        _rescale(support[one], amounts[one], lengths)


@compiled(fastmath={"contract"})
def _paint(
    atoms: Floats,
    corners: Ints,
    support: Ints,
    amounts: Floats,
    first: int,
    last: int,
    total: Floats,
    count: Floats,
) -> None:
    """Add the rows first .. last - 1 of all patches."""
    _, patch, _, slots = atoms.shape
    flat = atoms.reshape(atoms.shape[0], patch, patch * slots)
    lines = total.reshape(total.shape[0], -1)
    for p in range(len(corners)):
        v0, u0 = corners[p]
        for v in range(max(first, v0), min(last, v0 + patch)):
            count[v, u0 : u0 + patch] += 1
            target = lines[v, u0 * slots : (u0 + patch) * slots]
            for j in range(support.shape[1]):
                if support[p, j] < 0:
                    break
                amount = amounts[p, j]
                row = flat[support[p, j], v - v0]
                for k in range(len(target)):
                    target[k] += amount * row[k]
