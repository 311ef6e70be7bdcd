"""A PSF cut in two for moving light: a small middle on fine samples, and a smooth rest on panel pixels.

Far from its centre a PSF is smooth beside a panel pixel, so light further off is collected from pixels. Light
is spread to them, and drawn between them, with quadratic B-splines; the kernel between pixels is the one that
comes nearest, in least squares and over all places of light within a pixel, to the PSF outside of the middle,
and to one kernel within it. What it does there is taken out of the middle, so both add up to the whole PSF.
All that varies over the field is in the middle. That is how forces between many particles are divided (R. W.
Hockney and J. W. Eastwood, *Computer Simulation Using Particles*, 1988, chapter 8: the optimal influence
function).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from optsim.core.quantities import Doubles
from optsim.optics.field_blur import FieldPsf, uniform
from optsim.optics.pixel_splines import splines
from optsim.optics.tap_blur import LARGEST_TAPS
from optsim.optics.wings import near_half

# Light that pixels collect at most, and the least that the middle reaches, panel pixels.
_REST_SHARE, _LEAST_NEAR = 1e-2, 3
# Most that the light of a point may be off anywhere, of all of it.
_LARGEST_ERROR = 2e-4
# Beside the squares a solution's rounding: what hardly matters for them stays small.
_RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class MovingPsf:
    """PSF over the field as moving light gets it, what each point collects.

    Parameters
    ----------
    near : FieldPsf
        On fine samples.
    rest : FieldPsf or None
        On panel pixels, if any; the same all over the field.
    """

    near: FieldPsf
    rest: FieldPsf | None = None


# Kept, since a camera's blocks are many.
@lru_cache(maxsize=2)
def divided(psf: FieldPsf, pitch: int) -> MovingPsf:
    """Cut a PSF in two, if there is enough around its middle but not too much for a loop over taps.

    It stays whole, too, if it is not smooth enough: where a point's light would be off by more than 2e-4.

    Parameters
    ----------
    psf : FieldPsf
        On fine samples.
    pitch : int
        Fine samples to a panel pixel.
    """
    # Between nodes samples and pixels would weigh what varies differently: a frame would be off by half of
    # its noise where something moves before a window a thousand times as bright as the room.
    least = max(min(_LEAST_NEAR * pitch, LARGEST_TAPS), psf.core_half)
    half, reach = near_half(psf.kernel, least, _REST_SHARE), -(-psf.half // pitch)
    if pitch == 1 or half + pitch > psf.half or max(half, reach) > LARGEST_TAPS:
        return MovingPsf(psf)
    # As far as pixels collect: between the splines of the outermost ones.
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
    # What the rest does in the middle is taken out of it, and what it does too much in all.
    taken = inside @ rest @ inside.T
    taken[half, half] += pitch**2 * rest.sum() - wanted.sum() - taken.sum()
    wanted[inner, inner] = taken
    for down, across in np.ndindex(pitch, pitch):
        off = passed[down] @ rest @ passed[across].T - wanted
        if np.abs(off).max() > _LARGEST_ERROR * psf.kernel.sum():
            return MovingPsf(psf)
    return MovingPsf(_of_nodes(psf.middle(half).whole - taken), uniform(rest))


def _of_nodes(kernels: Doubles) -> FieldPsf:
    """PSF of kernels at the nodes, (n, n, ...), all of which may vary, or of one."""
    return uniform(kernels[0, 0]) if len(kernels) == 1 else FieldPsf(kernels[0, 0], kernels)


def _along_both(matrix: Doubles) -> Doubles:
    """Matrix of pictures, row by row, from that along an axis."""
    return np.einsum("ik,jl->ijkl", matrix, matrix).reshape(len(matrix) ** 2, -1)


def _passed(pitch: int, reach: int, half: int) -> Doubles:
    """Find what gets to places up to ``half`` from a sample, for each place of it in a pixel, along one axis.

    Array (pitch, 2 half + 1, 2 reach + 1): by way of each pixel, counted from one that light is spread to.
    """
    shares, place = splines(pitch), np.arange(-half, half + 1)
    passed = np.zeros((pitch, len(place), 2 * reach + 1))
    for phase, found in enumerate(passed):
        pixel, sample = np.divmod(phase + place, pitch)
        for spread, given in zip((-1, 0, 1), shares[phase], strict=True):
            for drawn in (-1, 0, 1):
                tap = pixel + drawn - spread + reach
                met = np.flatnonzero((tap >= 0) & (tap <= 2 * reach))
                found[met, tap[met]] += given * shares[sample[met], drawn + 1]
    return passed
