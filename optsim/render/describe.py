"""Describe a scene for Mitsuba: shapes, surfaces, lamps, sky and the sensor, in a fixed order."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from optsim.core.errors import ConfigError
from optsim.core.foreign import reading
from optsim.core.quantities import Floats, View
from optsim.render.lens import focus_depth_m, ideal
from optsim.scene.bands import MONO, Band, in_channel, value_in
from optsim.scene.camera_pose import CameraPose
from optsim.scene.geometry import Mesh
from optsim.scene.lamps import Lamp
from optsim.scene.materials import Diffuse, Glass, Material, Metal, Plastic, Principled
from optsim.scene.models import FORMATS, Surface, read_model
from optsim.scene.pictures import read_map, read_picture
from optsim.scene.scene import Scene
from optsim.scene.sky import PictureSky, SunSky
from optsim.scene.static_shapes import StaticShapes
from optsim.scene.textures import outside_map, reflectance_map

# Mitsuba offsets rays from a surface by at least 1e-4 units, so scenes nearer than this get a smaller unit.
_SMALL_M = 0.25
# Least roughness of a map: as of a model's number.
_SMOOTHEST = 0.01
_VERTEX_COLOURS = "vertex_reflectance"  # Mitsuba takes what begins so as one value a vertex
_IMAGES = ("bitmap", "envmap")  # plugins that read an image file


def unit_m(scene: Scene) -> float:
    """Length of the renderer's unit, m: 1, or less in tiny scenes, where Mitsuba's ray offsets would show."""
    # Light doesn't depend on scale; by a power of two vertices are scaled exactly.
    distance = scene.camera.distance_m
    return 1.0 if distance >= _SMALL_M else float(2.0 ** np.floor(np.log2(distance)))


def parse_static(mi: Any, scene: Scene) -> Any:
    """Parse the scene's file of shapes, if it has one, and read its images."""
    if scene.static is None:
        return None
    # Before the thread count is lowered: Mitsuba's OpenEXR reader hangs with a single thread.
    with _named(scene.static):
        config = mi.parser.ParserConfig(mi.variant())
        config.merge_equivalent = config.merge_meshes = False
        state = mi.parser.parse_string(config, scene.static.ready(unit_m(scene)))
        for node in state.nodes:
            if node.props.plugin_name() in _IMAGES and "filename" in node.props:
                node.props["bitmap"] = _image(mi, Path(node.props["filename"]))
                del node.props["filename"]
        mi.parser.transform_all(config, state)
    return config, state


def _image(mi: Any, path: Path) -> Any:
    """Read an image file; a truncated one is refused, while Mitsuba fills a JPEG's missing part with grey."""
    with reading(path, "an image"):
        image = mi.Bitmap(str(path))
        with path.open("rb") as stream:
            jpeg = stream.read(2) == b"\xff\xd8"
        if jpeg:
            with Image.open(path) as picture:
                picture.load()
    return image


def describe(mi: Any, scene: Scene, view: View, *, movers: bool, static: Any = None) -> dict[str, Any]:
    """Describe a scene of the variant's bands to ``mi.load_dict``; ``static`` is :func:`parse_static`'s."""
    unit, bands = unit_m(scene), _bands(mi, scene)
    meshes = {
        f"still_{material}": (mesh, material) for material, mesh in sorted(scene.still_meshes().items())
    }
    if movers:
        meshes |= {f"mover_{name}": (item.rest(), item.material) for name, item in scene.singles().items()}
    content: dict[str, Any] = {"type": "scene", "sensor": _sensor(mi, scene.camera, view, unit)}
    for name, lamp in sorted(scene.lamps.items()):
        content[f"lamp_{name}"] = _lamp(mi, lamp, unit, bands)
    if scene.sky is not None and scene.sky.lit:
        content["sky"] = _sky(mi, scene.sky, bands)
    # A kernel has the code of every surface object, and each launch traces them all: equal ones are one.
    surfaces: list[tuple[Material, Any]] = []
    for name, (mesh, key) in meshes.items():
        material = scene.materials[key]
        tiled = isinstance(material, Diffuse | Plastic | Principled)
        alike = material.model_copy(update={"tile_m": 1.0}) if tiled else material
        surface = next((found for known, found in surfaces if known == alike), None)
        if surface is None:
            surface = mi.load_dict(_surface(mi, material, bands))
            surfaces.append((alike, surface))
        content[name] = _mesh(mi, name, mesh, material, surface, unit, bands)
    if scene.static is not None:
        with _named(scene.static):
            loaded: Any = mi.parser.instantiate(*static)
        content |= {f"static_{index}": shape for index, shape in enumerate(loaded.shapes())}
    # Roulette from the 4th segment on minimises squared noise times time on window_room, 25 % less than from
    # the 3rd.
    content["integrator"] = {"type": "path", "max_depth": scene.max_depth, "rr_depth": 4}
    return content


