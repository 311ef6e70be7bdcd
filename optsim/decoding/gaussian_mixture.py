# pyright: reportMissingTypeStubs=false
"""Video from one coded image by a mixture of Gaussians: closed form, patch by patch."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from itertools import chain
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field
from threadpoolctl import threadpool_limits

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import nearest
from optsim.core.quantities import Bools, CodedFrame, Floats, Ints
from optsim.core.threads import n_threads
from optsim.decoding.coded_images import CodedImage, CodedImageDecoder, ImageDecoder, covered
from optsim.decoding.mixture.posterior import MeasuredMixture, measured_through, posterior
from optsim.decoding.mixture.posterior_spread import Spread
from optsim.decoding.partial import Partial
from optsim.decoding.patch_grid import add_patches, cut_patches, overlap, patch_corners
from optsim.decoding.shared_weights import shared_weights
from optsim.priors.mixture import Mixture, load_mixture, shipped_mixture
from optsim.priors.prior_file import fitted

# Patches whose videos are held at once: 256 of 8 x 8 x 36 are 2.4 MB.
_TOGETHER = 256
_BAND = 16
# Open share below which a slot counts as closed, and mean light beside the brightest patch that counts as
# none.
_NOTHING = np.float32(1e-12)
# Noise variance over squared mean light beyond which a patch has no information; it keeps float32 finite.
_NOISIEST = 1e12


class GaussianMixture(CodedImageDecoder):
    """Posterior mean over a learned Gaussian mixture, averaged over overlapping patches.

    Yang et al., IEEE Trans. Image Process. 23, 4863 (2014), doi:10.1109/TIP.2014.2344294. The same code, mask
    and handling of gain, crosstalk and saturation as :class:`SparseCoding`; no iteration.

    Parameters
    ----------
    mixture : str or None
        A mixture file, or None for the one shipped.
    single : bool
        Whether one Gaussian of the same mean and covariance replaces it: the best linear estimator.
    stride_px : int
        Distance of patches; 1 costs four times as much as 2.
    noise_gain : float
        Assumed standard deviation of the noise, relative to the predicted one; more smooths more.
    weight_tolerance : float
        Relative rms deviation of a patch's weights from those of its place in the repeated tile. Beyond it
        the patch is solved with its own weights.
    crosstalk : {"undone", "row_summed"}
        Whether the neighbours' light is removed from the image or added to the weights.
    uncertainty : bool
        Whether to predict the standard deviation of each patch's posterior by the law of total variance. It
        includes the variance outside the prior's rank and the noise of the patch's mean light. Variances are
        averaged over overlapping patches half a side apart. Their mean is that of all, and finer strides
        hardly cost more (two fifths of the time at a stride of 2, a tenth at 1). It leaves out calibration
        errors, saturated samples, patches unlike the training set, and pixels noisier than their patch.
    """

    kind: Literal["gaussian_mixture"] = "gaussian_mixture"
    mixture: str | None = None
    single: bool = False
    stride_px: int = Field(default=2, ge=1, le=8)
    noise_gain: float = Field(default=1.0, gt=0)
    weight_tolerance: float = Field(default=0.02, ge=0)
    uncertainty: bool = False

    def quick(self) -> Self:
        """Return it with every other patch."""
        return self.model_copy(update={"stride_px": max(2, self.stride_px)})

    def image_decoder(self, calibration: Calibration) -> ImageDecoder:
        """Prepare the mixture for a calibration."""
        prior = self._prior(calibration)
        spread = Spread.of(prior) if self.uncertainty else None

        def decoded(frame: CodedFrame, image: CodedImage) -> Partial:
            corners = patch_corners(frame.code.moving, prior.patch, self.stride_px)
            total, count, variance = self._painted(prior, spread, image, corners, frame)
            full = overlap(image.usable.shape, prior.patch, self.stride_px)
            return covered(frame, image, total, count, full, variance)

        return decoded

    def _prior(self, calibration: Calibration) -> Mixture:
        found = shipped_mixture() if self.mixture is None else load_mixture(Path(self.mixture))
        found = fitted(found, "mixture", calibration)
        return found.single() if self.single else found

    def _painted(
        self, prior: Mixture, spread: Spread | None, image: CodedImage, corners: Ints, frame: CodedFrame
    ) -> tuple[Floats, Floats, Floats | None]:
        """Sum of all patches over each pixel, (v, u, slot), their number, and mean of their variances."""
        size = prior.patch
        known = frame.code.moving & image.usable
        common = shared_weights(image.weights, known, corners, size, self.weight_tolerance)
        phase = common.phase
        cut = (cut_patches(each, corners, size) for each in (image.signal, image.exposure, image.variance))
        signals, exposure, variance = cut
        # In the dark the mean may be negative: the positive mean removes that without a bias.
        scale = signals.sum(axis=1) / np.maximum(exposure.sum(axis=1), _NOTHING)
        dark = _NOTHING * np.abs(scale).max(initial=0) or _NOTHING
        measured = (exposure.sum(axis=1) > _NOTHING) & (np.abs(scale) > dark)
        scale = np.where(measured, scale, dark).astype(np.float32)
        relative = signals / scale[:, None]
        mean_variance = variance.sum(axis=1) / np.maximum((exposure > 0).sum(axis=1), 1)
        noise = mean_variance * (self.noise_gain / scale.astype(np.float64)) ** 2
        noise = noise.clip(max=_NOISIEST).astype(np.float32)
        z = np.empty((len(corners), len(prior.basis)), np.float32)

        brightness = self._brightness_variance(exposure, variance, scale)
        asked = _half_apart(corners, image.usable.shape, size, self.stride_px)
        asked &= spread is not None

        def answer(measured_prior: MeasuredMixture, members: Ints) -> Floats | None:
            known = posterior(measured_prior, relative[members], noise[members])
            z[members] = known.mean()
            mine = asked[members]
            if spread is None or not mine.any():
                return None
            own = spread.variance(known.some(mine))
            own *= scale[members[mine], None] ** 2
            own += brightness[members[mine], None]
            return own

        def shared(members: Ints) -> Floats | None:
            return answer(measured_through(prior, common.weights(int(phase[members[0]]))), members)

        def alone(members: Ints) -> Floats | None:
            v, u = corners[members[0]]
            weights = image.weights[v : v + size, u : u + size].reshape(size**2, -1)
            return answer(measured_through(prior, weights), members)

        together = [np.flatnonzero(phase == n) for n in np.unique(phase[phase >= 0])]
        single = [np.array([p]) for p in np.flatnonzero(phase < 0)]
        rows, cols = image.usable.shape
        total = None if spread is None else np.zeros((rows, cols, prior.slots), np.float32)
        times = np.zeros(image.usable.shape, np.float32)
        with threadpool_limits(1), ThreadPoolExecutor(n_threads()) as pool:
            answers = chain(pool.map(shared, together), pool.map(alone, single))
            # Add in the order of the jobs, not as they finish: the same sums for any number of workers.
            for members, own in zip(chain(together, single), answers, strict=True):
                if own is not None and total is not None:
                    where = corners[members[asked[members]]]
                    _add(own, where, total, times)
            painted, count = _paint(prior, corners, z, scale, image.usable.shape, pool)
        if total is not None:
            total = _mean_everywhere(total, times)
        return painted, count, total

    def _brightness_variance(self, exposure: Floats, variance: Floats, scale: Floats) -> Floats:
        """Noise variance of each patch's mean light; a patch that was never open may equal the brightest."""
        gathered = exposure.sum(axis=1)
        noise = self.noise_gain**2 * variance.sum(axis=1) / np.maximum(gathered, _NOTHING) ** 2
        brightest = float(np.abs(scale).max(initial=0))
        return np.where(gathered > _NOTHING, noise, np.float32(brightest**2)).astype(np.float32)


