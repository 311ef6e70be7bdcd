"""The truth engine under stress: scale, broken triangles, movers that hit the camera, 1e5 : 1, kills."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from optsim.core.cache import Cache
from optsim.core.config import build
from optsim.core.errors import ConfigError
from optsim.core.quantities import Timing, View
from optsim.render import RenderSettings, choose_backend, render_truth
from optsim.render.backend import activate
from optsim.render.full import slot_image
from optsim.render.stage import RenderStage
from optsim.scene import load_scene
from optsim.scene.geometry import Mesh
from optsim.scene.movers import Card
from optsim.scene.scene import Scene

VIEW = View(24, 32, 1, 0.5)
TIMING = Timing(1 / 180, 4, 2)
SETTINGS = RenderSettings(
    static_error=0.3, change_error=0.3, moving_error=0.4, slots_per_segment=2, key_seeds=2
)
PIXELS = np.arange(VIEW.rows * VIEW.cols)
CARD = {"kind": "card", "material": "light", "center_m": (0.2, 0.3, 0), "size_m": (0.5, 0.4), "turns_hz": 2.0}
# A closed cube of 2 m, seen from its front wall, with a lamp under the ceiling, a box on the floor and a ball
# that some tests move.
ROOM = {
    "name": "room",
    "white_w_m2_sr": 1.0,
    "max_depth": 5,
    "camera": {"position_m": (0, -0.95, 0), "target_m": (0, 0, 0)},
    "materials": {"grey": {"reflectance": 0.5}, "light": {"reflectance": 0.8}, "pane": {"kind": "glass"}},
    "objects": {
        "walls": {"kind": "box", "material": "grey", "center_m": (0, 0, 0), "size_m": (2, 2, 2)},
        "plinth": {
            "kind": "box",
            "material": "light",
            "center_m": (-0.4, 0.5, -0.8),
            "size_m": (0.4, 0.4, 0.4),
        },
    },
    "lamps": {
        "lamp": {
            "center_m": (0, 0.2, 0.98),
            "edge_u_m": (0, 0.6, 0),
            "edge_v_m": (0.6, 0, 0),
            "radiance_w_m2_sr": 10.0,
        }
    },
}
BALL = {"kind": "globe", "material": "light", "center_m": (0, 0, 0), "radius_m": 0.15}
PATH = {
    "kind": "keyframed",
    "objects": ["ball"],
    "times_s": (0, 8 / 180),
    "positions_m": ((-0.3, 0.3, 0), (0.1, 0.2, 0.2)),
}
SHORT = Timing(1 / 180, 2, 1)


@pytest.fixture(scope="module", autouse=True)
def _backend():
    if choose_backend().preview:
        pytest.skip("only the scalar fallback works here")
    activate()


def room(**changes):
    return build(Scene, ROOM | changes, where="room")


def ball_along(times_s, positions_m):
    """Make the room with a ball on a path."""
    path = {
        "kind": "keyframed",
        "objects": ["ball"],
        "times_s": times_s,
        "positions_m": positions_m,
        "interpolation": "linear",
    }
    return room(objects=ROOM["objects"] | {"ball": BALL}, movers={"path": path})


def instants(scene, folder, *, view=VIEW, timing=TIMING, half=False):
    """All instants of a truth, (t, y, x); no value anywhere may be other than finite."""
    video = render_truth(scene, view, timing, SETTINGS, cache=Cache(Path(folder)))
    assert video.half_difference is not None
    found = []
    for one in (video, video.half_difference):
        segments = [one.load(i) for i in range(one.n_segments)]
        found.append([s.instant(i) for s in segments for i in range(s.n_instants)])
    images, halves = np.array(found[0]), np.array(found[1])
    assert images.shape == (timing.n_slots, view.rows, view.cols)
    assert np.isfinite(images).all()
    assert np.isfinite(halves).all()
    return halves if half else images


def direct(scene, slot, *, view=VIEW, samples=32, poses=1):
    """Mean of a slot by the plain loop with 4 seeds, and the variance of it, (y, x) each."""
    stage = RenderStage(scene, view)
    seeds = tuple(range(100 * slot + 1, 100 * slot + 5))
    many = slot_image(stage, slot * TIMING.slot_s, TIMING.slot_s, samples, poses, seeds)
    return many.mean(axis=0), many.var(axis=0, ddof=1) / len(seeds)


# --- what movers may do -------------------------------------------------------------------------------------


def test_without_movers_every_instant_is_the_same(tmp_path):
    images = instants(room(), tmp_path)
    assert all(np.array_equal(image, images[0]) for image in images)
    exact, _ = direct(room(), 0)
    # 768 pixels of 30 % noise at most: the mean has 1 %.
    assert images[0].mean() == pytest.approx(exact.mean(), rel=0.03)
    assert images[0].std() > 0.1 * images[0].mean()


def test_a_mover_that_leaves_the_room_leaves_nothing_behind(tmp_path):
    scene = ball_along((0, 4 / 180), ((0, 0.3, 0), (3, 0.3, 0)))
    images, still = instants(scene, tmp_path / "a"), instants(room(), tmp_path / "b")[0]
    assert (images[0] != still).mean() > 0.2
    for image in images[2:]:
        np.testing.assert_array_equal(image, still)


@pytest.mark.slow
def test_a_mover_may_pass_through_the_camera_and_behind_it(tmp_path):
    """At slot 4 the ball's centre is in the pinhole, where it is dark; then it goes out through the wall."""
    scene = ball_along((0, 8 / 180), ((0, 0.6, 0), (0, -2.5, 0)))
    images, still = instants(scene, tmp_path / "a"), instants(room(), tmp_path / "b")[0]
    means = images.mean(axis=(1, 2)) / still.mean()
    assert max(means[3], means[4]) < 0.6 < 0.9 < means[0]
    for slot in (3, 4):
        exact = direct(scene, slot, poses=64, samples=1)[0].mean()
        # Two thirds of the bound on interpolation between poses.
        assert images[slot].mean() == pytest.approx(exact, rel=0.07)
    np.testing.assert_array_equal(images[7], still)
    behind = ball_along((0, 8 / 180), ((0, -1.12, 0), (0, -3, 0)))
    images = instants(behind, tmp_path / "c")
    np.testing.assert_allclose(images.mean(axis=(1, 2)), still.mean(), rtol=0.02)


