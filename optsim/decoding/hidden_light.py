# pyright: reportMissingTypeStubs=false
"""How bright what saturates in every frame is: its glare, far away, tells.

Worth 0.8 dB to the adaptive scheme in ``night_street`` while frames still merge, and 0.8 stops of a bright
window; the steady mosaic loses 0.6 dB by it there (``reports/fidelity.md``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from optsim.calibration.calibration import Calibration
from optsim.calibration.demixed import DemixedFrame, predicted_variance
from optsim.core.quantities import Bools, Doubles, Floats

# So many regions are told apart at most, of so many pixels at least: the glare of less is lost in errors of
# the rest. By so much, one standard deviation, do their factors differ. Sensible defaults, no source.
_REGIONS, _LEAST_PX, _UNLIKE = 4, 16, 0.5
# What a glare must explain to be believed, standard deviations of noise.
_SIGMAS = 4.0
# What is left of a glare's error: calibrations leave up to 8 % (tests/test_laboratory.py).
_ERROR = 0.1
# Share of its neighbours' light that a pixel may get unknown to the calibration, one standard deviation: so
# what is dark tells of glare. A sensible default, no source.
_MISPLACED = 0.2
# Share of the kernel beyond which a neighbour is told by the kernel, not by glare.
_NEAR = 1e-4


def told_by_glare(
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
    """Find by what factor hidden regions are brighter than assumed, and how well their glare is known.

    Light of a saturated region arrives everywhere, for as long as the region's own code lets it through,
    whatever the code of the place where it arrives. So over a few frames with different codes it does not
    look like light of that place, and its amount is a linear unknown beside the irradiance of every pixel:
    weighted least squares over all pixels and frames. (Glare has told the brightness of highlights before,
    that of a star filter: M. Rouf and others, "Glare encoding of high dynamic range images", CVPR 2011.)

    Parameters
    ----------
    calibration : Calibration
        Holds the glare.
    samples, alive, usable
        As of :func:`~optsim.decoding.joint_merge.solved_together`; separated with the assumed light.
    mean : ndarray of shape (v, u), float32
        Merged irradiance, W m^-2.
    light : ndarray of shape (v, u), float32
        Assumed of what is hidden, W m^-2.
    hidden : ndarray of shape (v, u), bool
        Pixels that saturate in every frame.
    apart : bool
        Whether regions may differ, or there is one factor for all.

    Returns
    -------
    factor : ndarray of shape (v, u), float32
        By which to multiply that light; 1 where nothing is known better.
    error : ndarray of shape (v, u), float64
        Standard deviation of the merged irradiance by the glare of the assumed light, W m^-2: a tenth of what
        it would add.
    """
    # What lies beside saturation isn't settled yet, and tells of that more than of glare.
    bright = np.logical_or.reduce([ok & s.valid & s.saturated for s, ok in zip(samples, alive, strict=True)])
    far = calibration.spread(bright[None].astype(np.float32))[0] <= _NEAR
    light_here = np.maximum(mean, 0)
    typical = float(np.mean([s.exposure.mean() for s in samples]))
    # What a calibration that no longer holds brings from neighbours open for long looks like glare, too.
    misplaced = (_MISPLACED * typical * light_here) ** 2
    known = [
        np.where(ok, 1 / (predicted_variance(calibration, s.exposure, light_here) + misplaced), 0)
        for s, ok in zip(samples, usable, strict=True)
    ]
    frames = [(s, ok, c * far) for s, ok, c in zip(samples, alive, known, strict=True)]
    certainty = sum((c * s.exposure**2 for s, c in zip(samples, known, strict=True)), np.zeros(mean.shape))

    def merged(images: Sequence[Floats | Doubles]) -> Doubles:
        """Irradiance that a merge would make of additional light in each frame."""
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
        """Find what no irradiance explains of light in each frame, in standard deviations, in one row."""
        alike = merged(images)
        parts = zip(frames, images, strict=True)
        return np.concatenate([(np.sqrt(c) * (g - alike * s.exposure)).ravel() for (s, _, c), g in parts])

    # One factor for all that is hidden, and how far each region's differs from it.
    all_hidden = glare(hidden)
    parts = [hidden, *(_regions(np.where(hidden, light, 0)) if apart else [])]
    terms = np.stack([errors(all_hidden), *(errors(glare(part)) for part in parts[1:])], axis=1)
    unexplained = errors([s.signal - mean * s.exposure for s, _, _ in frames])
    precision = np.array([0.0, *[_UNLIKE**-2] * len(parts[1:])])
    gain = terms.T @ unexplained
    change = np.linalg.lstsq(terms.T @ terms + np.diag(precision), gain)[0]
    factor = np.ones(mean.shape, np.float32)
    if change @ gain > _SIGMAS**2:
        for part, more in zip(parts, change, strict=True):
            factor[part] += np.float32(more)
    factor = np.where(hidden, np.maximum(factor, _darkest(samples, alive, light)), 1)
    return factor, _ERROR * merged(all_hidden)


def _regions(light: Floats) -> list[Bools]:
    """List connected regions of light, those with most of it first."""
    from scipy import ndimage

    label = cast("Callable[..., tuple[Doubles, int]]", ndimage.label)
    labels, n = label(light > 0)
    total = np.bincount(labels.ravel().astype(np.int64), weights=light.ravel(), minlength=n + 1)
    size = np.bincount(labels.ravel().astype(np.int64), minlength=n + 1)
    brightest = [k for k in np.argsort(total)[::-1] if k > 0 and size[k] >= _LEAST_PX]
    return [labels == k for k in brightest[:_REGIONS]]


def _darkest(samples: Sequence[DemixedFrame], alive: Sequence[Bools], light: Floats) -> Floats:
    """Least factors: those of pixels among others as bright, which just saturate; (v, u)."""
    even = np.zeros(light.shape, np.float32)
    for sample, ok in zip(samples, alive, strict=True):
        even = np.where(ok & sample.saturated, np.maximum(even, sample.even), even)
    return np.minimum(even / np.maximum(light, np.float32(1e-30)), 1)