def _bands(mi: Any, scene: Scene) -> tuple[Band, ...]:
    """Bands of the variant's channels."""
    bands = scene.bands or (MONO,)
    if len(bands) == 1 or (len(bands) == 3 and str(mi.variant()).endswith("_ad_rgb")):
        return bands
    names = ", ".join(band.name for band in bands)
    raise ConfigError(
        f"bands: got {names}, but light is rendered one band at a time; cure: "
        "choose one by Scene.in_band(name), or scene.band in an experiment"
    )


@contextmanager
def _named(static: StaticShapes) -> Generator[None, None, None]:
    """Name the file in Mitsuba's errors about it."""
    try:
        yield
    except RuntimeError as error:
        said = " ".join(str(error).split())
        raise ConfigError(f"{Path(static.folder) / static.name}: Mitsuba cannot load it: {said}") from None


def _mesh(
    mi: Any,
    name: str,
    mesh: Mesh,
    material: Material,
    surface: Any,
    unit: float,
    bands: tuple[Band, ...],
) -> Any:
    """Make a Mitsuba mesh with smooth normals and texture coordinates."""
    properties = mi.Properties()
    properties["bsdf"] = surface
    shape = mi.Mesh(
        name,
        len(mesh.vertices_m),
        len(mesh.faces),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=True,
    )
    tile_m = material.tile_m if isinstance(material, Diffuse | Plastic | Principled) else 1.0
    if isinstance(material, Principled) and material.vertex_colours:
        white = np.ones((len(mesh.vertices_m), 3), np.float32)
        rgb = white if mesh.colours is None else mesh.colours
        shares = [in_channel(rgb, band.channel) * value_in(material.reflectance, band) for band in bands]
        shape.add_attribute(_VERTEX_COLOURS, len(bands), np.stack(shares, axis=-1).astype(np.float32).ravel())
    parameters = mi.traverse(shape)
    parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = (mesh.uv / tile_m).astype(np.float32).ravel()
    parameters["vertex_positions"] = (mesh.vertices_m / unit).astype(np.float32).ravel()
    parameters.update()
    shape.set_id(name)
    return shape


def _surface(mi: Any, material: Material, bands: tuple[Band, ...]) -> dict[str, Any]:
    """Describe a material; both sides are equal, except for glass, which transmits."""
    opacity: dict[str, Any] | float | None = None
    match material:
        case Diffuse():
            inside: dict[str, Any] = {"type": "diffuse", "reflectance": _reflectance(mi, material, bands)}
        case Plastic():
            inside = {
                "type": "pplastic",
                "diffuse_reflectance": _reflectance(mi, material, bands),
                "int_ior": material.ior,
                "ext_ior": 1.0,
                "alpha": material.roughness,
            }
        case Principled():
            inside = {
                "type": "principled",
                "base_color": _reflectance(mi, material, bands),
                "roughness": _scaled(mi, material, "roughness_map", material.roughness),
                "metallic": _scaled(mi, material, "metallic_map", material.metallic),
            }
            opacity = _opacity(mi, material)
        case Metal():
            inside = {"type": "conductor", **_index(mi, material.metal, bands)}
            if material.roughness > 0:
                inside |= {"type": "roughconductor", "distribution": "ggx", "alpha": material.roughness}
        case Glass():
            kind = "thindielectric" if material.thin else "dielectric"
            return {"type": kind, "int_ior": material.ior, "ext_ior": 1.0}
    both: dict[str, Any] = {"type": "twosided", "bsdf": inside}
    normals = _map(material, "normal_map") if isinstance(material, Diffuse | Principled) else None
    if normals is not None:
        # Outside of both sides: a bump is a dent from behind. Radiance is the cosine's to the mapped normal:
        # Mitsuba's softened terminator takes 0.1 % and more from it.
        both = {
            "type": "normalmap",
            "normalmap": _bitmap(mi, normals, _wrap(material)),
            "use_shadowing_function": False,
            "bsdf": both,
        }
    return both if opacity is None else {"type": "mask", "opacity": opacity, "bsdf": both}


