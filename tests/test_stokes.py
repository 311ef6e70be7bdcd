"""The Stokes pass: signs against Fresnel's reflections, S0 against the plain render, no side effects."""

import numpy as np
import pytest

from optsim.core.errors import BackendError
from optsim.core.quantities import View
from optsim.render import backend as backends
from optsim.render.backend import BackendReport, activate
from optsim.render.stage import RenderStage
from optsim.render.stokes import polarised, render_stokes, stokes_image
from optsim.scene import Scene

LAMP = 2.0


def hall(floor: dict[str, object], *, movers: bool = False, depth: int = 3) -> Scene:
    """A level floor under a wide bright ceiling, looked down on at a slant, with a wide view."""
    return Scene.model_validate(
        {
            "name": "hall",
            "white_w_m2_sr": 1.0,
            "max_depth": depth,
            "camera": {"position_m": (0.0, -2.0, 1.5), "target_m": (0.0, 0.0, 0.0)},
            "materials": {"floor": floor, "ball": {"reflectance": 0.7}},
            "lamps": {
                "ceiling": {
                    "center_m": (0.0, 0.0, 5.0),
                    "edge_u_m": (200.0, 0.0, 0.0),
                    "edge_v_m": (0.0, -200.0, 0.0),
                    "radiance_w_m2_sr": LAMP,
                }
            },
            "objects": {
                "floor": {
                    "kind": "quad",
                    "material": "floor",
                    "corner_m": (-20.0, -20.0, 0.0),
                    "edge_u_m": (40.0, 0.0, 0.0),
                    "edge_v_m": (0.0, 40.0, 0.0),
                }
            },
            "movers": {
                "ball": {
                    "kind": "pendulum",
                    "pivot_m": (0.0, 0.0, 1.4),
                    "length_m": 1.0,
                    "bob_radius_m": 0.25,
                    "swing_rad": 1.0,
                    "material": "ball",
                }
            }
            if movers
            else {},
        }
    )


def fresnel(cosine: np.ndarray, ior: float) -> tuple[np.ndarray, np.ndarray]:
    """Reflected shares of s and p light."""
    inside = np.sqrt(1 - (1 - cosine**2) / ior**2)
    s = (cosine - ior * inside) / (cosine + ior * inside)
    p = (ior * cosine - inside) / (ior * cosine + inside)
    return s**2, p**2


def test_gloss_over_a_wide_picture_follows_fresnel_in_the_stated_frame() -> None:
    """S1 and S2 of every sample, off the axis too: the s direction in the axes of its own ray."""
    view, scene = View(9, 12, 1, 0.6), hall({"kind": "glass", "ior": 1.5, "thin": False})
    seen = render_stokes(scene, view, 0.0, 4096, 7).astype(np.float64)
    forward = np.array([0, 2.0, -1.5]) / 2.5
    right, up = np.array([1.0, 0, 0]), np.cross([1.0, 0, 0], forward)
    row, col = np.indices((9, 12)) + 0.5
    across, down = (2 * 0.6 / 12) * (col - 6), (2 * 0.6 / 12) * (row - 4.5)
    ray = forward + across[..., None] * right - down[..., None] * up
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    x = np.cross(ray, up)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    y = np.cross(x, ray)
    s = np.cross(ray, [0, 0, 1.0])
    angle = np.arctan2((s * y).sum(-1), (s * x).sum(-1))
    share_s, share_p = fresnel(-ray[..., 2], 1.5)
    degree = (share_s - share_p) / (share_s + share_p)
    # a sample is not a point: its own 0.1 x 0.1 of the view changes the degree by up to 2 %
    assert seen[1] / seen[0] == pytest.approx(degree * np.cos(2 * angle), abs=0.02)
    assert seen[2] / seen[0] == pytest.approx(degree * np.sin(2 * angle), abs=0.02)
    assert (seen[1] > 0).all(), "a level floor's gloss is horizontal"
    assert np.abs(angle).max() > 0.2, "or the frame would not be tested"
    assert np.abs(seen[3]).max() == 0
    # 4096 paths of which a share R is reflected, over 108 samples: a deviation of 5 sigma once in 2e4 runs
    expected = LAMP * (share_s + share_p) / 2
    sigma = LAMP * np.sqrt(expected / LAMP * (1 - expected / LAMP) / 4096)
    assert np.abs((seen[0] - expected) / sigma).max() < 5.5


# From the mirror to the lamp: an upright mirror turns the light from there by 120 degrees, into -y.
TOWARDS = np.array([np.sin(np.radians(60)), -np.cos(np.radians(60)), 0.0])


