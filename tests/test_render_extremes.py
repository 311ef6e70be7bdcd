"""Users' own worlds at the ends: too little memory, a camera inside a thing, tiny, far, fine and bright."""

import warnings

import numpy as np
import OpenEXR
import pytest
import trimesh
from PIL import Image
from test_render_stress import CARD, ROOM, VIEW, instants, room

from optsim.core import foreign
from optsim.core.errors import StorageError
from optsim.optics.srgb import srgb_to_linear
from optsim.render import choose_backend, fireflies, footprint
from optsim.render.backend import activate
from optsim.scene.inside import warn_if_inside
from optsim.scene.models import read_model
from optsim.scene.pictures import read_map, read_picture
from optsim.scene.sky import PictureSky

GLOBE = {"kind": "globe", "material": "light", "center_m": (0, -0.95, 0), "radius_m": 0.3}
SUN = 1e9


@pytest.mark.parametrize("name", ["ball.ply", "ball.stl", "ball.obj", "ball.glb", "text.stl"])
def test_a_model_beyond_memory_is_refused_before_it_is_read(name, tmp_path, monkeypatch):
    ball = trimesh.creation.icosphere(subdivisions=3)  # 1280 triangles
    ball.export(tmp_path / name, **({"file_type": "stl_ascii"} if name == "text.stl" else {}))
    monkeypatch.setattr(foreign, "available_bytes", lambda: 1280 * 600.0)
    with pytest.raises(
        StorageError, match=rf"{name} .* about 1(\.\d)?e\+03 triangles .* take .* cure: a model with"
    ):
        read_model(tmp_path / name)
    monkeypatch.setattr(foreign, "available_bytes", lambda: 1280 * 1200.0)
    assert sum(len(mesh.faces) for _, mesh in read_model(tmp_path / name).parts) == 1280


def test_pictures_of_a_model_count(tmp_path, monkeypatch):
    picture, box = Image.new("RGB", (400, 300)), trimesh.creation.box()
    look = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, normalTexture=picture)
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)), material=look)
    box.export(tmp_path / "box.glb")
    monkeypatch.setattr(foreign, "available_bytes", lambda: 120_000 * 200.0)
    with pytest.raises(StorageError, match=r"12 triangles and 2\.4e\+05 texels"):
        read_model(tmp_path / "box.glb")


def test_a_picture_counts_by_memory_alone(tmp_path, monkeypatch):
    codes = np.random.default_rng(1).integers(0, 256, (600, 40, 3), np.uint8)
    Image.fromarray(codes).save(tmp_path / "p.png")
    monkeypatch.setattr(
        Image, "MAX_IMAGE_PIXELS", 100
    )  # of Pillow; a picture of 16384 pixels a side has more
    light = srgb_to_linear(codes[::-1] / 255) @ (0.2126, 0.7152, 0.0722)
    np.testing.assert_allclose(read_picture(tmp_path / "p.png"), light, atol=1e-4)
    assert Image.MAX_IMAGE_PIXELS == 100
    Image.fromarray(codes).save(tmp_path / "q.png")
    monkeypatch.setattr(foreign, "available_bytes", lambda: 600 * 40 * 20.0)
    for read in (read_picture, lambda path: read_map(path, "roughness_map")):
        with pytest.raises(StorageError, match=r"40 x 600 pixels take .* cure: a smaller picture"):
            read(tmp_path / "q.png")


def test_vertices_of_fine_movers_are_retained_by_their_bytes(monkeypatch):
    class Fine:
        def vertices(self, time_s):
            return np.full((2000, 3), time_s)

    fine = Fine()
    monkeypatch.setattr(footprint, "_retained", {})
    monkeypatch.setattr(footprint, "_MOST_BYTES", 5 * 48e3)
    first = footprint.vertices_at(fine, 0.0)
    for time_s in range(1, 20):
        assert footprint.vertices_at(fine, 0.0) is first
        footprint.vertices_at(fine, float(time_s))
        assert sum(each.nbytes for each in footprint._retained.values()) <= 5 * 48e3


