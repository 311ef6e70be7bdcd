# pyright: reportMissingTypeStubs=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
"""From a scene to what Mitsuba loads: shapes, surfaces, lamps and the sensor, in a fixed order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from optsim.quantities import Floats, View
from optsim.scene.geometry import Mesh
from optsim.scene.parts import Lamp, Material
from optsim.scene.scene import Scene
from optsim.scene.textures import outside_map, reflectance_map


def describe(mi: Any, scene: Scene, view: View, *, movers: bool) -> dict[str, Any]:
    """Describe a scene to ``mi.load_dict``.

    Parameters
    ----------
    mi : module
        Mitsuba with its variant set.
    scene : Scene
        What to load.
    view : View
        Fine grid and field of view.
    movers : bool
        Whether the movers are on stage; lamps and sensor are the same either way.
    """
    meshes = {
        f"still_{material}": (mesh, material) for material, mesh in sorted(scene.still_meshes().items())
    }
    if movers:
        meshes |= {f"mover_{name}": (item.rest(), item.material) for name, item in scene.singles().items()}
    content: dict[str, Any] = {"type": "scene", "sensor": _sensor(mi, scene, view)}
    for name, lamp in sorted(scene.lamps.items()):
        content[f"lamp_{name}"] = _lamp(mi, lamp)
    for name, (mesh, material) in meshes.items():
        content[name] = _mesh(mi, name, mesh, scene.materials[material])
    content["integrator"] = {"type": "path", "max_depth": scene.max_depth, "rr_depth": 3}
    return content


def _mesh(mi: Any, name: str, mesh: Mesh, material: Material) -> Any:
    """Make a Mitsuba mesh with smooth normals and texture coordinates."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(
        {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": _reflectance(mi, material)}}
    )
    shape = mi.Mesh(
        name,
        len(mesh.vertices_m),
        len(mesh.faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    parameters = mi.traverse(shape)
    parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = (mesh.uv / material.tile_m).astype(np.float32).ravel()
    parameters["vertex_positions"] = mesh.vertices_m.astype(np.float32).ravel()
    parameters.update()
    shape.set_id(name)
    return shape


def _reflectance(mi: Any, material: Material) -> dict[str, Any]:
    if material.texture is None:
        return {"type": "uniform", "value": material.reflectance}
    return _bitmap(mi, reflectance_map(material.texture) * np.float32(material.reflectance), "repeat")


def _bitmap(mi: Any, image: Floats, wrap: str) -> dict[str, Any]:
    picture: NDArray[np.float32] = np.ascontiguousarray(image[..., None])
    return {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True, "wrap_mode": wrap}


def _lamp(mi: Any, lamp: Lamp) -> dict[str, Any]:
    u, v = np.asarray(lamp.edge_u_m) / 2, np.asarray(lamp.edge_v_m) / 2
    normal = np.cross(u, v)
    matrix = np.eye(4)
    matrix[:3] = np.stack([u, v, normal / np.linalg.norm(normal), np.asarray(lamp.center_m)], axis=1)
    light: dict[str, Any] = {"type": "uniform", "value": lamp.radiance_w_m2_sr}
    if lamp.picture is not None:
        light = _bitmap(mi, outside_map(lamp.picture) * np.float32(lamp.radiance_w_m2_sr), "clamp")
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
        "emitter": {"type": "area", "radiance": light, "sampling_weight": lamp.sampling_weight},
    }


def _sensor(mi: Any, scene: Scene, view: View) -> dict[str, Any]:
    camera = scene.camera
    transform: Any = mi.ScalarTransform4f()
    return {
        "type": "perspective",
        "to_world": transform.look_at(
            origin=list(camera.position_m), target=list(camera.target_m), up=[0, 0, 1]
        ),
        "fov": float(np.degrees(2 * np.arctan(view.tan_half_width))),
        "fov_axis": "x",
        "near_clip": 0.01,
        "far_clip": 1000.0,
        "film": {
            "type": "hdrfilm",
            "width": view.cols,
            "height": view.rows,
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
            "component_format": "float32",
        },
    }
