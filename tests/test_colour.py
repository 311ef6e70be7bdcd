"""Colour: sRGB bands and colours, R, G and B of an export, and no bias of the bands by common paths."""

import colour
import numpy as np
import pytest
from PIL import Image
from scipy.stats import t as student
from small_experiment import SMALL

from optsim.core.config import build
from optsim.core.errors import ConfigError
from optsim.core.files import read_exr, write_exr
from optsim.core.quantities import Timing, View
from optsim.dataset import Extras, export_passes
from optsim.dataset.reading import Sample
from optsim.experiment.experiment import load_experiment
from optsim.render import RenderSettings, choose_backend
from optsim.render.backend import activate
from optsim.render.by_band import BandLight
from optsim.render.channels import Channels, three_channels
from optsim.report.pictures import tinted
from optsim.scene import load_scene
from optsim.scene.bands import SRGB
from optsim.scene.pictures import read_picture
from optsim.scene.scene import Scene
from optsim.scene.textures import reflectance_map

VIEW = View(12, 16, 1, 0.4)
TIMING = Timing(1 / 100, 4, 1)
# Of the test of bias.
SLOT, RUNS = 1, 12
TABLE = {
    "name": "coloured",
    "white_w_m2_sr": 2.0,
    "max_depth": 5,
    "bands": "srgb",
    "camera": {"position_m": (0, -2, 1.2), "target_m": (0, 0.5, 0.5)},
    "materials": {
        "floor": {"kind": "plastic", "colour": "#c04020", "roughness": 0.3},
        "wall": {"colour": "#4080c0", "texture": "checker", "tile_m": 0.5},
        "ball": {"colour": "#e0d020"},
        "bar": {"kind": "metal", "metal": "Au", "roughness": 0.3},
    },
    "lamps": {
        "top": {
            "center_m": (-1, 0, 2),
            "edge_u_m": (0.5, 0, 0),
            "edge_v_m": (0, -0.5, 0),
            "radiance_w_m2_sr": {"R": 9.0, "G": 7.0, "B": 4.0},
        },
        "side": {
            "center_m": (1.4, 0, 1),
            "edge_u_m": (0, 0, 0.6),
            "edge_v_m": (0, 0.6, 0),
            "radiance_w_m2_sr": 3.0,
            "flicker": {"kind": "sine", "frequency_hz": 30, "depth": 0.5},
        },
    },
    "objects": {
        "floor": {
            "kind": "quad",
            "material": "floor",
            "corner_m": (-4, -3, 0),
            "edge_u_m": (8, 0, 0),
            "edge_v_m": (0, 6, 0),
        },
        "wall": {
            "kind": "quad",
            "material": "wall",
            "corner_m": (-4, 1.5, 0),
            "edge_u_m": (8, 0, 0),
            "edge_v_m": (0, 0, 4),
        },
        "bar": {"kind": "box", "material": "bar", "center_m": (0.6, 0.6, 0.3), "size_m": (0.3, 0.3, 0.6)},
    },
    "movers": {
        "ball": {
            "kind": "pendulum",
            "pivot_m": (0, 0.4, 1.6),
            "length_m": 1.0,
            "bob_radius_m": 0.3,
            "swing_rad": 0.6,
            "material": "ball",
        }
    },
}


def scene(**changes) -> Scene:
    return build(Scene, {**TABLE, **changes}, where="scene.toml")


def lamp_only(**changes) -> Scene:
    """Direct light of one lamp on matt surfaces."""
    lamps = {"top": TABLE["lamps"]["top"]}
    materials = TABLE["materials"] | {"floor": {"colour": "#c04020"}, "bar": {"colour": [0.1, 0.2, 0.4]}}
    return scene(lamps=lamps, max_depth=2, materials=materials, **changes)


@pytest.fixture
def _renderer() -> None:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def test_the_bands_are_the_primaries_of_srgb() -> None:
    space = colour.RGB_COLOURSPACES["sRGB"]
    for band, primary in zip(SRGB, space.primaries, strict=True):
        nearest = float(colour.dominant_wavelength(primary, space.whitepoint)[0])
        assert band.wavelength_nm == pytest.approx(nearest, abs=0.5)
    assert scene().bands == SRGB
    assert scene().in_band().bands == (SRGB[1],)


