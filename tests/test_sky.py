"""Light from the sky: Mitsuba's own model as oracle, closed forms of diffuse light, and places of light."""

import json
import subprocess
import sys

import numpy as np
import pytest

from optsim.core.cache import Cache
from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import write_exr
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, choose_backend, render_passes, render_truth
from optsim.render.backend import activate
from optsim.render.fireflies import pilot
from optsim.render.nearby import boxes_around
from optsim.render.stage import RenderStage, outside_mask
from optsim.render.stokes import polarised
from optsim.scene import bright_lights, load_scene
from optsim.scene.bands import MONO, Band
from optsim.scene.clear_sky import SUN_RADIUS_RAD, sky_radiance, sun_radiance
from optsim.scene.depths import depth_range_m
from optsim.scene.scene import Scene
from optsim.scene.sky import SunSky, irradiance, looked_up

VIEW = View(24, 32, 1, 0.4)
PIXELS = np.arange(VIEW.rows * VIEW.cols)
SUN = {"kind": "sunsky", "irradiance_w_m2": 5.0, "azimuth_rad": 2.0, "elevation_rad": 0.6}
FLOOR = {
    "kind": "quad",
    "material": "grey",
    "corner_m": (-9, -9, 0),
    "edge_u_m": (18, 0, 0),
    "edge_v_m": (0, 18, 0),
}
# Straight down on a floor that fills the picture.
DOWN = {
    "name": "floor",
    "white_w_m2_sr": 1.0,
    "camera": {"position_m": (0, 0, 3), "target_m": (0, 0.1, 0)},
    "materials": {"grey": {"reflectance": 0.4}},
    "objects": {"floor": FLOOR},
}
HEAD = """
name = "x"
white_w_m2_sr = 1.0
[camera]
position_m = [0, 0, 3]
target_m = [0, 0.1, 0]
[materials.grey]
[objects.floor]
kind = "quad"
material = "grey"
corner_m = [-9, -9, 0]
edge_u_m = [18, 0, 0]
edge_v_m = [0, 18, 0]
"""


@pytest.fixture
def _renderer():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def picture(tmp_path, image, more="", name="sky.exr"):
    """Write a scene under a picture and load it."""
    write_exr(tmp_path / name, {"Y": np.asarray(image, np.float32)}, attributes={})
    sky = f'[sky]\nkind = "picture"\nfile = "{name}"\nradiance_w_m2_sr = 2.0\n{more}'
    (tmp_path / "scene.toml").write_text(HEAD + sky)
    return load_scene(tmp_path)


def mean_light(scene, seeds=64, samples=4):
    """Mean of a picture, its standard error from independent seeds."""
    each = RenderStage(scene, VIEW).radiance(PIXELS, samples, tuple(range(1, seeds + 1))).mean(axis=1)
    return each.mean(), each.std(ddof=1) / np.sqrt(seeds)


# --- the model of the clear sky --------------------------------------------------------------------------

PLACES = [(3.0, 0.2, 0.8, 550.0), (6.5, 0.35, 0.3, 430.0), (1.0, 0.0, 1.4, 700.0), (10.0, 1.0, 0.2, 560.0)]
ORACLE = """
import json, sys
import mitsuba as mi, numpy as np
mi.set_variant("scalar_spectral")
found = []
for turbidity, albedo, elevation, wavelength, directions in json.load(sys.stdin):
    sun = [float(np.cos(elevation)), 0.0, float(np.sin(elevation))]
    common = {"type": "sunsky", "turbidity": turbidity, "albedo": albedo, "sun_direction": sun}
    light = []
    for direction in directions:
        seen = mi.SurfaceInteraction3f()
        seen.wi, seen.wavelengths = [-x for x in direction], wavelength
        light.append(mi.load_dict({**common, "sun_scale": 0.0}).eval(seen)[0])
    # The disc from its centre to its rim, above and below, in rings of equal area.
    rings = []
    for share in (np.arange(40) + 0.5) / 40:
        for side in (-1, 1):
            beside = elevation + side * np.sqrt(share) * np.radians(0.5358 / 2)
            seen.wi = [-float(np.cos(beside)), 0.0, -float(np.sin(beside))]
            rings.append(mi.load_dict({**common, "sky_scale": 0.0, "complex_sun": True}).eval(seen)[0])
    found.append([light, float(np.mean(rings))])
print("ORACLE" + json.dumps(found))
"""


