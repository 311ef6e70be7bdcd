"""The pixel map, panel to CCD: anchors give an affine guess, dots a cubic map.

A polynomial of third order in (v, u) represents shift, rotation, magnification, shear, keystone to third
order and radial distortion about any centre near the axis. The residual shows the rest. No nominal geometry
is needed: the anchors also settle mirror images and quarter turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from optsim.calibration.bench import Bench, Patches
from optsim.calibration.orientation import Orientation, in_words, orientation_of
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats, Ints

_ORDER = 3
# A dot counts if its light exceeds this share of the median dot's: less is a dead pixel or the CCD's edge.
_DIM = 0.3
_OUTLIER_SIGMAS = 5.0
# What shading across the image of a dot moves its centroid, panel pixels. Measured on benches of another
# program (validation/calibration_intervals).
MODEL_PX = 6e-4
# No source, a sensible default: a lattice of which fewer dots agree shows another pattern.
_LEAST_AGREEING = 0.5
# Share of still benches whose noise is taken for a move: of dots, and of anchors.
_FALSE_ALARMS = 1e-3
# Panel pixels by which images may differ beyond noise, of dots and of anchors. The demo's differ by 0.002 and
# 0.008, with 200 um of defocus by 0.06. An anchor half a pixel off is wrong, however the dots scatter.
_STILL_PX, _ANCHOR_PX, _MOST_APART_PX = 0.02, 0.1, 0.5


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Smooth map from panel to CCD, both in pixels with centres at +0.5."""

    coefficients: Doubles  # (10, 2): polynomial for (y, x) in the panel coordinates scaled to -1..1.
    panel_shape: tuple[int, int]  # Panel pixels (v, u).
    residual_px: float  # Rms distance from the dots by the degrees of freedom, panel pixels.
    ccd_per_panel_px: float
    # (10, 10), of the coefficients along one axis, CCD pixels squared, by the scatter of the dots.
    covariance: Doubles
    dots_px: Doubles  # (n, 2), panel coordinates of the dots that the map is fitted to.
    off_ccd_px: Doubles  # (n, 2), seen minus mapped place of each dot, (y, x), CCD pixels.

    def on_ccd(self, panel: Doubles) -> Doubles:
        """CCD coordinates (y, x) of panel points (v, u): arrays of shape (n, 2), float64."""
        return _terms(panel, self.panel_shape, _ORDER) @ self.coefficients

    @property
    def slope(self) -> Doubles:
        """CCD pixels (y, x) a panel pixel along v and along u in the panel's middle: array (2, 2)."""
        middle = np.array([self.panel_shape]) / 2
        steps = [(self.on_ccd(middle + step) - self.on_ccd(middle - step))[0] for step in np.eye(2) / 2]
        return np.stack(steps)

    @property
    def orientation(self) -> Orientation:
        """Orientation of the panel's image."""
        return orientation_of(self.slope)

    def on_panel(self, ccd: Doubles) -> Doubles:
        """Convert distances on the CCD (y, x) to distances along v and u in the panel's middle: (n, 2)."""
        return np.linalg.solve(self.slope.T, ccd.T).T.astype(np.float64)

    def error_px(self) -> Doubles:
        """Give the map's standard error at each panel pixel along either axis, panel pixels: array (v, u)."""
        terms = _terms(self._centres(), self.panel_shape, _ORDER)
        variance = np.einsum("nt,ts,ns->n", terms, self.covariance, terms, optimize=True)
        return np.hypot(np.sqrt(variance) / self.ccd_per_panel_px, MODEL_PX).reshape(self.panel_shape)

    def beyond_dots(self) -> Bools:
        """Panel pixels outside of the dots' rectangle, where the map is extrapolated: array (v, u)."""
        centres = self._centres()
        outside = (centres < self.dots_px.min(axis=0)) | (centres > self.dots_px.max(axis=0))
        return outside.any(axis=1).reshape(self.panel_shape)

    def _centres(self) -> Doubles:
        centres: Doubles = np.indices(self.panel_shape, np.float64).reshape(2, -1).T + 0.5
        return centres

    def ccd_pixels(self) -> tuple[Ints, Ints]:
        """CCD row and column containing each panel pixel's centre: two arrays (v, u); may be off the CCD."""
        centres = self._centres()
        centre: Ints = np.floor(self.on_ccd(centres)).astype(np.int64)
        return centre[:, 0].reshape(self.panel_shape), centre[:, 1].reshape(self.panel_shape)

    def offsets_px(self, row: Ints, col: Ints) -> Doubles:
        """Centre of each mapped CCD pixel minus that of its panel pixel, panel pixels: array (v, u, 2)."""
        centres = self._centres()
        apart = np.stack([row.ravel() + 0.5, col.ravel() + 0.5], axis=1) - self.on_ccd(centres)
        slopes = [self.on_ccd(centres + step) - self.on_ccd(centres - step) for step in np.eye(2) / 2]
        # By the inverse of the local slope: right for mirrored and rotated cameras too.
        offsets = np.linalg.solve(np.stack(slopes, axis=-1), apart[..., None])
        return offsets.reshape(*self.panel_shape, 2).astype(np.float64)


