# pyright: reportUnknownMemberType=false
"""Camera rays and their random numbers: the only place where paths start."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np

from optsim.core.quantities import Ints, View
from optsim.render.lens import ideal, margin_px, undistorted
from optsim.render.sampler import pixel_sampler

# Bounds the memory of one launch (about 100 bytes a lane).
_MAX_LANES = 4 << 20


def camera_rays(
    loaded: Any, view: View, pixels: Ints, samples: Ints, seeds: Ints, first: Ints
) -> tuple[Any, Any, Any]:
    """Start random paths."""
    import drjit as dr
    import mitsuba as mi

    place = mi.UInt32(np.repeat(np.arange(len(pixels), dtype=np.uint32), samples))

    def each(values: Ints) -> Any:
        return dr.gather(mi.UInt32, mi.UInt32(values.astype(np.uint32)), place)

    pixel, lane = each(pixels), dr.arange(mi.UInt32, int(samples.sum()))
    sampler: Any = pixel_sampler(mi, dr)()
    sampler.start(each(seeds), pixel, lane - each(starts(samples) - first))
    row = pixel // dr.opaque(mi.UInt32, view.cols)
    place = mi.Point2f(mi.Float(pixel - row * view.cols), mi.Float(row)) + sampler.next_2d()
    # A view without distortion or lens uses neither arithmetic nor random numbers for them.
    if view.distortion:
        y, x = undistorted(place.y, place.x, view)
        place = mi.Point2f(x, y) + margin_px(view)
    lens = sampler.next_2d() if view.aperture_m else mi.Point2f(0.5)
    position, sensor = place / mi.Point2f(ideal(view).cols, ideal(view).rows), loaded.sensors()[0]
    return sampler, *sensor.sample_ray_differential(0.0, 0.0, position, lens)


def starts(samples: Ints) -> Ints:
    """Lane of each pixel's first path."""
    return np.cumsum(samples) - samples


def pieces(samples: Ints) -> list[slice]:
    """Cut into pieces of about equal work, so that a launch never exceeds its memory."""
    cuts = np.unique(starts(samples) // _MAX_LANES, return_index=True)[1]
    return [slice(*ends) for ends in pairwise([*cuts.tolist(), len(samples)])]
