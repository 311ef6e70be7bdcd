"""Spectral bands: each is the mono scene with its numbers, bitwise; wrong names are errors; exports."""

from pathlib import Path

import numpy as np
import pytest
from small_experiment import SMALL

from optsim.core.errors import ConfigError, StorageError
from optsim.core.files import read_exr, read_json
from optsim.core.quantities import View
from optsim.dataset import Extras, choose_extras, export_passes
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.truth import chosen_scene, describe_truth
from optsim.render import choose_backend
from optsim.render.backend import activate
from optsim.render.stage import RenderStage
from optsim.scene import Scene, load_scene

BANDS = """
bands = [
    { name = "red", wavelength_nm = 620 },
    { name = "green", wavelength_nm = 540 },
    { name = "blue", wavelength_nm = 460 },
]
"""
TEXT = """
name = "coloured"
description = "a table of stone"
white_w_m2_sr = 2.0
max_depth = 5
{bands}
camera = {{ position_m = [0, -2, 1.2], target_m = [0, 0.5, 0.5] }}
[materials]
floor = {{ kind = "plastic", reflectance = {floor}, roughness = 0.3 }}
wall = {{ reflectance = {wall}, texture = "checker", tile_m = 0.5 }}
ball = {{ reflectance = 0.8 }}
[lamps.top]
center_m = [-1, 0, 2]
edge_u_m = [0.5, 0, 0]
edge_v_m = [0, -0.5, 0]
radiance_w_m2_sr = {top}
[lamps.side]
center_m = [1.4, 0, 1]
edge_u_m = [0, 0, 0.6]
edge_v_m = [0, 0.6, 0]
radiance_w_m2_sr = 3.0
flicker = {{ kind = "sine", frequency_hz = 100, depth = 0.5 }}
[objects.floor]
kind = "quad"
material = "floor"
corner_m = [-4, -3, 0]
edge_u_m = [8, 0, 0]
edge_v_m = [0, 6, 0]
[objects.wall]
kind = "quad"
material = "wall"
corner_m = [-4, 1.5, 0]
edge_u_m = [8, 0, 0]
edge_v_m = [0, 0, 4]
[movers.ball]
kind = "pendulum"
pivot_m = [0, 0.4, 1.6]
length_m = 1.0
bob_radius_m = 0.3
swing_rad = 0.6
material = "ball"
"""
FLOOR = "{ red = 0.7, green = 0.4, blue = 0.1 }"
WALL = "{ red = 0.2, green = 0.3, blue = 0.6 }"
TOP = "{ red = 8.0, green = 5.0, blue = 4.0 }"


def scene(folder: Path, *, bands: str = BANDS, floor: str = FLOOR, wall: str = WALL, top: str = TOP) -> Scene:
    folder.mkdir(exist_ok=True)
    text = TEXT.format(bands=bands, floor=floor, wall=wall, top=top)
    (folder / "scene.toml").write_text(text)
    return load_scene(folder)


def picture(chosen: Scene) -> np.ndarray:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()
    stage = RenderStage(chosen, View(24, 32, 1, 0.4))
    stage.pose(0.1)
    return stage.radiance(np.arange(24 * 32), 8, (3,))


@pytest.mark.parametrize(
    ("band", "numbers"), [("red", ("0.7", "0.2", "8.0")), ("blue", ("0.1", "0.6", "4.0"))]
)
def test_a_band_is_the_mono_scene_with_its_numbers_bitwise(tmp_path: Path, band, numbers) -> None:
    floor, wall, top = numbers
    plain = scene(tmp_path / "mono", bands="", floor=floor, wall=wall, top=top)
    banded = scene(tmp_path / "bands").in_band(band)
    assert banded.model_dump(exclude={"bands"}) == plain.model_dump(exclude={"bands"})
    assert [one.name for one in banded.bands] == [band]
    np.testing.assert_array_equal(picture(banded), picture(plain))
    assert (picture(banded) != picture(scene(tmp_path / "bands").in_band("green"))).mean() > 0.9


def test_light_is_linear_in_a_bands_lamp(tmp_path: Path) -> None:
    """Reflectances alike, lamps two to one and one to one: bitwise double, since two is a power of two."""
    whole = scene(tmp_path / "s", floor="0.4", wall="0.3", top=TOP)
    alone = [whole.in_band(name).only_lamps(["top"]) for name in ("red", "blue")]
    red, blue = (picture(one) for one in alone)
    assert blue.mean() > 0
    np.testing.assert_array_equal(red, 2 * blue)


def test_without_bands_nothing_is_different(tmp_path: Path) -> None:
    plain = scene(tmp_path / "s", bands="", floor="0.5", wall="0.5", top="4.0")
    assert plain.bands == ()
    assert plain.in_band() is plain
    with pytest.raises(ConfigError, match=r"scene\.band: got 'red', but 'coloured' has no bands"):
        plain.in_band("red")


def test_the_band_nearest_to_550_nm_is_the_default(tmp_path: Path) -> None:
    whole = scene(tmp_path / "s")
    assert whole.in_band() == whole.in_band("green")
    assert whole.in_band().in_band() == whole.in_band()
    with pytest.raises(ConfigError, match=r"unknown scene\.band of coloured 'gren'.*did you mean 'green'"):
        whole.in_band("gren")
    with pytest.raises(ConfigError, match=r"red, green, blue.*one band at a time"):
        picture(whole)