def _map(material: Diffuse | Principled, key: str) -> Floats | None:
    """Read a material's map of raw numbers, from a picture or from a model."""
    name = getattr(material, key)
    if name is None:
        return None
    surface = _of_model(material)
    return read_map(Path(name), key) if surface is None else surface.maps[key]


def _scaled(mi: Any, material: Principled, key: str, number: float) -> dict[str, Any] | float:
    """Describe a map times a number, or the number."""
    values = _map(material, key)
    if values is None:
        return number
    least = _SMOOTHEST if key == "roughness_map" else 0.0
    return _bitmap(mi, np.maximum(values * np.float32(number), np.float32(least)), _wrap(material))


def _reflectance(
    mi: Any, material: Diffuse | Plastic | Principled, bands: tuple[Band, ...]
) -> dict[str, Any]:
    """Describe reflectances at vertices, a reflectance map, or one reflectance."""
    if isinstance(material, Principled) and material.vertex_colours:
        return {"type": "mesh_attribute", "name": _VERTEX_COLOURS}
    return _texture(mi, [_reflectance_in(material, band) for band in bands], _wrap(material))


def _reflectance_in(material: Diffuse | Plastic | Principled, band: Band) -> float | Floats:
    """Reflectance map of a band, or its reflectance."""
    share = np.float32(value_in(material.reflectance, band))
    picture = None
    if material.picture is not None:
        surface = _of_model(material)
        if surface is None:
            picture = read_picture(Path(material.picture), band.channel)
        elif surface.picture is not None:
            picture = in_channel(surface.picture, band.channel).astype(np.float32)
    elif not isinstance(material, Principled) and material.texture is not None:
        picture = reflectance_map(material.texture, band.channel)
    return float(share) if picture is None else picture * share


def _index(mi: Any, metal: str, bands: tuple[Band, ...]) -> dict[str, Any]:
    """Describe the complex refractive index of a metal, by the renderer's tables."""
    if bands == (MONO,):
        return {"material": metal}
    found: dict[str, Any] = {}
    for part in ("eta", "k"):
        path = Path(mi.__file__).parent / "data" / "ior" / f"{metal}.{part}.spd"
        with reading(path, "Mitsuba's table of a metal", "install the mitsuba version that optsim states"):
            known: NDArray[np.float64] = np.loadtxt(path)
        found[part] = _texture(
            mi, [float(np.interp(band.wavelength_nm, known[:, 0], known[:, 1])) for band in bands]
        )
    return found


def _opacity(mi: Any, material: Principled) -> dict[str, Any] | float | None:
    """Describe a cut-out or a uniform opacity; None for what is opaque."""
    surface = _of_model(material)
    if surface is not None and surface.cutout is not None:
        return _bitmap(mi, surface.cutout * np.float32(material.opacity), _wrap(material))
    return material.opacity if material.opacity < 1 else None


def _of_model(material: Material) -> Surface | None:
    """Surface of the part of a model whose pictures a material has; None for one with pictures of its own."""
    if not isinstance(material, Principled):
        return None
    names = (material.picture, material.normal_map, material.roughness_map, material.metallic_map)
    file = next((Path(name) for name in names if name and Path(name).suffix.lower() in FORMATS), None)
    return None if file is None else read_model(file).parts[material.part or 0][0]


def _wrap(material: Material) -> str:
    """How a material's pictures go on beyond their edges."""
    surface = _of_model(material)
    return "repeat" if surface is None else surface.wrap


