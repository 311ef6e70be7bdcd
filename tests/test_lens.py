"""The lens without the renderer: distortion and its inverse, shading, focus and what it is worth."""

from dataclasses import replace

import numpy as np
import pytest

from optsim.camera.camera import CodedCamera
from optsim.camera.effects import ALL, with_effects
from optsim.camera.hardware import prototype
from optsim.camera.parts import Objective
from optsim.core.errors import ConfigError
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import explanation
from optsim.experiment.focus import NEGLIGIBLE_SAMPLES, focus_on, seen_through
from optsim.experiment.truth import describe_truth, scene_focus, truth_view
from optsim.optics.lens import blur_tan, image_scale, object_scale
from optsim.scene import Scene, load_scene
from optsim.scene.depths import depth_range_m

DISTORTIONS = (-0.1, -0.03, 0.02, 0.1)


@pytest.mark.parametrize("k", DISTORTIONS)
def test_distortion_and_its_inverse_agree_with_the_roots_of_the_cubic(k):
    r = np.linspace(0.01, 1.05, 40)
    q = r * object_scale(r**2, k)
    for radius, found in zip(r, q, strict=True):
        roots = np.roots([k, 0, 1, -radius])
        real = roots[abs(roots.imag) < 1e-9].real
        assert found == pytest.approx(real[np.argmin(abs(real - radius))], rel=1e-6)
    assert q * image_scale(q**2, k) == pytest.approx(r, rel=1e-6)


@pytest.mark.parametrize("k", DISTORTIONS)
def test_what_is_far_outside_never_comes_back_into_the_picture(k):
    q = np.linspace(0, 50, 2000)
    r = q * image_scale(q**2, k)
    assert (np.diff(r) > 0).all()
    assert r[q > 1.3].min() > 1.0


@pytest.mark.parametrize("k", [-0.1, 0.0, 0.05])
def test_shading_keeps_the_flux_of_a_flat_scene(k):
    """Of light L A cos(angle) per steradian: what falls on the panel is what comes from the field it sees."""
    lens = Objective(focal_length_m=10e-3, magnification=1.0, glare_share=0.0, distortion=k)
    rows, cols, cell_m = 300, 400, 20e-6
    fallen = lens.shading(rows, cols, cell_m).sum() * (cell_m / 10e-3) ** 2
    # The border of the panel in directions: a ray through (x, y) has a tangent smaller or larger by q / r.
    half = np.array([rows, cols]) / 2 * cell_m / 10e-3
    corner = np.hypot(*half)

    def from_direction(angle):
        """Integrate cos over the solid angle from the axis to the border in a direction of the picture."""
        border = min(half[1] / max(abs(np.cos(angle)), 1e-12), half[0] / max(abs(np.sin(angle)), 1e-12))
        roots = np.roots([k, 0, 1, -border / corner])
        real = roots[abs(roots.imag) < 1e-9].real
        tan = corner * real[np.argmin(abs(real - border / corner))]
        return tan**2 / (1 + tan**2) / 2  # of cos^4 t dt: sin^2 / 2

    angles = (np.arange(20_000) + 0.5) / 20_000 * 2 * np.pi
    seen = np.mean([from_direction(angle) for angle in angles]) * 2 * np.pi
    # Midpoints of 300 x 400 cells and of 20 000 directions.
    assert fallen == pytest.approx(seen, rel=1e-5)


def test_a_barrel_is_brighter_in_the_corner_than_without():
    straight, barrel = (Objective(distortion=k).shading(300, 400, 20e-6)[0, 0] for k in (0.0, -0.05))
    # Area shrinks by (1 + k)(1 + 3 k), and the corner looks 5 % farther out.
    assert barrel / straight == pytest.approx(1 / (0.95 * 0.85), rel=0.05)


def test_the_circle_of_confusion_is_that_of_the_lens_equation():
    f, n, s = 50e-3, 2.0, 3.0
    image = 1 / (1 / f - 1 / s)
    for depth in (1.0, 2.9, 3.0, 10.0, 1e9):
        sharp = 1 / (1 / f - 1 / depth)
        disc = f / n * abs(image - sharp) / sharp
        assert blur_tan(f / n, s, np.array(depth)) * image == pytest.approx(disc, abs=1e-12)


