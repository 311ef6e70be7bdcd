"""Geometry of a scene at one instant, without light: surfaces, objects, motion, camera and poses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from optsim.core.errors import ValueCheckError
from optsim.core.quantities.arrays import Bools, Doubles, Floats, checked

Ids = NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class ObjectPose:
    """Pose of a mover at the three instants of a :class:`Passes`.

    Parameters
    ----------
    matrices : ndarray of shape (3, 4, 4), float64, or None
        World at time 0 -> world at t-, t, t+: a rigid motion. None for a mover that deforms.
    reason : str
        Reason for a missing matrix, with the largest deviation from rigid motion; empty for a rigid mover.
    center_m : ndarray of shape (3, 3), float64
        Mean of the mover's vertices at t-, t, t+, m: the reference point of a mover that deforms.
    """

    matrices: Doubles | None
    reason: str
    center_m: Doubles

    def __post_init__(self) -> None:
        if self.matrices is not None:
            _shaped("object pose", self.matrices, (3, 4, 4))
        _shaped("object centre", self.center_m, (3, 3))
        if (self.matrices is None) != bool(self.reason):
            raise ValueCheckError("object pose: expected either matrices or a reason why there are none")


@dataclass(frozen=True, eq=False)
class ObjectExtent:
    """Extent of an object at the instant t, whether it is seen or not.

    Boxes in the picture are (left, top, right, bottom) in fine samples, from the outer corner of the first.

    Parameters
    ----------
    category : str
        Category that the scene states, or its kind.
    box_px : tuple of 4 floats, or None
        Amodal: of the projected vertices, hidden ones too, clipped to the picture. None: outside.
    visible_box_px : tuple of 4 ints, or None
        Of the samples that show it; None without any.
    visible, covered : int
        Samples that show it, and those that it would cover if nothing stood before it.
    center_m, size_m : ndarray of shape (3,), float64
        Box in space: its middle in the world, and its sides.
    axes : ndarray of shape (3, 3), float64
        Columns are the directions of the sides in the world: the object's own axes if it is rigid, else the
        world's.
    """

    category: str
    box_px: tuple[float, float, float, float] | None
    visible_box_px: tuple[int, int, int, int] | None
    visible: int
    covered: int
    center_m: Doubles
    size_m: Doubles
    axes: Doubles

    @property
    def visibility(self) -> float:
        """Share of the samples that it would cover alone which show it; 0 outside of the picture."""
        return self.visible / self.covered if self.covered else 0.0


@dataclass(frozen=True, eq=False)
class Passes:
    """Passes of one instant t on the fine grid: one ray through the centre of every sample, never filtered.

    A sample shows the first surface along its ray, be it glass, a mirror or a lamp. Without a surface all
    passes are 0, the object id included, and both occlusion masks are set. There is no infinity and no NaN.

    Flow is the displacement of a sample's surface point in the image, in fine samples. Forward flow leads to
    its position at t+, backward flow to that at t-. The point moves with its object, and the camera moves
    too. Flow is also given for a point that is hidden then or outside the picture; the occlusion mask marks
    it. A point then behind the camera has flow 0 and is masked.

    The camera frame is that of OpenCV: x right, y down, z forward. ``intrinsics_px`` maps it to (column,
    row). Their origin is the outer corner of the first sample, so sample centres are at +0.5. Before that,
    distortion multiplies x/z and y/z by 1 + ``radial_k1`` ((x/z)^2 + (y/z)^2).

    The ray through a sample is its chief ray, through the centre of the lens: passes are never out of focus.

    Parameters
    ----------
    times_s : tuple of 3 floats
        Instants t-, t, t+, s.
    depth_m : ndarray of shape (y, x), float32
        Planar depth: the camera's z of the surface point, m.
    distance_m : ndarray of shape (y, x), float32
        Distance along the ray, from the pinhole to the surface point, m.
    normal : ndarray of shape (y, x, 3), float32
        Unit shading normal in the world (interpolated between vertices where an object is smooth, without a
        material's normal map), on the camera's side: its product with the viewing ray is not positive.
    albedo : ndarray of shape (y, x), float32
        Diffuse reflectance in the band, 0..1; of the base under a coat; 0 for metal, glass and lamps.
    ids : ndarray of shape (y, x), uint32
        Object seen; 0 for nothing.
    parts : ndarray of shape (y, x), uint32
        Part of the object: one of its materials, or a node of a model; 0 for nothing.
    moving : ndarray of shape (y, x), bool
        A mover of the scene moves the part, even if it rests at this instant.
    flow_forward_px, flow_backward_px : ndarray of shape (y, x, 2), float32
        Flow to t+ and to t-, (row, column) in fine samples.
    occluded_forward, occluded_backward : ndarray of shape (y, x), bool
        The surface point is not seen at t+ or t-: hidden, outside of the picture or of the depth range.
    id_table : Mapping
        Object id -> name, ``lamp/...``, ``object/...``, ``mover/...`` or ``static/...`` (a shape of the
        scene's own file), whether in view or not.
    part_table : Mapping
        Part -> id of its object, and the part's name.
    intrinsics_px : ndarray of shape (3, 3), float64
        Camera frame -> (column, row, 1) times depth, in fine samples, of the image without distortion.
    radial_k1 : float
        Distortion, as OpenCV's k1; 0 for none, negative for a barrel.
    camera_to_world : ndarray of shape (3, 4, 4), float64
        Camera frame -> world at t-, t, t+.
    object_poses : Mapping
        Name of a mover, as in the table -> its poses; of one that is not rigid as a whole, also those of its
        parts.
    extents : Mapping
        Object id -> its boxes, category and visibility; lamps and shapes of the scene's own file have none.
    """

    times_s: tuple[float, float, float]
    depth_m: Floats
    distance_m: Floats
    normal: Floats
    albedo: Floats
    ids: Ids
    parts: Ids
    moving: Bools
    flow_forward_px: Floats
    flow_backward_px: Floats
    occluded_forward: Bools
    occluded_backward: Bools
    id_table: Mapping[int, str]
    part_table: Mapping[int, tuple[int, str]]
    intrinsics_px: Doubles
    radial_k1: float
    camera_to_world: Doubles
    object_poses: Mapping[str, ObjectPose]
    extents: Mapping[int, ObjectExtent]

    def __post_init__(self) -> None:
        sizes = {"xyz": 3, "row col": 2}
        for names, unit, dtype, component in (
            ("ids", "object id", np.uint32, ()),
            ("parts", "part", np.uint32, ()),
            ("depth_m distance_m", "m", np.float32, ()),
            ("normal", "unit vector", np.float32, ("xyz",)),
            ("albedo", "1", np.float32, ()),
            ("flow_forward_px flow_backward_px", "fine samples", np.float32, ("row col",)),
            ("moving occluded_forward occluded_backward", "mask", np.bool_, ()),
        ):
            for name in names.split():
                array, axes = getattr(self, name), ("y", "x", *component)
                checked(name, array, axes=axes, dtype=dtype, unit=unit, nonnegative=not component)
                _shaped(name, array, (*self.ids.shape, *(sizes[each] for each in component)))
        if float(self.albedo.max()) > 1:
            raise ValueCheckError(f"albedo: got {self.albedo.max()}, expected 0..1")
        strange = sorted(set(np.unique(self.ids).tolist()) - {0} - set(self.id_table))
        if strange or 0 in self.id_table:
            raise ValueCheckError(
                f"ids: {strange or [0]} must be in the table; 0, which is nothing, must not"
            )
        _shaped("intrinsics_px", self.intrinsics_px, (3, 3))
        _shaped("camera_to_world", self.camera_to_world, (3, 4, 4))


def _shaped(name: str, array: NDArray[np.generic], shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueCheckError(f"{name}: got an array of shape {array.shape}, expected {shape}")
