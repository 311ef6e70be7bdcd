"""Normal and roughness maps: light by closed forms and against plain surfaces, raw numbers, bad files."""

import numpy as np
import pytest
import trimesh
from PIL import Image

from optsim.core.cache import Cache
from optsim.core.errors import ConfigError, OptsimError
from optsim.core.files import write_exr
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, choose_backend, render_passes, render_truth
from optsim.render.backend import activate
from optsim.render.stage import RenderStage
from optsim.scene import load_scene
from optsim.scene.models import read_model
from optsim.scene.pictures import read_map

VIEW = View(12, 16, 1, 0.3)
PIXELS = np.arange(VIEW.rows * VIEW.cols)
# A lamp far away, 40 degrees off the normal of the plate, towards +x and a little to +z.
AWAY = np.array([np.sin(0.7) * np.cos(0.3), -np.cos(0.7), np.sin(0.7) * np.sin(0.3)])
EDGE_U = np.cross(AWAY, [0, 0, 1]) / np.linalg.norm(np.cross(AWAY, [0, 0, 1]))
EDGE_V = np.cross(-AWAY, EDGE_U)
HEAD = f"""
name = "plate"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -3, 0]
target_m = [0, 0, 0]
[lamps.far]
center_m = {(5000 * AWAY).tolist()}
edge_u_m = {(40 * EDGE_U).tolist()}
edge_v_m = {(40 * EDGE_V).tolist()}
radiance_w_m2_sr = 1e4
"""
# Its normal is -y, u is +x, v is +z.
PLATE = """
[objects.plate]
kind = "quad"
material = "paint"
corner_m = [-2, 0, -2]
edge_u_m = [4, 0, 0]
edge_v_m = [0, 0, 4]
"""
SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


@pytest.fixture
def _renderer():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def scene(folder, material, body=PLATE):
    (folder / "scene.toml").write_text(f"{HEAD}[materials.paint]\n{material}\n{body}")
    return load_scene(folder)


def write_normal(path, normal):
    coded = (np.asarray(normal, np.float32) + 1) / 2
    channels = {name: np.full((4, 4), coded[k], np.float32) for k, name in enumerate("RGB")}
    write_exr(path, channels, attributes={})


def light(found, samples=16):
    return RenderStage(found, VIEW).radiance(PIXELS, samples, (1,))[0].reshape(VIEW.rows, VIEW.cols)


@pytest.mark.usefixtures("_renderer")
@pytest.mark.parametrize(
    ("normal", "edge_u", "turned"),
    [
        ((0.3, 0.0, np.sqrt(0.91)), 4, (0.3, -np.sqrt(0.91), 0.0)),
        ((0.0, -0.4, np.sqrt(0.84)), 4, (0.0, -np.sqrt(0.84), -0.4)),
        # From behind, u is -x, and a bump is a dent.
        ((-0.3, 0.4, np.sqrt(0.75)), -4, (-0.3, -np.sqrt(0.75), -0.4)),
    ],
)
def test_a_tilted_normal_gives_a_matt_plate_the_cosine_to_it(tmp_path, normal, edge_u, turned):
    write_normal(tmp_path / "n.exr", normal)
    body = PLATE.replace("corner_m = [-2,", f"corner_m = [{-edge_u / 2},").replace("[4,", f"[{edge_u},")
    plain = light(scene(tmp_path, "reflectance = 0.5", body))
    mapped = light(scene(tmp_path, 'reflectance = 0.5\nnormal_map = "n.exr"', body))
    expected = np.dot(turned, AWAY) / -AWAY[1]
    assert abs(expected - 1) > 0.05
    np.testing.assert_allclose(mapped / plain, expected, rtol=5e-4)


