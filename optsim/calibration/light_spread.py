# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""Where light goes beside its own pixel: glare by images of bright patches, crosstalk by those of dots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import cast

import numpy as np

from optsim.calibration.bench import Patches
from optsim.calibration.glare import NO_GLARE, RINGS_PX, Glare, wings_blur
from optsim.calibration.shading import PixelReader, Shading
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats
from optsim.optics.crosstalk import REACH, Dots, crosstalk_kernels
from optsim.optics.ghost import mirrored

# A ghost is believed if it explains more of what dark places see than so many standard deviations of noise.
_GHOST_SIGMAS = 10.0
# Blurs of the ghost that are looked for, panel pixels, and how finely.
_GHOST_BLURS_PX, _BLUR_STEP = (4.0, 100.0), 0.02
# Of the panel's shorter side: wider rings look like the veil, and count as that.
_WIDEST_RING = 1 / 2
# More than half cannot be told from light that belongs there.
_MOST = 0.5


def measured_glare(patterns: Sequence[Patches], reader: PixelReader, flat: Shading) -> Glare:
    """Estimate glare from what dark places see of a bright patch; none without images.

    Light there exceeds the panel's own leak by what :meth:`Glare.light` says of the pattern: linear in all
    shares, none of which is negative. They are found by least squares, weighted by the noise.

    Raises
    ------
    BenchError
        When no valid pixel is far enough from a patch.
    """
    if not patterns:
        return NO_GLARE
    from scipy.optimize import fminbound, nnls

    lights, places, excess, sigma = _dark_places(patterns, reader, flat)
    shape = (flat.valid.shape[0], flat.valid.shape[1])

    def term(arriving: Callable[[Doubles], Doubles]) -> Doubles:
        """Light at the places, in standard deviations of its noise."""
        images = [arriving(light)[far] for light, far in zip(lights, places, strict=True)]
        return np.concatenate(images) / sigma

    n_rings = sum(outer <= _WIDEST_RING * min(shape) for outer in RINGS_PX[1:])
    blurs = [wings_blur(tuple(ring), REACH, shape) for ring in np.eye(len(RINGS_PX) - 1)[:n_rings]]
    plain = [term(lambda light: np.full(shape, light.mean())), *(term(blur.apply) for blur in blurs)]

    def fit(terms: list[Doubles]) -> tuple[float, list[float]]:
        """Sum of squares that is left, and shares."""
        # An orthogonal transformation keeps both, and leaves as many rows as columns.
        triangle = np.asarray(np.linalg.qr(np.stack([*terms, excess / sigma], axis=1), mode="r"))
        shares, left = cast("tuple[Doubles, float]", nnls(triangle[:, :-1], triangle[:, -1]))
        return left**2, np.minimum(shares, _MOST).tolist()

    def with_ghost(log_blur: float) -> tuple[float, list[float]]:
        return fit([*plain, term(partial(mirrored, sigma_px=float(np.exp(log_blur))))])

    def left_with_ghost(log_blur: float) -> float:
        return with_ghost(log_blur)[0]

    log_blur = cast("float", fminbound(left_with_ghost, *np.log(_GHOST_BLURS_PX), xtol=_BLUR_STEP))
    left, (veil, *wings) = fit(plain)
    ghost, blur_px = 0.0, Glare.ghost_blur_px
    left_with, (veil_with, *wings_with, ghost_with) = with_ghost(log_blur)
    if left - left_with > _GHOST_SIGMAS**2:
        veil, wings, ghost, blur_px = veil_with, wings_with, ghost_with, float(np.exp(log_blur))
    wings += [0.0] * (len(RINGS_PX) - 1 - n_rings)
    return Glare(veil, ghost, blur_px, tuple(wings))


def _dark_places(
    patterns: Sequence[Patches], reader: PixelReader, flat: Shading
) -> tuple[list[Doubles], list[Bools], Doubles, Doubles]:
    """Light of each pattern, where its kernel does not reach, what is seen there and its standard error.

    Both light and what is seen are what exceeds the panel all off: the rest is the leak's.
    """
    from scipy.ndimage import binary_dilation

    kernel = np.ones((2 * REACH + 1, 2 * REACH + 1))
    lights, places = list[Doubles](), list[Bools]()
    excess, sigma = list[Doubles](), list[Doubles]()
    for pattern in patterns:
        lit = pattern.levels((flat.valid.shape[0], flat.valid.shape[1])) > 0
        far = flat.valid & ~np.asarray(binary_dilation(lit, kernel), np.bool_)
        if not far.any():
            raise BenchError(
                f"bench glare: no panel pixel is more than {REACH} pixels from the patch; use a smaller "
                "patch, or leave the list empty on a panel too small for it"
            )
        rate, variance = reader.rate((pattern,))
        lights.append(np.where(lit, flat.responsivity_dn - flat.off_dn, 0))
        places.append(far)
        excess.append((rate - flat.off_dn)[far])
        sigma.append(np.sqrt(variance[far]))
    return lights, places, np.concatenate(excess), np.concatenate(sigma)


def crosstalk(
    dots: Sequence[Patches], reader: PixelReader, flat: Shading, offset_px: Doubles, glare: Glare
) -> Floats:
    """Crosstalk kernel of every panel pixel: array of shape (v, u, k, k), float32, each of sum 1.

    Parameters
    ----------
    dots : sequence of Patches
        Lattices of single bright pixels.
    picker, flat : Picker, Shading
        What is known by now.
    offset_px : ndarray of shape (v, u, 2), float64
        Centre of each picked CCD pixel less that of its panel pixel, panel pixels.
    glare : Glare
        What arrives from farther dots.

    Raises
    ------
    BenchError
        When no dot lies among valid pixels.
    """
    full = flat.responsivity_dn - flat.off_dn
    lattices: list[Dots] = []
    for dot in dots:
        light = np.where(dot.levels((full.shape[0], full.shape[1])) > 0, full, 0)
        seen = reader.rate((dot,))[0] - flat.off_dn - glare.light(light, REACH)
        lattices.append(
            Dots(np.array(dot.rows), np.array(dot.cols), seen / np.where(flat.valid, full, np.inf))
        )
    try:
        return crosstalk_kernels(lattices, offset_px, flat.valid)
    except ValueError as error:
        raise BenchError(f"bench dots: {error}; take a denser or shifted lattice") from None