def map_pixels(bench: Bench, black_dn: Floats) -> PixelMap:
    """Fit the map from the bench's anchors and dots."""
    off = bench.off.dn.mean(axis=0, dtype=np.float32) - black_dn

    def light(shown: Patches, dn: Floats) -> tuple[Patches, Floats]:
        return shown, dn - black_dn - off * (shown.irradiance_w_m2 / bench.off.irradiance_w_m2)

    pictures = [light(p, p.dn.mean(axis=0, dtype=np.float32)) for p in (*bench.anchors, *bench.dots)]
    n = len(bench.anchors)
    anchors, on_ccd = _anchors(bench, pictures[:n])
    affine = np.linalg.lstsq(_terms(anchors, bench.panel_shape, 1), on_ccd)[0].astype(np.float64)
    scale = float(np.sqrt(abs(np.linalg.det(affine[1:])))) / np.sqrt(np.prod(bench.panel_shape) / 4)
    panel, ccd, lattice = _dots(pictures[n:], affine, scale, bench.panel_shape)
    found, kept = _fit(bench, panel, ccd, scale)
    ccd_shape = black_dn.shape[0], black_dn.shape[1]
    _check_lattices(bench, found, ccd_shape, np.bincount(lattice[kept], minlength=len(bench.dots)))
    _check_anchors(bench, found, anchors, on_ccd, _MOST_APART_PX)
    frames = [(p, dn.astype(np.float32)) for p in bench.dots for dn in p.dn]
    _check_still(bench, found, *_dots([light(*each) for each in frames], affine, scale, bench.panel_shape))
    # An anchor has more light than a dot, so less noise; on either axis.
    sigmas = NormalDist().inv_cdf(1 - _FALSE_ALARMS / 4 / n)
    _check_anchors(bench, found, anchors, on_ccd, max(_ANCHOR_PX, sigmas * found.residual_px / np.sqrt(2)))
    if bench.orientation is not None and found.orientation != bench.orientation:
        raise BenchError(
            f"{bench.where('anchors[0]')}: orientation: got an image that is {in_words(found.orientation)}, "
            f"expected {in_words(bench.orientation)}; cure: correct orientation if the optics or the readout "
            "turn the image, or take the patterns as they are said to be"
        )
    return found


def _check_lattices(bench: Bench, found: PixelMap, ccd_shape: tuple[int, int], agreeing: Ints) -> None:
    """Refuse a lattice whose dots are not where the other lattices' map has them."""
    margin = 2 * found.ccd_per_panel_px
    for number, (pattern, n_kept) in enumerate(zip(bench.dots, agreeing, strict=True)):
        places = found.on_ccd(_places(pattern))
        inside = ((places > margin) & (places < np.array(ccd_shape) - margin)).all(axis=1)
        n_there = int(np.count_nonzero(inside))
        if n_kept < _LEAST_AGREEING * n_there:
            raise BenchError(
                f"{bench.where(f'dots[{number}]')}: got {n_kept} of {n_there} dots where the map of all "
                "dots has them, expected most; cure: it shows another pattern than rows and cols say: "
                "exchange the file or correct them; or the camera moved: take the bench again"
            )