def _half_apart(corners: Ints, shape: tuple[int, ...], size: int, stride: int) -> Bools:
    """Select patches half a side apart, or all if they lie farther apart, and those at the edge: (p,)."""
    step = max(1, size // 2 // stride) * stride
    return ((corners % step == 0) | (corners == np.array(shape) - size)).all(axis=1)


def _mean_everywhere(total: Floats, times: Floats) -> Floats:
    """Divide sums (v, u, slot) by their numbers (v, u); where there are none, take the nearest mean."""
    if not times.any():
        return total
    total /= np.maximum(times, 1)[:, :, None]
    if times.all():
        return total
    rows, cols = nearest(times > 0)
    return total[rows, cols]


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
            _add(videos, corners[some] - (first, 0), total, count)
        return total, count

    total, count = np.zeros((rows, cols, slots), np.float32), np.zeros((rows, cols), np.float32)
    firsts = range(0, rows, _BAND)
    # Bands are the same for any number of workers, and so is the order in which they are added.
    for first, (part, times) in zip(firsts, pool.map(band, firsts), strict=True):
        end = min(rows, first + _BAND + size)
        total[first:end] += part[: end - first]
        count[first:end] += times[: end - first]
    return total, count


def _add(videos: Floats, corners: Ints, total: Floats, count: Floats) -> None:
    """Add patches (p, pixel * slot) to sums (v, u, slot), and their number."""
    size = math.isqrt(videos.shape[1] // total.shape[2])
    once = np.ones((size, size), np.float32)
    add_patches(videos, corners, once, total)
    add_patches(np.ones((len(corners), size**2), np.float32), corners, once, count[:, :, None])
