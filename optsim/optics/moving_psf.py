"""A PSF cut in two for moving light: a small core on fine samples, and a smooth rest on panel pixels.

Far from its centre a PSF is smooth on the scale of a panel pixel, so distant light is collected from pixels.
Quadratic B-splines carry light from samples to pixels and back. The kernel between pixels is a least-squares
fit over all positions of light within a pixel. Outside the core it fits the PSF, within the core a single
kernel. Its contribution there is subtracted from the core, so both add up to the whole PSF. All variation
over the field is in the core. Forces between many particles are divided in the same way (R. W. Hockney and J.
W. Eastwood, *Computer Simulation Using Particles*, 1988, chapter 8: the optimal influence function).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from optsim.core.quantities import Doubles
from optsim.optics.field_blur import FieldPsf, uniform
from optsim.optics.pixel_splines import splines
from optsim.optics.psf_tails import near_half
from optsim.optics.tap_blur import LARGEST_TAPS

# Largest share of light collected on pixels, and least half width of the core, panel pixels.
_REST_SHARE, _LEAST_NEAR = 1e-2, 3
# Largest error of a point's light anywhere, as a share of all of it.
_LARGEST_ERROR = 2e-4
# Ridge of the least squares: poorly determined values stay small.
_RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class MovingPsf:
    """PSF over the field for moving light: the weights with which each point collects."""

    near: FieldPsf  # On fine samples.
    rest: FieldPsf | None = None  # On panel pixels, if any; the same all over the field.


# Cached, since a camera has many blocks.
@lru_cache(maxsize=2)
def divided(psf: FieldPsf, pitch: int) -> MovingPsf:
    """Cut a PSF in two, if it is smooth and large around its core, and the core fits a loop over taps."""
    # The varying part stays on fine samples: between nodes, samples and pixels would weigh it differently. A
    # frame would be off by half of its noise for motion before a window a thousand times as bright as the
    # room.
    least = max(min(_LEAST_NEAR * pitch, LARGEST_TAPS), psf.core_half)
    half, reach = near_half(psf.kernel, least, _REST_SHARE), -(-psf.half // pitch)
    if pitch == 1 or half + pitch > psf.half or max(half, reach) > LARGEST_TAPS:
        return MovingPsf(psf)
    # Reach of the pixels' collection, up to the splines of the outermost ones.
    margin = (reach + 3) * pitch - psf.half
    wanted = np.pad(psf.kernel, margin)
    inner = slice(psf.half + margin - half, psf.half + margin + half + 1)
    wanted[inner, inner] = 0
    passed = _passed(pitch, reach, psf.half + margin)
    mean: Doubles = passed.mean(axis=0)
    inside = mean[inner]
    # Squared deviations from the PSF outside, and from their own mean inside, over all places of the light.
    normal = _along_both(np.einsum("pam,pan->mn", passed, passed) / pitch) - _along_both(inside.T @ inside)
    normal += _RIDGE * np.trace(normal) * np.eye(len(normal))
    right = mean.T @ wanted @ mean
    rest = np.asarray(np.linalg.solve(normal, right.ravel()), np.float64).reshape(right.shape)
    # The rest's contribution within the core is subtracted there, and its excess in total.
    taken = inside @ rest @ inside.T
    taken[half, half] += pitch**2 * rest.sum() - wanted.sum() - taken.sum()
    wanted[inner, inner] = taken
    for down, across in np.ndindex(pitch, pitch):
        off = passed[down] @ rest @ passed[across].T - wanted
        if np.abs(off).max() > _LARGEST_ERROR * psf.kernel.sum():
            return MovingPsf(psf)
    return MovingPsf(_of_nodes(psf.middle(half).whole - taken), uniform(rest))


def _of_nodes(kernels: Doubles) -> FieldPsf:
    """PSF from kernels at the nodes, (n, n, ...), all of which may vary, or from a single one."""
    return uniform(kernels[0, 0]) if len(kernels) == 1 else FieldPsf(kernels[0, 0], kernels)


def _along_both(matrix: Doubles) -> Doubles:
    """Matrix for whole images, row by row, from the matrix along one axis."""
    return np.einsum("ik,jl->ijkl", matrix, matrix).reshape(len(matrix) ** 2, -1)


def _passed(pitch: int, reach: int, half: int) -> Doubles:
    """Light at samples up to ``half`` away, for each position of a source in its pixel, along one axis."""
    shares, place = splines(pitch), np.arange(-half, half + 1)
    # Pixel by pixel of the path.
    passed = np.zeros((pitch, len(place), 2 * reach + 1))
    for phase, found in enumerate(passed):
        pixel, sample = np.divmod(phase + place, pitch)
        for spread, given in zip((-1, 0, 1), shares[phase], strict=True):
            for drawn in (-1, 0, 1):
                tap = pixel + drawn - spread + reach
                met = np.flatnonzero((tap >= 0) & (tap <= 2 * reach))
                found[met, tap[met]] += given * shares[sample[met], drawn + 1]
    return passed