def test_focus_is_a_length_or_one_of_two_words():
    assert Objective(focus_m="85 cm").focus_m == pytest.approx(0.85)
    for word in ("target", "everywhere"):
        assert load_experiment("demo", [f"camera.objective.focus_m={word}"]).camera.objective.focus_m == word
    with pytest.raises(ConfigError, match=r"focus_m: got 'nearby'.*words target, everywhere"):
        load_experiment("demo", ["camera.objective.focus_m=nearby"])
    with pytest.raises(ConfigError, match=r"focus_m: got 0\.01 m, expected at least twice"):
        load_experiment(
            "demo", ["camera.objective.focal_length_m='12.5 mm'", "camera.objective.focus_m=0.01"]
        )
    with pytest.raises(ConfigError, match=r"distortion"):
        load_experiment("demo", ["camera.objective.distortion=-0.2"])


def test_the_view_carries_the_lens():
    lens = Objective(focal_length_m=20e-3, f_number=5.0, focus_m=4.0, defocus_per_m=0.1, distortion=-0.02)
    view = prototype().model_copy(update={"objective": lens}).view
    assert (view.aperture_m, view.focus_m, view.defocus_per_m, view.distortion) == (4e-3, 4.0, 0.1, -0.02)
    everywhere = lens.model_copy(update={"focus_m": "everywhere"})
    assert prototype().model_copy(update={"objective": everywhere}).view.aperture_m == 0


def test_both_effects_of_the_lens_are_switches():
    ideal, nominal, bad = (with_effects(prototype(), {"all": s}) for s in ("ideal", "nominal", "pessimistic"))
    assert (ideal.view.aperture_m, ideal.view.distortion) == (0, 0)
    assert nominal.view.aperture_m == pytest.approx(12.5e-3 / 4)
    assert nominal.view.distortion == -0.01
    assert (bad.view.defocus_per_m, bad.view.distortion) == (0.1, -0.03)
    assert {name for name, effect in ALL.items() if effect.in_scene} == {
        "depth_of_field",
        "objective_distortion",
        "polarised_scene",
    }


def wall(depth_m: float, half_m: float, **more: object) -> Scene:
    """A square of a lamp facing us at a depth; the camera looks along +y, focused at 2 m."""
    table: dict[str, object] = {
        "name": "wall",
        "white_w_m2_sr": 1.0,
        "materials": {"matt": {"reflectance": 0.5}},
        "camera": {"position_m": (0.0, 0.0, 0.0), "target_m": (0.0, 2.0, 0.0)},
        "lamps": {
            "lamp": {
                "center_m": (0.0, depth_m, 0.0),
                "edge_u_m": (2 * half_m, 0.0, 0.0),
                "edge_v_m": (0.0, 0.0, 2 * half_m),
                "radiance_w_m2_sr": 1.0,
            }
        },
    }
    return Scene.model_validate(table | more)


FLOOR = {
    "objects": {
        "floor": {
            "kind": "quad",
            "material": "matt",
            "corner_m": (-50.0, -50.0, -1.0),
            "edge_u_m": (100.0, 0.0, 0.0),
            "edge_v_m": (0.0, 100.0, 0.0),
        }
    },
}


def test_depths_of_what_the_picture_cuts_out():
    assert depth_range_m(wall(5.0, 0.1), 0.4, 0.75, 1.0) == pytest.approx((5.0, 5.0))
    # Larger than the picture: no corner of the lamp is in it.
    assert depth_range_m(wall(5.0, 9.0), 0.4, 0.75, 1.0) == pytest.approx((5.0, 5.0))
    # A floor 1 m below: cut by the lower border at 1 / 0.3 m, and as far as it goes.
    assert depth_range_m(wall(5.0, 0.1, **FLOOR), 0.4, 0.75, 1.0) == pytest.approx((1 / 0.3, 50.0))
    shiny = {**FLOOR, "materials": {"matt": {"kind": "metal"}}}
    assert depth_range_m(wall(5.0, 0.1, **shiny), 0.4, 0.75, 1.0) == pytest.approx((1 / 0.3, np.inf))
    # Beside the picture, and behind the camera: nothing is known.
    for place in (wall(-5.0, 0.1), wall(5.0, 0.1).model_copy(update={"camera": away()})):
        near_m, far_m = depth_range_m(place, 0.4, 0.75, 1.0)
        assert near_m == place.camera.near_m
        assert np.isinf(far_m)


