"""The pixel map, panel to CCD: anchors give an affine guess, dots a cubic map.

A polynomial of third order in (v, u) represents shift, rotation, magnification, shear, keystone to third
order and radial distortion about any centre near the axis. The residual shows the rest. No nominal geometry
is needed: the anchors also settle mirror images and quarter turns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from optsim.calibration.bench import Bench, Patches
from optsim.core.errors import BenchError
from optsim.core.quantities import Bools, Doubles, Floats, Ints

_ORDER = 3
# A dot counts if its light exceeds this share of the median dot's: less is a dead pixel or the CCD's edge.
_DIM = 0.3
_OUTLIER_SIGMAS = 5.0


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Smooth map from panel to CCD, both in pixels with centres at +0.5.

    Parameters
    ----------
    coefficients : ndarray of shape (10, 2), float64
        Polynomial in the panel coordinates scaled to -1..1, for (y, x).
    panel_shape : tuple of int
        Panel pixels (v, u).
    residual_px : float
        Rms distance between the map and the dots, corrected for the degrees of freedom, panel pixels.
    ccd_per_panel_px : float
        Mean scale.
    """

    coefficients: Doubles
    panel_shape: tuple[int, int]
    residual_px: float
    ccd_per_panel_px: float

    def on_ccd(self, panel: Doubles) -> Doubles:
        """CCD coordinates (y, x) of panel points (v, u): arrays of shape (n, 2), float64."""
        return _terms(panel, self.panel_shape, _ORDER) @ self.coefficients

    def ccd_pixels(self) -> tuple[Ints, Ints]:
        """CCD row and column containing each panel pixel's centre: two arrays (v, u); may be off the CCD."""
        centres = np.indices(self.panel_shape, np.float64).reshape(2, -1).T + 0.5
        pick: Ints = np.floor(self.on_ccd(centres)).astype(np.int64)
        return pick[:, 0].reshape(self.panel_shape), pick[:, 1].reshape(self.panel_shape)

    def offsets_px(self, row: Ints, col: Ints) -> Doubles:
        """Centre of each CCD pixel of the map minus that of its panel pixel, along v and u: array (v, u, 2).

        In panel pixels, by the inverse of the map's local slope: right for mirrored and rotated cameras too.
        """
        centres = np.indices(self.panel_shape, np.float64).reshape(2, -1).T + 0.5
        apart = np.stack([row.ravel() + 0.5, col.ravel() + 0.5], axis=1) - self.on_ccd(centres)
        slopes = [self.on_ccd(centres + step) - self.on_ccd(centres - step) for step in np.eye(2) / 2]
        offsets = np.linalg.solve(np.stack(slopes, axis=-1), apart[..., None])
        return offsets.reshape(*self.panel_shape, 2).astype(np.float64)


def map_pixels(bench: Bench, black_dn: Floats) -> PixelMap:
    """Fit the map from the bench's anchors and dots.

    Parameters
    ----------
    bench : Bench
        Its off frames, anchors and dots.
    black_dn : ndarray of shape (y, x), float32
        Black level.

    Raises
    ------
    BenchError
        When an anchor is not seen, or too few dots are.
    """
    off = bench.off.dn.mean(axis=0, dtype=np.float32) - black_dn
    pictures = [
        (
            p,
            p.dn.mean(axis=0, dtype=np.float32)
            - black_dn
            - off * (p.irradiance_w_m2 / bench.off.irradiance_w_m2),
        )
        for p in (*bench.anchors, *bench.dots)
    ]
    n = len(bench.anchors)
    affine = _affine(pictures[:n], bench.panel_shape)
    scale = float(np.sqrt(abs(np.linalg.det(affine[1:])))) / np.sqrt(np.prod(bench.panel_shape) / 4)
    panel, ccd = _dots(pictures[n:], affine, scale, bench.panel_shape)
    return _fit(panel, ccd, scale, bench.panel_shape)


def _terms(panel: Doubles, panel_shape: tuple[int, int], order: int) -> Doubles:
    """Monomials of panel points (n, 2) scaled to -1..1, constant first: array of shape (n, terms)."""
    a, b = 2 * panel[:, 0] / panel_shape[0] - 1, 2 * panel[:, 1] / panel_shape[1] - 1
    terms = [a ** (n - i) * b**i for n in range(order + 1) for i in range(n + 1)]
    return np.stack(terms, axis=-1)