@pytest.mark.usefixtures("_renderer")
def test_a_roughness_map_is_two_plates_side_by_side(tmp_path):
    halves = np.repeat(np.repeat(np.uint8([[51, 204]]), 32, axis=1), 4, axis=0)
    # Both numbers in one picture, as glTF has them: a red channel of something else, green and blue.
    packed = np.stack([np.full_like(halves, 7), halves, 255 - halves], axis=-1)
    Image.fromarray(packed).save(tmp_path / "rough.png")
    maps = 'roughness = 0.5\nroughness_map = "rough.png"\nmetallic_map = "rough.png"\nmetallic = 1.0'
    common = 'kind = "principled"\nreflectance = 0.6\ntile_m = 4.0\n'
    both = light(scene(tmp_path, common + maps))
    for cols, roughness, metallic in ((slice(0, 7), 0.1, 0.8), (slice(9, 16), 0.4, 0.2)):
        one = light(scene(tmp_path, f"{common}roughness = {roughness}\nmetallic = {metallic}"))
        np.testing.assert_allclose(both[:, cols], one[:, cols], rtol=2e-3)
        assert (abs(both / one - 1) > 0.1).mean() > 0.3


@pytest.mark.usefixtures("_renderer")
@pytest.mark.parametrize("backend", ["scalar_rgb", None])
@pytest.mark.parametrize(
    ("text", "albedo"),
    [
        ('reflectance = 0.4\nnormal_map = "n.exr"', 0.4),
        ('kind = "principled"\nreflectance = 0.4\nmetallic = 0.7\nroughness = 0.3', 0.4),
        ('kind = "principled"\nreflectance = 0.4\nnormal_map = "n.exr"', 0.4),
        ('kind = "principled"\nreflectance = 0.4\nopacity = 0.9999999', 0.4),
        ('kind = "plastic"\nreflectance = 0.4\nroughness = 0.1', 0.4),
        ('kind = "metal"\nmetal = "Cu"\nroughness = 0.2', 0.0),
    ],
)
def test_passes_have_the_normals_of_the_shape_and_the_albedo(tmp_path, text, albedo, backend):
    write_normal(tmp_path / "n.exr", (0.6, 0, 0.8))
    found = render_passes(scene(tmp_path, text), VIEW, 0.0, 0.01, backend=backend)
    np.testing.assert_allclose(found.normal, np.broadcast_to([0, -1, 0], found.normal.shape), atol=1e-6)
    np.testing.assert_allclose(found.albedo, albedo, rtol=1e-5)


@pytest.mark.usefixtures("_renderer")
def test_difference_rendering_of_a_mapped_mover_agrees_with_the_plain_loop(tmp_path):
    """Columns of one slot; z from the halves' and the seeds' own scatter."""
    slopes = np.random.default_rng(3).normal(0, 0.4, (16, 16, 2))
    normals = np.dstack([slopes, np.ones((16, 16))])
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    Image.fromarray(np.uint8(np.rint((normals + 1) / 2 * 255))).save(tmp_path / "n.png")
    mover = """
[objects.card]
kind = "quad"
material = "card"
corner_m = [-0.4, -0.5, -0.3]
edge_u_m = [0.8, 0, 0]
edge_v_m = [0, 0, 0.6]
[movers.card]
kind = "keyframed"
objects = ["card"]
times_s = [0.0, 1.0]
positions_m = [[0, 0, 0], [4.0, 0, 0]]
interpolation = "linear"
[materials.card]
reflectance = 0.6
normal_map = "n.png"
tile_m = 0.4
"""
    found, timing = scene(tmp_path, "reflectance = 0.3", PLATE + mover), Timing(0.01, 2, 1)
    # A hard shadow's edge would be finer than the poses of either.
    lamp = found.lamps["far"]
    wide = {"edge_u_m": tuple(2000 * EDGE_U), "edge_v_m": tuple(2000 * EDGE_V), "radiance_w_m2_sr": 4.0}
    found = found.model_copy(update={"lamps": {"far": lamp.model_copy(update=wide)}})
    settings = RenderSettings(static_error=0.02, change_error=0.02, moving_error=0.02, instants_per_slot=1)
    video = render_truth(found, VIEW, timing, settings, cache=Cache(tmp_path))
    ours, noise = video.load(0).instant(1), video.half_difference.load(0).instant(1)
    stage, poses = RenderStage(found, VIEW), []
    for step in range(16):
        stage.pose((1 + (step + 0.5) / 16) * 0.01)
        poses.append(stage.radiance(PIXELS, 16, tuple(range(40 * step + 1, 40 * step + 5))))
    direct = np.mean(poses, axis=0)
    mean, error = direct.mean(0).reshape(ours.shape), direct.std(0, ddof=1).reshape(ours.shape) / 2
    columns = [a.astype(float).sum(axis=0) for a in (ours - mean, error**2 + noise.astype(float) ** 2)]
    z = columns[0] / np.sqrt(columns[1])
    assert np.abs(z).max() < 7
    np.testing.assert_allclose(ours.mean(), mean.mean(), rtol=0.01)
    flat = {"card": found.materials["card"].model_copy(update={"normal_map": None})}
    other = RenderStage(found.model_copy(update={"materials": found.materials | flat}), VIEW)
    other.pose(0.015)
    plain = other.radiance(PIXELS, 16, (1,))[0].reshape(ours.shape)
    assert abs(plain / mean - 1).max() > 0.1