def test_it_comes_back_from_json_as_it_was(tmp_path: Path) -> None:
    for chosen in (scene(tmp_path / "s"), scene(tmp_path / "s").in_band("red")):
        text = chosen.model_dump_json()
        assert Scene.model_validate_json(text) == chosen
        assert Scene.model_validate_json(text).model_dump_json() == text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"floor": "{ red = 0.7, gren = 0.4, blue = 0.1 }"}, r"materials.floor.reflectance.*'gren'.*'green'"),
        (
            {"floor": "{ red = 0.7, blue = 0.1 }"},
            r"materials.floor.reflectance: got no value for band 'green'",
        ),
        (
            {"top": "{ red = 0.7 }", "bands": ""},
            r"(materials.floor.reflectance|lamps.top.radiance).*none declared",
        ),
        (
            {"floor": "{ red = 1.7, green = 0.4, blue = 0.1 }"},
            r"floor.*reflectance.red: got 1.7, expected at most 1",
        ),
        (
            {"top": "{ red = 8.0, green = 0.0, blue = 1.0 }"},
            r"radiance_w_m2_sr.green: got 0.0, expected more than 0",
        ),
        ({"top": "0.0"}, r"lamps.top.radiance_w_m2_sr: got 0.0, expected more than 0"),
        ({"floor": "'4'"}, r"reflectance: got '4', expected a plain number"),
        ({"bands": BANDS.replace("green", "red")}, "names must differ"),
        ({"bands": BANDS.replace("green", "light green")}, r"bands.1.name: got 'light green'"),
    ],
)
def test_bad_bands_are_named(tmp_path: Path, change, message) -> None:
    with pytest.raises(ConfigError, match=message):
        scene(tmp_path / "s", **change)


@pytest.fixture(scope="module")
def experiment(tmp_path_factory) -> Experiment:
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    folder = tmp_path_factory.mktemp("scenes") / "coloured"
    scene(folder)
    return load_experiment("demo", [*SMALL, f"scene.name={folder}"])


def test_an_experiment_sees_one_band_and_says_which(experiment) -> None:
    assert chosen_scene(experiment).bands[0].name == "green"
    assert "band green at 540 nm" in describe_truth(experiment).description
    assert experiment.camera.wavelength_nm == 540
    red = load_experiment("demo", [*SMALL, f"scene.name={experiment.scene.name}", "scene.band=red"])
    assert chosen_scene(red).lamps["top"].radiance_w_m2_sr == 8
    assert red.camera.wavelength_nm == 620
    assert red.fingerprint() != experiment.fingerprint()
    wrong = experiment.model_copy(update={"scene": red.scene.model_copy(update={"band": "rad"})})
    with pytest.raises(ConfigError, match="'red'"):
        describe_truth(wrong)
    assert load_experiment("demo").camera.wavelength_nm == 550
    assert "band" not in describe_truth(load_experiment("demo")).description


def test_samples_of_bands_can_be_asked_for(experiment) -> None:
    assert choose_extras(experiment, 7) == Extras(band_samples=7)
    assert choose_extras(experiment, 7, stokes=True) == Extras(band_samples=7, stokes_samples=7)
    assert choose_extras(experiment) == Extras()
    with pytest.raises(ConfigError, match="band_samples: got 0"):
        choose_extras(experiment, 0)
    with pytest.raises(ConfigError, match="a scene with several bands"):
        choose_extras(load_experiment("demo"), 7)


def test_an_export_holds_all_bands_with_noise_of_little_colour(experiment, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_passes(experiment, out, range(1), extras=Extras(band_samples=16))
    channels, said = read_exr(out / "slot000000.exr")
    names = {f"Y.band.{name}" for name in ("red", "green", "blue")}
    assert names < set(channels)
    about = said["further"]["Y.band"]
    assert about["wavelength_nm"] == {"red": 620, "green": 540, "blue": 460}
    assert about["seen"] == "green"
    assert about["samples"] == 16
    assert about["channels"] == {name: f"Y.band.{name}" for name in ("red", "green", "blue")}
    assert said["band_nm"] == 540
    assert read_json(out / "manifest.json")["band_nm"] == 540
    np.testing.assert_array_equal(channels["Y.band.green"], channels["Y"])
    assert channels["Y.band.red"].mean() > 1.2 * channels["Y.band.blue"].mean()
    assert about["noise_besides_Y"]["red"] < 0.5 * about["noise"]["red"]
    # A wall of one colour: its noise is of one colour too, so a ratio of bands is smoother than a band.
    wall = channels["id"] == next(int(k) for k, v in said["id_table"].items() if v == "object/wall")
    wall &= channels["albedo"] > 0.1
    red, green = channels["Y.band.red"][wall], channels["Y.band.green"][wall]
    assert wall.sum() > 50
    assert np.std(red / green) / np.mean(red / green) < 0.5 * np.std(red) / np.mean(red)
    for other in (Extras(band_samples=17), Extras(band_samples=16, light_samples=4)):
        with pytest.raises(StorageError, match="another truth"):
            export_passes(experiment, out, range(1), extras=other)
    # The band that is seen is the same, another one is not.
    scene(tmp_path / "other", floor=FLOOR.replace("0.1", "0.2"))
    other = load_experiment("demo", [*SMALL, f"scene.name={tmp_path / 'other'}"])
    assert chosen_scene(other) == chosen_scene(experiment)
    with pytest.raises(StorageError, match="another truth"):
        export_passes(other, out, range(1), extras=Extras(band_samples=16))
