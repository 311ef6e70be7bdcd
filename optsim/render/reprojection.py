# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false, reportUnknownParameterType=false, reportMissingParameterType=false
"""Irradiance reprojection: light on a moving matt surface, taken from key poses.

A matt point's radiance is its reflectance times irradiance / pi. When a mover moves, reflectance, edges and
visibility in a pixel change at once. The irradiance of *the same point of the surface* hardly changes. So
whole paths estimate it at key poses only. Between them only the primary hits are traced anew. A hit is
followed by its triangle to its position at the key pose. It takes the irradiance that paths through that
sample of the grid found there.

Reprojection with a visibility test: B. Walter, G. Drettakis, S. Parker, "Interactive Rendering using the
Render Cache", EGWR 1999, doi:10.1007/978-3-7091-6809-7_3; reflectance separate from irradiance: G. J. Ward,
F. M. Rubinstein, R. D. Clear, "A Ray Tracing Solution for Diffuse Interreflection", SIGGRAPH 1988,
doi:10.1145/54852.378490.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import ndimage

from optsim.core.compiled import compiled
from optsim.core.quantities import Bools, Doubles, Floats, Ints, View
from optsim.render.stage import PrimaryHits
from optsim.scene.geometry import Faces

# A key's sample is of the same surface if its depth differs by at most this many sample widths there: a
# surface tilted by 70 degrees differs by less within a sample. No source.
_DEPTH_PX = 3.0


@dataclass(frozen=True, eq=False)
class KeyPoseLight:
    """Light at a key pose, path by path: those of half A sorted by fine sample, then those of half B."""

    corner: tuple[int, int]  # First row and column of the grid.
    size: tuple[int, int]  # Rows and columns of the grid.
    first: Ints  # (2 * samples of the grid + 1,), index of the first path of each half and fine sample.
    shape: Ints  # (n,), shape hit by each path.
    depth_m: Floats  # (n,), of the hit.
    albedo: Floats  # (n,), reflectance at the hit.
    light: Floats  # (n,), radiance, W m^-2 sr^-1.

    def beside(self, movers: list[int]) -> Floats:
        """Mean radiance of the paths that miss some shapes, (half, fine sample); NaN where there are none."""
        past = np.flatnonzero(~np.isin(self.shape, movers))
        sample, n = np.searchsorted(self.first, past, "right") - 1, len(self.first) - 1
        with np.errstate(invalid="ignore"):
            mean = np.bincount(sample, self.light[past], n) / np.bincount(sample, minlength=n)
        return mean.astype(np.float32).reshape(2, -1)

    def by_place(self, row: Doubles, col: Doubles) -> KeyPoseLight:
        """Sort the paths by their hits' positions in the ideal image, instead of by their samples.

        The two differ by defocus and distortion. The result has its own grid, which extends a picture's size
        around the picture; other paths are left out.
        """
        with np.errstate(invalid="ignore"):
            retained = np.flatnonzero((abs(row) < 2 * self.size[0]) & (abs(col) < 2 * self.size[1]))
        corner, size, first, at = (0, 0), (0, 0), np.zeros(1, np.int64), retained
        if len(retained):
            half = np.searchsorted(self.first, retained, "right") > self.size[0] * self.size[1]
            y, x = (np.floor(place[retained]).astype(np.int64) for place in (row, col))
            corner = int(y.min()), int(x.min())
            size = int(y.max()) + 1 - corner[0], int(x.max()) + 1 - corner[1]
            sample = (half * size[0] + y - corner[0]) * size[1] + x - corner[1]
            order = np.argsort(sample, kind="stable")
            first = np.searchsorted(sample[order], np.arange(2 * size[0] * size[1] + 1))
            at = retained[order]
        return KeyPoseLight(
            corner, size, first, self.shape[at], self.depth_m[at], self.albedo[at], self.light[at]
        )

    def irradiance(
        self,
        hits: PrimaryHits,
        chosen: Ints,
        half: Ints,
        faces: Faces,
        here: Doubles,
        then: Doubles,
        view: View,
    ) -> Floats:
        """Look up the irradiance over pi at this pose, for points hit at another one."""
        if not len(chosen):
            return np.zeros(0, np.float32)
        tolerance = _DEPTH_PX * 2 * view.tan_half_width / view.cols
        met = int(hits.shape[chosen[0]]), tolerance, *self.corner, *self.size
        key = self.first, self.shape, self.depth_m, self.albedo, self.light
        return _looked_up(hits.face, hits.weights, chosen, half, faces, here, then, *met, *key)


def seen_at(hits: PrimaryHits, chosen: Ints, faces: Faces, places: Doubles) -> Doubles:
    """Positions of hits in the ideal image, and their depth in m: (n, 3)."""
    second, third = hits.weights[chosen].T
    corners = places[faces[hits.face[chosen]]]
    a, b, c = corners[:, :, 2].T
    # Linear in space, hence linear in position times depth.
    weighted = np.stack([(1 - second - third) * a, second * b, third * c], axis=-1)
    depth = weighted.sum(axis=-1)
    return np.column_stack([np.einsum("nk,nkx->nx", weighted, corners[:, :, :2]) / depth[:, None], depth])


@compiled()
def _turns(a, b, c):  # type: ignore[no-untyped-def]
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]) > 0


@compiled()
def _looked_up(  # type: ignore[no-untyped-def]
    face,
    weights,
    chosen,
    half,
    faces,
    here,
    then,
    which,
    tolerance,
    top,
    left,
    rows,
    cols,
    first,
    shape,
    depth,
    albedo,
    light,
):
    found = np.full(chosen.shape[0], np.nan, np.float32)
    for n in range(chosen.shape[0]):
        i, j, k = faces[face[chosen[n]]]
        a, b, c = here[i], here[j], here[k]
        # The other side of a thin sheet has its own light.
        if _turns(a, b, c) != _turns(then[i], then[j], then[k]):
            continue
        second, third = weights[chosen[n], 0], weights[chosen[n], 1]
        # Linear in space, hence linear in position times depth.
        wa, wb, wc = (1 - second - third) * a[2], second * b[2], third * c[2]
        z = wa + wb + wc
        y, x = (wa * a[0] + wb * b[0] + wc * c[0]) / z, (wa * a[1] + wb * b[1] + wc * c[1]) / z
        y, x = y - top, x - left
        if not (0 <= y < rows and 0 <= x < cols):  # nor if NaN
            continue
        row, col = int(y), int(x)
        # Its own sample of the grid, or those around it at an edge.
        for reach in range(2):
            of_light, of_albedo = 0.0, 0.0
            for v in range(max(0, row - reach), min(rows, row + reach + 1)):
                for u in range(max(0, col - reach), min(cols, col + reach + 1)):
                    sample = (half[n] * rows + v) * cols + u
                    for path in range(first[sample], first[sample + 1]):
                        if shape[path] == which and abs(depth[path] - z) <= tolerance * z:
                            of_light += light[path]
                            of_albedo += albedo[path]
            if of_albedo > 0:
                found[n] = of_light / of_albedo
                break
    return found


def filled(behind: Floats, static: Floats, mask: Bools, floor: float) -> Floats:
    """Fill unknown values (NaN) at a key from the nearest key that has them, or from the nearest sample."""
    # The movers' change beside them varies slowly in time, and in space relative to the light without movers.
    known = np.logical_and(*np.moveaxis(np.isfinite(behind), 1, 0))
    light = np.take_along_axis(behind, _nearest(known)[:, None], axis=0)
    never, ever = np.flatnonzero(~known.any(axis=0)), np.zeros(mask.shape, np.bool_)
    ever[mask] = known.any(axis=0)
    if len(never) and ever.any():
        beside = cast(
            "Ints", ndimage.distance_transform_edt(~ever, return_distances=False, return_indices=True)
        )
        number = np.cumsum(mask).reshape(mask.shape) - 1
        other = number[tuple(beside[:, mask][:, never])]
        about = np.maximum(static.mean(axis=0), 0) + floor
        light[:, :, never] = (light[:, :, other] + floor) * (about[never] / about[other]) - floor
    return light


def _nearest(known: Bools) -> Ints:
    """Nearest known index along the first axis, the earlier of two; 0 if there is none."""
    n = len(known)
    order = np.arange(n)[:, None]
    before = np.maximum.accumulate(np.where(known, order, -n), axis=0)
    after = np.minimum.accumulate(np.where(known, order, 2 * n)[::-1], axis=0)[::-1]
    return np.where(known.any(axis=0), np.where(order - before <= after - order, before, after), 0)


def between(before: Floats, after: Floats, share: float) -> Floats:
    """Interpolate linearly; where one is unknown (NaN) the other is used."""
    mixed = (1 - share) * before + share * after
    return np.where(np.isnan(before), after, np.where(np.isnan(after), before, mixed))