def test_a_colour_is_a_reflectance_in_each_band() -> None:
    decoded = colour.RGB_COLOURSPACES["sRGB"].cctf_decoding(np.array([0xC0, 0x40, 0x20]) / 255)
    table = scene().materials["floor"].reflectance
    np.testing.assert_allclose([table[name] for name in "RGB"], decoded, rtol=1e-6)
    assert scene().in_band("R").materials["floor"].reflectance == pytest.approx(decoded[0])
    # Own bands may see a channel too; without bands it is the luminance (IEC 61966-2-1).
    lamps = {"top": TABLE["lamps"]["top"] | {"radiance_w_m2_sr": 3.0}}
    own = [{"name": "x", "wavelength_nm": 700, "channel": "B"}, {"name": "y", "wavelength_nm": 500}]
    luminance = decoded @ [0.2126, 0.7152, 0.0722]
    expected = {"x": pytest.approx(decoded[2]), "y": pytest.approx(luminance)}
    assert scene(bands=own, lamps=lamps).materials["floor"].reflectance == expected
    assert scene(bands=(), lamps=lamps).materials["floor"].reflectance == pytest.approx(luminance)
    again = Scene.model_validate_json(scene().model_dump_json())
    assert again == scene()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"bands": "rgb"}, r"bands: got 'rgb', expected \"srgb\" or a list"),
        ({"floor": {"colour": "#c0402"}}, r"floor.*colour.*got '#c0402', expected a colour as \"#rrggbb\""),
        ({"floor": {"colour": "red"}}, r"got 'red', expected a colour"),
        ({"floor": {"colour": [0.1, 0.2, 1.4]}}, r"colour.2: got 1.4, expected at most 1"),
        ({"floor": {"colour": "#ffffff", "reflectance": 0.5}}, "floor: got colour and reflectance"),
        ({"floor": {"kind": "glass", "colour": "#ffffff"}}, "colour"),
    ],
)
def test_bad_colours_are_named(change, message) -> None:
    if "floor" in change:
        change = {"materials": TABLE["materials"] | {"floor": change["floor"]}}
    with pytest.raises(ConfigError, match=message):
        scene(**change)


def test_a_band_takes_its_channel_of_pictures_and_photographs(tmp_path) -> None:
    pixels = np.array([[[188, 0, 255], [10, 20, 30]]], np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    linear = colour.RGB_COLOURSPACES["sRGB"].cctf_decoding(pixels / 255)
    write_exr(
        tmp_path / "a.exr", {n: linear[..., i].astype(np.float32) for i, n in enumerate("RGB")}, attributes={}
    )
    for name in ("a.png", "a.exr"):
        for index, band in enumerate(SRGB):
            np.testing.assert_allclose(
                read_picture(tmp_path / name, band.channel), linear[..., index], atol=1e-6
            )
        np.testing.assert_allclose(
            read_picture(tmp_path / name), linear @ [0.2126, 0.7152, 0.0722], atol=1e-6
        )
    astronaut = [reflectance_map("astronaut", name).mean() for name in "RGB"]
    assert len({round(float(mean), 3) for mean in astronaut}) == 3
    assert reflectance_map("checker", "R").mean() == reflectance_map("checker", "B").mean()


def test_a_models_texture_and_base_colour_have_colour(tmp_path) -> None:
    import trimesh

    quad = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=[0.5, 1.0, 0.25, 1.0],
        baseColorTexture=Image.new("RGB", (4, 4), (255, 188, 188)),
        roughnessFactor=0.6,
        metallicFactor=0.0,
    )
    quad.visual = trimesh.visual.TextureVisuals([[0, 0], [1, 0], [1, 1], [0, 1]], material=material)
    quad.export(tmp_path / "quad.glb")
    (tmp_path / "scene.toml").write_text(
        'name = "m"\nwhite_w_m2_sr = 1.0\nbands = "srgb"\n[camera]\nposition_m = [0.5, -0.5, 0.5]\n'
        "target_m = [0.5, 0.5, 0.5]\n[lamps.sun]\ncenter_m = [0, -3, 0]\nedge_u_m = [1, 0, 0]\n"
        'edge_v_m = [0, 0, 1]\nradiance_w_m2_sr = 1.0\n[objects.quad]\nkind = "mesh"\nfile = "quad.glb"\n'
    )
    found = load_scene(tmp_path).materials["quad"].reflectance
    # The factors of glTF are linear, in trimesh of 8 bits.
    assert [found[name] for name in "RGB"] == pytest.approx([0.5, 1.0, 0.25], abs=0.003)