def test_sky_and_sun_are_those_of_mitsubas_own_model():
    zenith, azimuth = np.array([0.0, 0.5, 1.2, 1.5]), np.array([0.0, 1.0, 2.0, 3.0])
    x, y = np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth)
    directions = np.stack([x, y, np.cos(zenith)], axis=-1)
    asked = json.dumps([(*place, directions.tolist()) for place in PLACES])
    done = subprocess.run(
        [sys.executable, "-c", ORACLE], input=asked, capture_output=True, text=True, check=True
    )
    oracle = json.loads(done.stdout.split("ORACLE")[1])
    for (turbidity, albedo, elevation, wavelength), (light, disc) in zip(PLACES, oracle, strict=True):
        ours = sky_radiance(
            directions[:, 2],
            directions @ np.array([np.cos(elevation), 0.0, np.sin(elevation)]),
            sun_elevation_rad=elevation,
            turbidity=turbidity,
            ground_albedo=albedo,
            wavelength_nm=wavelength,
        )
        np.testing.assert_allclose(ours, light, rtol=2e-5)
        assert sun_radiance(elevation, turbidity, wavelength) == pytest.approx(disc, rel=0.005)


@pytest.mark.parametrize("elevation_rad", [0.01, 0.1, 0.7, 1.5, np.pi / 2])
def test_a_map_gives_the_stated_irradiance_and_has_the_sun_in_its_place(elevation_rad):
    sky = SunSky(irradiance_w_m2=5.0, elevation_rad=elevation_rad, azimuth_rad=-2.5, turbidity=4.0)
    image = sky.radiance()
    assert irradiance(image) == pytest.approx(5.0, rel=1e-5)
    # Below the horizon lies ground in this light.
    np.testing.assert_allclose(image[-200:], 0.2 * 5.0 / np.pi, rtol=1e-5)
    sun = [np.cos(elevation_rad) * np.cos(-2.5), np.cos(elevation_rad) * np.sin(-2.5), np.sin(elevation_rad)]
    assert looked_up(sky, np.array(sun), MONO) == pytest.approx(image.max(), rel=0.05)
    assert image.max() > 1000 * np.median(image[:512])


def test_haze_takes_light_from_the_sun_to_the_sky():
    def of_sky(turbidity, wavelength_nm):
        image = SunSky(irradiance_w_m2=1.0, elevation_rad=0.7, turbidity=turbidity).radiance(
            Band(name="x", wavelength_nm=wavelength_nm)
        )
        return irradiance(np.minimum(image, 20 * np.median(image[:512])))

    assert 0.05 < of_sky(2.0, 550.0) < of_sky(5.0, 550.0) < of_sky(9.0, 550.0) < 0.9
    assert of_sky(2.0, 450.0) > 1.5 * of_sky(2.0, 650.0), "the sky is blue"


# --- rendered ----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("_renderer")
def test_matt_ground_under_an_even_sky_reflects_its_albedo(tmp_path):
    scene = picture(tmp_path, np.ones((64, 128)))
    mean, error = mean_light(scene.model_copy(update={"materials": Scene(**DOWN, sky=SUN).materials}))
    # Everywhere 0.4 x 2 W m^-2 sr^-1; float32, and Mitsuba's own table of directions.
    assert mean == pytest.approx(0.8, abs=max(5 * error, 2e-4))
    assert error < 1e-2


@pytest.mark.usefixtures("_renderer")
@pytest.mark.parametrize("elevation_rad", [0.15, 0.6, 1.4])
def test_ground_under_sun_and_sky_has_the_stated_irradiance(elevation_rad):
    """The mean of 64 seeds within 5 standard errors: a false alarm in 2e5 of Student's t with 63 degrees."""
    scene = Scene(**DOWN, sky={**SUN, "elevation_rad": elevation_rad})
    mean, error = mean_light(scene)
    assert error < 0.005 * mean, "sun and sky are sampled directly"
    # 0.1 % for the sum over texels in place of Mitsuba's interpolation.
    assert mean * np.pi / 0.4 == pytest.approx(5.0, abs=5 * error * np.pi / 0.4 + 0.005)


