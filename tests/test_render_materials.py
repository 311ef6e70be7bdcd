"""From scene to Mitsuba: materials conserve energy, lamps are in order, shapes files and scales work."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image
from test_mesh_files import serialized

from optsim.core.config import build
from optsim.core.errors import ConfigError, StorageError
from optsim.core.quantities import View
from optsim.render import choose_backend
from optsim.render.backend import activate
from optsim.render.describe import describe, unit_m
from optsim.render.stage import RenderStage
from optsim.scene import load_scene
from optsim.scene.scene import Scene

VIEW = View(24, 32, 1, 0.32)
PIXELS = np.arange(VIEW.rows * VIEW.cols)
# Inward faces of the cube -3 .. 3, as centre, edges (edge_u x edge_v points inward).
WALLS = {
    "east": ((3, 0, 0), (0, 0, 6), (0, 6, 0)),
    "west": ((-3, 0, 0), (0, 6, 0), (0, 0, 6)),
    "north": ((0, 3, 0), (6, 0, 0), (0, 0, 6)),
    "south": ((0, -3, 0), (0, 0, 6), (6, 0, 0)),
    "top": ((0, 0, 3), (0, 6, 0), (6, 0, 0)),
    "bottom": ((0, 0, -3), (6, 0, 0), (0, 6, 0)),
}


@pytest.fixture(scope="module", autouse=True)
def backend():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()
    yield
    activate()


def scaled(value, scale):
    """Lengths of a nested table, multiplied: keys that end in ``_m``."""
    if isinstance(value, dict):
        return {
            key: (np.multiply(item, scale).tolist() if key.endswith("_m") else scaled(item, scale))
            for key, item in value.items()
        }
    return value


def furnace(material, thing):
    """Make a closed cube whose walls shine with radiance 1 round a thing: what is lossless vanishes."""
    lamps = {
        name: {"center_m": center, "edge_u_m": u, "edge_v_m": v, "radiance_w_m2_sr": 1.0}
        for name, (center, u, v) in WALLS.items()
    }
    table = {
        "name": "furnace",
        "white_w_m2_sr": 1.0,
        "max_depth": 64,
        "camera": {"position_m": (0, -2.8, 0), "target_m": (0, 0, 0)},
        "materials": {"m": material},
        "lamps": lamps,
        "objects": {"thing": {"material": "m"} | thing},
    }
    return build(Scene, table, where="furnace")


GLOBE = {"kind": "globe", "center_m": (0, 0, 0), "radius_m": 1.0}
PANE = {"kind": "quad", "corner_m": (-1, 0, -1), "edge_u_m": (2, 0, 0), "edge_v_m": (0, 0, 2)}

# Material, thing, lowest and highest mean radiance that it may show where it fills the picture.
FURNACES = {
    # Exact: the reflectance. The path's own noise over this patch is below 0.2 %.
    "diffuse": ({"reflectance": 0.5}, GLOBE, 0.4975, 0.5025),
    "white diffuse": ({"kind": "diffuse", "reflectance": 1.0}, GLOBE, 0.99, 1.0025),
    # Head-on, by hand: F0 + (1 - F0) (1 - Fd) reflectance with F0 = 0.04 and, over the hemisphere,
    # Fd = 0.0918; what the coat throws back at the base is lost. Roughness and slanted rays: within 0.01.
    "white plastic": ({"kind": "plastic", "reflectance": 1.0}, GLOBE, 0.902, 0.922),
    "grey plastic": ({"kind": "plastic", "reflectance": 0.5}, GLOBE, 0.466, 0.486),
    "black plastic": ({"kind": "plastic", "reflectance": 0.0}, GLOBE, 0.035, 0.045),
    # Fresnel reflectance head-on of the mean index over the visible is 0.919; a globe shows slants too.
    "aluminium": ({"kind": "metal", "metal": "Al", "roughness": 0.1}, GLOBE, 0.89, 0.93),
    "mirror": ({"kind": "metal", "metal": "Ag", "roughness": 0.0}, GLOBE, 0.94, 0.98),
    "copper": ({"kind": "metal", "metal": "Cu", "roughness": 0.2}, GLOBE, 0.60, 0.76),
    # Nothing is absorbed: invisible. Russian roulette keeps the mean.
    "pane": ({"kind": "glass"}, PANE, 0.99, 1.01),
    "solid glass": ({"kind": "glass", "thin": False}, GLOBE, 0.98, 1.01),
}


@pytest.fixture
def variant(request):
    import mitsuba as mi

    if request.param not in mi.variants():
        pytest.skip(f"this Mitsuba has no {request.param}")
    before = mi.variant()
    mi.set_variant(request.param)
    yield mi
    mi.set_variant(before)


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "scalar_rgb", "llvm_ad_mono_polarized"], indirect=True)
@pytest.mark.parametrize("name", FURNACES)
def test_materials_conserve_energy_in_a_closed_furnace(variant, name):
    material, thing, low, high = FURNACES[name]
    view = View(12, 12, 1, 0.1)
    loaded = variant.load_dict(describe(variant, furnace(material, thing), view, movers=True), optimize=False)
    image = np.array(variant.render(loaded, spp=400)).mean(axis=2)
    assert np.isfinite(image).all()
    # In colour, a metal has three values; the bounds are for the one band.
    slack = 0.05 if variant.variant() == "scalar_rgb" and material.get("kind") == "metal" else 0.0
    assert low - slack < image.mean() < high + slack


def test_an_index_is_relative_to_vacuum_and_a_texture_is_on_the_coat_s_base():
    """Head-on, the coat of a black base reflects ((n - 1) / (n + 1))^2 of the furnace's light."""
    black = {"kind": "plastic", "reflectance": 0.0, "ior": 2.0, "roughness": 0.02}
    view = View(8, 8, 1, 0.02)
    shown = RenderStage(furnace(black, PANE), view).radiance(np.arange(64), 256, (1,)).mean()
    assert shown == pytest.approx(1 / 9, rel=0.02)
    checker = {"kind": "plastic", "texture": "checker", "tile_m": 0.2}
    image = RenderStage(furnace(checker, PANE), VIEW).radiance(PIXELS, 64, (1,))
    assert image.std() > 0.05