def behind_a_polariser(roll_deg: float, mirror: dict[str, object] | None = None) -> np.ndarray:
    """Stokes vector of a lamp behind a polariser, seen along +y, or in a mirror at (0, 3, 0).

    The polariser's axis is level, then rolled anticlockwise as seen from where its light goes.
    """
    turning = np.array([0, 3.0, 0]) if mirror else np.zeros(3)
    direction = TOWARDS if mirror else np.array([0, 1.0, 0])
    with polarised() as mi:
        turn = mi.ScalarTransform4f()

        def facing(origin: np.ndarray, target: np.ndarray, roll: float = 0.0) -> object:
            look = turn.look_at(origin=list(origin), target=list(target), up=[0, 0, 1])
            return look @ turn.rotate([0, 0, 1], roll)

        content: dict[str, object] = {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "to_world": turn.look_at(origin=[0, 0, 0], target=[0, 1, 0], up=[0, 0, 1]),
                "fov": 0.002,
                "film": {
                    "type": "hdrfilm",
                    "width": 1,
                    "height": 1,
                    "rfilter": {"type": "box"},
                    "pixel_format": "luminance",
                    "component_format": "float32",
                },
            },
            "lamp": {
                "type": "rectangle",
                "to_world": facing(turning + 5 * direction, turning),
                "emitter": {"type": "area", "radiance": {"type": "uniform", "value": LAMP}},
            },
            "polariser": {
                "type": "rectangle",
                "to_world": facing(turning + 3 * direction, turning, roll_deg),
                "bsdf": {"type": "polarizer"},
            },
        }
        if mirror:
            half_way = turning + TOWARDS + np.array([0, -1.0, 0])
            content["mirror"] = {"type": "rectangle", "to_world": facing(turning, half_way), "bsdf": mirror}
        loaded = mi.load_dict(content, optimize=False)
        return stokes_image(mi, loaded, View(1, 1, 1, 1e-5), 8, 1, max_depth=6)[:, 0, 0]


@pytest.mark.parametrize("roll_deg", [0.0, 45.0, 90.0, 135.0])
def test_a_polariser_says_where_its_axis_is(roll_deg: float) -> None:
    axis = np.radians(2 * roll_deg)
    expected = LAMP / 2 * np.array([1, np.cos(axis), np.sin(axis), 0])
    assert behind_a_polariser(roll_deg) == pytest.approx(expected, abs=1e-5)


def test_a_metal_mirror_turns_the_field_the_stated_way() -> None:
    """Linear light at 45 degrees on metal: handedness from the field itself, by complex Fresnel."""
    n, k, roll = 0.2, 3.4, np.radians(45)
    metal = {
        "type": "conductor",
        "eta": {"type": "uniform", "value": n},
        "k": {"type": "uniform", "value": k},
    }
    seen = behind_a_polariser(45.0, mirror=metal)

    light, leaving = -TOWARDS, np.array([0, -1.0, 0])
    # The polariser as seen from the mirror.
    right = np.cross(TOWARDS, [0, 0, 1.0])
    field = np.cos(roll) * right + np.sin(roll) * np.array([0, 0, 1.0])
    s = np.array([0, 0, 1.0])
    p_in, p_out = np.cross(s, light), np.cross(s, leaving)
    cosine = np.sqrt((1 - light @ leaving) / 2)
    index = n + 1j * k
    inside = np.sqrt(1 - (1 - cosine**2) / index**2)
    r_s = (cosine - index * inside) / (cosine + index * inside)
    r_p = (index * cosine - inside) / (index * cosine + inside)
    # e^(-iwt), as n + ik means; p_in and p_out both are s x direction, so r_p keeps its sign
    wave = r_s * (field @ s) * s + r_p * (field @ p_in) * p_out
    x, y = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    e_x, e_y = wave @ x, wave @ y
    turn = [np.real(np.array([e_x, e_y]) * np.exp(-1j * t)) for t in (0.0, 0.01)]
    anticlockwise = turn[0][0] * turn[1][1] - turn[0][1] * turn[1][0] > 0
    expected = np.array(
        [
            abs(e_x) ** 2 + abs(e_y) ** 2,
            abs(e_x) ** 2 - abs(e_y) ** 2,
            2 * np.real(e_x * np.conj(e_y)),
            (-1 if anticlockwise else 1) * 2 * abs(np.imag(e_x * np.conj(e_y))),
        ]
    )
    assert seen == pytest.approx(LAMP / 2 * expected, abs=2e-4)
    assert abs(seen[3] / seen[0]) > 0.1, "or the sign would not be tested"