@pytest.mark.usefixtures("_renderer")
def test_no_fireflies_come_from_the_sun():
    found = pilot(Scene(**DOWN, sky=SUN), view=VIEW, samples=128, bound=20)
    assert found[0].n_flagged == 0
    assert found[0].median < 3


@pytest.mark.usefixtures("_renderer")
@pytest.mark.parametrize(("rotation_rad", "row", "col"), [(0.0, 20, 64), (0.9, 12, 30), (-2.0, 28, 100)])
def test_a_bright_spot_is_where_azimuth_and_rotation_say(tmp_path, rotation_rad, row, col):
    """A camera that looks there has it in its middle; two texels to the picture's right, to the right."""
    image = np.full((64, 128), 1e-3)
    image[row, col] = 100.0
    image[row, (col + 4) % 128] = 10.0
    scene = picture(tmp_path, image, f"rotation_rad = {rotation_rad}\n")
    elevation = np.pi / 2 - row / 63 * np.pi
    azimuth = rotation_rad - ((col + 0.5) / 128 - 0.5) * 2 * np.pi
    ahead = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    camera = scene.camera.model_copy(update={"target_m": tuple(np.array([0, 0, 3]) + ahead)})
    there = scene.model_copy(update={"camera": camera})
    seen = RenderStage(there, View(49, 65, 1, 0.3)).radiance(np.arange(49 * 65), 4, (1,))[0].reshape(49, 65)
    rows, cols = np.indices(seen.shape)
    bright = np.where(seen > 20, seen, 0)
    assert (bright * rows).sum() / bright.sum() == pytest.approx(24, abs=1.0)
    assert (bright * cols).sum() / bright.sum() == pytest.approx(32, abs=1.0)
    lesser = seen[:, 45:]
    assert lesser.max() > 3, "the second spot lies to the right"
    assert lesser.max() > 20 * seen[:, :20].max()
    np.testing.assert_allclose(looked_up(there.sky, ahead, MONO), 200.0)


def moving(sky):
    """A card that turns above a floor, in and out of its light."""
    fan = {"kind": "fan", "material": "grey", "center_m": (0.2, 0.2, 0.8), "radius_m": 0.5, "turns_hz": 4.0}
    return Scene(**{**DOWN, "movers": {"fan": fan}}, sky=sky)


@pytest.mark.usefixtures("_renderer")
def test_paths_that_meet_no_box_are_bitwise_the_same_under_a_sky():
    scene = moving(SUN)
    boxes = boxes_around(scene, np.linspace(0, 0.1, 9))
    still = RenderStage(scene, VIEW, movers=False, boxes=boxes).radiance(PIXELS, 1, (1,))[0]
    around = RenderStage(scene, VIEW, movers=False, boxes=boxes, glow=True).radiance(PIXELS, 1, (1,))[0]
    near = still != around
    assert 0.1 < near.mean() < 0.8
    # Each that differs has met a box: it glows, or hides light.
    assert (np.abs(around - still)[near] > 0.01 * still[near]).all()


@pytest.mark.usefixtures("_renderer")
def test_difference_rendering_under_a_sky_agrees_with_the_plain_loop(tmp_path):
    """Blocks of one instant against plain paths; z of 12 blocks, from halves' and seeds' own scatter."""
    scene, timing = moving(SUN), Timing(1 / 180, 2, 1)
    settings = RenderSettings(static_error=0.05, change_error=0.05, moving_error=0.05, instants_per_slot=1)
    video = render_truth(scene, VIEW, timing, settings, cache=Cache(tmp_path))
    ours, noise = video.load(0).instant(1), video.half_difference.load(0).instant(1)
    stage = RenderStage(scene, VIEW)
    poses = []
    for step in range(16):
        stage.pose((1 + (step + 0.5) / 16) / 180)
        poses.append(stage.radiance(PIXELS, 8, tuple(range(40 * step + 1, 40 * step + 5))))
    direct = np.mean(poses, axis=0)
    mean, error = direct.mean(0).reshape(ours.shape), direct.std(0, ddof=1).reshape(ours.shape) / 2
    blocks = [
        a.astype(float).reshape(3, 8, 4, 8).sum((1, 3))
        for a in (ours - mean, error**2 + noise.astype(float) ** 2)
    ]
    z = blocks[0] / np.sqrt(blocks[1])
    # Variances from few numbers have wide tails; interpolation between key poses adds below its bound.
    assert np.abs(z).max() < 7
    assert np.abs(z).mean() < 2
    np.testing.assert_allclose(ours.mean(), mean.mean(), rtol=0.005)
    assert ours.std() > 0.05 * ours.mean(), "there are a shadow and a fan"


