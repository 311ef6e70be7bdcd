"""Truth of polarised light: fast paths against the Stokes render, when it is chosen, and who is told."""

from pathlib import Path

import numpy as np
import pytest
from small_experiment import SMALL

from optsim.camera.effects import with_effects
from optsim.core.cache import Cache
from optsim.core.errors import BackendError
from optsim.core.quantities import Timing, View
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import explanation
from optsim.experiment.truth import render_truth as truth_of
from optsim.experiment.truth import scene_light
from optsim.optics.mueller import polariser, turned
from optsim.render import RenderSettings, choose_backend, render_truth
from optsim.render.backend import activate
from optsim.render.plan import seed_of
from optsim.render.stage import RenderStage
from optsim.render.stokes import polarised, render_stokes
from optsim.scene import Scene, load_scene

VIEW = View(24, 32, 1, 0.5)
# In focus on the floor's far end: the ball's disc is several samples wide.
LENS = View(24, 32, 1, 0.5, aperture_m=0.4, focus_m=4.0, distortion=-0.1)
TIMING = Timing(1 / 180, 4, 1)
SETTINGS = RenderSettings(static_error=0.1, change_error=0.15, moving_error=0.15, slots_per_segment=4)
SLANTS = (0.0, np.pi / 2, 0.6)


@pytest.fixture(autouse=True)
def _vectorised():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def hall(floor=None, ball=None, *, pan=0.0, flicker=None):
    """A polished floor near Brewster's angle, lit from behind, and a ball that swings over it."""
    lamp = {
        "center_m": (0.0, 3.0, 1.5),
        "edge_u_m": (3.0, 0.0, 0.0),
        "edge_v_m": (0.0, 0.0, 2.0),
        "radiance_w_m2_sr": 3.0,
    }
    return Scene.model_validate(
        {
            "name": "hall",
            "white_w_m2_sr": 1.0,
            "max_depth": 4,
            "camera": {
                "position_m": (0.0, -2.0, 1.3),
                "target_m": (0.0, 0.0, 0.1),
                **({"pan_rad_s": pan} if pan else {}),
            },
            "materials": {
                "floor": floor or {"kind": "plastic", "reflectance": 0.2, "roughness": 0.15},
                "ball": ball or {"reflectance": 0.6},
            },
            "lamps": {"screen": {**lamp, "flicker": flicker} if flicker else lamp},
            "objects": {
                "floor": {
                    "kind": "quad",
                    "material": "floor",
                    "corner_m": (-6.0, -3.0, 0.0),
                    "edge_u_m": (12.0, 0.0, 0.0),
                    "edge_v_m": (0.0, 5.9, 0.0),
                }
            },
            "movers": {
                "ball": {
                    "kind": "pendulum",
                    "pivot_m": (0.0, 0.3, 1.6),
                    "length_m": 1.0,
                    "bob_radius_m": 0.3,
                    "swing_rad": 1.0,
                    "material": "ball",
                }
            },
        }
    )


def analysed(stokes, azimuth_rad):
    """Twice what a polariser passes, by the camera's own Mueller algebra."""
    vectors = np.moveaxis(stokes.astype(np.float64), 0, -1)
    return 2 * (vectors @ turned(polariser(1, 0), azimuth_rad).T)[..., 0]


def test_a_stage_sees_what_a_polariser_passes_of_the_stokes_vector():
    """The same light by two samplers: a block mean of 12 deviates by 4.6 of its errors once in 2e4 runs."""
    scene, pixels = hall(), np.arange(VIEW.rows * VIEW.cols)
    runs = [render_stokes(scene, VIEW, 0.1, 64, seed) for seed in range(8)]
    with polarised():
        for azimuth_rad in SLANTS:
            stage = RenderStage(scene, VIEW, azimuth_rad=azimuth_rad)
            stage.pose(0.1)
            ours = stage.radiance(pixels, 64, tuple(range(100, 108))).reshape(8, 4, 6, 4, 8).mean((2, 4))
            theirs = np.array([analysed(run, azimuth_rad) for run in runs])
            theirs = theirs.reshape(8, 4, 6, 4, 8).mean((2, 4))
            error = np.sqrt((ours.var(0, ddof=1) + theirs.var(0, ddof=1)) / 8)
            # Student's t of 14 degrees of freedom, 16 blocks and 3 azimuths: beyond 6.5 once in 1500 runs.
            assert np.abs((ours - theirs).mean(0) / error).max() < 6.5
            assert ours.mean() == pytest.approx(theirs.mean(), rel=0.01)
    plain = RenderStage(scene, VIEW)
    plain.pose(0.1)
    dull = plain.radiance(pixels, 64, (5,)).mean()
    assert analysed(runs[0], 0.0).mean() > 1.1 * dull
    assert analysed(runs[0], np.pi / 2).mean() < 0.9 * dull


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ball", "pan", "flicker", "view"),
    [
        (None, 0.0, None, VIEW),
        ({"kind": "metal", "metal": "Cr", "roughness": 0.3}, 0.0, None, VIEW),
        (None, 0.5, None, VIEW),
        (None, 0.0, {"kind": "sine", "frequency_hz": 100, "depth": 0.5}, VIEW),
        (None, 0.0, None, LENS),
    ],
    ids=["matt mover", "metal mover", "camera", "flicker", "lens"],
)
def test_fast_paths_agree_with_the_stokes_render(tmp_path: Path, ball, pan, flicker, view):
    """Differences, carried light and allocation, against whole Stokes pictures at two times of a slot."""
    scene, azimuth_rad = hall(ball=ball, pan=pan, flicker=flicker), 1.2
    cache = Cache(tmp_path)
    truth = render_truth(scene, view, TIMING, SETTINGS, cache=cache, azimuth_rad=azimuth_rad)
    slot, lamp = 2, scene.lamps["screen"]
    gain = lamp.gain(slot / 180, (slot + 1) / 180)
    times = [(slot + share) / 180 for share in (0.25, 0.75)]

    def stokes(seed):
        seen = [render_stokes(scene, view, time_s, 48, seed_of(seed, time_s)) for time_s in times]
        return analysed(np.mean(seen, axis=0), azimuth_rad)

    runs = np.array([stokes(seed) for seed in range(8)])
    index, instant = divmod(slot, truth.slots_per_segment)

    def image(video):
        return video.load(index).instant(instant).astype(np.float64)

    def blocks(pictures):
        return pictures.reshape(*pictures.shape[:-2], 4, 6, 4, 8).mean((-3, -1))

    direct, noise = blocks(runs * gain), image(truth.half_difference)
    ours, own = blocks(image(truth)), np.sqrt(blocks(noise**2) / 48)
    error = np.sqrt(direct.var(0, ddof=1) / 8 + own**2)
    z = (ours - direct.mean(0)) / error
    # Errors from few numbers, and the plan's own error of interpolation: as in the test of unpolarised truth.
    assert np.abs(z).max() < 7
    assert abs(z.mean()) < 1.0
    assert ours.mean() == pytest.approx(direct.mean(), rel=0.02)
    # It is another picture than the unpolarised one, in a place of the cache of its own.
    plain = render_truth(scene, view, TIMING, SETTINGS, cache=cache)
    assert image(plain).mean() > 1.05 * ours.mean()