@pytest.mark.usefixtures("_renderer")
def test_direct_light_on_matt_surfaces_is_a_multiple_of_the_seen_band() -> None:
    """A closed form: light times reflectance, so the rest is zero where a pixel has one reflectance."""
    lit = lamp_only()
    truth = np.full((VIEW.rows, VIEW.cols), 1.0, np.float32)
    half = np.full_like(truth, 0.01)
    found = BandLight(lit, "G", VIEW, TIMING, RenderSettings(), [0], 4).of(0, truth, half)
    assert found.w_m2_sr["G"] is truth
    floor, lamp = lit.materials["floor"].reflectance, TABLE["lamps"]["top"]["radiance_w_m2_sr"]
    for name in "RB":
        ratio = floor[name] * lamp[name] / (floor["G"] * lamp["G"])
        np.testing.assert_allclose(found.w_m2_sr[name][-2:], ratio, rtol=1e-3)
        assert found.noise[name] >= found.own_noise[name]
    assert found.own_noise["G"] == 0
    # A hundredth of 1, over 1 and 1 % of the white of 2.
    assert found.noise["G"] == pytest.approx(0.01 / 1.02, rel=1e-4)


@pytest.mark.usefixtures("_renderer")
def test_a_scene_without_movers_keeps_its_light_in_every_band() -> None:
    """Nothing is traced again in a slot there: bands come from the still paths alone."""
    whole = scene(movers={}, lamps={"top": TABLE["lamps"]["top"]})
    counts = np.full(VIEW.rows * VIEW.cols, 256)
    with three_channels(whole):
        stage = Channels(whole, SRGB, VIEW, movers=True)
        stage.pose(0.0)
        sums = stage.radiance(counts, np.full_like(counts, 5), np.zeros_like(counts))
    plain = dict(zip("RGB", sums.reshape(3, VIEW.rows, VIEW.cols) / 256, strict=True))
    bands = BandLight(whole, "G", VIEW, TIMING, RenderSettings(seed=1), [SLOT], 16)
    found = bands.of(SLOT, plain["G"].astype(np.float32)).w_m2_sr
    for name in "RB":
        assert found[name].mean() == pytest.approx(plain[name].mean(), rel=0.02)


@pytest.fixture(scope="module")
def plain_runs() -> list[dict[str, np.ndarray]]:
    """Slot 1 in each band, rendered plainly: independent runs, at random times in equal parts of the slot."""
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    whole, counts, found = scene(), np.full(VIEW.rows * VIEW.cols, 64), []
    with three_channels(whole):
        groups = [
            (names[0], Channels(whole.only_lamps(names), SRGB, VIEW, movers=True))
            for names in whole.light_groups().values()
        ]
        for run in range(RUNS):
            light, rng = np.zeros((3, len(counts))), np.random.default_rng(run)
            for share in (np.arange(4) + rng.random(4)) / 4:
                for lamp, stage in groups:
                    stage.pose((SLOT + share) * TIMING.slot_s)
                    gain = whole.gain(lamp, SLOT * TIMING.slot_s, (SLOT + 1) * TIMING.slot_s)
                    seeds = np.full_like(counts, rng.integers(1 << 31))
                    sums = stage.radiance(counts, seeds, np.zeros_like(counts))
                    light += gain * sums / (4 * 64)
            found.append(dict(zip("RGB", light.reshape(3, VIEW.rows, VIEW.cols), strict=True)))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("shared", "seen"), [(True, "G"), (False, "R")])