def test_a_mover_that_appears_late_is_there(tmp_path):
    """Outside the room until slot 4, then through the wall, at rest from slot 6: within the noise of both."""
    slots = (0, 4, 6, 100)
    scene = ball_along(tuple(s / 180 for s in slots), ((5, 0.3, 0), (5, 0.3, 0), (0, 0.3, 0), (0, 0.3, 0)))
    images, halves = instants(scene, tmp_path / "a"), instants(scene, tmp_path / "a", half=True)
    still = instants(room(), tmp_path / "b")[0]
    for slot in range(4):
        np.testing.assert_array_equal(images[slot], still)
    exact, variance = direct(scene, 7)
    for part in (np.s_[:], np.s_[9:15, 13:19], np.s_[15:]):  # all, the ball, the floor below it
        error = images[7][part].mean() - exact[part].mean()
        noise = np.sqrt((halves[7][part] ** 2).sum() + variance[part].sum()) / exact[part].size
        assert abs(error) < 5 * noise
        assert noise < 0.1 * exact[part].mean()
    assert images[7, 11:13, 15:17].mean() < 0.85 * still[11:13, 15:17].mean()  # seen from its dark side


class Torn(Card):
    """A card with triangles of no area: with a corner twice or thrice, and three corners in one place."""

    def rest(self):
        mesh = super().rest()
        vertices = self.vertices(0.0)
        n = len(vertices)
        broken = [[0, 0, 1], [5, 5, 5], [7, 8, 7], [n - 3, n - 2, n - 1]]
        faces = np.concatenate([broken, mesh.faces]).astype(mesh.faces.dtype)
        return Mesh(vertices, faces, np.concatenate([mesh.uv, mesh.uv[:3]]))

    def vertices(self, time_s):
        card = super().vertices(time_s)
        return np.concatenate([card, card[[20, 20, 20]]])


