# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false
"""Estimate glare from images of bright patches, and crosstalk from images of dot lattices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np

from optsim.calibration.bench import Bench, Patches
from optsim.calibration.glare import NO_GLARE, RINGS_PX, Glare, tails_blur
from optsim.calibration.shading import PixelReader, Shading
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats
from optsim.optics.crosstalk import REACH, Dots, crosstalk_kernels
from optsim.optics.ghost import mirrored

# A ghost counts as found if it improves the fit in dark places by this many standard deviations.
_GHOST_SIGMAS = 10.0
# Search range of the ghost's blur, panel pixels, and its relative step.
_GHOST_BLURS_PX, _BLUR_STEP = (4.0, 100.0), 0.02
# Share of the panel's shorter side: tails in wider rings look like veiling glare and count as such.
_WIDEST_RING = 1 / 2
# A larger share cannot be distinguished from direct light.
_MOST = 0.5
# Veil and ghost have an error where the fit has none of them, too.
_TINY = 1e-9
# A patch is where the bench says if it is this many times as bright as the rest.
_BRIGHTER = 2.0
# Share of the light with the panel off that dark places have at least: they have its leak, and glare.
_DARKER = 0.8


@dataclass(frozen=True)
class GlareFit:
    """Glare with the standard errors of its veil and ghost, by noise and by the scatter over the patterns."""

    glare: Glare
    veil_error: float
    ghost_error: float  # Of a ghost too weak to count: what it might be.


def measured_glare(bench: Bench, reader: PixelReader, flat: Shading) -> GlareFit:
    """Estimate glare by non-negative least squares from the light of a bright patch in dark places."""
    patterns = bench.glare
    if not patterns:
        return GlareFit(NO_GLARE, 0.0, 0.0)
    from scipy.optimize import fminbound, nnls

    lights, places, excess, sigma = _dark_places(bench, reader, flat)
    shape = (flat.valid.shape[0], flat.valid.shape[1])

    # Light beyond the panel's leak is Glare.light of the pattern: linear in all shares.
    def term(arriving: Callable[[Doubles], Doubles]) -> Doubles:
        """Light at the places, in standard deviations of its noise."""
        images = [arriving(light)[far] for light, far in zip(lights, places, strict=True)]
        return np.concatenate(images) / sigma

    n_rings = sum(outer <= _WIDEST_RING * min(shape) for outer in RINGS_PX[1:])
    blurs = [tails_blur(tuple(ring), REACH, shape) for ring in np.eye(len(RINGS_PX) - 1)[:n_rings]]
    plain = [term(lambda light: np.full(shape, light.mean())), *(term(blur.apply) for blur in blurs)]

    def fit(terms: list[Doubles]) -> tuple[float, list[float]]:
        """Residual sum of squares, and shares."""
        # An orthogonal transformation keeps both, and reduces the rows to the number of columns.
        triangle = np.asarray(np.linalg.qr(np.stack([*terms, excess / sigma], axis=1), mode="r"))
        shares, left = cast("tuple[Doubles, float]", nnls(triangle[:, :-1], triangle[:, -1]))
        return left**2, np.minimum(shares, _MOST).tolist()

    def with_ghost(log_blur: float) -> tuple[float, list[float]]:
        return fit([*plain, term(partial(mirrored, sigma_px=float(np.exp(log_blur))))])

    def left_with_ghost(log_blur: float) -> float:
        return with_ghost(log_blur)[0]

    log_blur = cast("float", fminbound(left_with_ghost, *np.log(_GHOST_BLURS_PX), xtol=_BLUR_STEP))
    left, (veil, *tails) = fit(plain)
    ghost, blur_px = 0.0, Glare.ghost_blur_px
    left_with, (veil_with, *tails_with, ghost_with) = with_ghost(log_blur)
    if left - left_with > _GHOST_SIGMAS**2:
        veil, tails, ghost, blur_px = veil_with, tails_with, ghost_with, float(np.exp(log_blur))
    tails += [0.0] * (len(RINGS_PX) - 1 - n_rings)
    found = Glare(veil, ghost, blur_px, tuple(tails))

    def errors(at: float) -> list[float]:
        """Errors of veil and ghost by a fit with a ghost of a blur, noise and what it changes."""
        _, (veil_with, *_, ghost_with) = with_ghost(at)
        terms = np.stack([*plain, term(partial(mirrored, sigma_px=float(np.exp(at))))], axis=1)
        shares = np.array([max(veil_with, _TINY), *found.wings[:n_rings], max(ghost_with, _TINY)])
        scatter = _share_errors(terms, shares, excess / sigma, [far.sum() for far in places])
        return [
            float(np.hypot(scatter[0], veil_with - veil)),
            float(np.hypot(scatter[-1], ghost_with - ghost)),
        ]

    # A ghost that is not found may have any blur, and on a small panel a wide one looks like veiling glare.
    tried = [errors(at) for at in ((log_blur,) if ghost else (log_blur, np.log(Glare.ghost_blur_px)))]
    return GlareFit(found, *np.max(tried, axis=0).tolist())


def _share_errors(terms: Doubles, shares: Doubles, seen: Doubles, counts: Sequence[int]) -> list[float]:
    """Give standard errors of shares: by noise, and by the spread of fits to each pattern alone."""
    lit = shares > 0
    if not lit.any():
        return [0.0] * len(shares)
    inverse = np.linalg.pinv(terms[:, lit].T @ terms[:, lit])
    errors = np.zeros(len(shares))
    errors[lit] = np.sqrt(np.diag(inverse))
    if len(counts) > 1:
        ends = np.cumsum(counts)[:-1]
        parts = zip(np.split(terms, ends), np.split(seen, ends), strict=True)
        alone = np.array([np.linalg.lstsq(each[:, lit], part)[0] for each, part in parts])
        errors[lit] = np.hypot(errors[lit], alone.std(axis=0, ddof=1) / np.sqrt(len(counts)))
    return errors.tolist()


def _dark_places(
    bench: Bench, reader: PixelReader, flat: Shading
) -> tuple[list[Doubles], list[Bools], Doubles, Doubles]:
    """Return each pattern's light, the places beyond its kernel, and the light there with standard error."""
    from scipy.ndimage import binary_dilation

    kernel = np.ones((2 * REACH + 1, 2 * REACH + 1))
    lights, places = list[Doubles](), list[Bools]()
    excess, sigma = list[Doubles](), list[Doubles]()
    for number, pattern in enumerate(bench.glare):
        where = bench.where(f"glare[{number}]")
        lit = pattern.levels((flat.valid.shape[0], flat.valid.shape[1])) > 0
        far = flat.valid & ~np.asarray(binary_dilation(lit, kernel), np.bool_)
        if not far.any():
            raise BenchError(
                f"{where}: no panel pixel is more than {REACH} pixels from the patch, expected some; cure: a "
                "smaller patch, or an empty list on a panel too small for it"
            )
        rate, variance = reader.rate((pattern,))
        bright, dark = float(rate[lit & flat.valid].mean()), float(rate[far].mean())
        if bright < _BRIGHTER * dark:
            raise BenchError(
                f"{where}: got {bright / max(dark, 1e-30):.2g} times the light of the dark rest in its "
                f"patch, expected more than {_BRIGHTER:g}; cure: correct rows and cols, or exchange the file"
            )
        leak = float(flat.off_dn[far].mean())
        if dark < _DARKER * leak:
            raise BenchError(
                f"{bench.where('off')}: got {leak / max(dark, 1e-30):.2g} times the light of the dark rest "
                f"of {where}, expected no more; cure: exchange the file, or correct irradiance_w_m2"
            )
        # All light is the excess over the panel all off.
        lights.append(np.where(lit, flat.responsivity_dn - flat.off_dn, 0))
        places.append(far)
        excess.append((rate - flat.off_dn)[far])
        sigma.append(np.sqrt(variance[far]))
    return lights, places, np.concatenate(excess), np.concatenate(sigma)


def crosstalk(
    dots: Sequence[Patches], reader: PixelReader, flat: Shading, offset_px: Doubles, glare: Glare
) -> Floats:
    """Crosstalk kernel of every panel pixel: array of shape (v, u, k, k), float32, each of sum 1."""
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