def away():
    return wall(1.0, 1.0).camera.model_copy(update={"target_m": (2.0, 0.0, 0.0)})


def test_movers_bring_their_own_depths():
    ball = {"kind": "pendulum", "pivot_m": (0.0, 3.0, 1.0), "length_m": 1.0, "bob_radius_m": 0.1}
    swings = {"movers": {"ball": ball | {"swing_rad": 0.1, "material": "matt"}}, **FLOOR}
    scene = wall(5.0, 0.1, **{**swings, "objects": {}})
    bob = scene.singles()["ball"]
    nearest_m = min(bob.vertices(time_s)[:, 1].min() for time_s in np.linspace(0, 1, 200))
    assert 2.7 < nearest_m < 2.95
    # Found at nine instants of a swing of a few centimetres.
    assert depth_range_m(scene, 0.4, 0.75, 1.0) == pytest.approx((nearest_m, 5.0), abs=0.02)


def camera(**lens: object) -> CodedCamera:
    """12.5 mm at f/4, focused at the target: a point at infinity is 1.56e-3 wide, at 20 um a pixel."""
    return prototype().model_copy(update={"objective": Objective.model_validate(lens)})


def test_a_lens_is_modelled_only_where_one_would_see_it():
    found = focus_on(wall(4.0, 0.1), camera(), 1.0, 0.1)
    assert found.choice == "modelled"
    # D (1/2 - 1/4) over a pixel's 20 um / (1.5 x 12.5 mm).
    assert found.far_px == pytest.approx(12.5e-3 / 4 * 0.25 / (20e-6 / (1.5 * 12.5e-3)))
    stopped = camera(f_number=22)
    for depth_m, choice in ((2.0, "skipped"), (2.3, "modelled")):
        found = focus_on(wall(depth_m, 0.1), stopped, 1.0, 0.1)
        assert found.choice == choice
        assert (3 * found.far_px < NEGLIGIBLE_SAMPLES) == (choice == "skipped")
        assert seen_through(stopped.view, found).aperture_m == (stopped.view.aperture_m if depth_m > 2 else 0)
    assert focus_on(wall(2.0, 0.1), stopped, 1.0, 0.0).choice == "modelled"
    assert focus_on(wall(4.0, 0.1), camera(focus_m="everywhere"), 1.0, 0.0).choice == "everywhere"


def test_distortion_is_said_in_panel_pixels():
    # 1 % of half the diagonal of 500 x 600 pixels.
    found = focus_on(wall(4.0, 0.1), camera(distortion=-0.01), 1.0, 0.1)
    assert found.corner_px == pytest.approx(-0.01 * np.hypot(250, 300))
    assert f"{found.corner_px:.2g} panel pixels" in found.text()


def test_explain_and_the_truth_say_what_the_lens_does():
    experiment = load_experiment("demo", ["scene.name=chart"])
    assert scene_focus(experiment).choice == "skipped"
    assert truth_view(experiment) == replace(experiment.camera.view, aperture_m=0.0)
    said = describe_truth(experiment).description
    assert "focused at 2 m" in said
    assert "a pinhole renders it" in said
    wide = load_experiment("demo", ["scene.name=chart", "camera.objective.f_number=0.7"])
    assert truth_view(wide) == wide.camera.view
    record = explanation("demo", ["scene.name=chart"])["focus"]
    assert record["choice"] == "skipped"
    assert record["far_m"] == pytest.approx(2.6, rel=0.01)


def test_every_shipped_scene_lies_within_its_depths():
    """Distances of all vertices in front of the camera bound the range from outside."""
    scene = load_scene("window_room")
    near_m, far_m = depth_range_m(scene, 0.32, 0.83, 1.0)
    vertices = np.concatenate([mesh.vertices_m for mesh in scene.still_meshes().values()])
    corner = np.linalg.norm(vertices - np.asarray(scene.camera.position_m), axis=1).max()
    assert scene.camera.near_m < near_m < scene.camera.distance_m < far_m < max(corner, 20.0)