# --- order ------------------------------------------------------------------------------------------------

CLOSED = {
    "name": "closed",
    "white_w_m2_sr": 1.0,
    "max_depth": 5,
    "camera": {"position_m": (0, -1.5, 0), "target_m": (0, 0, 0)},
    "materials": {"grey": {"texture": "checker"}, "shiny": {"kind": "plastic", "texture": "brick"}},
    "lamps": {
        name: {
            "center_m": (x, 0, 0.999),
            "edge_u_m": (0, 0.5, 0),
            "edge_v_m": (0.3, 0, 0),
            "radiance_w_m2_sr": light,
        }
        for name, x, light in (("b", -0.5, 2.0), ("a", 0.5, 9.0), ("c", 0.0, 3.0))
    },
    "objects": {
        "room": {"kind": "box", "material": "grey", "center_m": (0, 0, 0), "size_m": (2, 4, 2)},
        "ball": {"kind": "globe", "material": "shiny", "center_m": (0, 0.6, -0.6), "radius_m": 0.4},
    },
}
OUTSIDE = {"kind": "fan", "material": "grey", "center_m": (0, 9, 0), "radius_m": 0.4, "turns_hz": 5.0}


def closed(**changes):
    return build(Scene, CLOSED | changes, where="closed")


def test_lamps_and_random_numbers_do_not_depend_on_movers():
    """A mover outside the closed room changes no path at all, whatever it does."""
    plain = closed()
    moving = plain.model_copy(update={"movers": closed(movers={"a_first": OUTSIDE}).movers})
    stages = [RenderStage(plain, VIEW), RenderStage(moving, VIEW), RenderStage(moving, VIEW, movers=False)]
    stages[1].pose(0.37)
    images = [stage.radiance(PIXELS, 16, (1, 2)) for stage in stages]
    assert images[0].mean() > 0.01
    np.testing.assert_allclose(images[2], images[0], rtol=1e-4)
    # Embree may break ties along shared edges another way with one more shape.
    assert np.mean(np.abs(images[1] - images[0]) > 1e-5 * images[0].mean()) < 0.002
    ids = [[str(shape.id()) for shape in s._loaded.shapes() if shape.is_emitter()] for s in stages]
    assert ids[0] == ids[1] == ids[2] == ["lamp_a", "lamp_b", "lamp_c"]


