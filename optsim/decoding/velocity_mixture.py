# pyright: reportMissingTypeStubs=false
"""Video from one coded image: textures that move, one Gaussian a velocity, weighted by their evidence."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field
from threadpoolctl import threadpool_limits

from optsim.calibration.calibration import Calibration
from optsim.core.quantities import Bools, CodedFrame, Floats, Ints
from optsim.core.threads import side_by_side
from optsim.decoding.coded_images import CodedImage, CodedImageDecoder, ImageDecoder, covered
from optsim.decoding.mixture.moving_textures import (
    TIMES_SLOTS,
    Component,
    Posterior,
    Windows,
    likelihoods,
    posterior,
)
from optsim.decoding.partial import Partial
from optsim.decoding.patch_grid import add_patches, cut_patches, overlap, patch_corners
from optsim.decoding.shared_weights import followed_tile, places, weights_at

# Speeds, panel pixels a slot, and directions of each: about as dense as a window of 12 tells apart.
_RINGS = (
    *((0.05, 6), (0.1, 8), (0.2, 12), (0.35, 14), (0.55, 16)),
    *((0.8, 18), (1.1, 20), (1.5, 22), (2.0, 24), (2.7, 28)),
)
# Relative rms deviation of a pixel's weights from the tile's beyond which they are another code's.
_DEVIATING = 0.25
_LEAST_MEASURED, _LEAST_ALIKE = 0.2, 0.1  # of a window's pixels: any sample, and one like the tile's
_BEST = 2  # velocities of a window with weights of its own
# Weights below this share of a pixel's largest are gathered in so many slots.
_LEAK, _LEAK_SLOTS = 0.03, 4
_LONG = 8  # slots of an exposure that are taken one by one
_BLOCK = 2048  # windows of a job
_TINY = np.float32(1e-12)


class VelocityMixture(CodedImageDecoder):
    """Posterior mean over textures that translate, each with one of some hundred velocities.

    In a window the light of two pixels in two slots has the covariance ``exp(-|dx - v dt| / length -
    |dt| / time)``, and a free mean. Each velocity ``v`` and coherence time is a Gaussian. Its evidence for
    the window's samples, with the scale integrated out, is its weight in the mean. Nothing is trained, and
    any code can be decoded; a code without a period takes much longer. Whole windows are averaged, weighted
    by a squared triangle. Where another code begins, velocities come from the pixels of the periodic tile,
    and the light from all. A window with more noise than texture takes every fourth velocity.

    Parameters
    ----------
    window_px, stride_px : int
        Side of a window, and distance of windows, panel pixels.
    fastest : float
        Largest speed, panel pixels a slot.
    noise_gain : float
        Assumed standard deviation of the noise, relative to the predicted one; more smooths more.
    uncertainty : bool
        Whether to predict the standard deviation of each window's posterior by the law of total variance, and
        average the variances over overlapping windows. It leaves out calibration errors, samples that are
        missing, and light unlike the Gaussians'. It takes as long again.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    """

    kind: Literal["velocity_mixture"] = "velocity_mixture"
    window_px: int = Field(default=12, ge=6, le=16)
    stride_px: int = Field(default=4, ge=1, le=8)
    fastest: float = Field(default=2.7, ge=0, le=2.7)
    noise_gain: float = Field(default=1.0, gt=0)
    uncertainty: bool = False

    def image_decoder(self, calibration: Calibration) -> ImageDecoder:
        """Prepare for the frames of a calibration."""
        size = min(self.window_px, *calibration.shape)
        components = _components(self.fastest)
        at_first = [component for component in components if component[2] == TIMES_SLOTS[0]]
        still = _components(0)

        def decoded(frame: CodedFrame, image: CodedImage) -> Partial:
            corners = _corners(frame.code.moving, size, self.stride_px)
            tile, follows = followed_tile(image.weights, frame.code.moving & image.usable, _DEVIATING)
            exposure = np.maximum(image.exposure, _TINY)
            means = (image.signal / exposure).astype(np.float32)
            unit = np.float32(np.abs(means).max(initial=0) or 1)
            means /= unit
            noise = (image.variance / np.square(exposure * unit)).astype(np.float32)
            # Wide gaps repeat their nearest sample.
            windows = Windows(
                cut_patches(means, corners, size),
                cut_patches(noise, corners, size),
                cut_patches(image.exposure > 0, corners, size),
            )
            like_tile = replace(windows, measured=cut_patches(follows & image.usable, corners, size))
            strange: Bools = np.asarray((windows.measured & ~like_tile.measured).any(axis=1))
            enough = windows.measured.mean(axis=1) >= _LEAST_MEASURED
            alike = like_tile.measured.mean(axis=1) >= _LEAST_ALIKE
            place = places(corners, tile.shape[:2])
            moves: dict[int, list[Component]] = {}

            def search(members: Ints) -> None:
                """Find velocities by the pixels like the tile."""
                weights = _sparse(weights_at(tile, int(place[members[0]]), size))
                shares = likelihoods(weights, like_tile.some(members), at_first, self.noise_gain)
                for m, share in zip(members.tolist(), shares.T, strict=True):
                    best: list[int] = np.argsort(-share, kind="stable")[:_BEST].tolist()
                    found = [at_first[k] for k in best if share[k] > 0]
                    moves[m] = [(v, u, time) for time in TIMES_SLOTS for v, u, _ in found]

            def solve(members: Ints) -> Posterior:
                m = int(members[0])
                if strange[m]:
                    v, u = corners[m]
                    weights = image.weights[v : v + size, u : u + size].reshape(size**2, -1)
                    some, chosen = windows.some(members), moves.get(m, still)
                else:
                    weights = weights_at(tile, int(place[m]), size)
                    some, chosen = like_tile.some(members), components
                return posterior(_sparse(weights), some, chosen, self.noise_gain, spread=self.uncertainty)

            def blocks(chosen: Bools) -> list[Ints]:
                """Divide windows into jobs that share weights."""
                found: list[Ints] = []
                for each in np.unique(place[chosen]):
                    members = np.flatnonzero(chosen & (place == each))
                    found += [members[k : k + _BLOCK] for k in range(0, len(members), _BLOCK)]
                return found

            with threadpool_limits(1):
                side_by_side(lambda m=m: search(m) for m in blocks(enough & strange & alike))
                jobs: list[Ints] = [*blocks(enough & ~strange), *np.flatnonzero(enough & strange)[:, None]]
                answers = side_by_side(lambda m=m: solve(m) for m in jobs)
            canvas = _Canvas.of(image.weights, self.uncertainty)
            for members, found in zip(jobs, answers, strict=True):
                canvas.add(corners[members], found, windows.measured[members])
            full = overlap(image.usable.shape, size, self.stride_px, _triangle(size))
            canvas.brighten(unit)
            partial = covered(frame, image, canvas.total, canvas.count, full, canvas.variance)
            return replace(partial, held_out=canvas.held_out() * unit**2)

        return decoded


