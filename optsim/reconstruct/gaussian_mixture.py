# pyright: reportUntypedFunctionDecorator=false, reportUnknownMemberType=false, reportMissingTypeStubs=false
"""Video from one coded image by a mixture of Gaussians: closed form, patch by patch."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

import numpy as np
from numba import njit
from pydantic import Field
from threadpoolctl import threadpool_limits

from optsim.calibrate.calibration import Calibration
from optsim.calibrate.sample import Crosstalk
from optsim.quantities import CodedFrame, Floats, Ints
from optsim.reconstruct.coded_images import CodedImage, coded_images, covered
from optsim.reconstruct.layer import Branch, Layer
from optsim.reconstruct.mixture import Mixture, load_mixture, shipped_mixture
from optsim.reconstruct.patch_codes import nominal_tile, overlap, patch_corners, phase_weights, tile_phases
from optsim.reconstruct.posterior import expected, seen_through
from optsim.reconstruct.prior_file import check_fit

# Patches whose videos are held at once: 256 of 8 x 8 x 36 are 2.4 MB.
_TOGETHER = 256
_BAND = 16
_NOTHING = np.float32(1e-12)
# Noise variance, relative to the brightness, beyond which a patch says nothing; it keeps float32 finite.
_NOISIEST = 1e12


class GaussianMixture(Branch):
    """Posterior mean over a learned mixture of Gaussians, overlapping patches averaged.

    Yang et al., IEEE Trans. Image Process. 23, 4863 (2014), doi:10.1109/TIP.2014.2344294. The same code, mask
    and handling of gain, crosstalk and saturation as :class:`SparseCoding`; no iteration.

    Parameters
    ----------
    mixture : str or None
        A mixture file, or None for the one shipped.
    single : bool
        Whether one Gaussian of the same mean and covariance stands for it: the best linear estimator.
    stride_px : int
        Distance of patches; 1 costs four times as much as 2.
    noise_gain : float
        Standard deviation of the noise taken, relative to the one predicted; more smooths more.
    tile_px : int
        Period of the code, panel pixels; patches that deviate are solved one by one.
    weight_tolerance : float
        Relative rms deviation of a patch's weights from those of its tile phase beyond which it is solved
        with its own.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    """

    kind: Literal["gaussian_mixture"] = "gaussian_mixture"
    mixture: str | None = None
    single: bool = False
    stride_px: int = Field(default=2, ge=1, le=8)
    noise_gain: float = Field(default=1.0, gt=0)
    tile_px: int = Field(default=8, ge=1, le=64)
    weight_tolerance: float = Field(default=0.02, ge=0)
    crosstalk: Crosstalk = "undone"

    def layers(self, frames: Iterable[CodedFrame], calibration: Calibration) -> Iterator[Layer]:
        """As :meth:`decode`, before negative light is clipped and with the opacity of the seam."""
        prior = self._prior(calibration)
        for frame, image in coded_images(frames, calibration, self.crosstalk):
            corners = patch_corners(frame.code.moving, prior.patch, self.stride_px)
            total, count = self._painted(prior, image, corners, frame)
            yield covered(
                frame, image, total, count, overlap(image.usable.shape, prior.patch, self.stride_px)
            )

    def _prior(self, calibration: Calibration) -> Mixture:
        found = shipped_mixture() if self.mixture is None else load_mixture(Path(self.mixture))
        check_fit(found, "mixture", calibration)
        return found.single() if self.single else found

    def _painted(
        self, prior: Mixture, image: CodedImage, corners: Ints, frame: CodedFrame
    ) -> tuple[Floats, Floats]:
        """Sum of all patches over each pixel, (v, u, slot), and how many there are."""
        size = prior.patch
        nominal = nominal_tile(image.weights, frame.code.moving & image.usable, self.tile_px)
        phase = tile_phases(image.weights, nominal, corners, size, self.weight_tolerance)
        cut = (_patches(each, corners, size) for each in (image.signal, image.exposure, image.variance))
        signals, exposure, variance = cut
        # In the dark it may come out negative: what noise leaves of a patch then is that, without a bias.
        scale = signals.sum(axis=1) / np.maximum(exposure.sum(axis=1), _NOTHING)
        scale = np.where(np.abs(scale) > _NOTHING, scale, _NOTHING).astype(np.float32)
        relative = signals / scale[:, None]
        mean_variance = variance.sum(axis=1) / np.maximum((exposure > 0).sum(axis=1), 1)
        noise = mean_variance * (self.noise_gain / scale.astype(np.float64)) ** 2
        noise = noise.clip(max=_NOISIEST).astype(np.float32)
        z = np.empty((len(corners), len(prior.basis)), np.float32)

        def shared(number: int) -> None:
            members, seen = np.flatnonzero(phase == number), phase_weights(nominal, number, size)
            z[members] = expected(seen_through(prior, seen), relative[members], noise[members])

        def alone(p: int) -> None:
            v, u = corners[p]
            weights = image.weights[v : v + size, u : u + size].reshape(size**2, -1)
            one = slice(p, p + 1)
            z[one] = expected(seen_through(prior, weights), relative[one], noise[one])

        with threadpool_limits(1), ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            jobs = [pool.submit(shared, int(n)) for n in np.unique(phase[phase >= 0])]
            jobs += [pool.submit(alone, int(p)) for p in np.flatnonzero(phase < 0)]
            for done in jobs:
                done.result()
            return _paint(prior, corners, z, scale, image.usable.shape, pool)


def _patches(image: Floats, corners: Ints, size: int) -> Floats:
    """Cut patches of an image, (v, u), to rows of an array (p, pixel)."""
    windows = np.lib.stride_tricks.sliding_window_view(image, (size, size))
    return windows[corners[:, 0], corners[:, 1]].reshape(len(corners), size**2)


def _paint(
    prior: Mixture, corners: Ints, z: Floats, scale: Floats, shape: tuple[int, ...], pool: ThreadPoolExecutor
) -> tuple[Floats, Floats]:
    """Add up the patches where they overlap: sums (v, u, slot) and how many there are, (v, u)."""
    rows, cols = shape
    size, slots = prior.patch, prior.slots
    basis, base = prior.basis.reshape(len(prior.basis), -1), prior.base.ravel()

    def band(first: int) -> tuple[Floats, Floats]:
        members = np.flatnonzero(corners[:, 0] // _BAND == first // _BAND)
        total = np.zeros((_BAND + size, cols, slots), np.float32)
        count = np.zeros((_BAND + size, cols), np.float32)
        for start in range(0, len(members), _TOGETHER):
            some = members[start : start + _TOGETHER]
            videos = (z[some] @ basis + base) * scale[some, None]
            _add(videos.reshape(-1, size, size * slots), corners[some] - (first, 0), total, count)
        return total, count

    total, count = np.zeros((rows, cols, slots), np.float32), np.zeros((rows, cols), np.float32)
    firsts = range(0, rows, _BAND)
    # Bands are the same for any number of workers, and so is the order in which they are added.
    for first, (part, times) in zip(firsts, pool.map(band, firsts), strict=True):
        end = min(rows, first + _BAND + size)
        total[first:end] += part[: end - first]
        count[first:end] += times[: end - first]
    return total, count


@njit(nogil=True, cache=True)
def _add(videos: Floats, corners: Ints, total: Floats, count: Floats) -> None:
    slots = total.shape[2]
    lines = total.reshape(total.shape[0], -1)
    patch = videos.shape[1]
    for p in range(len(corners)):
        v0, u0 = corners[p]
        for v in range(patch):
            count[v0 + v, u0 : u0 + patch] += 1
            target = lines[v0 + v, u0 * slots : (u0 + patch) * slots]
            row = videos[p, v]
            for k in range(len(target)):
                target[k] += row[k]
