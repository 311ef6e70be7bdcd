"""A trace of one pixel: its origins are the whole signal, its number is the run's, bad input is refused."""

import json
import sys
from dataclasses import asdict, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from optsim.app.cli import main
from optsim.camera.camera import CodedCamera
from optsim.camera.effects import with_effects
from optsim.core.files import read_json, read_png16
from optsim.core.quantities import Block, CodedFrame, ExposureCode, RadianceVideo, Segment
from optsim.core.random_streams import stream
from optsim.experiment import calibrations, job, loop, trace
from optsim.experiment.experiment import Experiment, load_experiment
from optsim.experiment.loop import Shot
from optsim.experiment.signal_breakdown import ORIGINS, read_out
from optsim.experiment.trace import TracedPixel, choose_pixel, trace_experiment, trace_pixel
from optsim.optics.fringing import border_shares, fine_image, fine_image_adjoint
from optsim.report.trace_plot import trace_plot
from optsim.report.trace_record import Trace

ROWS, COLS, FRAMES, SLOTS = 24, 32, 3, 36
CCD = (3 * ROWS + 8, 3 * COLS + 8)
# Every light, weight and energy is a float32, off by at most 6e-8 of itself; a few of them are multiplied.
ROUNDING = 1e-6


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return load_experiment(
        "demo",
        [
            f"n_frames={FRAMES}",
            f"camera.panel_rows={ROWS}",
            f"camera.panel_cols={COLS}",
            f"camera.sensor.rows={CCD[0]}",
            f"camera.sensor.cols={CCD[1]}",
            "calibration=true",
            "save_reconstructions=[]",
        ],
    )


