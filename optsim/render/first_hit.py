# pyright: reportUnknownMemberType=false
"""First surface of one Mitsuba ray, or of a wavefront of rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class FirstHit:
    """First surface, in the types of Mitsuba's variant; in a wavefront, unread fields cost nothing."""

    distance: Any  # In the renderer's unit; infinite if no surface is hit: other fields are then meaningless.
    shape: Any  # Index of the shape.
    face: Any  # Index of its triangle.
    weights: Any  # Barycentric weights of the triangle's second and third vertex.
    normal: Any  # Shading normal.
    flat_normal: Any  # The triangle's own.
    albedo: Any  # Diffuse reflectance, of ``principled`` its base colour; 0 where there is no diffuse part.


def first_hit(mi: Any, loaded: Any, ray: Any, *, matt_only: bool = False) -> FirstHit:
    """Find the first surface of one ray or a wavefront of rays, depending on the variant."""
    import drjit as dr

    first = loaded.ray_intersect_preliminary(ray)
    hit = first.is_valid()
    if hit is False:
        return FirstHit(np.inf, 0, 0, [0.0] * 2, [0.0] * 3, [0.0] * 3, 0.0)
    surface = first.compute_surface_interaction(ray, mi.RayFlags.UV if matt_only else mi.RayFlags.All)
    material = surface.bsdf(ray)
    # Attributes with the reflectance of a material's diffuse part. Materials without the attribute give 0 in
    # a wavefront, and an error for a single ray.
    names = ("reflectance",) if matt_only else ("reflectance", "diffuse_reflectance")
    known = [name for name in names if hit is not True or material.has_attribute(name, True)]
    albedo = sum((material.eval_attribute(name, surface, hit)[0] for name in known), start=0.0 * first.t)
    if not matt_only:
        # Maps of normals and opacity name no attribute of what is below them. Mitsuba's own albedo is one of
        # matt and principled surfaces alone: of plastic and metal it evaluates the gloss, which exceeds 1.
        bare = (material.flags() & int(mi.BSDFFlags.DiffuseReflection)) == 0
        coated = material.has_attribute("diffuse_reflectance", hit)
        reflected = mi.unpolarized_spectrum(material.eval_diffuse_reflectance(surface, hit))
        albedo = dr.select(bare | coated, albedo, reflected[0])
    normal, flat = surface.sh_frame.n, surface.n
    shape = first.shape_index if hit is True else _shape_index(mi, loaded, first, hit)
    return FirstHit(first.t, shape, first.prim_index, first.prim_uv, normal, flat, albedo)


def first_place(mi: Any, loaded: Any, ray: Any) -> tuple[Any, Any, Any]:
    """Find distance, shape and triangle of the first surface, without evaluating it."""
    first = loaded.ray_intersect_preliminary(ray)
    hit = first.is_valid()
    if hit is False:
        return np.inf, 0, 0
    shape = first.shape_index if hit is True else _shape_index(mi, loaded, first, hit)
    return first.t, shape, first.prim_index


def _shape_index(mi: Any, loaded: Any, first: Any, hit: Any) -> Any:
    """Index in ``loaded.shapes()``, by comparing shapes: OptiX leaves Embree's ``shape_index`` 0."""
    import drjit as dr

    shapes: Any = dr.reinterpret_array(mi.UInt32, loaded.shapes_dr())
    pointers = np.asarray(shapes.numpy())
    index = np.zeros(pointers.max() + 1, np.uint32)
    index[pointers] = np.arange(pointers.size)
    met: Any = dr.reinterpret_array(mi.UInt32, first.shape)
    return dr.gather(mi.UInt32, mi.UInt32(index), met, hit)
