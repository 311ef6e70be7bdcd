# pyright: reportMissingTypeStubs=false
"""Irradiance of pixels that saturate in every frame, estimated from their glare far away.

It gains the adaptive scheme 0.8 dB in ``night_street`` while frames still merge, and 0.8 stops of a bright
window; the static mosaic loses 0.6 dB by it there (``reports/fidelity.md``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import DemixedFrame, predicted_variance
from optsim.core.quantities import Bools, Doubles, Floats

# Most regions with separate factors, and their least pixels: glare of smaller ones is lost in errors of the
# rest. Standard deviation between their factors. Sensible defaults, no source.
_REGIONS, _LEAST_PX, _UNLIKE = 4, 16, 0.5
# Least explained signal for glare to be accepted, standard deviations: of noise, and of errors that are alike
# within blocks of so many pixels.
_SIGMAS, _SIGMAS_OF_BLOCKS, _BLOCK_PX = 4.0, 3.0, 16
# Residual relative error of the glare: calibrations leave up to 8 % (tests/test_laboratory.py).
_ERROR = 0.1
# Share of its neighbours' light that a pixel may get unknown to the calibration, one standard deviation. So
# dark pixels show glare best. A sensible default, no source.
_MISPLACED = 0.2
# Share of the kernel beyond which the kernel, not glare, gives a neighbour's light.
_NEAR = 1e-4


def estimate_by_glare(
    calibration: Calibration,
    samples: Sequence[DemixedFrame],
    alive: Sequence[Bools],
    usable: Sequence[Bools],
    mean: Floats,
    light: Floats,
    hidden: Bools,
    *,
    apart: bool,
) -> tuple[Floats, Doubles]:
    """Estimate by what factor hidden regions exceed the assumed light, and the error by their glare.

    Glare of a saturated region arrives everywhere while the region's own code is open, whatever the code at
    the receiving pixel. Over a few frames with different codes it differs from local light. Its amount is a
    linear unknown beside the irradiance of every pixel: weighted least squares over all pixels and frames.
    (M. Rouf and others, "Glare encoding of high dynamic range images", CVPR 2011, recover highlights from the
    glare of a star filter.)
    """
    # Estimates beside saturation haven't converged yet and would dominate the fit.
    bright = np.logical_or.reduce([ok & s.valid & s.saturated for s, ok in zip(samples, alive, strict=True)])
    far = calibration.spread(bright[None].astype(np.float32))[0] <= _NEAR
    light_here = np.maximum(mean, 0)
    typical = float(np.mean([s.exposure.mean() for s in samples]))
    # Crosstalk that the calibration misses, from neighbours open for long, resembles glare.
    misplaced = (_MISPLACED * typical * light_here) ** 2
    known = [
        np.where(ok, 1 / (predicted_variance(calibration, s.exposure, light_here) + misplaced), 0)
        for s, ok in zip(samples, usable, strict=True)
    ]
    frames = [(s, ok, c * far) for s, ok, c in zip(samples, alive, known, strict=True)]
    certainty = sum((c * s.exposure**2 for s, c in zip(samples, known, strict=True)), np.zeros(mean.shape))

    def merged(images: Sequence[Floats | Doubles]) -> Doubles:
        """Merge additional light of each frame to irradiance."""
        top = np.zeros(mean.shape)
        for sample, c, image in zip(samples, known, images, strict=True):
            top += c * sample.exposure * image
        return np.divide(top, certainty, out=np.zeros_like(top), where=certainty > 0)

    def glare(of: Bools) -> list[Floats]:
        return [
            calibration.mix_far(np.where(of & ok, light * s.exposure, 0).astype(np.float32))
            for s, ok, _ in frames
        ]

    def errors(images: Sequence[Floats | Doubles]) -> Doubles:
        """Residual of light in each frame that no irradiance explains, in standard deviations, as one row."""
        alike = merged(images)
        parts = zip(frames, images, strict=True)
        return np.concatenate([(np.sqrt(c) * (g - alike * s.exposure)).ravel() for (s, _, c), g in parts])

    # One factor for all hidden pixels, and each region's deviation from it.
    all_hidden = glare(hidden)
    parts = [hidden, *(_regions(np.where(hidden, light, 0)) if apart else [])]
    terms = np.stack([errors(all_hidden), *(errors(glare(part)) for part in parts[1:])], axis=1)
    unexplained = errors([s.signal - mean * s.exposure for s, _, _ in frames])
    precision = np.array([0.0, *[_UNLIKE**-2] * len(parts[1:])])
    gain = terms.T @ unexplained
    change = np.linalg.lstsq(terms.T @ terms + np.diag(precision), gain)[0]
    factor = np.ones(mean.shape, np.float32)
    explained = terms @ change
    votes = _by_block(explained * (unexplained - explained), mean.shape)
    if change @ gain > max(_SIGMAS**2, _SIGMAS_OF_BLOCKS * float(np.sqrt((votes**2).sum()))):
        for part, more in zip(parts, change, strict=True):
            factor[part] += np.float32(more)
    factor = np.where(hidden, np.maximum(factor, _darkest(samples, alive, light)), 1)
    return factor, _ERROR * merged(all_hidden)


def _by_block(values: Doubles, shape: tuple[int, ...]) -> Doubles:
    """Sum values of all frames, (frame x v x u,), over blocks of the panel."""
    # Edges off their place leave residuals that resemble glare, in a few places. The error is that of sums
    # over blocks (K.-Y. Liang and S. L. Zeger, Biometrika 73, 13, 1986).
    image = values.reshape(-1, *shape).sum(axis=0)
    rows, cols = (np.arange(0, side, _BLOCK_PX) for side in shape)
    return np.add.reduceat(np.add.reduceat(image, rows, axis=0), cols, axis=1)


def _regions(light: Floats) -> list[Bools]:
    """List connected regions of light, in falling order of their light."""
    from scipy import ndimage

    label = cast("Callable[..., tuple[Doubles, int]]", ndimage.label)
    labels, n = label(light > 0)
    total = np.bincount(labels.ravel().astype(np.int64), weights=light.ravel(), minlength=n + 1)
    size = np.bincount(labels.ravel().astype(np.int64), minlength=n + 1)
    brightest = [k for k in np.argsort(total)[::-1] if k > 0 and size[k] >= _LEAST_PX]
    return [labels == k for k in brightest[:_REGIONS]]


def _darkest(samples: Sequence[DemixedFrame], alive: Sequence[Bools], light: Floats) -> Floats:
    """Least factors, (v, u): those of pixels that just saturate among others of equal light."""
    uniform = np.zeros(light.shape, np.float32)
    for sample, ok in zip(samples, alive, strict=True):
        uniform = np.where(ok & sample.saturated, np.maximum(uniform, sample.uniform), uniform)
    return np.minimum(uniform / np.maximum(light, np.float32(1e-30)), 1)