def _affine(pictures: Sequence[tuple[Patches, Floats]], panel_shape: tuple[int, int]) -> Doubles:
    """Affine map from the brightest spot of each anchor: array of shape (3, 2)."""
    panel: list[list[float]] = []
    ccd: list[Doubles] = []
    for number, (anchor, picture) in enumerate(pictures):
        # A 3 x 3 mean, so that a hot pixel is not taken for the patch.
        smooth = sum(np.roll(picture, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / np.float32(9)
        peak = np.array(np.unravel_index(int(np.argmax(smooth)), smooth.shape))
        noise = 1.4826 * float(np.median(np.abs(smooth - np.median(smooth))))
        if float(smooth.max()) < 20 * max(noise, 1.0):
            raise BenchError(
                f"bench anchors[{number}]: no bright patch seen (peak {smooth.max():.1f} DN); check that "
                "the panel showed it and that it falls on the CCD"
            )
        centre = _centroids(picture, peak[None].astype(np.float64) + 0.5, radius=3 * anchor.size)[0][0]
        panel.append([anchor.rows[0] + anchor.size / 2, anchor.cols[0] + anchor.size / 2])
        ccd.append(centre)
    terms = _terms(np.array(panel), panel_shape, 1)
    if np.linalg.cond(terms) > 100:
        raise BenchError("bench anchors: they are almost in one line; spread them over the panel")
    return np.linalg.lstsq(terms, np.array(ccd))[0].astype(np.float64)


def _dots(
    pictures: Sequence[tuple[Patches, Floats]], affine: Doubles, scale: float, panel_shape: tuple[int, int]
) -> tuple[Doubles, Doubles]:
    """Panel centres and CCD centroids of all dots seen well: two arrays of shape (n, 2)."""
    found: list[tuple[Doubles, Doubles, Doubles]] = []
    for pattern, picture in pictures:
        rows, cols = np.meshgrid(pattern.rows, pattern.cols, indexing="ij")
        panel = np.stack([rows.ravel(), cols.ravel()], axis=-1) + np.float64(pattern.size / 2)
        gap = float(min(np.diff(rows[:, 0]).min(initial=99), np.diff(cols[0]).min(initial=99)))
        guess = (_terms(panel, panel_shape, 1) @ affine).astype(np.float64)
        # The first window reaches halfway to the next dot, since the affine guess ignores distortion.
        near, _ = _centroids(picture, guess, radius=max(2, round(0.45 * gap * scale)))
        centres, light = _centroids(picture, near, radius=max(2, round((1.5 + pattern.size / 2) * scale)))
        found.append((panel, centres, light))
    panel = np.concatenate([dots[0] for dots in found])
    ccd = np.concatenate([dots[1] for dots in found])
    light = np.concatenate([dots[2] for dots in found])
    seen = np.isfinite(ccd[:, 0]) & np.isfinite(ccd[:, 1])
    if seen.any():
        seen &= light > _DIM * float(np.median(light[seen]))
    return panel[seen], ccd[seen]


def _centroids(picture: Floats, centres: Doubles, radius: int) -> tuple[Doubles, Doubles]:
    """Centre of light and light in square windows about CCD points; NaN where a window leaves the CCD.

    The window moves to the brightest pixel's neighbourhood over three rounds. The border's median is
    subtracted as background.
    """
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


def _fit(panel: Doubles, ccd: Doubles, scale: float, panel_shape: tuple[int, int]) -> PixelMap:
    kept = np.ones(len(panel), np.bool_)
    terms = _terms(panel, panel_shape, _ORDER)
    coefficients, residual = np.zeros((terms.shape[1], 2)), 0.0
    for _ in range(3):
        n_kept, n_terms = int(np.count_nonzero(kept)), int(terms.shape[1])
        if n_kept < 2 * n_terms:
            raise BenchError(
                f"bench dots: only {n_kept} of {len(panel)} dots seen well agree on a map, expected at least "
                f"{2 * n_terms}; brighten them, or spread a denser lattice over the panel"
            )
        coefficients = np.linalg.lstsq(terms[kept], ccd[kept])[0].astype(np.float64)
        distance = np.linalg.norm(ccd - terms @ coefficients, axis=1)
        # For a two-dimensional Gaussian the median distance is 1.18 standard deviations of an axis.
        limit = _OUTLIER_SIGMAS * float(np.median(distance[kept])) / 1.18 + 0.02
        residual = float(np.sqrt(np.sum(distance[kept] ** 2) / (n_kept - n_terms))) / scale
        kept = distance < limit
    return PixelMap(coefficients, panel_shape, residual, scale)
