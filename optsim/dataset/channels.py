"""Content of a slot's file: channels, their names, units and conventions; pure functions of arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from optsim.core.quantities import Floats, Ids, Passes, Video

# Stored as 16 bit on demand. Depth and flow stay float32: half of 7 m has steps of 4 mm, and flow must agree
# with the poses. Noise stays float32 too, because it may lie below the range of half. Half
# radiance is exact to 2^-11 above 6.1e-5 W m^-2 sr^-1, to 3e-8 W m^-2 sr^-1 below.
HALF_CHANNELS = ("Y", "N.X", "N.Y", "N.Z", "albedo")
# Side of the square of samples that share an estimate of noise: 25 values, so 14 % uncertain.
_NOISE_SIDE = 5
CONVENTIONS = {
    "axes": "y, x: row, column; row 0 on top; sample centres at +0.5",
    "instant": "radiance: mean over the slot; all other passes: the middle of the slot, times_s[1]",
    "rays": "all but radiance: one ray through the centre of each sample and of the lens, first surface, "
    "never filtered",
    "nothing": "id 0, all other passes 0, occluded 1",
    "depth": "Z: planar, z of the camera frame; distance: along the ray from the pinhole",
    "normal": "unit shading normal in the world, on the camera's side",
    "flow": "place of the surface point at times_s[2] (forward) or times_s[0] (backward) minus its place "
    "now; also given where it is hidden then",
    "occluded": "1 where the surface point is not seen at that instant: hidden, or outside of the picture",
    "moving": "1 where a mover moves the part, even if it rests then",
    "camera": "frame as OpenCV's: x right, y down, z forward; intrinsics_px takes it to (column, row), after "
    "x/z and y/z were multiplied by 1 + radial_k1 ((x/z)^2 + (y/z)^2)",
    "camera_to_world": "camera frame -> world, m, at each of times_s",
    "object_poses": "rigid movers: world at time 0 -> world at each of times_s; null for movers that deform, "
    "with those of their parts",
    "id": "id_table: of objects, a model with all its parts; part_table: part -> object's id and part's name",
    "objects": "at times_s[1], by id. Boxes in the picture are left, top, right, bottom. box_px: amodal, of "
    "the projected vertices, clipped to the picture; visible_box_px: of samples that show it; visibility: "
    "share of the samples that it would cover alone which show it; box_m: middle, sides, their directions "
    "in the world as columns: the object's own axes where it is rigid, else the world's",
    "noise": "where nothing moves the noise of Y is frozen: what stands still is rendered once, and "
    "all slots share its noise, which is no texture; only a moving camera has every slot rendered anew",
    "Y.sigma": f"standard deviation of the Monte-Carlo noise of Y, from the two halves of the render, over "
    f"{_NOISE_SIDE} x {_NOISE_SIDE} samples of the same part",
}
# Replaces the noise's convention where each slot has its own noise.
OWN_NOISE = "every slot was rendered by itself: no two share the noise of Y, not even where nothing moves"
UNITS = {
    "Y": "W m^-2 sr^-1",
    "Y.sigma": "W m^-2 sr^-1",
    "Z": "m",
    "distance": "m",
    "N": "1, world axes",
    "albedo": "1",
    "id": "object id",
    "part": "part",
    "objects": "fine samples (boxes in the picture), m (boxes in space)",
    "flow": "fine samples",
    "occluded": "mask",
    "moving": "mask",
    "camera_to_world": "m",
    "times_s": "s",
}


def slot_mean(radiance: Video, slot: int) -> Floats:
    """Mean light over a slot on the fine grid: (y, x), float32."""
    first = slot % radiance.slots_per_segment * radiance.instants_per_slot
    segment = radiance.load(slot // radiance.slots_per_segment)
    total = np.zeros((radiance.rows, radiance.cols))
    for instant in range(first, first + radiance.instants_per_slot):
        total += segment.instant(instant)
    return (total / radiance.instants_per_slot).astype(np.float32)


def noise_sigma(half_difference: Floats, ids: Ids) -> Floats:
    """Estimate the sigma of noise from (half A - half B) / 2 over a small square of a part (or id)."""
    # A square is an unbiased estimate of the variance of the mean of both halves, of one degree of freedom.
    reach = _NOISE_SIDE // 2
    square = np.pad(half_difference.astype(np.float64) ** 2, reach)
    # No object has this id: beyond the border there is no neighbour.
    owner = np.pad(ids.astype(np.int64), reach, constant_values=-1)
    rows, cols = ids.shape
    total, count = np.zeros((rows, cols)), np.zeros((rows, cols))
    for row in range(_NOISE_SIDE):
        for col in range(_NOISE_SIDE):
            window = (slice(row, row + rows), slice(col, col + cols))
            same = owner[window] == ids
            total += np.where(same, square[window], 0.0)
            count += same
    return np.sqrt(total / count).astype(np.float32)


def channels_of(passes: Passes, radiance: Floats, sigma: Floats | None) -> dict[str, NDArray[np.generic]]:
    """Name the channels of a slot's file; masks are 0 or 1 as uint32."""
    noise = {} if sigma is None else {"Y.sigma": sigma}
    masks = {
        "moving": passes.moving,
        "occluded.forward": passes.occluded_forward,
        "occluded.backward": passes.occluded_backward,
    }
    return {
        "Y": radiance,
        **noise,
        "Z": passes.depth_m,
        "distance": passes.distance_m,
        **{f"N.{axis}": passes.normal[..., i] for i, axis in enumerate("XYZ")},
        "albedo": passes.albedo,
        "id": passes.ids,
        "part": passes.parts,
        **{f"flow.forward.{axis}": passes.flow_forward_px[..., i] for i, axis in enumerate(("row", "col"))},
        **{f"flow.backward.{axis}": passes.flow_backward_px[..., i] for i, axis in enumerate(("row", "col"))},
        **{name: mask.astype(np.uint32) for name, mask in masks.items()},
    }