def test_triangles_without_area_change_nothing(tmp_path):
    plain = room(movers={"card": CARD})
    torn = plain.model_copy(update={"movers": {"card": Torn(**CARD)}})
    mesh = torn.singles()["card"].rest()
    corners = mesh.vertices_m[mesh.faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert (area == 0).sum() == 4
    images, whole = instants(torn, tmp_path / "a"), instants(plain, tmp_path / "b")
    assert np.abs(whole - instants(room(), tmp_path / "c")).max() > 0.1
    # A ray along an edge may take either side.
    assert np.mean(np.abs(images - whole) > 1e-5 * np.abs(whole)) < 0.01
    np.testing.assert_allclose(images.mean(axis=(1, 2)), whole.mean(axis=(1, 2)), rtol=1e-3)


# --- what light may be -------------------------------------------------------------------------------------


def scaled(value, scale):
    """Lengths of a nested table, multiplied: keys that end in ``_m``."""
    if isinstance(value, dict):
        return {
            key: np.multiply(item, scale).tolist() if key.endswith("_m") else scaled(item, scale)
            for key, item in value.items()
        }
    return value


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3 / 2, 1e3 / 2])
def test_a_room_of_1_mm_and_of_1_km_looks_like_one_of_2_m(scale, tmp_path):
    movers = {"card": CARD, "path": PATH}
    table = ROOM | {"objects": ROOM["objects"] | {"ball": BALL}, "movers": movers}
    images, other = (
        instants(build(Scene, scaled(table, s), where="room"), tmp_path / str(s)) for s in (1.0, scale)
    )
    assert np.abs(images[7] - images[0]).max() > 0.1
    # The same random numbers; only digits, and with them a few samples' numbers, differ.
    difference = np.abs(other - images) / images.mean()
    assert np.median(difference) < 1e-3
    np.testing.assert_allclose(other.mean(axis=(1, 2)), images.mean(axis=(1, 2)), rtol=0.01)


@pytest.mark.slow
def test_a_window_of_1e5_to_1_behind_glass_stays_finite(tmp_path):
    """A small window in a nearly black room, seen through a pane, with a card that comes before both."""
    radiance = 1e5
    scene = room(
        materials={"grey": {"reflectance": 0.005}, "light": {"reflectance": 0.1}, "pane": {"kind": "glass"}},
        objects={
            "walls": {"kind": "box", "material": "grey", "center_m": (0, 0, 0), "size_m": (2, 2, 2)},
            "pane": {
                "kind": "quad",
                "material": "pane",
                "corner_m": (-0.3, 0.9, -0.3),
                "edge_u_m": (0.6, 0, 0),
                "edge_v_m": (0, 0, 0.6),
            },
        },
        lamps={
            "window": {
                "center_m": (0, 0.98, 0),
                "edge_u_m": (0.1, 0, 0),
                "edge_v_m": (0, 0, 0.1),
                "radiance_w_m2_sr": radiance,
            }
        },
        movers={"card": CARD | {"center_m": (0.35, 0.5, 0), "velocity_m_s": (-5.0, 0, 0), "turns_hz": 0.0}},
    )
    view = View(48, 64, 1, 0.5)
    images = instants(scene, tmp_path, view=view)
    exact, _ = direct(scene, 0, view=view)
    seen = exact > 0.5 * radiance
    assert 4 <= seen.sum() < 20
    # Through a pane of index 1.5, head-on: 1 - 2 r / (1 + r) with r = 0.04.
    assert exact[seen].max() == pytest.approx(0.923 * radiance, rel=0.03)
    assert images[0][seen].mean() == pytest.approx(exact[seen].mean(), rel=0.15)
    assert images[0].max() / np.median(images[0]) > 1e5
    # The card comes before it at last.
    assert images[7][seen].mean() < 0.01 * radiance


@pytest.mark.parametrize("lamps", ["", "[lamps.a]\n" + "lit = false\n"])
def test_no_light_is_an_error_at_load(lamps, tmp_path):
    head = 'name = "x"\nwhite_w_m2_sr = 1.0\n[materials]\n'
    head += "[camera]\nposition_m = [0, -3, 0]\ntarget_m = [0, 0, 0]\n"
    if lamps:
        lamps += "center_m = [0, 0, 1]\nedge_u_m = [1, 0, 0]\nedge_v_m = [0, -1, 0]\nradiance_w_m2_sr = 1.0\n"
    (tmp_path / "scene.toml").write_text(head + lamps)
    with pytest.raises(ConfigError, match=r"lamps: (missing|.*no lamp is lit)"):
        load_scene(tmp_path)