@pytest.mark.usefixtures("_renderer")
def test_the_sky_is_unpolarised():
    """Matt ground under it gives either component half of its light, path by path."""
    scene = Scene(**DOWN, sky=SUN)
    plain = RenderStage(scene, VIEW).radiance(PIXELS, 2, (1,))
    with polarised():
        seen = RenderStage(scene, VIEW, azimuth_rad=0.3).radiance(PIXELS, 2, (1,))
    np.testing.assert_allclose(seen, plain, rtol=1e-4)


@pytest.mark.usefixtures("_renderer")
def test_what_sees_the_sky_has_no_depth_no_id_and_no_flow():
    level = {"camera": {"position_m": (0, 0, 1), "target_m": (0, 5, 1)}}
    scene = Scene(**{**DOWN, **level}, sky=SUN)
    passes = render_passes(scene, VIEW, 0.0, 0.01)
    outside = outside_mask(scene, VIEW)
    assert 0.4 < outside.mean() < 0.75  # the floor ends after 9 m
    sky = np.zeros_like(outside)
    sky[: VIEW.rows // 2 - 3] = True
    assert outside[sky].all()
    for array in (passes.depth_m, passes.ids, passes.flow_forward_px, passes.albedo):
        assert not np.asarray(array)[sky].any()
    assert not outside[-4:].any()


# --- what else knows it ------------------------------------------------------------------------------------


def test_the_sky_is_a_steady_lamp_named_sky():
    lamp = {"center_m": (0, 0, 5), "edge_u_m": (1, 0, 0), "edge_v_m": (0, -1, 0), "radiance_w_m2_sr": 3.0}
    pulsed = {**lamp, "flicker": {"kind": "sine", "frequency_hz": 100}}
    scene = Scene(**DOWN, sky=SUN, lamps={"a": lamp, "b": pulsed})
    assert list(scene.light_groups().values()) == [("a", "sky"), ("b",)]
    assert scene.gain("sky", 0.0, 0.3) == 1.0
    alone = scene.only_lamps(["sky"])
    assert alone.lit() == ["sky"]
    assert [lamp.lit for lamp in alone.lamps.values()] == [False, False]
    assert scene.only_lamps(["a"]).lit() == ["a"]
    assert Scene(**DOWN, sky=SUN).kind_of_change() == "static"
    assert scene.kind_of_change() == "lamps"
    with pytest.raises(ConfigError, match="sky"):
        scene.only_lamps(["skies"])


def test_the_sun_in_the_picture_is_a_bright_light_and_the_sky_is_far():
    ahead = np.array([np.cos(0.6) * np.cos(2.0), np.cos(0.6) * np.sin(2.0), np.sin(0.6)])
    to_sun = {"position_m": (0, 0, 1), "target_m": tuple(np.array([0, 0, 1]) + 5 * ahead)}
    scene = Scene(**{**DOWN, "camera": to_sun}, sky=SUN)
    brightest = max(bright_lights(scene, 0.3, 0.75), key=lambda light: light.over_white)
    assert brightest.over_white > 1e4
    solid = brightest.share * 4 * 0.3**2 * 0.75
    assert 0.3 < solid / (np.pi * SUN_RADIUS_RAD**2) < 2
    away = {"position_m": (0, 0, 1), "target_m": (0.1, -5, -1)}
    assert not bright_lights(Scene(**{**DOWN, "camera": away}, sky=SUN), 0.3, 0.75)
    assert depth_range_m(scene, 0.3, 0.75, 0.0)[1] == np.inf


def test_a_sky_has_values_by_band():
    bands = [{"name": "blue", "wavelength_nm": 450}, {"name": "red", "wavelength_nm": 650}]
    sky = {**SUN, "irradiance_w_m2": {"blue": 2.0, "red": 4.0}}
    scene = Scene(**DOWN, bands=bands, sky=sky)
    assert scene.in_band("red").sky.irradiance_w_m2 == 4.0
    with pytest.raises(ValueError, match=r"sky.irradiance_w_m2: got no value for band 'red'"):
        Scene(**DOWN, bands=bands, sky={**SUN, "irradiance_w_m2": {"blue": 2.0}})


@pytest.mark.parametrize(
    ("sky", "message"),
    [
        ({**SUN, "turbidity": 12}, "turbidity"),
        ({**SUN, "elevation_rad": -0.2}, "elevation_rad"),
        ({**SUN, "irradiance_w_m2": 0}, "irradiance_w_m2"),
        ({**SUN, "lit": False}, "no lamp is lit"),
        ({"kind": "cloudy"}, "picture"),
    ],
)
def test_a_bad_sun_is_refused(sky, message):
    with pytest.raises(ValueError, match=message):
        Scene(**DOWN, sky=sky)


def test_a_lamp_cannot_be_named_sky_beside_one():
    lamp = {"center_m": (0, 0, 5), "edge_u_m": (1, 0, 0), "edge_v_m": (0, -1, 0), "radiance_w_m2_sr": 3.0}
    with pytest.raises(ValueError, match=r"lamps.sky: the name is taken by \[sky\]"):
        Scene(**DOWN, sky=SUN, lamps={"sky": lamp})
    with pytest.raises(ValueError, match="nothing under the sky"):
        Scene(**{**DOWN, "objects": {}}, sky=SUN)


def negative(image):
    image[3, 5] = -1.0
    return image


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.ones((64, 100)), r"got 100 x 64 pixels, expected twice as wide as high"),
        (negative(np.ones((64, 128))), r"got -1.0 in row 3, column 5, expected finite values of 0 or more"),
        (np.zeros((64, 128)), r"got a black picture"),
    ],
)
def test_a_bad_picture_is_one_line(tmp_path, image, message):
    with pytest.raises(ConfigError, match=message) as caught:
        picture(tmp_path, image)
    assert "sky.file" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_picture_with_nan_is_refused(tmp_path):
    import OpenEXR

    image = np.ones((64, 128), np.float32)
    image[7, 9] = np.nan
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": image}) as file:
        file.write(str(tmp_path / "nan.exr"))
    sky = '[sky]\nkind = "picture"\nfile = "nan.exr"\nradiance_w_m2_sr = 2.0\n'
    (tmp_path / "scene.toml").write_text(HEAD + sky)
    with pytest.raises((ConfigError, StorageError), match=r"nan|row 7") as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("none.exr", "no such file"),
        ("../sky.exr", "expected a path inside"),
        ("sky.png", "expected OpenEXR or Radiance"),
    ],
)
def test_a_picture_must_be_a_file_of_the_scene(tmp_path, name, message):
    (tmp_path / "sky.png").write_bytes(b"no picture")
    sky = f'[sky]\nkind = "picture"\nfile = "{name}"\nradiance_w_m2_sr = 2.0\n'
    (tmp_path / "scene.toml").write_text(HEAD + sky)
    with pytest.raises(ConfigError, match=message) as caught:
        load_scene(tmp_path)
    assert "\n" not in str(caught.value)


def test_the_content_of_a_picture_is_part_of_the_scene(tmp_path):
    one = picture(tmp_path, np.ones((64, 128))).model_dump(mode="json")
    (tmp_path / "other").mkdir()
    same = picture(tmp_path / "other", np.ones((64, 128)), name="renamed.exr").model_dump(mode="json")
    assert same == one
    assert "file" not in one["sky"]
    other = picture(tmp_path / "other", 2 * np.ones((64, 128))).model_dump(mode="json")
    assert other["sky"]["sha256"] != one["sky"]["sha256"]
