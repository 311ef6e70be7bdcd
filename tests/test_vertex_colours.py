"""Colours at vertices and wrap modes as the renderer shows them: light, albedo, bands, movers."""

import json

import numpy as np
import pytest
from PIL import Image
from test_gltf import attribute, embedded, triangle, with_array, with_sampler
from test_model_formats import ply, written
from test_surface_maps import HEAD, PIXELS, VIEW, light

from optsim.optics.srgb import linear_to_srgb
from optsim.render import choose_backend, render_passes
from optsim.render.backend import activate
from optsim.render.channels import Channels, three_channels
from optsim.scene import load_scene
from optsim.scene.bands import SRGB

ENDS = np.array([[0.6, 0.3, 0.05], [0.1, 0.5, 0.8]])
PLACE = 'kind = "mesh"\nfile = "m.ply"\nunit = "m"\nup = "z"\nanchor = "origin"\n'
# Centres of the pixels' columns on the plate, which is 3 m away.
ACROSS = 3 * 0.3 * (2 * (np.arange(VIEW.cols) + 0.5) / VIEW.cols - 1)


@pytest.fixture
def _renderer():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def plate(folder, ends=ENDS, head=HEAD, table="[objects.m]", material=""):
    """A plate of 4 x 4 m that faces the camera, its colour going from one to another along x."""
    points = [(-2, 0, -2), (2, 0, -2), (2, 0, 2), (-2, 0, 2)]
    coded = linear_to_srgb(np.asarray(ends, float))[[0, 1, 1, 0]]
    columns = dict(zip(("red", "green", "blue"), coded.T.tolist(), strict=True))
    written(folder, ply(points, [(0, 1, 2, 3)], **columns), "m.ply")
    (folder / "scene.toml").write_text(f"{head}{table}\n{PLACE}{material}")
    return load_scene(folder)


def expected(channels=(0.2126, 0.7152, 0.0722)):
    share = ((ACROSS + 2) / 4)[:, None]
    return ((1 - share) * ENDS[0] + share * ENDS[1]) @ np.asarray(channels)


@pytest.mark.usefixtures("_renderer")
@pytest.mark.parametrize("backend", ["scalar_rgb", None])
@pytest.mark.parametrize("mover", [False, True])
def test_the_albedo_between_vertices_is_their_mix(tmp_path, backend, mover):
    found = plate(tmp_path)
    if mover:
        path = "times_s = [0, 1]\npositions_m = [[0, 0, 0], [0, 0, 0.01]]\n"
        found = plate(tmp_path, table="[movers.m]", material=path)
    albedo = render_passes(found, VIEW, 0.0, 0.01, backend=backend).albedo
    np.testing.assert_allclose(albedo, np.tile(expected(), (VIEW.rows, 1)), rtol=1e-4)


@pytest.mark.usefixtures("_renderer")
def test_light_is_that_of_plain_surfaces_of_these_reflectances(tmp_path):
    seen = light(plate(tmp_path), 256)
    plain = [light(plate(tmp_path, [[share] * 3] * 2), 256) for share in (0.2, 0.4)]
    assert plate(tmp_path, [[0.2] * 3] * 2).materials["m"].vertex_colours is False
    slope = (plain[1] - plain[0]) / 0.2
    np.testing.assert_allclose(seen, plain[0] + slope * (expected() - 0.2), rtol=0.02)


@pytest.mark.usefixtures("_renderer")
def test_bands_take_their_channel(tmp_path):
    whole = plate(tmp_path, head='bands = "srgb"\n' + HEAD)
    for index, band in enumerate(SRGB):
        albedo = render_passes(whole.in_band(band.name), VIEW, 0.0, 0.01).albedo
        np.testing.assert_allclose(albedo[0], expected(np.eye(3)[index]), rtol=1e-4)
    with three_channels(whole):
        stage = Channels(whole, SRGB, VIEW, movers=True)
        shares = stage.reflectances(PIXELS, 64, 1).reshape(3, VIEW.rows, VIEW.cols)
    wanted = np.stack([expected(channel) for channel in np.eye(3)])
    # What has gloss counts by 0.04 more.
    np.testing.assert_allclose(shares.mean(axis=1) - 0.04, wanted, atol=0.01)


@pytest.mark.usefixtures("_renderer")
def test_a_material_of_the_scene_covers_the_colours(tmp_path):
    grey = HEAD + "[materials.grey]\nreflectance = 0.3\n"
    albedo = render_passes(plate(tmp_path, head=grey, material='material = "grey"\n'), VIEW, 0.0, 0.01).albedo
    np.testing.assert_allclose(albedo, 0.3, rtol=1e-5)


@pytest.mark.usefixtures("_renderer")
@pytest.mark.parametrize(
    ("wrap", "seen"), [(10497, "dark light"), (33071, "light light"), (33648, "light dark")]
)
def test_pictures_go_on_as_their_sampler_says(tmp_path, wrap, seen):
    """Along x the coordinate is 3 x: 1.2 to 1.35 and 1.7 to 1.8 lie one picture further on."""
    image = tmp_path / "t.png"
    Image.fromarray(np.repeat(np.uint8([[[0], [255]]]), 3, axis=2).repeat(8, axis=1).repeat(2, axis=0)).save(
        image
    )
    content = with_array(triangle(), np.float32([[0, 0], [3, 0], [0, 1]]), "VEC2")
    content = with_sampler(attribute(content, "TEXCOORD_0"), wrapS=wrap, wrapT=wrap)
    content["images"] = [{"uri": embedded(image.read_bytes(), "image/png")}] * 2
    del content["materials"][0]["normalTexture"]
    (tmp_path / "m.gltf").write_text(json.dumps(content))
    place = 'kind = "mesh"\nfile = "m.gltf"\nanchor = "origin"\nposition_m = [-0.5, 0, -0.2]\n'
    (tmp_path / "scene.toml").write_text(f"{HEAD}[objects.m]\n{place}")
    albedo = render_passes(load_scene(tmp_path), VIEW, 0.0, 0.01).albedo[6]
    u = 3 * (ACROSS + 0.5)
    for (low, high), shade in zip(((1.1, 1.4), (1.6, 1.9)), seen.split(), strict=True):
        inside = albedo[(u > low) & (u < high)]
        assert len(inside)
        np.testing.assert_allclose(inside, 1.0 if shade == "light" else 0.0, atol=1e-6)