@pytest.mark.parametrize(
    ("changes", "inside"),
    [
        ({}, None),  # the room
        ({"objects": ROOM["objects"] | {"ball": GLOBE}}, "objects.ball"),
        ({"objects": ROOM["objects"] | {"ball": GLOBE | {"material": "pane"}}}, None),
        ({"objects": ROOM["objects"] | {"ball": GLOBE | {"radius_m": 0.6}}}, None),  # with its target
        ({"objects": ROOM["objects"] | {"ball": GLOBE | {"center_m": (0, -0.6, 0)}}}, None),
        ({"movers": {"card": CARD | {"center_m": (0, -0.95, 0), "size_m": (0.2, 0.2)}}}, None),  # open
        (
            {"movers": {"m": {"kind": "bouncing_ball", "material": "light", "floor_m": (0, -0.95, -0.2)}
                        | {"radius_m": 0.25, "height_m": 0.01}}},
            "movers.m",
        ),
    ],
)  # fmt: skip
def test_a_camera_inside_a_thing_is_remarked(changes, inside):
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        warn_if_inside(room(**changes))
    said = [str(each.message) for each in found]
    assert len(said) == (inside is not None)
    assert (
        inside is None or f"camera.position_m lies inside {inside}, which hides the scene; cure:" in said[0]
    )


def judged(scene, folder):
    """Instants of a truth, all finite, without more fireflies than is fit."""
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()
    images = instants(scene, folder)
    assert images.mean() > 0
    for one in fireflies.pilot(scene, view=VIEW):
        assert one.visible_share <= fireflies.MOST_SHARE, one.text()
    return images


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [0.0, 1.0])
def test_metal_from_a_mirror_to_the_roughest(roughness, tmp_path):
    steel = {"steel": {"kind": "metal", "roughness": roughness}}
    plinth = {"plinth": ROOM["objects"]["plinth"] | {"material": "steel"}}
    judged(room(materials=ROOM["materials"] | steel, objects=ROOM["objects"] | plinth), tmp_path)


@pytest.mark.slow
def test_a_micrometre_and_10_km_in_one_scene(tmp_path):
    foil = {"kind": "box", "material": "light", "center_m": (0.3, 0.3, 0), "size_m": (0.3, 1e-6, 0.3)}
    hill = {"kind": "box", "material": "grey", "center_m": (0, 1.2e4, 0), "size_m": (5e3, 2e3, 4e3)}
    sky = {"kind": "sunsky", "irradiance_w_m2": 4.0, "elevation_rad": 0.75}
    images = judged(room(objects={"foil": foil, "hill": hill}, sky=sky, movers={"card": CARD}), tmp_path)
    assert images[:, 12, 18:22].min() > 0


@pytest.mark.slow
def test_a_sun_of_1e9_in_a_picture_of_the_sky(tmp_path):
    light = np.full((64, 128), 0.3, np.float32)
    light[12, 40] = SUN
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(head, {"Y": light}) as file:
        file.write(str(tmp_path / "sky.exr"))
    sky = PictureSky(file=str(tmp_path / "sky.exr"), radiance_w_m2_sr=1.0)
    floor = {"kind": "quad", "material": "grey", "corner_m": (-2, -2, -1), "edge_u_m": (4, 0, 0)}
    objects = {"floor": floor | {"edge_v_m": (0, 4, 0)}, "plinth": ROOM["objects"]["plinth"]}
    scene = room(objects=objects).model_copy(update={"sky": sky})
    images = judged(scene, tmp_path / "truth")
    assert images.max() > 1e-4 * SUN


@pytest.mark.slow
def test_a_million_triangles(tmp_path):
    trimesh.creation.icosphere(subdivisions=8, radius=0.3).export(tmp_path / "ball.ply")
    ball = {
        "kind": "mesh",
        "file": str(tmp_path / "ball.ply"),
        "material": "light",
        "position_m": (0, 0.3, -0.2),
    }
    scene = room(objects=ROOM["objects"] | {"ball": ball | {"unit": "m", "up": "z"}})
    assert len(scene.still_objects()["ball"].mesh().faces) == 1_310_720
    judged(scene, tmp_path / "truth")


@pytest.mark.slow
def test_a_hundred_movers(tmp_path):
    place, small = np.random.default_rng(0).uniform(-0.8, 0.8, (100, 3)), CARD | {"size_m": (0.1, 0.1)}
    scene = room(movers={f"c{n}": small | {"center_m": tuple(p)} for n, p in enumerate(place.tolist())})
    images = judged(scene, tmp_path)
    assert np.abs(images[-1] - images[0]).max() > 0