def test_lamps_switched_off_stay_as_black_rectangles_and_lamps_add_up():
    scene = closed()
    whole = RenderStage(scene, VIEW)
    alone = [RenderStage(scene.only_lamps([name]), VIEW) for name in "abc"]
    assert [len(stage._loaded.emitters()) for stage in alone] == [1, 1, 1]
    assert {len(stage._loaded.shapes()) for stage in alone} == {len(whole._loaded.shapes())}
    together = sum(stage.radiance(PIXELS, 256, (7,)).mean() for stage in alone)
    # Light is additive; the noise of these means is about 0.5 %.
    assert together == pytest.approx(whole.radiance(PIXELS, 256, (7,)).mean(), rel=0.02)


def test_a_mover_may_pass_the_camera_and_leave_the_frame():
    """A ball on its way from the far wall through the pinhole, and out of the room."""
    path = {
        "kind": "keyframed",
        "objects": ["ball"],
        "times_s": [0, 1],
        "positions_m": [[0, 0, 0.6], [0, -4.2, 0.6]],
        "interpolation": "linear",
    }
    stage = RenderStage(closed(movers={"m": path}), VIEW)
    seen = []
    for time_s in (0.0, 0.3, 0.5, 1.0, 2.0):
        stage.pose(time_s)
        image = stage.radiance(PIXELS, 8, (1,))
        assert np.isfinite(image).all()
        seen.append(image.mean())
    # At half time it is round the pinhole (0, -1.5, 0): inside it is dark; afterwards it is out of the way.
    assert seen[2] < 1e-6 < 0.01 < min(seen[0], seen[3])
    # Behind the camera's back and outside the room it changes nothing any more.
    assert seen[4] == seen[3]


# --- shapes files -------------------------------------------------------------------------------------------

TOML = """
name = "x"
white_w_m2_sr = 1.0
static = "static.xml"
[camera]
position_m = [0, -3, 0]
target_m = [0, 0, 0]
[materials.grey]
[lamps.a]
center_m = [0, -2, 2]
edge_u_m = [1, 0, 0]
edge_v_m = [0, -1, 0]
radiance_w_m2_sr = 9.0
"""
DEGENERATE = """v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
f 1 2 3
f 1 3 4
f 1 1 2
f 2 2 2
"""


def test_a_shapes_file_is_seen_and_degenerate_triangles_do_no_harm(tmp_path):
    (tmp_path / "scene.toml").write_text(TOML)
    (tmp_path / "wall.obj").write_text(DEGENERATE)
    shape = '<shape type="obj"><string name="filename" value="wall.obj"/>'
    flat = '<boolean name="face_normals" value="true"/>'
    surface = '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
    (tmp_path / "static.xml").write_text(f'<scene version="3.0.0">{shape}{flat}{surface}</scene>')
    image = RenderStage(load_scene(tmp_path), VIEW).radiance(PIXELS, 64, (1,)).reshape(VIEW.rows, VIEW.cols)
    assert np.isfinite(image).all()
    assert (image[8:16, 12:20] > 0).all()
    behind = '<shape type="sphere"><point name="center" x="0" y="-9" z="0"/></shape>'
    (tmp_path / "static.xml").write_text(f'<scene version="3.0.0">{behind}</scene>')
    assert RenderStage(load_scene(tmp_path), VIEW).radiance(PIXELS, 4, (1,)).max() == 0