def _check_still(bench: Bench, found: PixelMap, panel: Doubles, ccd: Doubles, image: Ints) -> None:
    """Refuse images of dots between which the camera moved, by their medians beside the map of all."""
    names = [(f"dots[{k}]", frame) for k, p in enumerate(bench.dots) for frame in range(len(p.dn))]
    beside = found.on_panel(ccd - found.on_ccd(panel))
    counts = np.bincount(image, minlength=len(names))
    medians = [np.median(beside[image == k], axis=0) if counts[k] else [0, 0] for k in range(len(names))]
    place: Doubles = np.array(medians, np.float64)
    # Robust standard deviation of a dot on one axis, and from it the standard error of a median.
    freedom = max(1 - len(names) / len(beside), 0.1)
    scatter = 1.4826 * float(np.median(np.abs(beside - place[image]))) / np.sqrt(freedom)
    variance = np.pi / 2 * scatter**2 / np.maximum(counts, 1e-9)
    n_tests = max(len(names) * (len(names) - 1), 1)  # both axes of all pairs
    sigmas = NormalDist().inv_cdf(1 - _FALSE_ALARMS / 2 / n_tests)
    limit = np.maximum(sigmas * np.sqrt(variance[:, None] + variance), _STILL_PX)
    excess = np.abs(place[:, None] - place).max(axis=2) / limit
    pair = np.unravel_index(int(excess.argmax()), excess.shape)
    # The image that differs from most others is named first.
    first, other = sorted(pair, key=lambda image: float(np.median(excess[image])))
    if excess[first, other] > 1:
        down, right = place[other] - place[first]
        raise BenchError(
            f"{bench.where(*names[other])}: got dots {down:+.3f} rows and {right:+.3f} columns of the panel "
            f"beside those of {bench.where(*names[first])}, expected at most {limit[first, other]:.2g}; "
            "cure: the camera moved between them: fix it and take the bench again"
        )


def _check_anchors(bench: Bench, found: PixelMap, panel: Doubles, on_ccd: Doubles, most: float) -> None:
    """Refuse an anchor that is not where the dots' map has it."""
    for number, (down, right) in enumerate(found.on_panel(on_ccd - found.on_ccd(panel))):
        if max(abs(down), abs(right)) > most:
            raise BenchError(
                f"{bench.where(f'anchors[{number}]')}: got its patch {down:+.2f} rows and {right:+.2f} "
                f"columns of the panel from where the map of {bench.where('dots[0]')} has it, expected at "
                f"most {most:.2g}; cure: the camera moved: take the bench again; or rows and cols are not "
                "those shown, or files are exchanged"
            )


def _places(pattern: Patches) -> Doubles:
    """Panel coordinates of the centres of a lattice's patches: array of shape (n, 2)."""
    rows, cols = np.meshgrid(pattern.rows, pattern.cols, indexing="ij")
    return np.stack([rows.ravel(), cols.ravel()], axis=-1) + np.float64(pattern.size / 2)


def _terms(panel: Doubles, panel_shape: tuple[int, int], order: int) -> Doubles:
    """Monomials of panel points (n, 2) scaled to -1..1, constant first: array of shape (n, terms)."""
    a, b = 2 * panel[:, 0] / panel_shape[0] - 1, 2 * panel[:, 1] / panel_shape[1] - 1
    terms = [a ** (n - i) * b**i for n in range(order + 1) for i in range(n + 1)]
    return np.stack(terms, axis=-1)