def test_bands_have_no_bias(plain_runs, shared, seen) -> None:
    """Against plain rendering of each band: gloss, metal, a mover, coloured and flickering lamps.

    Means of blocks over independent runs. With normal noise 1 of 1000 such tests fails by chance.
    """
    whole, errors = scene(), []
    for run, plain in enumerate(plain_runs):
        settings = RenderSettings(seed=run)
        bands = BandLight(whole, seen, VIEW, TIMING, settings, [SLOT], 4, shared=shared)
        found = bands.of(SLOT, plain[seen].astype(np.float32)).w_m2_sr
        differences = np.stack([found[name] - plain[name] for name in "RGB" if name != seen])
        errors.append(differences.reshape(2, 4, 3, 4, 4).mean(axis=(2, 4)).ravel())
    mean, deviation = np.mean(errors, axis=0), np.std(errors, axis=0, ddof=1) / np.sqrt(RUNS)
    ratio = np.abs(mean) / deviation
    assert ratio.max() < student.ppf(1 - 1e-3 / 2 / ratio.size, RUNS - 1)
    # Small enough to see a bias of half a hundredth of white in a block.
    assert np.median(deviation) < 0.001 * whole.white_w_m2_sr


def test_r_g_and_b_are_in_the_file_and_read_as_an_array(tmp_path) -> None:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    place = tmp_path / "coloured"
    place.mkdir()
    lamps = {"top": TABLE["lamps"]["top"]}
    (place / "scene.toml").write_text(toml({**TABLE, "lamps": lamps, "max_depth": 3}))
    experiment = load_experiment("demo", [*SMALL, f"scene.name={place}"])
    assert experiment.camera.wavelength_nm == 549
    export_passes(experiment, tmp_path / "out" / "truth", range(1, 3), extras=Extras(band_samples=2))
    channels, said = read_exr(tmp_path / "out" / "truth" / "slot000001.exr")
    np.testing.assert_array_equal(channels["G"], channels["Y"])
    about = said["further"]["colour"]
    assert about["wavelength_nm"] == {"R": 611, "G": 549, "B": 464}
    assert (about["unit"], about["seen"], about["samples"]) == ("W m^-2 sr^-1", "G", 2)
    assert 0 < about["noise_besides_Y"]["B"] < about["noise"]["B"]
    sample = Sample(tmp_path / "out", None, {"name": "x"})
    assert sample["colour"].shape == (2, 3, *channels["Y"].shape)
    assert sample.axes("colour") == "slot, band, y, x"
    assert sample.wavelengths_nm == {"R": 611, "G": 549, "B": 464}
    np.testing.assert_array_equal(sample.slot("colour", 0)[0], channels["R"])
    ball = channels["id"] == next(int(k) for k, v in said["id_table"].items() if v == "mover/ball")
    means = {name: channels[name][ball].mean() for name in "RGB"}
    assert means["R"] > means["G"] > 3 * means["B"]


def toml(table, prefix="") -> str:
    """Write a table of tables; enough for this file."""
    plain = {key: value for key, value in table.items() if not isinstance(value, dict)}
    lines = [f"{key} = {written(value)}" for key, value in plain.items()]
    for key, value in table.items():
        if isinstance(value, dict):
            lines += [f"[{prefix}{key}]", toml(value, f"{prefix}{key}.")]
    return "\n".join(lines) + "\n"


def written(value) -> str:
    return f'"{value}"' if isinstance(value, str) else str(list(value) if isinstance(value, tuple) else value)


def test_a_picture_keeps_its_brightness_and_takes_the_colour_of_light() -> None:
    grey = np.array([[128, 60]], np.uint8)
    light = np.array([[[2.0, 2.0, 2.0], [0.0, 3.0, 3.0]]])
    drawn = tinted(light, grey)
    np.testing.assert_array_equal(drawn[0, 0], [128, 128, 128])
    assert drawn[0, 1, 0] == 0
    assert drawn[0, 1, 1] == drawn[0, 1, 2] > 60