def test_the_layout_of_serialized_meshes_is_mitsubas(tmp_path):
    (tmp_path / "scene.toml").write_text(TOML)
    corners = [(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)]
    lines = ["v {} {} {}".format(*corner) for corner in corners]
    (tmp_path / "wall.obj").write_text("\n".join([*lines, "f 1 2 3", "f 1 3 4\n"]))
    (tmp_path / "wall.serialized").write_bytes(serialized([(0, 1, 2), (0, 2, 3)], corners))
    images = []
    for kind in ("obj", "serialized"):
        named = f'<string name="filename" value="wall.{kind}"/><boolean name="face_normals" value="true"/>'
        surface = '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf>'
        shape = f'<shape type="{kind}">{named}{surface}</shape>'
        (tmp_path / "static.xml").write_text(f'<scene version="3.0.0">{shape}</scene>')
        images.append(RenderStage(load_scene(tmp_path), VIEW).radiance(PIXELS, 4, (1,)))
    assert images[0].max() > 0
    np.testing.assert_allclose(images[1], images[0], rtol=1e-5)


@pytest.mark.parametrize("name", ["t.png", "t.jpg", "t.bmp"])
def test_a_damaged_image_is_named(name, tmp_path):
    (tmp_path / "scene.toml").write_text(TOML)
    Image.fromarray(np.random.default_rng(1).integers(0, 255, (64, 64, 3), np.uint8)).save(tmp_path / name)
    whole = (tmp_path / name).read_bytes()
    texture = f'<texture type="bitmap" name="reflectance"><string name="filename" value="{name}"/></texture>'
    shape = f'<shape type="sphere"><bsdf type="diffuse">{texture}</bsdf></shape>'
    (tmp_path / "static.xml").write_text(f'<scene version="3.0.0">{shape}</scene>')
    RenderStage(load_scene(tmp_path), VIEW)
    for damaged in (whole[: len(whole) // 2], b"", b"no image at all"):
        (tmp_path / name).write_bytes(damaged)
        with pytest.raises(
            StorageError, match=rf"{tmp_path / name} cannot be read as an image: .*; cure:"
        ) as raised:
            RenderStage(load_scene(tmp_path), VIEW)
        assert "\n" not in str(raised.value)


IMAGES = """
import sys
from pathlib import Path
import numpy as np, mitsuba as mi
from optsim.core.quantities import View
from optsim.render.backend import activate
from optsim.render.stage import RenderStage
from optsim.scene import load_scene
activate(None)
folder = Path(sys.argv[1])
grey = np.full((8, 8, 3), 0.25, np.float32)
mi.Bitmap(grey).write(str(folder / "t.exr"))
mi.Bitmap(grey).write(str(folder / "t.hdr"))
mi.Bitmap(grey).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True).write(str(folder / "t.png"))
for name in ("exr", "hdr", "png"):
    image = '<texture type="bitmap" name="reflectance"><string name="filename" value="t.%s"/>' % name
    surface = '<bsdf type="twosided"><bsdf type="diffuse">%s</texture></bsdf></bsdf>' % image
    (folder / "static.xml").write_text(
        '<scene version="3.0.0"><shape type="sphere">%s</shape></scene>' % surface
    )
    print(RenderStage(load_scene(folder), View(8, 8, 1, 0.3)).picture(64, 1).mean())
"""


def test_images_that_a_shapes_file_names_are_seen_in_every_format(tmp_path):
    """By another process: Mitsuba's reader of OpenEXR would wait for ever on one thread."""
    (tmp_path / "scene.toml").write_text(TOML)
    command = [sys.executable, "-c", IMAGES, str(tmp_path)]
    done = subprocess.run(command, check=True, timeout=120, capture_output=True, text=True)
    means = [float(line) for line in done.stdout.split()[-3:]]
    assert means[0] > 0.01
    # The same seed, so only the rounding of 8 bits and of a shared exponent is left.
    np.testing.assert_allclose(means, means[0], rtol=0.01)


def test_what_mitsuba_refuses_is_named_before_rendering(tmp_path):
    (tmp_path / "scene.toml").write_text(TOML)
    (tmp_path / "static.xml").write_text('<scene version="3.0.0"><shape type="spheer"/></scene>')
    with pytest.raises(ConfigError, match=r"static\.xml: Mitsuba cannot load it.*spheer"):
        RenderStage(load_scene(tmp_path), VIEW)


# --- scale --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 1e-2, 1e3])
def test_light_does_not_depend_on_scale(scale):
    """The same room of 2 m, 2 mm and 2 km looks the same (contact shadows included)."""
    import mitsuba as mi

    view = View(48, 64, 1, 0.32)
    images = []
    for factor in (1.0, scale):
        table = scaled(CLOSED, factor)
        table["materials"] = CLOSED["materials"] | {"grey": {"texture": "checker", "tile_m": factor}}
        scene = build(Scene, table, where="scaled")
        assert scene.camera.near_m / unit_m(scene) < 0.1
        loaded = mi.load_dict(describe(mi, scene, view, movers=True), optimize=False)
        image = np.array(mi.render(loaded, spp=256, seed=1))[..., 0]
        images.append(image.reshape(6, 8, 8, 8).mean((1, 3)))
    # Blocks of 64 pixels x 256 samples with the same random numbers; at other scales only digits differ.
    np.testing.assert_allclose(images[1], images[0], rtol=0.05)
    assert images[1].mean() == pytest.approx(images[0].mean(), rel=0.005)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("share", [0.002, 900.0])
def test_near_and_far_things_are_seen_at_every_scale(scale, share):
    """A wall at 0.2 % of the viewing distance, and one at 900 times it, are hit at their depth."""
    import mitsuba as mi

    depth, wide = 1.5 * share, 4 * 1.5 * share
    wall = {
        "kind": "quad",
        "material": "grey",
        "corner_m": (-wide / 2, depth - 1.5, -wide / 2),
        "edge_u_m": (wide, 0, 0),
        "edge_v_m": (0, 0, wide),
    }
    scene = build(Scene, scaled(CLOSED | {"objects": {"wall": wall}}, scale), where="scaled")
    loaded = mi.load_dict(describe(mi, scene, VIEW, movers=True), optimize=False)
    ray, _ = loaded.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.6), mi.Point2f(0.5))
    hit = loaded.ray_intersect(ray)
    assert bool(np.all(hit.is_valid()))
    found = (float(hit.p.y[0]) * unit_m(scene) + 1.5 * scale) / scale
    assert found == pytest.approx(depth, rel=1e-3)


