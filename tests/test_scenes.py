"""The shipped scenes keep what their READMEs promise: shares of moving pixels, speeds, ratios, positions."""

import functools

import numpy as np
import pytest

from optsim.core.quantities import View
from optsim.render import choose_backend
from optsim.render.backend import activate
from optsim.render.footprint import cover, project
from optsim.render.stage import RenderStage, outside_mask
from optsim.scene import bright_lights, list_scenes
from optsim.scene import load_scene as load_afresh
from optsim.scene.scene import scenes_folder

load_scene = functools.cache(load_afresh)
VIEW = View(360, 480, 3, 0.32)  # the fine grid of the demo camera
SLOT_S = 1 / 180
TIMES_S = (0.0, 0.35, 1.0, 1.8)
# Share of pixels that movers cover at each of these instants, in main and in numbered variations.
SHARES = {
    "wheel": (0.01, 0.06),
    "half_moving": (0.40, 0.60),
    "glossy_floor": (0.025, 0.055),
    "flicker_lamp": (0.015, 0.05),
    "night_street": (0.02, 0.2),
    "moving_camera": (0.02, 0.1),
    "chart": (0.04, 0.07),
    "courtyard": (0.08, 0.12),
}
NUMBERS = ("1", "2", "3")
ALL = [(n, v) for n in SHARES for v in (*list_scenes()[n], *NUMBERS)]


def share(scene, time_s):
    mask = np.zeros((VIEW.rows, VIEW.cols), np.bool_)
    for mover in scene.singles().values():
        cover(mask, mover.vertices(time_s), mover.rest().faces, scene.camera.at(time_s), VIEW)
    return mask.mean()


def fastest(mover, scene, time_s):
    """Farthest way of a visible point in one slot, panel pixels."""
    before, after = (
        project(mover.vertices(t), scene.camera.at(t), VIEW)[:, :2] for t in (time_s, time_s + SLOT_S)
    )
    seen = ((before > 0) & (before < (VIEW.rows, VIEW.cols))).all(axis=1)
    return np.hypot(*(after - before)[seen].T).max() / VIEW.samples_per_pitch


@pytest.mark.parametrize(("name", "variation"), ALL)
def test_every_variation_loads_lit_and_clear_of_the_camera(name, variation):
    scene = load_scene(name, variation)
    assert scene.name == name
    assert scene.light_groups()
    for time_s in TIMES_S:
        eye = np.asarray(scene.camera.at(time_s).position_m)
        for key, mover in scene.singles().items():
            points = mover.vertices(time_s)
            # No vertex near the pinhole, and the pinhole not in the box round any mover.
            assert np.linalg.norm(points - eye, axis=1).min() > 0.5, key
            assert ((eye < points.min(0)) | (eye > points.max(0))).any(), key
        nearest = min(np.linalg.norm(m.vertices_m - eye, axis=1).min() for m in scene.still_meshes().values())
        assert nearest > 0.3


@pytest.mark.parametrize("name", SHARES)
def test_numbers_vary_the_scene_and_repeat(name):
    drawn = [load_scene(name, n).model_dump_json(exclude={"variation"}) for n in NUMBERS]
    assert len(set(drawn)) == len(drawn)
    assert load_afresh(name, "1").model_dump_json(exclude={"variation"}) == drawn[0]


@pytest.mark.parametrize("name", SHARES)
@pytest.mark.parametrize("variation", ["main", *NUMBERS])
def test_movers_cover_the_stated_share_of_the_picture(name, variation):
    low, high = SHARES[name]
    scene = load_scene(name, variation)
    shares = [share(scene, time_s) for time_s in TIMES_S]
    assert low < min(shares)
    assert max(shares) < high


@pytest.mark.parametrize("name", SHARES)
def test_readmes_state_what_a_user_must_know(name):
    text = (scenes_folder() / name / "README.md").read_text().lower()
    for phrase in (
        "pixels per slot",
        "share of moving pixels",
        "dynamic range",
        "cc0",
        "variations",
        "measured",
    ):
        assert phrase in text, phrase
    reserved = load_scene(name).reserved
    assert reserved == (name in ("chart", "night_street"))
    assert ("reserved for testing" in text) == reserved


@pytest.mark.parametrize(
    ("name", "mover", "stated_px"),
    [
        ("wheel", "wheel", 4.0),
        ("night_street", "car_body", 0.55),
        ("courtyard", "pinwheel", 0.686),
        ("courtyard", "car_body", 0.122),
        ("chart", "slow_bars_6", 0.5),
        ("chart", "fast_bars_6", 2.0),
    ],
)
def test_steady_speeds_are_the_stated_ones(name, mover, stated_px):
    scene = load_scene(name)
    assert f"{stated_px}" in (scenes_folder() / name / "README.md").read_text()
    assert fastest(scene.singles()[mover], scene, 0.05) == pytest.approx(stated_px, rel=0.015)