def test_matt_scenes_are_unpolarised() -> None:
    seen = render_stokes(hall({"reflectance": 0.6}), View(6, 8, 1, 0.3), 0.0, 64, 3)
    assert seen.dtype == np.float32
    assert seen.shape == (4, 6, 8)
    assert (seen[0] > 0).all()
    assert not seen[1:].any()


def test_s0_is_the_unpolarised_render() -> None:
    """One gloss a path, a mover at its place: 12 + 12 pictures, z of each sample and of the sum."""
    floor = {"kind": "plastic", "reflectance": 0.4, "roughness": 0.2, "ior": 1.5}
    scene, view, time_s = hall(floor, movers=True, depth=5), View(9, 12, 1, 0.4), 0.35
    one = np.stack([render_stokes(scene, view, time_s, 256, seed)[0] for seed in range(12)]).astype(
        np.float64
    )
    activate()
    stage = RenderStage(scene, view)
    stage.pose(time_s)
    other = stage.radiance(np.arange(108), 256, tuple(range(100, 112))).reshape(12, 9, 12)
    difference = one.mean(0) - other.mean(0)
    z = difference / np.sqrt(one.var(0, ddof=1) / 12 + other.var(0, ddof=1) / 12)
    # Student's t of 22 degrees: 5.5 has two tails of 2e-5; 108 samples: a false alarm once in 500 seeds
    assert np.abs(z).max() < 5.5
    sums = one.sum((1, 2)), other.sum((1, 2))
    error = np.sqrt(sums[0].var(ddof=1) / 12 + sums[1].var(ddof=1) / 12)
    assert abs(difference.sum()) < 4 * error
    assert error / other.mean(0).sum() < 0.005, "or the test would see nothing"
    still = RenderStage(scene, view)
    still.pose(0.0)
    moved = still.radiance(np.arange(108), 256, (1,)).reshape(9, 12) / other.mean(0) - 1
    assert np.abs(moved).max() > 0.1, "the mover moves"


def test_a_moving_camera_is_where_it_is_at_the_instant() -> None:
    scene, view = hall({"kind": "plastic", "reflectance": 0.3}), View(6, 8, 1, 0.3)
    moving = scene.camera.model_copy(update={"velocity_m_s": (0.0, 2.0, 0.0)})
    there = scene.camera.model_copy(update={"position_m": (0.0, -1.0, 1.5), "target_m": (0.0, 1.0, 0.0)})
    seen = [
        render_stokes(scene.model_copy(update={"camera": camera}), view, 0.5, 16, 1)
        for camera in (moving, there, scene.camera)
    ]
    np.testing.assert_array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])


@pytest.mark.slow
def test_a_pass_repeats_bitwise_and_more_samples_are_finer() -> None:
    scene, view = hall({"kind": "plastic", "reflectance": 0.3}), View(6, 8, 1, 0.3)
    one = render_stokes(scene, view, 0.0, 32, 5)
    np.testing.assert_array_equal(one, render_stokes(scene, view, 0.0, 32, 5))
    assert not np.array_equal(one, render_stokes(scene, view, 0.0, 32, 6))
    fine = render_stokes(scene, view, 0.0, 4096, 5)
    spread = [
        np.std([render_stokes(scene, view, 0.0, n, 40 + k)[0] - fine[0] for k in range(6)]) for n in (8, 128)
    ]
    # 16 times the samples, 288 differences each: a ratio of 4 known to 6 %, five times that allowed
    assert spread[0] / spread[1] == pytest.approx(4, rel=0.3)


def test_nothing_else_is_disturbed() -> None:
    import mitsuba as mi

    report = activate()
    scene, view = hall({"kind": "plastic", "reflectance": 0.3}, movers=True), View(6, 8, 1, 0.3)
    stage = RenderStage(scene, view)
    before = stage.radiance(np.arange(48), 16, (1, 2))
    render_stokes(scene, view, 0.2, 4, 1)
    assert mi.variant() == report.variant
    np.testing.assert_array_equal(stage.radiance(np.arange(48), 16, (1, 2)), before)
    with pytest.raises(RuntimeError, match=f"{report.variant}_polarized"), polarised():
        raise RuntimeError(str(mi.variant()))
    assert mi.variant() == report.variant
    stage.pose(0.3)
    assert not np.array_equal(stage.radiance(np.arange(48), 16, (1, 2)), before)


def test_the_scalar_fallback_has_no_stokes_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    fallback = BackendReport("scalar_rgb", "", True, "no LLVM here", ())
    monkeypatch.setattr("optsim.render.stokes.activate", lambda _backend: fallback)
    with pytest.raises(BackendError, match=r"needs llvm_ad_mono or cuda_ad_mono.*no LLVM here"), polarised():
        pass
    assert backends.VARIANTS[-1] == "scalar_rgb"