def quad_model(path, uv, **maps):
    square = trimesh.Trimesh(SQUARE, [[0, 1, 2], [0, 2, 3]], process=False)
    material = trimesh.visual.material.PBRMaterial(name="m", **maps)
    square.visual = trimesh.visual.TextureVisuals(np.array(uv, float), material=material)
    square.export(path)
    return read_model(path).parts


def test_maps_of_a_model_are_raw_and_the_factors_stay(tmp_path):
    normal = Image.new("RGB", (2, 2), (204, 128, 230))
    packed = Image.fromarray(np.array([[[0, 51, 255]], [[0, 204, 0]]], np.uint8))
    ((surface, _),) = quad_model(
        tmp_path / "a.glb",
        [[0, 0], [1, 0], [1, 1], [0, 1]],
        normalTexture=normal,
        metallicRoughnessTexture=packed,
        roughnessFactor=0.5,
    )
    coded = np.array([204, 128, 230]) / 255 * 2 - 1
    np.testing.assert_allclose(
        2 * surface.maps["normal_map"][0, 0] - 1, coded / np.linalg.norm(coded), atol=1e-6
    )
    # Row 0 is the lower one; 51 of 255 is 0.2, and no transfer function makes it darker.
    np.testing.assert_allclose(surface.maps["roughness_map"][:, 0], [0.8, 0.2], atol=1e-6)
    np.testing.assert_allclose(surface.maps["metallic_map"][:, 0], [0, 1], atol=1e-6)
    assert (surface.roughness, surface.metallic) == (0.5, 1.0)
    (tmp_path / "scene.toml").write_text(f'{HEAD}[objects.a]\nkind = "mesh"\nfile = "a.glb"\n')
    found = load_scene(tmp_path).materials["a"]
    assert found.normal_map == found.roughness_map == found.metallic_map == str(tmp_path / "a.glb")
    assert found.picture is None


@pytest.mark.usefixtures("_renderer")
def test_a_mirrored_texture_keeps_its_bumps(tmp_path):
    """The same surface by mirrored texture coordinates and the picture to them looks the same."""
    rng = np.random.default_rng(1)
    slopes = rng.uniform(-0.5, 0.5, (4, 4, 2))
    normals = np.dstack([slopes, np.sqrt(1 - (slopes**2).sum(axis=2))])
    coded = np.uint8(np.rint((normals + 1) / 2 * 255))
    over = coded[:, ::-1].copy()
    straight = [[0, 0], [1, 0], [1, 1], [0, 1]]
    mirrored = [[1, 0], [0, 0], [0, 1], [1, 1]]
    seen = []
    for uv, picture in ((straight, coded), (mirrored, over)):
        # The same normal in the world, whose x is along -u of what is mirrored.
        picture = picture if uv is straight else picture * [-1, 1, 1] + [255, 0, 0]
        texture = Image.fromarray(np.uint8(picture))
        quad_model(tmp_path / "a.glb", uv, normalTexture=texture, roughnessFactor=1.0, metallicFactor=0.0)
        place = 'unit = "m"\nheight_m = 3.0\nup = "y"\nanchor = "middle"\n'
        (tmp_path / "scene.toml").write_text(f'{HEAD}[objects.a]\nkind = "mesh"\nfile = "a.glb"\n{place}')
        seen.append(light(load_scene(tmp_path)))
    assert seen[0].std() > 0.05 * seen[0].mean()
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.01, atol=0.01 * seen[0].mean())