def test_kinds_of_change_cover_all_that_a_renderer_tells_apart():
    kinds = {n: load_scene(*n).kind_of_change() for n in ALL}
    assert kinds["chart", "still"] == "static"
    assert kinds["flicker_lamp", "lamps_only"] == "lamps"
    assert kinds["moving_camera", "main"] == kinds["moving_camera", "still_room"] == "camera"
    assert {kinds[n, "main"] for n in SHARES if n != "moving_camera"} == {"movers"}
    assert len(load_scene("flicker_lamp").light_groups()) == 3


def test_car_wheels_roll_without_slipping():
    wheel = load_scene("night_street").singles()["car_wheel_fl"]
    step_s = 1e-5
    now = wheel.vertices(0.2)
    velocity = (wheel.vertices(0.2 + step_s) - now) / step_s
    low, high = now[:, 2].argmin(), now[:, 2].argmax()
    assert now[low, 2] == pytest.approx(0, abs=2e-3)
    # The lowest vertex may stand a few degrees before or behind the point of contact, so it may rise or sink.
    assert np.abs(velocity[low, :2]).max() < 0.05
    np.testing.assert_allclose(velocity[high, :2], 2 * np.asarray(wheel.velocity_m_s)[:2], atol=0.05)


# --- rendered --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def _renderer():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def radiance(name, rows, cols, samples):
    stage = RenderStage(load_scene(name), VIEW)
    return stage.radiance(np.asarray(rows) * VIEW.cols + np.asarray(cols), samples, (3,))[0]


@pytest.mark.usefixtures("_renderer")
def test_night_street_lamps_outshine_the_road_by_more_than_1e5():
    scene = load_scene("night_street")
    places = project(np.array([lamp.center_m for lamp in scene.lamps.values()]), scene.camera, VIEW)
    in_view = [p for p in places if 0 < p[0] < VIEW.rows and 0 < p[1] < VIEW.cols]
    rows, cols = np.floor(np.array(in_view)[:, :2]).astype(int).T
    lamps = radiance("night_street", rows, cols, 64)
    rng = np.random.default_rng(1)
    road = radiance("night_street", rng.integers(335, 360, 300), rng.integers(0, 480, 300), 64)
    ratio = lamps.max() / np.median(road)
    assert 1e5 < ratio < 4e5
    assert (lamps > 100).sum() >= 4


@pytest.mark.usefixtures("_renderer")
def test_courtyard_has_the_sky_the_shadows_and_the_sun_that_its_readme_states():
    outside = outside_mask(load_scene("courtyard"), VIEW)
    assert outside.mean() == pytest.approx(0.14, abs=0.01)
    assert not outside[VIEW.rows // 3 :].any()
    image = RenderStage(load_scene("courtyard"), VIEW).picture(16, 1)
    high, low = np.percentile(image[~outside], (99.5, 1))
    assert high / low == pytest.approx(115, rel=0.15)
    assert 45 < np.median(image[outside]) < 65
    assert image.max() < 2 * load_scene("courtyard").white_w_m2_sr
    against = RenderStage(load_scene("courtyard", "low_sun"), VIEW).picture(16, 1)
    assert 1e6 < against.max() / np.median(against[~outside]) < 3e6
    row, col = np.unravel_index(against.argmax(), against.shape)
    assert row < 70
    assert 300 < col < 400
    assert 25 < (against > against.max() / 2).sum() < 50, "the sun is seven fine samples across"


@pytest.mark.parametrize("number", [str(n) for n in range(12)])
def test_the_sun_of_a_numbered_courtyard_is_high_and_not_in_the_picture(number):
    scene = load_scene("courtyard", number)
    assert not [light for light in bright_lights(scene, 0.32, 0.75) if light.over_white > 10]
    assert 0.35 <= scene.sky.elevation_rad <= 1.1


@pytest.mark.usefixtures("_renderer")
def test_chart_targets_are_where_the_readme_says():
    def at(x, z):  # the samples around a place in panel pixels from the centre
        rows, cols = np.mgrid[-2:3, -2:3].reshape(2, -1)
        return np.floor(180 - 3 * z + rows).astype(int), np.floor(240 + 3 * x + cols).astype(int)

    places = [at(-55 + 11 * k, 49) for k in range(11)]
    places += [at(44, 26), at(56, 26), at(68, 26), at(44, 12), at(56, 12), at(68, 12)]
    rows, cols = (np.concatenate(part) for part in zip(*places, strict=True))
    mean = radiance("chart", rows, cols, 64).reshape(len(places), -1).mean(axis=1)
    assert mean[0] == pytest.approx(1.0, rel=0.02)
    np.testing.assert_allclose(mean[:10] / mean[1:11], 2.0, rtol=0.03)
    # The last patch is two panel pixels wide, a little more than the samples around its centre.
    np.testing.assert_allclose(mean[11:], 4.0 ** np.arange(1, 7), rtol=0.02)