def _texture(mi: Any, values: Sequence[float | Floats], wrap: str = "repeat") -> dict[str, Any]:
    """Describe a value of each channel: numbers, or maps."""
    numbers = [value for value in values if isinstance(value, float)]
    if len(numbers) == len(values):
        one = {"type": "uniform", "value": numbers[0]}
        return one if len(numbers) == 1 else {"type": "rgb", "value": numbers}
    return _bitmap(mi, np.stack(np.broadcast_arrays(*values), axis=-1), wrap)


def _bitmap(mi: Any, image: Floats, wrap: str) -> dict[str, Any]:
    """Describe a map (y, x) or (y, x, channel)."""
    picture: NDArray[np.float32] = np.ascontiguousarray(image if image.ndim == 3 else image[..., None])
    return {"type": "bitmap", "bitmap": mi.Bitmap(picture), "raw": True, "wrap_mode": wrap}


def _lamp(mi: Any, lamp: Lamp, unit: float, bands: tuple[Band, ...]) -> dict[str, Any]:
    """Describe a black rectangle that emits if its lamp is lit."""
    u, v = np.asarray(lamp.edge_u_m) / 2, np.asarray(lamp.edge_v_m) / 2
    # Unit vectors, since a product of tiny edges would vanish in single precision.
    normal = np.cross(u / np.linalg.norm(u), v / np.linalg.norm(v))
    matrix = np.eye(4)
    matrix[:3] = np.stack([u / unit, v / unit, normal, np.asarray(lamp.center_m) / unit], axis=1)
    rectangle: dict[str, Any] = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
    }
    if lamp.lit:
        light: list[float | Floats] = [value_in(lamp.radiance_w_m2_sr, band) for band in bands]
        if lamp.picture is not None:
            light = [outside_map(lamp.picture) * np.float32(radiance) for radiance in light]
        rectangle["emitter"] = {
            "type": "area",
            "radiance": _texture(mi, light, "clamp"),
            "sampling_weight": lamp.sampling_weight,
        }
    return rectangle


def _sky(mi: Any, sky: PictureSky | SunSky, bands: tuple[Band, ...]) -> dict[str, Any]:
    """Describe an emitter all around, which Mitsuba samples by its brightness."""
    # Mitsuba's map has y up and z in its middle column; ours has z up and x there, turned by the azimuth.
    upright = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    cos, sin = np.cos(sky.turn_rad), np.sin(sky.turn_rad)
    turn = np.array([[cos, -sin, 0, 0], [sin, cos, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    picture = np.stack([sky.radiance(band) for band in bands], axis=-1)
    return {
        "type": "envmap",
        "bitmap": mi.Bitmap(picture),
        "to_world": mi.ScalarTransform4f(turn @ upright),
        "sampling_weight": sky.sampling_weight,
    }


def camera_to_world(mi: Any, pose: CameraPose, unit: float) -> Any:
    """Transform of the sensor at a motionless pose, in the renderer's unit."""
    transform: Any = mi.ScalarTransform4f()
    origin, target = (np.asarray(point) / unit for point in (pose.position_m, pose.target_m))
    return transform.look_at(origin=list(origin), target=list(target), up=[0, 0, 1])


def _sensor(mi: Any, camera: CameraPose, view: View, unit: float) -> dict[str, Any]:
    """Describe a pinhole or a thin lens before the ideal grid: Mitsuba's sensors don't distort."""
    lens: dict[str, Any] = {"type": "perspective"}
    if view.aperture_m:
        radius, distance = view.aperture_m / 2 / unit, focus_depth_m(camera, view) / unit
        lens = {"type": "thinlens", "aperture_radius": radius, "focus_distance": distance}
    view = ideal(view)
    return {
        **lens,
        "to_world": camera_to_world(mi, camera.at(0.0), unit),
        "fov": float(np.degrees(2 * np.arctan(view.tan_half_width))),
        "fov_axis": "x",
        "near_clip": camera.near_m / unit,
        "far_clip": camera.far_m / unit,
        "sampler": {"type": "multijitter"},
        "film": {
            "type": "hdrfilm",
            "width": view.cols,
            "height": view.rows,
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
            "component_format": "float32",
        },
    }