def made_scene(camera: CodedCamera) -> RadianceVideo:
    """A texture that brightens, a bright window, a patch that flickers; two instants a slot."""
    rng = np.random.default_rng(0)
    texture = np.kron(rng.uniform(0.02, 0.15, (ROWS // 2, COLS // 2)), np.ones((6, 6))).astype(np.float32)
    texture[6:20, 60:90] = 10.0
    excess = rng.uniform(0, 0.3, (8, 12, 20)).astype(np.float32)

    def load(index: int) -> Segment:
        now, then = (np.float32(1 + 0.02 * k) * texture for k in (index, index + 1))
        return Segment(now, then, (Block(34, 40, np.roll(excess, index, 0)),), 8)

    return RadianceVideo(
        rows=camera.view.rows,
        cols=camera.view.cols,
        samples_per_pitch=3,
        slot_s=camera.slot_s,
        instants_per_slot=2,
        slots_per_segment=4,
        n_slots=FRAMES * SLOTS,
        load=load,
        white_w_m2_sr=0.4,
    )


def one_frame(camera: CodedCamera, load) -> RadianceVideo:
    return RadianceVideo.on_view(camera.view, camera.slot_s, load, slots_per_segment=9, n_slots=SLOTS)


def traced(experiment: Experiment, traced: TracedPixel) -> tuple[Trace, CodedCamera, np.ndarray, Shot]:
    """Trace a pixel behind a fixed density; the camera, its own expected electrons, and the shot."""
    camera = experiment.camera.with_nd(0.5)
    radiance = made_scene(camera)
    light = camera.form_image(radiance)
    method = next(m for m in experiment.methods if m.name == traced.method)
    taken = loop.shots(experiment, method, camera, light, calibrations.calibrate(experiment))
    shot = [next(taken) for _ in range(traced.frame + 1)][-1]
    expected, _ = camera.expected_electrons(light, traced.frame, shot.frame.code, shot.before)
    return trace_pixel(experiment, camera, radiance, light, shot, traced), camera, expected, shot


def with_camera(experiment: Experiment, camera: CodedCamera) -> Experiment:
    return experiment.model_copy(update={"camera": camera})


def electrons(found: Trace) -> dict[str, float]:
    return {origin.name: origin.electrons_e for origin in found.origins}


def before_readout(found: Trace) -> float:
    return sum(e for name, e in electrons(found).items() if name != "smear")


def shown(experiment: Experiment, camera: CodedCamera, image: np.ndarray, levels: np.ndarray, y: int, x: int):
    """Trace a pixel that sees a picture of radiance that stands still, under given levels (slot, v, u)."""
    picture = np.asarray(image, np.float32)
    radiance = one_frame(camera, lambda _: Segment(picture, picture, (), 9))
    code = ExposureCode(levels.astype(np.uint8), np.zeros((ROWS, COLS), np.bool_))
    shot = Shot(CodedFrame(0, np.zeros(CCD, np.uint16), code), None)
    return trace_pixel(
        experiment, camera, radiance, camera.form_image(radiance), shot, TracedPixel(y, x, 0, "normal")
    )


# -- the sum -------------------------------------------------------------------------------------------------


@pytest.mark.slow
# Picked where it flickers; a corner between four; the panel's corner; beside the window; off the image.
@pytest.mark.parametrize("pixel", [(41, 50), (42, 51), (5, 5), (16, 62), (1, 2)])
@pytest.mark.parametrize("state", ["nominal", "pessimistic"])
def test_the_origins_add_up_to_the_expected_signal(experiment, pixel, state) -> None:
    worse = with_camera(experiment, with_effects(experiment.camera, {"all": state}))
    found, camera, expected, _ = traced(worse, TracedPixel(*pixel, 1, "hdr_mosaic"))
    # Sums in float32, in another order: 1.2e-6 apart at the default nodes of pixel edges.
    assert before_readout(found) == pytest.approx(expected[pixel], rel=2 * ROUNDING, abs=0)
    assert found.reading.collected_e == expected[pixel]
    smear = camera.sensor.smear_e(expected, camera.exposure_s)[pixel[1]]
    assert electrons(found)["smear"] == pytest.approx(smear, rel=1e-12, abs=0)
    assert list(electrons(found)) == list(ORIGINS)
    for name, by_slot in found.slots.origins_e.items():
        assert sum(by_slot) == pytest.approx(electrons(found)[name], rel=1e-12, abs=1e-12), name
    assert sum(origin.share for origin in found.origins) == pytest.approx(1, rel=1e-12)


def test_stuck_pixels_and_a_closed_shutter_are_in_the_sum(experiment) -> None:
    """What the panel shows is then not what it is told."""
    panel = experiment.camera.modulator.model_copy(update={"stuck_share": 0.3})
    slow = experiment.camera.sensor.model_copy(update={"readout_rows": None})
    camera = experiment.camera.model_copy(update={"modulator": panel, "sensor": slow, "overlap": False})
    stuck, levels = camera.stuck_pixels
    v, u = (int(k) for k in np.argwhere(stuck & (levels == 255))[0])
    pixel = (3 * v + 5, 3 * u + 5)
    found, _, expected, shot = traced(with_camera(experiment, camera), TracedPixel(*pixel, 1, "hdr_mosaic"))
    assert before_readout(found) == pytest.approx(expected[pixel], rel=ROUNDING, abs=0)
    assert (found.target.v, found.target.u, found.target.stuck) == (v, u, True)
    assert found.slots.shutter_open == (True,) * 28 + (False,) * 8
    assert all(by_slot[28:] == (0.0,) * 8 for by_slot in found.slots.origins_e.values())
    told = shot.frame.code.levels[:, v, u]
    assert found.slots.level == tuple(told)
    assert min(found.slots.weight) > 0.9
    # Told dark it shines all the same, and only then is that late light.
    late_e = np.array(found.slots.origins_e["own_late"][:28])
    assert np.array_equal(late_e > 0, told[:28] == 0)


# -- each origin ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("away", "name"), [(0, "own_open"), (1, "neighbours"), (2, "near_field"), (5, "near_field"), (6, "wings")]
)
def test_the_light_of_one_panel_pixel_counts_by_its_distance(experiment, away, name) -> None:
    camera = with_effects(experiment.camera, {"all": "ideal", "relay_blur": "nominal"})
    v, u = 11, 15
    image = np.zeros((3 * ROWS, 3 * COLS))
    image[3 * v : 3 * v + 3, 3 * u : 3 * u + 3] = 1.0
    levels = np.full((SLOTS, ROWS, COLS), 255)
    levels[:, v, u] = 200
    found = shown(experiment, camera, image, levels, 3 * v + 5, 3 * (u + away) + 5)
    assert (found.target.v, found.target.u, found.target.relation) == (v, u + away, "picked")
    assert found.reading.collected_e > 1
    assert electrons(found)[name] == pytest.approx(found.reading.collected_e, rel=1e-5)
    assert found.slots.own_radiance_w_m2_sr == pytest.approx([0.0 if away else 1.0] * SLOTS, rel=1e-6)
    if away:
        first = found.sources[0]
        assert (first.dv, first.du, first.v, first.u) == (0, -away, v, u)
        assert first.electrons_e == pytest.approx(electrons(found)[name], rel=1e-5)
        assert set(first.level) == {200}
        # Of what an even, all open panel would send here, only this pixel's part is lit.
        assert found.slots.radiance_w_m2_sr == pytest.approx([first.even_share] * SLOTS, rel=1e-5)


def test_leak_and_late_light_of_the_own_pixel_are_told_apart(experiment) -> None:
    levels = np.zeros((SLOTS, ROWS, COLS))
    levels[10:13] = 255
    flat = np.full((3 * ROWS, 3 * COLS), 0.1)
    dark = levels[:, 0, 0] == 0
    column = {"own_open": ~dark, "own_leak": dark, "own_late": dark}

    def by_slot(effects: dict[str, str]) -> tuple[CodedCamera, Trace, dict[str, np.ndarray]]:
        camera = with_effects(experiment.camera, {"all": "ideal"} | effects)
        found = shown(experiment, camera, flat, levels, 41, 50)
        parts = {name: np.array(found.slots.origins_e[name]) for name in column}
        for name, where in column.items():
            assert np.abs(parts[name][~where]).max() == 0, name
        return camera, found, parts

    camera, found, at_once = by_slot({"contrast": "nominal"})
    leak = camera.column_leaks[found.target.u]
    assert at_once["own_leak"][dark] == pytest.approx(leak * at_once["own_open"][11], rel=ROUNDING, abs=0)
    assert np.abs(at_once["own_late"]).max() < 1e-6 * at_once["own_open"][11]

    _, found, slow = by_slot({"response": "nominal"})
    assert np.abs(slow["own_leak"]).max() < 1e-6 * slow["own_open"][12]
    weight = np.array(found.slots.weight)
    assert weight[13] > 0.1
    assert slow["own_late"][13] / weight[13] == pytest.approx(slow["own_open"][12] / weight[12], rel=1e-5)


def test_wings_ghost_and_veil_are_what_their_switches_take_away(experiment) -> None:
    camera = with_effects(experiment.camera, {"ghost": "pessimistic", "relay_glare": "pessimistic"})
    pixel = (41, 50)
    found, camera, expected, shot = traced(
        with_camera(experiment, camera), TracedPixel(*pixel, 1, "hdr_mosaic")
    )
    light = camera.form_image(made_scene(camera))
    glare, ghost = camera.relay.glare_share, camera.relay.ghost_share

    def without(**shares: float) -> float:
        relay = camera.relay.model_copy(update=shares)
        other = camera.model_copy(update={"relay": relay})
        return other.expected_electrons(light, 1, shot.frame.code, shot.before)[0][pixel] - camera.dark_e

    whole, no_veil = expected[pixel] - camera.dark_e, (1 - glare) * without(glare_share=0.0)
    direct = (1 - glare) * (1 - ghost) * without(glare_share=0.0, ghost_share=0.0)
    got = electrons(found)
    assert got["veil"] == pytest.approx(whole - no_veil, abs=ROUNDING * whole)
    assert got["ghost"] == pytest.approx(no_veil - direct, abs=ROUNDING * whole)
    assert min(got["veil"], got["ghost"], abs(got["veil"] - got["ghost"])) > 100 * ROUNDING * whole
    assert got["dark_current"] == pytest.approx(camera.sensor.dark_current_e_s * camera.exposure_s)


def test_neighbourhood_and_sources_are_the_near_light_pixel_by_pixel(experiment) -> None:
    found, *_ = traced(experiment, TracedPixel(5, 14, 1, "hdr_mosaic"))  # panel pixel (0, 3): near two edges
    assert (found.target.v, found.target.u) == (0, 3)
    near = np.array([[np.nan if e is None else e for e in row] for row in found.neighbourhood_e])
    assert np.isnan(near[:5]).all()
    assert np.isnan(near[:, :2]).all()
    assert np.isfinite(near[5:, 2:]).all()
    got = electrons(found)
    own_e = got["own_open"] + got["own_leak"] + got["own_late"]
    assert near[5, 5] == pytest.approx(own_e, rel=1e-9)
    assert np.nansum(near) == pytest.approx(own_e + got["neighbours"] + got["near_field"], rel=1e-9)
    given = [source.electrons_e for source in found.sources]
    assert given == sorted(given, reverse=True)
    at = {(source.dv, source.du): source.electrons_e for source in found.sources}
    assert (0, 0) not in at
    for (row, col), expected_e in np.ndenumerate(near):
        if (row, col) != (5, 5) and expected_e > given[-1]:
            assert at[row - 5, col - 5] == pytest.approx(expected_e, rel=1e-12)


def test_a_pixel_looks_at_the_panel_pixel_that_picks_it_or_gives_it_most(experiment) -> None:
    camera = with_effects(experiment.camera, {"all": "ideal", "relay_blur": "nominal"})
    flat, levels = np.full((3 * ROWS, 3 * COLS), 0.1), np.full((SLOTS, ROWS, COLS), 255)
    shares = []
    for dy, dx, relation in ((0, 0, "picked"), (-1, 1, "most light"), (1, 0, "most light")):
        found = shown(experiment, camera, flat, levels, 41 + dy, 50 + dx)
        target = found.target
        assert (target.v, target.u, target.relation) == (12, 15, relation)
        assert (target.offset_v_px, target.offset_u_px) == pytest.approx((dy / 3, dx / 3), abs=1e-9)
        assert target.share == pytest.approx(
            electrons(found)["own_open"] / found.reading.collected_e, rel=1e-5
        )
        shares.append(target.share)
    assert 1 > shares[0] > shares[2] > shares[1] > 0.25


def test_radiance_and_irradiance_follow_the_scene_slot_by_slot(experiment) -> None:
    """A flat scene that brightens, through a lens without glare and vignetting: exact in every slot."""
    off = {"objective_glare": "ideal", "vignetting": "ideal"}
    camera = with_effects(experiment.camera, off).with_nd(0.5)
    flat = np.full((3 * ROWS, 3 * COLS), 0.1, np.float32)
    one = one_frame(camera, lambda k: Segment((1 + k) * flat, (2 + k) * flat, (), 18))
    radiance = replace(one, instants_per_slot=2)
    code = ExposureCode(np.full((SLOTS, ROWS, COLS), 255, np.uint8), np.zeros((ROWS, COLS), np.bool_))
    shot = Shot(CodedFrame(0, np.zeros(CCD, np.uint16), code), None)
    found = trace_pixel(
        experiment, camera, radiance, camera.form_image(radiance), shot, TracedPixel(41, 50, 0, "normal")
    )
    expected = 0.1 * (1 + (np.arange(SLOTS) + 0.5) / 9)
    slots = found.slots
    for seen in (slots.own_radiance_w_m2_sr, slots.radiance_w_m2_sr):
        np.testing.assert_allclose(np.array(seen, float), expected, rtol=1e-6)
    for seen in (slots.own_irradiance_w_m2, slots.irradiance_w_m2):
        np.testing.assert_allclose(np.array(seen, float), found.irradiance_per_radiance * expected, rtol=1e-5)


def test_fine_image_adjoint_is_the_transpose() -> None:
    rng = np.random.default_rng(3)
    panel, fine, borders = rng.random((7, 9)), rng.random((21, 27)), border_shares(0.2, 3)
    assert np.vdot(fine_image(panel, borders), fine) == pytest.approx(
        np.vdot(panel, fine_image_adjoint(fine, borders)), rel=1e-12
    )


# -- outside, and the reading --------------------------------------------------------------------------------


def test_a_pixel_outside_the_image_says_so_and_gets_only_veil(experiment) -> None:
    found, _, expected, _ = traced(experiment, TracedPixel(1, 2, 1, "normal"))
    assert (found.target.relation, found.target.v, found.target.u) == ("outside", 0, 0)
    assert electrons(found)["veil"] == pytest.approx(
        expected[1, 2] - electrons(found)["dark_current"], rel=1e-5
    )
    assert found.sources == ()
    assert found.slots.radiance_w_m2_sr[0] is not None
    assert "outside the panel" in trace_plot(found)


def test_where_nothing_can_arrive_the_light_seen_is_null_not_nan(experiment) -> None:
    camera = with_effects(experiment.camera, {"all": "ideal"})
    found, *_ = traced(with_camera(experiment, camera), TracedPixel(1, 2, 1, "normal"))
    assert set(found.slots.radiance_w_m2_sr) == set(found.slots.irradiance_w_m2) == {None}
    assert None not in found.slots.own_radiance_w_m2_sr
    assert before_readout(found) == 0
    json.dumps(asdict(found), allow_nan=False)
    ElementTree.fromstring(trace_plot(found))


@pytest.mark.parametrize(
    ("collected_e", "clipped"),
    [
        (0.0, "no"),
        (20.0, "no"),
        (9e3, "no"),
        (15.7e3, "no"),
        (15.8e3, "at the full well"),
        (1e5, "at the full well"),
    ],
)
def test_the_reading_is_the_mean_and_spread_of_what_the_sensor_draws(
    experiment, collected_e, clipped
) -> None:
    """Shot noise at the edge of the well included; 20 000 draws, each bound five standard errors."""
    sensor = experiment.camera.sensor.model_copy(
        update={"rows": 100, "cols": 200, "dsnu_e": 0.0, "smear_share": 0.01}
    )
    camera = experiment.camera.model_copy(update={"sensor": sensor})
    expected = np.full((100, 200), collected_e)
    dn, _ = sensor.digitise(expected, camera.exposure_s, camera.serial_number, np.random.default_rng(1))
    found = read_out(camera, expected, 50, 100, int(dn[50, 100]))
    assert found.clipped == clipped
    assert found.drawn_dn == dn[50, 100]
    n = dn.size
    assert found.expected_dn == pytest.approx(dn.mean(), abs=5 * found.sigma_dn / np.sqrt(n))
    assert found.sigma_dn == pytest.approx(dn.std(), rel=5 / np.sqrt(2 * n))
    kept = found.collected_e - found.lost_at_well_e + found.smear_e - found.lost_to_bend_e + found.dsnu_e
    assert kept == pytest.approx(found.signal_e, rel=1e-9, abs=1e-9)
    assert found.signal_e / found.gain_e + found.black_dn == pytest.approx(found.expected_dn, rel=1e-9)


def test_the_fixed_pattern_and_the_converter_s_end_are_in_the_reading(experiment) -> None:
    sensor = experiment.camera.sensor.model_copy(update={"bits": 13, "dsnu_e": 30.0})
    camera = experiment.camera.model_copy(update={"sensor": sensor})
    found = read_out(camera, np.full(CCD, 1e4), 3, 4, 8191)
    assert (found.clipped, found.expected_dn) == ("by the converter", 8191)
    found = read_out(camera, np.full(CCD, 1e3), 3, 4, 1000)
    assert found.dsnu_e == sensor.dark_signal_e(camera.serial_number)[3, 4]
    assert found.expected_dn == pytest.approx(64 + (1e3 + found.smear_e + found.dsnu_e) / 0.96, abs=0.01)


# -- the loop and the command line ---------------------------------------------------------------------------


@pytest.fixture
def no_render(monkeypatch: pytest.MonkeyPatch, experiment: Experiment) -> None:
    for where in (job, trace):
        monkeypatch.setattr(where, "render_truth", lambda e, **_: made_scene(e.camera))
    monkeypatch.setattr(job, "renderer", lambda *_: ("none", "made truth"))


@pytest.mark.slow
@pytest.mark.usefixtures("no_render")
def test_the_drawn_number_is_exactly_that_of_the_run(experiment, tmp_path: Path) -> None:
    """Of every method: also where the code follows from the method's own earlier frames."""
    job.execute(experiment, tmp_path)
    for method, frame in (("adaptive", 2), ("random", 1), ("hdr_mosaic", 0)):
        written = read_png16(tmp_path / "frames" / method / f"{frame:06d}.png")
        for pixel in ((41, 50), (1, 2)):
            found = trace_experiment(experiment, TracedPixel(*pixel, frame, method))
            assert found.reading.drawn_dn == written[pixel], (method, frame, pixel)
        assert found.fingerprint == read_json(tmp_path / "experiment.json")["fingerprint"]
        light = read_json(tmp_path / "results.json")["light_rule"]
        assert found.nd_transmission == light["nd_transmission"]


def test_a_shot_says_how_the_panel_was_when_its_frame_began(experiment) -> None:
    """Taken again from there, with the method's own photons, the frame is the same to the last number."""
    _, camera, _, shot = traced(experiment, TracedPixel(41, 50, 2, "hdr_mosaic"))
    light = camera.form_image(made_scene(camera))
    photons = stream(experiment.seed, "shot", "hdr_mosaic", 2)
    again, _ = camera.expose(light, 2, shot.frame.code, shot.before, photons)
    np.testing.assert_array_equal(again.dn, shot.frame.dn)


@pytest.fixture
def cli(capsys, monkeypatch, tmp_path, no_render):
    del no_render
    monkeypatch.chdir(tmp_path)
    small = [f"n_frames={FRAMES}", f"camera.panel_rows={ROWS}", f"camera.panel_cols={COLS}"]
    small += [f"camera.sensor.rows={CCD[0]}", f"camera.sensor.cols={CCD[1]}", "calibration=true"]
    sets = [word for one in small for word in ("--set", one)]

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["optsim", "trace", "demo", *sets, *words])
        with pytest.raises(SystemExit) as stop:
            main()
        captured = capsys.readouterr()
        return stop.value.code, captured.out, captured.err

    return run


def test_the_command_writes_a_record_and_a_picture(cli, tmp_path: Path) -> None:
    code, out, _ = cli("--pixel", "41,50", "--method", "random", "--frame", "1", "--out", "here", "--json")
    assert code == 0
    record = json.loads(out)
    assert record == read_json(tmp_path / "here" / "trace.json")
    assert (record["y"], record["x"], record["frame"], record["method"]) == (41, 50, 1, "random")
    picture = (tmp_path / "here" / "trace.svg").read_text()
    words = " ".join(ElementTree.fromstring(picture).itertext())
    for expected in (
        "CCD pixel (41, 50)",
        "W m⁻²",
        "slot of the exposure",
        f"{record['reading']['drawn_dn']} DN",
    ):
        assert expected in words
    assert "nan" not in picture


def test_without_out_a_new_folder_says_what_it_holds(cli, tmp_path: Path) -> None:
    code, out, _ = cli("--pixel", " 1, 2 ")
    assert code == 0
    assert "outside the panel's image" in out
    assert "veil" in out
    (folder,) = (tmp_path / "reports" / "runs").iterdir()
    assert folder.name.startswith("trace-demo-")
    assert {file.name for file in folder.iterdir()} == {"trace.json", "trace.svg"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--pixel", "41;50"), "--pixel: got '41;50', expected y,x"),
        (("--pixel", "41"), "--pixel: got '41', expected y,x"),
        (("--pixel", "41,5.5"), "--pixel: got '41,5.5', expected y,x"),
        (("--pixel", "80,50"), "--pixel: got row 80, column 50, expected rows 0 to 79 (camera.sensor.rows)"),
        (("--pixel", "41,104"), "columns 0 to 103 (camera.sensor.cols); choose a pixel on the CCD"),
        (("--pixel", "-1,5"), "--pixel: got row -1, column 5, expected rows 0 to 79"),
        (("--pixel", "5,-1"), "--pixel: got row 5, column -1, expected rows 0 to 79"),
        (("--pixel", "41,50", "--frame", "3"), "--frame: got 3, expected 0 to 2; choose one of these"),
        (("--pixel", "41,50", "--frame", "-1"), "--frame: got -1, expected 0 to 2"),
        (("--pixel", "41,50", "--method", "adaptiv"), "did you mean 'adaptive'?"),
        (("--pixel", "41,50", "--out", "file"), "is a file, expected a folder"),
    ],
)
def test_bad_input_exits_2_with_the_cure_before_rendering(cli, monkeypatch, tmp_path, words, message) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(trace, "render_truth", lambda *_, **__: pytest.fail("rendered"))
    code, _, err = cli(*words)
    assert code == 2
    assert message in err
    assert not (tmp_path / "reports").exists()


def test_the_first_steady_frame_and_the_first_method_are_the_defaults() -> None:
    long = load_experiment("demo")
    assert choose_pixel(long, "180,240") == TracedPixel(180, 240, 5, "adaptive")
    assert choose_pixel(long.model_copy(update={"n_frames": 6}), "0,0") == TracedPixel(0, 0, 5, "adaptive")
    assert choose_pixel(long.model_copy(update={"n_frames": 4}), "0,0") == TracedPixel(0, 0, 3, "adaptive")
    late = long.model_copy(update={"camera": long.camera.model_copy(update={"latency_frames": 3})})
    assert choose_pixel(late, "367,487", None, "random") == TracedPixel(367, 487, 7, "random")
    assert choose_pixel(long, "1,2", 0, "normal") == TracedPixel(1, 2, 0, "normal")
