"""Where movers are rendered, against a pinhole of this file's own: an instant shows the instant's place."""

from pathlib import Path

import numpy as np
import pytest

from optsim.core.cache import Cache
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, choose_backend, render_truth
from optsim.render.backend import activate
from optsim.scene import load_scene

VIEW = View(8, 60, 1, 0.3)
DEPTH_M, START_M, SPEED_M_S, SLOT_S = 4.0, -0.4, 20.0, 1 / 200
SCENE = f"""
name = "passing"
white_w_m2_sr = 1.0
max_depth = 2
[camera]
position_m = [0, 0, 0]
target_m = [0, 1, 0]
[materials.paint]
reflectance = 0.8
[lamps.a]
center_m = [0, -2, 30]
edge_u_m = [4, 0, 0]
edge_v_m = [0, -4, 0]
radiance_w_m2_sr = 500.0
[movers.card]
kind = "card"
material = "paint"
center_m = [{START_M}, {DEPTH_M}, 0]
size_m = [0.3, 0.1]
velocity_m_s = [{SPEED_M_S}, 0, 0]
"""


def test_a_card_is_where_it_is_at_the_middle_of_each_instant(tmp_path: Path) -> None:
    """A slot's path is 2.5 samples, so half a slot is 1.25."""
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()
    (tmp_path / "scene.toml").write_text(SCENE)
    scene = load_scene(tmp_path)
    settings = RenderSettings(
        static_error=0.3, change_error=0.3, moving_error=0.2, slots_per_segment=2, interpolation_error=0.1
    )
    timing = Timing(SLOT_S, 2, 1)
    video = render_truth(scene, VIEW, timing, settings, cache=Cache(tmp_path / "cache"))
    for index in range(2 * video.instants_per_slot):
        light = video.load(0).instant(index).astype(np.float64).sum(axis=0)
        time_s = (index + 0.5) / video.instants_per_slot * SLOT_S
        place = (START_M + SPEED_M_S * time_s) / DEPTH_M / VIEW.tan_half_width
        found = (light * (np.arange(VIEW.cols) + 0.5)).sum() / light.sum()
        assert found == pytest.approx((place + 1) * VIEW.cols / 2, abs=0.25), (index, light)