def _anchors(bench: Bench, pictures: Sequence[tuple[Patches, Floats]]) -> tuple[Doubles, Doubles]:
    """Panel centre and CCD centroid of the brightest spot of each anchor: two arrays of shape (n, 2)."""
    ccd: list[Doubles] = []
    for number, (anchor, picture) in enumerate(pictures):
        # A 3 x 3 mean, so that a hot pixel is not taken for the patch.
        smooth = sum(np.roll(picture, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / np.float32(9)
        peak = np.array(np.unravel_index(int(np.argmax(smooth)), smooth.shape))
        noise = 1.4826 * float(np.median(np.abs(smooth - np.median(smooth))))
        centre = _centroids(picture, peak[None].astype(np.float64) + 0.5, radius=3 * anchor.size)[0][0]
        if float(smooth.max()) < 20 * max(noise, 1.0) or not np.isfinite(centre).all():
            raise BenchError(
                f"{bench.where(f'anchors[{number}]')}: no bright patch seen (peak {smooth.max():.1f} DN), "
                "expected one inside the picture; cure: check that the panel showed it and that it falls "
                "on the CCD, well inside"
            )
        ccd.append(centre)
    panel = np.concatenate([_places(anchor)[:1] for anchor, _ in pictures])
    if np.linalg.cond(_terms(panel, bench.panel_shape, 1)) > 100:
        raise BenchError("bench anchors: they are almost in one line; cure: spread them over the panel")
    return panel, np.stack(ccd)


def _dots(
    pictures: Sequence[tuple[Patches, Floats]], affine: Doubles, scale: float, panel_shape: tuple[int, int]
) -> tuple[Doubles, Doubles, Ints]:
    """Panel centres and CCD centroids of all dots seen well, (n, 2), and the number of their lattice, (n)."""
    found: list[tuple[Doubles, Doubles, Doubles]] = []
    for pattern, picture in pictures:
        panel = _places(pattern)
        gaps = [np.diff(sorted(places)).min(initial=99) for places in (pattern.rows, pattern.cols)]
        guess = (_terms(panel, panel_shape, 1) @ affine).astype(np.float64)
        # The first window reaches halfway to the next dot, since the affine guess ignores distortion.
        near, _ = _centroids(picture, guess, radius=max(2, round(0.45 * float(min(gaps)) * scale)))
        centres, light = _centroids(picture, near, radius=max(2, round((1.5 + pattern.size / 2) * scale)))
        found.append((panel, centres, light))
    panel = np.concatenate([dots[0] for dots in found])
    ccd = np.concatenate([dots[1] for dots in found])
    light = np.concatenate([dots[2] for dots in found])
    lattice: Ints = np.repeat(np.arange(len(found)), [len(dots[0]) for dots in found])
    seen = np.isfinite(ccd[:, 0]) & np.isfinite(ccd[:, 1])
    if seen.any():
        seen &= light > _DIM * float(np.median(light[seen]))
    return panel[seen], ccd[seen], lattice[seen]


def _centroids(picture: Floats, centres: Doubles, radius: int) -> tuple[Doubles, Doubles]:
    """Centre of light and light in square windows about CCD points; NaN where a window leaves the CCD."""
    span = np.arange(-radius, radius + 1)
    result = centres.astype(np.float64)
    light = np.zeros(len(centres))
    for _ in range(3):
        known = np.isfinite(result[:, 0]) & np.isfinite(result[:, 1])
        corner = np.floor(np.where(known[:, None], result, 0)).astype(np.int64)
        inside: Bools = known & (corner >= radius).all(axis=1)
        inside &= (corner < np.array(picture.shape) - radius).all(axis=1)
        rows, cols = (corner[inside, axis, None] + span for axis in (0, 1))
        windows = picture[rows[:, :, None], cols[:, None, :]].astype(np.float64)
        # The border's median is the background.
        edge = np.concatenate([windows[:, 0], windows[:, -1], windows[:, :, 0], windows[:, :, -1]], axis=1)
        windows -= np.median(edge, axis=1)[:, None, None]
        light = np.where(inside, 0.0, np.nan)
        light[inside] = windows.sum(axis=(1, 2))
        safe = np.maximum(light[inside], 1e-9)
        result = np.full(result.shape, np.nan)
        result[inside, 0] = ((rows + 0.5) * windows.sum(axis=2)).sum(axis=1) / safe
        result[inside, 1] = ((cols + 0.5) * windows.sum(axis=1)).sum(axis=1) / safe
        lost = np.abs(result - corner - 0.5).max(axis=1, initial=0) > radius
        result[lost] = np.nan
    return result, np.nan_to_num(light)


def _fit(bench: Bench, panel: Doubles, ccd: Doubles, scale: float) -> tuple[PixelMap, Bools]:
    """Fit the map to the dots that agree; also return which those are."""
    kept = np.ones(len(panel), np.bool_)
    terms = _terms(panel, bench.panel_shape, _ORDER)
    coefficients, residual, fitted = np.zeros((terms.shape[1], 2)), 0.0, kept
    for _ in range(3):
        n_kept, n_terms = int(np.count_nonzero(kept)), int(terms.shape[1])
        if n_kept < 2 * n_terms:
            raise BenchError(
                f"{bench.where('dots[0]')}: only {n_kept} of {len(panel)} dots seen well agree on a map, "
                f"expected at least {2 * n_terms}; cure: brighten them, spread a denser lattice over the "
                "panel, or check that rows and cols are those shown"
            )
        coefficients = np.linalg.lstsq(terms[kept], ccd[kept])[0].astype(np.float64)
        distance = np.linalg.norm(ccd - terms @ coefficients, axis=1)
        # For a two-dimensional Gaussian the median distance is 1.18 standard deviations of an axis.
        limit = _OUTLIER_SIGMAS * float(np.median(distance[kept])) / 1.18 + 0.02
        residual = float(np.sqrt(np.sum(distance[kept] ** 2) / (n_kept - n_terms))) / scale
        kept, fitted = distance < limit, kept
    # The residual is of both axes together.
    covariance = np.linalg.inv(terms[fitted].T @ terms[fitted]) * (residual * scale) ** 2 / 2
    off_ccd_px: Doubles = (ccd - terms @ coefficients)[fitted].astype(np.float64)
    found = PixelMap(coefficients, bench.panel_shape, residual, scale, covariance, panel[fitted], off_ccd_px)
    return found, fitted