def test_equal_materials_are_one_surface_object():
    """Each launch traces every surface object: a model of a hundred parts must not have a hundred."""
    import mitsuba as mi

    quads = ("red", "also red", "tiled red", "blue")
    shared = {"kind": "plastic", "texture": "planks"}
    looks = {
        "red": shared,
        "also red": shared,
        "tiled red": {**shared, "tile_m": 0.3},
        "blue": {**shared, "reflectance": 0.2},
    }
    quad = {"kind": "quad", "edge_u_m": [1, 0, 0], "edge_v_m": [0, 0, 1]}
    table = {
        "name": "quads",
        "description": "four quads of two looks",
        "white_w_m2_sr": 1.0,
        "camera": {"position_m": [0, -3, 1], "target_m": [0, 0, 0.5]},
        "materials": looks,
        "lamps": {
            "top": {
                "center_m": [0, 0, 3],
                "edge_u_m": [1, 0, 0],
                "edge_v_m": [0, -1, 0],
                "radiance_w_m2_sr": 1,
            }
        },
        "objects": {
            name: {**quad, "material": name, "corner_m": [k - 2, 0, 0]} for k, name in enumerate(quads)
        },
    }
    scene = build(Scene, table, where="quads")
    content = describe(mi, scene, VIEW, movers=True)
    surfaces = {name: content[f"still_{name}"].bsdf() for name in quads}
    assert surfaces["red"] is surfaces["also red"] is surfaces["tiled red"]
    assert surfaces["blue"] is not surfaces["red"]