@dataclass(frozen=True, eq=False)
class _Canvas:
    """Windows summed over the image, by a squared triangle."""

    total: Floats
    count: Floats
    errors: Floats
    times: Floats
    variance: Floats | None

    @classmethod
    def of(cls, weights: Floats, spread: bool) -> _Canvas:
        """Start an empty one for an image of such weights, (v, u, slot)."""
        total, flat = np.zeros_like(weights), np.zeros_like(weights[:, :, 0])
        return cls(total, flat, flat.copy(), flat.copy(), total.copy() if spread else None)

    def add(self, corners: Ints, found: Posterior, measured: Bools) -> None:
        """Add windows."""
        taper = _triangle(math.isqrt(measured.shape[1]))
        once, square = np.outer(taper, taper), np.outer(taper, taper) ** 2
        there = measured.astype(np.float32)
        add_patches(found.videos, corners, once, self.total)
        add_patches(np.ones_like(there), corners, once, self.count[:, :, None])
        add_patches(np.square(found.residuals), corners, square, self.errors[:, :, None])
        add_patches(there, corners, square, self.times[:, :, None])
        if self.variance is not None and found.variances is not None:
            add_patches(found.variances, corners, once, self.variance)

    def brighten(self, unit: np.float32) -> None:
        """Convert sums to a unit of light, and summed variances to means."""
        self.total[:] *= unit
        if self.variance is not None:
            self.variance[:] *= unit**2 / np.maximum(self.count, _TINY)[:, :, None]

    def held_out(self) -> Floats:
        """Squared residual of each sample; NaN without one."""
        found = np.full_like(self.errors, np.nan)
        np.divide(self.errors, self.times, out=found, where=self.times > 0)
        return found


def _components(fastest: float) -> list[Component]:
    velocities = [(0.0, 0.0)]
    for speed, n in _RINGS:
        if speed <= fastest:
            angles = 2 * np.pi * np.arange(n) / n
            velocities += [(speed * float(np.sin(a)), speed * float(np.cos(a))) for a in angles]
    return [(*velocity, time) for time in TIMES_SLOTS for velocity in velocities]


def _sparse(weights: Floats) -> Floats:
    """Divide weights by their sum, with leaks and long exposures in fewer slots: (p, slot)."""
    # What never opens in the tile counts as not measured: any weights do.
    weights = np.where(weights.any(axis=1, keepdims=True), weights, np.float32(1))
    small = weights < _LEAK * weights.max(axis=1, keepdims=True)
    found = np.where(small, 0, weights)
    slots = weights.shape[1]
    # A long exposure is one of every third slot.
    long = (found > 0).sum(axis=1) > _LONG
    for first in range(0, slots, 3):
        part = found[long, first : first + 3]
        found[long, first : first + 3] = 0
        found[long, min(first + 1, slots - 1)] = part.sum(axis=1)
    parts = min(_LEAK_SLOTS, slots)
    edges = [slots * part // parts for part in range(parts + 1)]
    for first, end in pairwise(edges):
        found[:, (first + end) // 2] += (weights * small)[:, first:end].sum(axis=1)
    return found / np.maximum(found.sum(axis=1, keepdims=True), _TINY)


def _corners(moving: Bools, size: int, stride: int) -> Ints:
    """First rows and columns of the windows whose middle half, or at the edge any part, touches a mask."""
    corners = patch_corners(moving, size, stride)
    middle = np.zeros((size, size), bool)
    middle[size // 4 : size - size // 4, size // 4 : size - size // 4] = True
    inside = cut_patches(moving, corners, size)[:, middle.ravel()].any(axis=1)
    at_edge = ((corners == 0) | (corners == np.array(moving.shape) - size)).any(axis=1)
    return corners[inside | at_edge]


def _triangle(size: int) -> Floats:
    """Weights along a side of a window."""
    return np.square(np.minimum(np.arange(1, size + 1), np.arange(size, 0, -1))).astype(np.float32)
