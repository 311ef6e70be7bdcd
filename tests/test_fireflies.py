"""The firefly pilot: what it flags, and that it names the lamp and the bounces that make it so."""

import json

import numpy as np
import pytest

from optsim.app.cli import main
from optsim.core.config import build
from optsim.core.errors import ConfigError
from optsim.core.quantities import View
from optsim.render import choose_backend
from optsim.render.backend import activate
from optsim.render.fireflies import all_paths, origins, pilot, relative_variance
from optsim.render.stage import RenderStage
from optsim.scene.scene import Scene

VIEW = View(24, 32, 1, 0.5)
# A cube of 2 m round the origin under a broad lamp behind the camera.
ROOM = {
    "name": "room",
    "white_w_m2_sr": 1.0,
    "max_depth": 6,
    "camera": {"position_m": (0, -0.95, 0), "target_m": (0, 0, 0)},
    "materials": {"grey": {"reflectance": 0.3}},
    "objects": {"walls": {"kind": "box", "material": "grey", "center_m": (0, 0, 0), "size_m": (2, 2, 2)}},
    "lamps": {
        "broad": {
            "center_m": (0, -0.99, 0),
            "edge_u_m": (0, 0, 1.6),
            "edge_v_m": (1.6, 0, 0),
            "radiance_w_m2_sr": 1.0,
        }
    },
}
# A lamp of 4 mm below a second floor with a slit of 1 x 2 cm: it lights a spot on the ceiling, which the
# camera doesn't see. A path must meet this spot by chance, so its light comes after two bounces or more.
SLIT = {
    "objects": ROOM["objects"]
    | {
        "floor": {
            "kind": "wall",
            "material": "grey",
            "corner_m": (-1, -1, -0.8),
            "edge_u_m": (2, 0, 0),
            "edge_v_m": (0, 2, 0),
            "holes_m": [(0.995, 0.99, 1.005, 1.01)],
            "depth_m": 0.001,
        }
    },
    "lamps": ROOM["lamps"]
    | {
        "tiny": {
            "center_m": (0, 0, -0.9),
            "edge_u_m": (0.004, 0, 0),
            "edge_v_m": (0, 0.004, 0),
            "radiance_w_m2_sr": 3e8,
        }
    },
}
CARD = {"kind": "card", "material": "grey", "center_m": (0, 0.5, 0), "size_m": (0.4, 0.3)}


@pytest.fixture(scope="module", autouse=True)
def _backend():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def room(**changes):
    return build(Scene, ROOM | changes, where="room")


def test_a_tiny_lamp_behind_a_slit_is_flagged_with_its_bounces():
    (found,) = pilot(room(**SLIT), view=VIEW)
    assert not found.movers
    assert (found.rows, found.cols, found.samples) == (24, 32, 256)
    assert 0.2 < found.visible_share <= found.flagged_share < 0.9
    lamp, bounces, n = found.causes()[0]
    assert (lamp, bounces) == ("tiny", 2)
    # Some paths meet the spot one bounce later.
    assert n > 0.8 * len(found.fireflies) > 100
    assert {one.lamp for one in found.fireflies} == {"tiny"}
    worst = found.fireflies[0]
    assert 50 < worst.ratio <= 256
    assert 0.4 < worst.path_share <= 1
    assert "light of lamp 'tiny' after 2 bounces" in found.text()


def test_a_plain_room_has_none():
    scene = room(movers={"card": CARD})
    found = pilot(scene, view=VIEW)
    assert [one.movers for one in found] == [False, True]
    assert [one.n_flagged for one in found] == [0, 0]
    assert [one.fireflies for one in found] == [(), ()]
    # Diffuse light of a broad lamp: the median pixel is neither without noise nor noisy.
    assert all(0.02 < one.median < 3 for one in found)
    assert found[0].median != found[1].median