def test_maps_have_no_transfer_function_whatever_their_bits(tmp_path):
    Image.fromarray(np.full((2, 2), 51, np.uint8)).save(tmp_path / "8.png")
    Image.fromarray(np.full((2, 2), 13107, np.uint16)).save(tmp_path / "16.png")
    write_exr(tmp_path / "32.exr", {"Y": np.full((2, 2), 0.2, np.float32)}, attributes={})
    for name in ("8.png", "16.png", "32.exr"):
        np.testing.assert_allclose(read_map(tmp_path / name, "roughness_map"), 0.2, atol=1e-6)


@pytest.mark.parametrize(
    ("material", "message"),
    [
        ('normal_map = "no.png"', r"materials\.paint\.normal_map: got 'no\.png', but there is no such file"),
        ('normal_map = "../n.png"', "expected a path inside"),
        ('normal_map = "photo.png"', r"photo\.png: got vectors of length 0\.\d\d, .* mostly light blue"),
        ('normal_map = "nan.exr"', r"nan\.exr: got nan in row 1, column 2, expected 0 to 1"),
        ('normal_map = "one.exr"', "got one channel, expected red, green and blue"),
        ('kind = "principled"\nroughness_map = "nan.exr"', "got nan in row 1, column 2"),
        ('kind = "principled"\nroughness_map = "text.png"', r"text\.png cannot be read as a PNG"),
    ],
)
def test_bad_maps_are_said_in_a_line_before_rendering(tmp_path, material, message):
    Image.new("RGB", (4, 4), (90, 120, 110)).save(tmp_path / "photo.png")
    import OpenEXR

    values = np.full((4, 4), 0.9, np.float32)
    values[1, 2] = np.nan
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.dstack([values] * 3)}) as file:
        file.write(str(tmp_path / "nan.exr"))
    write_exr(tmp_path / "one.exr", {"Y": np.ones((2, 2), np.float32)}, attributes={})
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(OptsimError, match=message) as caught:
        scene(tmp_path, material)
    assert "\n" not in str(caught.value)


def test_which_map_is_which_is_part_of_the_scene(tmp_path):
    Image.new("L", (2, 2), 100).save(tmp_path / "a.png")
    Image.new("L", (2, 2), 200).save(tmp_path / "b.png")
    texts = (
        'roughness_map = "a.png"\nmetallic_map = "b.png"',
        'roughness_map = "b.png"\nmetallic_map = "a.png"',
    )
    found = {scene(tmp_path, f'kind = "principled"\n{text}').model_dump_json() for text in texts}
    assert len(found) == 2
    with pytest.raises(ConfigError, match=r"got one channel|got vectors"):
        scene(tmp_path, 'normal_map = "a.png"')


@pytest.mark.parametrize(
    "material", ['kind = "metal"\nnormal_map = "good.png"', 'roughness_map = "good.png"']
)
def test_a_material_without_such_a_map_says_so(tmp_path, material):
    Image.new("RGB", (4, 4), (128, 128, 255)).save(tmp_path / "good.png")
    with pytest.raises(ConfigError, match=r"materials\.paint\.\w+_map: unknown key"):
        scene(tmp_path, material)