# --- repetition, threads, kills, memory ---------------------------------------------------------------------

FAN = {"kind": "fan", "material": "grey", "center_m": (-0.4, 0.4, 0.1), "radius_m": 0.2}
BUSY = {"card": CARD, "fan": FAN}
HEAD = "import sys\nsys.path.insert(0, {!r})\nfrom test_render_stress import *\nactivate()\n"


def program(text, **environment):
    """Start Python with this module's names."""
    code = HEAD.format(str(Path(__file__).parent)) + text
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_a_truth_is_the_same_again_and_on_1_or_2_threads(tmp_path):
    scene = load_scene("window_room")
    text = (
        "import drjit as dr\n"
        "dr.set_thread_count({threads})\n"
        "np.save({file!r}, instants(load_scene('window_room'), {folder!r}, timing=SHORT))\n"
        "assert dr.thread_count() == {threads}\n"
    )
    runs = {
        n: program(
            text.format(threads=n, file=str(tmp_path / f"{n}.npy"), folder=str(tmp_path / f"cache_{n}"))
        )
        for n in (1, 2)
    }
    images = instants(scene, tmp_path / "a", timing=SHORT)
    assert np.abs(images[1] - images[0]).max() > 0
    # Mitsuba sums vertex normals over triangles by several threads at once: their last digit may differ.
    np.testing.assert_allclose(instants(scene, tmp_path / "b", timing=SHORT), images, rtol=1e-5)
    for n, run in runs.items():
        _, err = run.communicate(timeout=120)
        assert run.returncode == 0, err
        np.testing.assert_allclose(np.load(tmp_path / f"{n}.npy"), images, rtol=1e-5)


def test_killed_in_the_middle_it_goes_on_from_there(tmp_path):
    """Killed with half an array of the sixth entry on disk: what is whole stays, what is half is no entry."""
    text = (
        "import os, signal\n"
        "save, done = np.save, []\n"
        "def half(path, array):\n"
        "    done.append(path.parent)\n"
        "    save(path, array)\n"
        "    if len(set(done)) == 6:\n"
        "        os.truncate(path, os.path.getsize(path) // 2)\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "np.save = half\n"
        "instants(room(movers=BUSY), {!r})\n"
    )
    run = program(text.format(str(tmp_path / "killed")))
    whole = instants(room(movers=BUSY), tmp_path / "whole")
    _, err = run.communicate(timeout=120)
    assert run.returncode == -signal.SIGKILL, err
    cache = Cache(tmp_path / "killed")
    before = entries(cache)
    assert len({path.parent for path in before}) == 5
    assert [path for path in cache.folder.rglob(".part-*") if path.is_dir()]
    np.testing.assert_allclose(instants(room(movers=BUSY), tmp_path / "killed"), whole, rtol=1e-5)
    after = entries(cache)
    assert {path: after[path] for path in before} == before
    assert len({path.parent for path in after}) == len(
        {path.parent for path in entries(Cache(tmp_path / "whole"))}
    )


def entries(cache):
    """Files of whole entries: path -> what changes when one is written again."""
    found = [path for path in cache.folder.glob("entries/??/*/*.npy") if not path.parent.name.startswith(".")]
    return {path: (path.stat().st_ino, path.stat().st_mtime_ns, path.stat().st_size) for path in found}


def resident_mb():
    """Memory of this process, MB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_memory_does_not_grow_with_poses():
    stage = RenderStage(room(movers=BUSY), VIEW)

    def go(first, last):
        for i in range(first, last):
            stage.pose(i / 1000)
            stage.radiance(PIXELS[::4], 2, (i,))

    # The vertices of the last 128 poses are kept on purpose.
    go(0, 150)
    before = resident_mb()
    go(150, 450)
    # Measured 0.4. One copy of the movers' buffers kept at each pose would be 3, a scene loaded anew 6.
    assert resident_mb() - before < 2