def test_origins_add_up_to_the_path_and_tell_one_bounce_from_two():
    scene, seed, samples = room(**SLIT), 9, 32
    pixels = np.repeat(np.arange(VIEW.rows * VIEW.cols), samples)
    numbers = np.tile(np.arange(samples), VIEW.rows * VIEW.cols)
    whole = all_paths(RenderStage(scene, VIEW, movers=False), samples, seed, lambda _: None).ravel()
    by_bounces, by_lamp = origins(scene, VIEW, pixels, numbers, seed, movers=False)
    assert by_bounces.shape == (scene.max_depth, len(pixels))
    np.testing.assert_allclose(by_bounces.sum(axis=0), whole, rtol=1e-6)
    # Digits, and a billionth of the other lamp, which is 3e8 times as bright.
    np.testing.assert_allclose(by_lamp["tiny"] + by_lamp["broad"], whole, rtol=1e-4, atol=1e-3)
    # By where things are: no lamp is in the picture, and nothing in it sees the tiny one.
    assert (by_bounces[0] == 0).all()
    tiny = by_lamp["tiny"] > 1
    assert 50 < tiny.sum() < 0.02 * len(pixels)
    assert (by_bounces[1, tiny] <= by_lamp["broad"][tiny] + 1e-3).all()
    assert by_bounces[2, tiny].sum() > 0.3 * whole[tiny].sum()


def test_the_ratio_of_a_rare_bright_path_is_its_closed_form():
    """One path in n of radiance x, the others 0: variance / mean^2 is n. The same with a floor."""
    values = np.zeros((3, 64), np.float32)
    values[0, 7] = 5.0
    values[1] = 2.0
    np.testing.assert_allclose(relative_variance(values), [64, 0, 0])
    mean = 5 / 64
    np.testing.assert_allclose(relative_variance(values, 0.1), [64 * (mean / (mean + 0.1)) ** 2, 0, 0])


def test_a_dark_corner_is_flagged_but_not_visible():
    """The same room a million times dimmer than its white: below what any error target counts."""
    dim = room(**SLIT, white_w_m2_sr=1e6)
    (found,) = pilot(dim, view=VIEW)
    assert found.flagged_share > 0.2
    assert found.n_visible == 0


def test_a_bound_that_no_pixel_can_reach_is_refused():
    with pytest.raises(ConfigError, match="more samples"):
        pilot(room(), view=VIEW, samples=32, bound=32)


# --- the command -------------------------------------------------------------------------------------------

LAMP_TOML = """
[lamps.{name}]
center_m = {center_m}
edge_u_m = {edge_u_m}
edge_v_m = {edge_v_m}
radiance_w_m2_sr = {radiance_w_m2_sr}
"""


def written(folder, radiance_w_m2_sr):
    """Write the room with the slit as a scene folder."""
    lamps = SLIT["lamps"] | {"tiny": SLIT["lamps"]["tiny"] | {"radiance_w_m2_sr": radiance_w_m2_sr}}
    text = """
name = "slit"
white_w_m2_sr = 1.0
[camera]
position_m = [0, -0.95, 0]
target_m = [0, 0, 0]
[materials.grey]
reflectance = 0.3
[objects.walls]
kind = "box"
material = "grey"
center_m = [0, 0, 0]
size_m = [2, 2, 2]
[objects.floor]
kind = "wall"
material = "grey"
corner_m = [-1, -1, -0.8]
edge_u_m = [2, 0, 0]
edge_v_m = [0, 2, 0]
holes_m = [[0.995, 0.99, 1.005, 1.01]]
depth_m = 0.001
"""
    for name, lamp in lamps.items():
        table = {key: list(value) if isinstance(value, tuple) else value for key, value in lamp.items()}
        text += LAMP_TOML.format(name=name, **table)
    (folder / "scene.toml").write_text(text)
    return str(folder)


@pytest.fixture
def check(monkeypatch, capsys):
    def run(*words):
        monkeypatch.setattr("sys.argv", ["optsim", "check", *words])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code, *capsys.readouterr()

    return run


def test_the_command_fails_on_fireflies_and_says_whose(check, tmp_path):
    code, out, _ = check(written(tmp_path, 3e8), "--json")
    record = json.loads(out)
    assert code == 1
    assert record["kind_of_change"] == "static"
    assert not record["fit"]
    assert record["pilots"][0]["causes"][0]["lamp"] == "tiny"
    assert record["pilots"][0]["causes"][0]["bounces"] == 2
    code, out, _ = check(written(tmp_path, 30.0))
    assert code == 0
    assert "nothing changes" in out


def test_the_command_names_what_it_cannot_find(check):
    code, _, err = check("window_roon")
    assert code == 2
    assert "window_room" in err
    code, _, err = check("window_room", "--variation", "corssing")
    assert code == 2
    assert "crossing" in err