def test_unpolarised_pictures_are_untouched_by_a_polarised_render(tmp_path: Path):
    scene = hall()
    before = render_truth(scene, VIEW, TIMING, SETTINGS, cache=Cache(tmp_path / "a"))
    cache = Cache(tmp_path / "b")
    render_truth(scene, VIEW, TIMING, SETTINGS, cache=cache, azimuth_rad=0.3)
    after = render_truth(scene, VIEW, TIMING, SETTINGS, cache=cache)
    for slot in range(4):
        np.testing.assert_allclose(after.load(0).instant(slot), before.load(0).instant(slot), rtol=1e-5)


def test_what_has_no_gloss_needs_no_polarised_render():
    matt = {"reflectance": 0.4}
    assert hall().polarising() == ("floor",)
    assert hall(matt).polarising() == ()
    assert hall(matt, {"kind": "metal"}).polarising() == ("ball",)
    assert hall({"kind": "glass", "thin": False}, matt).polarising() == ("floor",)
    assert hall({"kind": "glass", "thin": True}, matt).polarising() == ()
    assert load_scene("window_room").polarising() == ()
    assert load_scene("glossy_floor").polarising() == ("brass", "floor", "pot", "steel")
    # And these don't: nothing but S0, whatever the direction.
    for floor in (matt, {"kind": "glass", "thin": True}):
        seen = render_stokes(hall(floor, matt), VIEW, 0.1, 8, 3)
        assert np.abs(seen[1:]).max() == 0
        assert seen[0].mean() > 0.05


def test_auto_follows_the_materials_and_says_so():
    glossy = ["scene.name=glossy_floor", "camera.splitter.azimuth_rad='90 deg'"]
    chosen = scene_light(load_experiment("demo", glossy))
    assert chosen.azimuth_rad == pytest.approx(np.pi / 2)
    assert "floor" in chosen.why
    assert "90 degrees" in chosen.why
    assert scene_light(load_experiment("demo")).azimuth_rad is None
    insisted = load_experiment("demo", ["camera.splitter.scene_light=polarised"])
    assert scene_light(insisted).azimuth_rad == 0.0
    off = load_experiment("demo", [*glossy, "camera.effects.polarised_scene=ideal"])
    assert scene_light(off).azimuth_rad is None
    assert "camera.splitter.scene_light" in scene_light(off).why
    camera = with_effects(load_experiment("demo").camera, {"polarised_scene": "pessimistic"})
    assert camera.splitter.scene_light == "polarised"
    # Where only the scalar renderer works.
    fallen = scene_light(load_experiment("demo", glossy), preview=True)
    assert fallen.azimuth_rad is None
    assert "TAKEN AS UNPOLARISED" in fallen.why
    assert "floor" in fallen.why
    with pytest.raises(BackendError, match=r"camera.splitter.scene_light: got 'polarised'.*cure"):
        scene_light(insisted, preview=True)


GLOSSY = ["scene.name=glossy_floor", *SMALL]


@pytest.mark.slow
def test_an_experiment_renders_what_its_splitter_passes():
    """The floor of glossy_floor by the splitter's azimuth, nothing else set."""
    means = {}
    for name, more in (("rows", "0 deg"), ("columns", "90 deg")):
        experiment = load_experiment("demo", [*GLOSSY, f"camera.splitter.azimuth_rad='{more}'"])
        means[name] = truth_of(experiment).load(0).instant(0)[24:].mean()
    dull = load_experiment("demo", [*GLOSSY, "camera.splitter.scene_light=unpolarised"])
    means["unpolarised"] = truth_of(dull).load(0).instant(0)[24:].mean()
    assert means["rows"] > 1.2 * means["unpolarised"] > 1.44 * means["columns"]
    # What one azimuth gains the other one loses.
    assert (means["rows"] + means["columns"]) / 2 == pytest.approx(means["unpolarised"], rel=0.06)


def test_explain_says_it():
    said = explanation("demo", [*GLOSSY, "tolerance=0"])
    assert said["light"].startswith("polarised by brass, floor")
