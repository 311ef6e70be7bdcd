"""Each imperfection by itself: nothing where it is off, and about what it should be where it is on."""

import io
import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from rich.console import Console
from scipy.ndimage import shift

from optsim.camera.effect_sizes import effect_sizes, size_of, size_of_defocus
from optsim.camera.effects import ALL, STATES, changed, switched, with_effects
from optsim.camera.hardware import demo, imx174, prototype
from optsim.camera.probe import PLAIN, Illumination, Probe, drifted_as_far, make_probe, shrunk
from optsim.camera.probe.made_scene import made_scene
from optsim.coding import HdrMosaic
from optsim.coding.periodic import PeriodicCode
from optsim.core.errors import ConfigError
from optsim.core.quantities import Block, ExposureCode, IrradianceVideo, Segment
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import explanation, not_planned, scene_effects, show
from optsim.footage.made import still
from optsim.scene import BrightLight

WINDOW = Illumination(0.1, 90.0, 0.8, (BrightLight(25.0, 0.07),))
ROOM = Illumination(0.1, 90.0, 0.8)
SCHEMES = load_experiment("demo").schemes
IDEAL = with_effects(shrunk(prototype(), 64), {"all": "ideal"})


def frame(camera, level=255, dark_half=False):
    """Electrons after the sensor's clip and bend, of a flat at half of the well; or its right half dark."""
    view = camera.view
    flat = np.full((view.rows, view.cols), 0.08, np.float32)
    flat[:, view.cols // 2 :] *= not dark_half
    light = camera.form_image(still(flat, n_slots=36, slot_s=camera.slot_s, samples_per_pitch=3))
    rows, cols = camera.panel_rows, camera.panel_cols
    levels = np.broadcast_to(np.uint8(level), (36, rows, cols)).copy()
    code = ExposureCode(levels, np.zeros((rows, cols), np.bool_))
    electrons, _ = camera.expected_electrons(light, 0, code, None)
    return camera.sensor.signal_e(electrons, camera.exposure_s, camera.serial_number)


@pytest.mark.slow
def test_with_everything_ideal_a_flat_is_the_ledger_and_dark_is_dark():
    seen = frame(IDEAL)[20:-20, 20:-20]
    expected = {row.stage: row.value for row in IDEAL.ledger(0.08)}["electrons a frame"]
    np.testing.assert_allclose(seen, expected, rtol=1e-5)
    assert np.abs(frame(IDEAL, 0)).max() < 1e-6 * expected
    assert IDEAL.contrast > 1e9


def _border(camera):
    """Contrast of the border between a dark and a bright half, over one CCD pixel; its steepest row."""
    levels = np.zeros((36, camera.panel_rows, camera.panel_cols), np.uint8)
    levels[:, :, camera.panel_cols // 2 :] = 255
    seen = frame(camera, levels)
    middle = seen.shape[1] // 2
    return np.abs(np.diff(seen[20:-20, middle - 6 : middle + 6], axis=1)).max() / seen[20:-20, 20:-20].max()


def mean(camera, level=255):
    """Mean of a flat away from the border."""
    return frame(camera, level)[20:-20, 20:-20].mean()


# What of the picture each effect changes: a measure, and bounds on it, nominal and all else ideal.
MEASURES = {
    "contrast": (lambda c: mean(c, 0) / mean(c), 0.0095, 0.0101),
    "response": (lambda c: mean(c, blinking(c)) / mean(c), 0.51, 0.56),
    "fields": (lambda c: mean(c, 128) / mean(IDEAL, 128) - 1, 3.4e-5, 4.3e-5),
    "fringing": (lambda c: 1 - _border(c) / _border(IDEAL), 0.05, 0.2),
    "panel_uniformity": (lambda c: frame(c)[20:-20, 20:-20].std() / frame(c).max(), 0.01, 0.025),
    "splitter_shading": (lambda c: 1 - frame(c)[80, 9] / frame(c)[80, 96], 0.02, 0.07),
    "vignetting": (lambda c: 1 - frame(c)[9, 9] / frame(c)[80, 96], 0.2, 0.35),
    "objective_blur": (lambda c: across_the_edge(c) / mean(c), 0.016, 0.021),
    "relay_blur": (lambda c: 1 - _border(c) / _border(IDEAL), 0.2, 0.6),
    "objective_glare": (lambda c: dark_side(c) / mean(c), 0.5 * 0.00245, 0.5 * 0.00255),
    "relay_glare": (lambda c: frame(c)[1, 1] / frame(c)[80, 96], 0.0015, 0.003),
    "ghost": (lambda c: frame(c, corner(c))[-30:-10, -30:-10].mean() / mean(c), 1e-4, 2e-3),
    "distortion": (lambda c: width(IDEAL) - width(c), 0.9, 1.5),
    "lateral_colour": (lambda c: width(red(c)) / width(red(IDEAL)) - 1, 1.9e-4, 2e-4),
    "smear": (lambda c: mean(c) / mean(IDEAL) - 1, 1.8e-4, 2.1e-4),
    "pixel_response": (lambda c: frame(c)[20:-20, 20:-20].std() / frame(c).mean(), 0.006, 0.012),
    "dark_current": (lambda c: frame(c, 0).mean(), 0.25, 0.26),
    "bend": (lambda c: 1 - frame(c)[80, 96] / frame(IDEAL)[80, 96], 3e-4, 6e-4),
    # Twice ts and rp: 0.92 instead of 0.95 for tp, 0.989 instead of 0.99 for rs.
    "splitter_colour": (lambda c: 1 - mean(red(c)) / mean(red(IDEAL)), 0.0320, 0.0330),
    "read_noise": (lambda c: dark_noise_e(c) ** 2 - dark_noise_e(IDEAL) ** 2, 9.39**2 * 0.98, 9.39**2 * 1.03),
    # Of 0.96 e- instead of 0.24 e-.
    "quantisation": (lambda c: steps_e(c) - steps_e(IDEAL), 0.719, 0.721),
}  # fmt: skip
# What the measures are where nothing is on, if not 0: of a panel that needs no time half of the light.
OFF = {"response": 0.5}


def dark_noise_e(camera):
    """Temporal noise of a frame of 25 electrons: 5, read noise and rounding."""
    sensor = camera.sensor.model_copy(update={"rows": 200, "cols": 500})
    rng = np.random.default_rng(7)
    frames = [sensor.digitise(np.full((200, 500), 25.0), 0.2, 1, rng)[0].astype(float) for _ in range(2)]
    return float(np.std(frames[1] - frames[0]) / 2**0.5 * sensor.step_e)


def steps_e(camera):
    """Step of the digital numbers, in which a ramp of electrons keeps its height."""
    sensor = camera.sensor.model_copy(update={"rows": 1, "cols": 4000})
    seen, _ = sensor.digitise(np.linspace(0, 4000, 4000)[None], 0.2, 1, np.random.default_rng(7))
    assert np.ptp(seen.astype(float)) * sensor.step_e == pytest.approx(4000, abs=300)
    return float(sensor.step_e)


def across_the_edge(camera):
    """What the objective brings from a scene's bright half into the next three panel pixels, in a corner."""
    middle = camera.sensor.cols // 2
    return frame(camera, dark_half=True)[12:20, middle + 1 : middle + 9].mean()


def dark_side(camera):
    """What the dark half of a scene gets, far from the bright one: half of its veil."""
    return frame(camera, dark_half=True)[40:-40, -40:-20].mean()


def corner(camera):
    """Only the first quarter bright: its ghost lies opposite."""
    levels = np.zeros((36, camera.panel_rows, camera.panel_cols), np.uint8)
    levels[:, : camera.panel_rows // 2, : camera.panel_cols // 2] = 255
    return levels


def width(camera):
    """Light of the middle row over its brightest: 0.3 pixels narrower, and by 0.5 % brighter at the ends."""
    row = frame(camera)[80]
    return row.sum() / row.max()


def red(camera):
    return camera.model_copy(update={"wavelength_m": 650e-9})


def blinking(camera):
    """Every other slot bright."""
    levels = np.zeros((36, camera.panel_rows, camera.panel_cols), np.uint8)
    levels[::2] = 255
    return levels


@pytest.mark.slow
@pytest.mark.parametrize("name", MEASURES)
def test_each_effect_is_absent_when_off_and_of_its_size_when_on(name):
    measure, low, high = MEASURES[name]
    alone = with_effects(shrunk(prototype(), 64), {"all": "ideal", name: "nominal"})
    assert low <= measure(alone) <= high
    off = OFF.get(name, 0.0)
    assert measure(IDEAL) == pytest.approx(off, abs=0.02 * low)
    assert not low <= off <= high


def test_rows_written_at_once_are_the_nominal_state_and_every_effect_is_measured_above():
    # What acts in the scene is tested with the lens (test_lens) and the renderer (test_render_lens,
    # test_polarised_truth).
    in_scene = {name for name, effect in ALL.items() if effect.in_scene}
    drifting = {name for name, effect in ALL.items() if effect.drifts}
    other = {"row_scan", "sync", "alignment", "lost_fields"} | drifting
    assert set(MEASURES) | other | in_scene == set(ALL)
    assert not {each.effect for each in effect_sizes(make_probe(IDEAL, ROOM, SCHEMES))} & in_scene
    scanned = with_effects(IDEAL, {"row_scan": "pessimistic"})
    assert np.ptp(scanned.panel_response.row_delays_s(10)) > 0
    assert scanned.modulator.lateness_s(36, 1) == 0
    late = with_effects(IDEAL, {"sync": "pessimistic"})
    np.testing.assert_allclose(late.panel_response.row_delays_s(10), 0.5e-3)
    assert late.modulator.lateness_s(36, 1) != late.modulator.lateness_s(72, 1) != 0
    assert IDEAL.modulator.lateness_s(36, 1) == 0
    # A readout of 39.1 ms takes 7.04 of them.
    slots = [with_effects(prototype(), {"lost_fields": state}).coded_slots for state in STATES]
    assert slots == [36, 36, 28]


def test_what_drifts_is_no_part_of_the_camera_that_is_calibrated(monkeypatch):
    def loaded(*switches):
        return load_experiment("demo", [f"camera.effects.{each}" for each in switches])

    plain = loaded("misregistration=nominal", "grey_curve=ideal")
    assert plain.drift == {}
    moved = loaded("misregistration=pessimistic", "grey_curve=pessimistic")
    assert moved.camera == plain.camera
    assert moved.at_work().relay.shift_x_px == 0.4
    # Light of a level that passes a quarter of it: a third of half a wave.
    exponents = [each.at_work().modulator.drive_exponent for each in (plain, moved)]
    level = (1 / 3) ** (1 / exponents[0])
    light = [np.sin(np.pi / 2 * level**each) ** 2 for each in exponents]
    assert light[0] == pytest.approx(0.25)
    assert light[1] / light[0] - 1 == pytest.approx(-0.08, abs=0.005)
    # From where the camera stands when it is calibrated, and not where that is set by hand.
    far = loaded("misregistration=pessimistic", "alignment=pessimistic")
    assert (far.camera.relay.shift_x_px, far.at_work().relay.shift_x_px) == (1.0, 1.4)
    by_hand = load_experiment("demo", ["camera.effects.all=pessimistic", "drift.relay.shift_x_px=0.1"])
    assert by_hand.at_work().relay.shift_x_px == 0.1
    found = explanation("demo", ["camera.effects.misregistration=pessimistic"])
    sizes = {row["effect"]: row["size"] for row in found["effects"]}
    assert sizes["misregistration"] > 1
    assert sizes["grey_curve"] == sizes["lost_fields"] == 0
    assert found["drift"] == {"relay": {"shift_x_px": 0.4}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "setting",
    [
        ["camera.panel_rows=1", "camera.panel_cols=1"],
        ["camera.panel_rows=120", "camera.panel_cols=1"],
        ["camera.panel_rows=2", "camera.panel_cols=31"],
        ["camera.relay.glare_share=0.99"],
    ],
)
def test_explain_can_say_what_it_found_of_any_camera(setting):
    found = explanation("demo", setting)
    json.dumps(found, allow_nan=False)
    assert ("every pixel clips" in shown(found)) == ("glare" in setting[0])
    sizes = {row["effect"]: row["size"] for row in found["effects"]}
    if "glare" not in setting[0]:
        assert sizes["relay_blur"] > 0.1


def shown(found):
    """What a terminal gets."""
    console = Console(file=io.StringIO(), width=250)
    for item in show(found):
        console.print(item)
    return console.file.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(name for name, effect in ALL.items() if not effect.in_scene))
def test_states_go_from_better_to_worse(name):
    """The predicted size of each effect grows with its state, and its fields exist."""
    sizes = {}
    for state in STATES:
        camera = with_effects(shrunk(prototype(), 32), {name: state})
        camera = red(camera) if name in {"lateral_colour", "splitter_colour"} else camera
        type(camera).model_validate(camera.model_dump())
        effect = ALL[name]
        drift = effect.pessimistic if effect.drifts and state == "pessimistic" else {}
        sizes[state] = size_of(name, make_probe(camera, ROOM, SCHEMES), drift).size
    assert sizes["ideal"] == 0
    # Under light that stands still only the difference of the time constants shows, which is smaller.
    if name != "response":
        assert sizes["nominal"] <= sizes["pessimistic"] * (1 + 1e-6)
    # No shipped scheme, and no probe, shows grey levels.
    assert (sizes["pessimistic"] > 5e-4) == (name != "grey_curve")


def place_of_corner(camera):
    """CCD coordinates of the panel's last corner, from the middle of the CCD."""
    geometry = camera.relay_geometry()
    y, x = geometry.place(np.array(geometry.rows), np.array(geometry.cols))
    return np.array([y - geometry.ccd_rows / 2, x - geometry.ccd_cols / 2])


def test_alignment_moves_the_image_and_defocuses_it():
    ideal, nominal, bad = (with_effects(prototype(), {"all": "ideal", "alignment": s}) for s in STATES)
    assert nominal.relay == ideal.relay
    # 720 x 864 from the middle: 0.3 % less, a milliradian from x towards y, and a pixel each way.
    turned = 0.997 * (np.array([720.0, 864.0]) + 1e-3 * np.array([864.0, -720.0])) + 1
    np.testing.assert_allclose(place_of_corner(ideal), [720, 864])
    np.testing.assert_allclose(place_of_corner(bad), turned, atol=1e-3)
    # As much light, on 0.6 % less area.
    (even, *_), (less, *_) = (
        (np.median(frame(with_effects(shrunk(prototype(), 64), {"all": "ideal"} | s))[20:-20, 20:-20]),)
        for s in ({}, {"alignment": "pessimistic"})
    )
    assert less / even == pytest.approx(0.997**-2, rel=1e-3)
    small = [with_effects(shrunk(prototype(), 64), {"all": "ideal", "alignment": s}) for s in STATES]
    assert _border(small[1]) == _border(small[0])
    # Spread over a disc of one CCD pixel, and no longer between two of them.
    assert 0.6 < _border(small[2]) / _border(small[0]) < 0.95


@pytest.mark.parametrize("others", STATES)
@pytest.mark.parametrize("preset", ["demo", "paper_prototype"])
def test_a_misaligned_camera_still_fits(preset, others):
    switches = [f"camera.effects.all={others}", "camera.effects.alignment=pessimistic"]
    assert load_experiment(preset, switches).camera.geometry().fits


@pytest.mark.slow
def test_a_probe_moves_its_pixels_as_far_as_the_camera():
    """What an error of scale or angle does to the few pixels of a probe, and what moves none of them."""
    camera = prototype()
    moved = changed(
        camera,
        {"relay": {"rotation_rad": 1e-3, "shift_y_px": -1.5, "distortion": 1e-3, "lateral_colour": 0.1}},
    )
    for each in (camera, moved):
        mapped = make_probe(each, ROOM, SCHEMES)
        far = place_of_corner(each) - place_of_corner(changed(each, STRAIGHT))
        near = place_of_corner(changed(mapped.camera, mapped.mapping)) - place_of_corner(
            changed(mapped.camera, STRAIGHT)
        )
        np.testing.assert_allclose(near, far, atol=0.06)
    lost = make_probe(changed(camera, {"relay": {"shift_x_px": 100.0, "rotation_rad": 0.05}}), ROOM, SCHEMES)
    assert lost.mapping["relay"]["shift_x_px"] == 4
    assert lost.mapping["relay"]["rotation_rad"] < 0.06
    still = {each.effect: each.size for each in effect_sizes(make_probe(camera, ROOM, SCHEMES))}
    turned = {each.effect: each.size for each in effect_sizes(make_probe(moved, ROOM, SCHEMES))}
    assert still["alignment"] == 0
    assert turned["alignment"] > 1
    # Everything but the mapping is predicted on the image in the middle.
    assert turned["vignetting"] == pytest.approx(still["vignetting"], rel=0.01)


STRAIGHT = {"relay": {"rotation_rad": 0.0, "shift_y_px": 0.0, "shift_x_px": 0.0, "distortion": 0.0}}


@pytest.mark.slow
def test_the_size_of_noise_is_its_share():
    camera = make_probe(prototype(), ROOM, SCHEMES).camera
    noises = make_probe(prototype(), ROOM, SCHEMES).noise_e
    for noise_e, light_e in noises.values():
        assert noise_e**2 - light_e**2 == pytest.approx(9.39**2 + 0.96**2 / 12)
    noise_e = min(noises.values())[0]
    sizes = {each.effect: each.size for each in effect_sizes(make_probe(prototype(), ROOM, SCHEMES))}
    assert sizes["read_noise"] == pytest.approx(camera.sensor.read_noise_e / noise_e, rel=1e-6)
    assert sizes["quantisation"] == pytest.approx(((0.96**2 - 0.24**2) / 12) ** 0.5 / noise_e, rel=1e-6)
    dim = Illumination(0.1, 90.0, 0.08)
    assert {e.effect: e.size for e in effect_sizes(make_probe(prototype(), dim, SCHEMES))}["read_noise"] > 0.3


@pytest.mark.parametrize(("bits", "in_all"), [(14, 16), (12, 16), (16, 16)])
def test_a_finer_converter_has_the_same_range(bits, in_all):
    sensor = imx174().model_copy(update={"bits": bits, "finer_bits": 8})
    coarse = sensor.model_copy(update={"finer_bits": 0})
    assert sensor.converter_bits == in_all
    assert sensor.max_dn * sensor.step_e == pytest.approx(coarse.max_dn * coarse.gain_e, rel=3e-4)
    assert sensor.zero_dn * sensor.step_e == coarse.black_dn * coarse.gain_e
    assert coarse.model_copy(update={"finer_bits": -8}).converter_bits == 8
    assert (coarse.step_e, coarse.zero_dn, coarse.max_dn) == (8.0, 16.0, 2**bits - 1)


@pytest.mark.parametrize("blur_px", [0.5, 2.0])
def test_the_size_of_defocus_is_that_of_a_disc(blur_px):
    """Against the probe's scene, spread over discs by brute force."""
    probe = make_probe(prototype(), ROOM, SCHEMES)

    def spread(index):
        segment = probe.radiance.load(index)
        start = disc_blurred(segment.start, 3 * blur_px)
        stop = start if segment.stop is segment.start else disc_blurred(segment.stop, 3 * blur_px)
        blocks = tuple(
            Block(b.row, b.col, np.stack([disc_blurred(each, 3 * blur_px) for each in b.excess]))
            for b in segment.blocks
        )
        return Segment(start, stop, blocks, segment.n_instants)

    blurred = replace(probe.radiance, load=lru_cache(spread))
    found = size_of_defocus(probe, blur_px)
    before, usable = probe.frame({}, found.scheme)
    after, _ = replace(probe, radiance=blurred).frame({}, found.scheme)
    expected = np.sqrt(np.mean((after - before)[usable] ** 2)) / probe.noise_e[found.scheme][0]
    assert found.size == pytest.approx(expected, rel=0.2)
    assert size_of_defocus(probe, 0.0).size == 0


def disc_blurred(image, diameter):
    """Mean over points of a disc, in samples; cubic splines between samples hardly blur themselves."""
    reach = np.linspace(-1, 1, 13) * diameter / 2
    points = [(y, x) for y in reach for x in reach if np.hypot(y, x) <= diameter / 2]
    return np.mean([shift(image.astype(float), p, order=3, mode="nearest") for p in points], 0).astype(
        np.float32
    )


def test_an_explanation_shows_every_effect():
    """Those that act in the scene too; footage has been through a lens already."""
    found = {each["effect"]: each for each in explanation("demo", [])["effects"]}
    assert found.keys() == ALL.keys()
    assert 0 < found["depth_of_field"]["size"] < 0.1
    assert found["objective_distortion"]["size"] is None
    assert "panel pixels in the corners" in found["objective_distortion"]["what"]
    assert found["polarised_scene"]["size"] == 0
    seen = {
        each.effect: each.size
        for each in scene_effects(make_probe(IDEAL, ROOM, SCHEMES), None, polarised=True)
    }
    assert seen == {"depth_of_field": 0, "objective_distortion": 0, "polarised_scene": None}
    wide = ["camera.objective.f_number=1.4", "camera.effects.depth_of_field=pessimistic"]
    sharp = [*wide, "camera.objective.focus_m=everywhere", "camera.effects.objective_distortion=ideal"]
    sizes = [{e["effect"]: e["size"] for e in explanation("demo", more)["effects"]} for more in (wide, sharp)]
    assert sizes[0]["depth_of_field"] > 10 * found["depth_of_field"]["size"]
    assert (sizes[1]["depth_of_field"], sizes[1]["objective_distortion"]) == (0, 0)


def test_unknown_effects_and_states_are_named_with_the_cure():
    with pytest.raises(ConfigError, match=r"camera\.effects.*fringing"):
        switched({"fringe": "ideal"})
    with pytest.raises(ConfigError, match=r"camera\.effects\.response 'off'; expected one of: ideal"):
        switched({"response": "off"})
    with pytest.raises(ConfigError, match=r"camera\.effects: got 'ideal'"):
        load_experiment("demo", ["camera.effects=ideal"])


def test_a_switch_changes_the_hardware_and_a_value_set_by_hand_wins():
    assignments = ["camera.effects.response=pessimistic", "camera.modulator.tau_on_s=0.0007"]
    panel = load_experiment("demo", assignments).camera.modulator
    assert (panel.tau_on_s, panel.tau_off_s) == (0.0007, 1.4e-3)
    assert load_experiment("demo").camera.modulator.tau_off_s == 1.0e-3


@pytest.mark.parametrize("key", ["camera.sensor", "camera.sensor.hardware"])
def test_another_sensor_is_chosen_by_its_name(key):
    sensor = load_experiment("demo", [f"{key}=imx174"]).camera.sensor
    assert sensor == imx174()
    chosen = ["camera.sensor.hardware=imx174", "camera.sensor.rows=400", "camera.effects.dark_current=ideal"]
    sensor = load_experiment("demo", chosen).camera.sensor
    assert sensor == imx174().model_copy(update={"rows": 400, "dark_current_e_s": 0.0})
    with pytest.raises(
        ConfigError, match=r"camera\.sensor\.hardware 'imx17'; expected one of: icx674, imx174"
    ):
        load_experiment("demo", [f"{key}=imx17"])


def test_the_probe_sees_the_field_of_the_camera_it_stands_for():
    whole, probe = prototype(), shrunk(prototype(), 64)
    assert probe.view.tan_half_width == pytest.approx(whole.view.tan_half_width, rel=0.01)
    assert probe.ratio == pytest.approx(whole.ratio)
    assert probe.panel_gain[:, -1].mean() == pytest.approx(whole.panel_gain[:, -1].mean(), rel=0.02)
    assert probe.geometry().fits


def test_small_cameras_take_as_long_to_read_as_the_camera_they_stand_for():
    # Smear and slots lost to the readout would otherwise be a small panel's.
    for camera in (demo(), prototype()):
        assert shrunk(camera).sensor.frame_readout_s == pytest.approx(camera.sensor.frame_readout_s)
        closed = [c.model_copy(update={"overlap": False}).coded_slots for c in (camera, shrunk(camera))]
        assert closed[0] == closed[1]


def test_every_key_of_a_drift_has_a_size_or_is_not_predicted():
    drifts = {
        "relay.rotation_rad": "0.001",
        "relay.defocus_m": "36e-6",
        "relay.wavefront.coma_waves": "0.3",
        "modulator.delay_s": "-0.0005",
        "sensor.read_noise_e": "12.0",
        "sensor.gain_e": "1.0",
        "splitter.azimuth_rad": "0.1",
        "serial_number": "2",
    }
    found = explanation("demo", [f"drift.{key}={value}" for key, value in drifts.items()])
    rows = {row["effect"]: row for row in found["effects"]}
    assert {name for name in rows if name.startswith("drift.")} == {f"drift.{key}" for key in drifts}
    unknown = {"sensor.gain_e", "splitter.azimuth_rad"}
    for key in drifts:
        assert (rows[f"drift.{key}"]["size"] is None) == (key in unknown), key
        assert rows[f"drift.{key}"]["size"] is None or rows[f"drift.{key}"]["size"] > 0.01, key
    # All that moves the image, together.
    assert rows["misregistration"]["size"] > rows["drift.relay.rotation_rad"]["size"]
    assert shown(found).count("not predicted") == len(unknown)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value"),
    [("rotation_rad", 1e-3), ("magnification_error", 1e-3), ("shift_x_px", 0.4), ("keystone_y", 2e-3)],
)
def test_a_drift_that_moves_the_image_is_as_large_on_the_probe_as_on_the_camera(key, value):
    camera, schemes = demo(), {"hdr_mosaic": HdrMosaic()}
    now = changed(camera, {"relay": {key: value}})
    probe = make_probe(camera, ROOM, schemes)
    (of_probe,) = [
        each.size
        for each in effect_sizes(probe, drifted_as_far(camera, now, shrunk(camera)))
        if each.effect == f"drift.relay.{key}"
    ]
    nd = probe.camera.objective.nd_transmission
    whole = Probe(
        changed(camera.with_nd(nd), PLAIN), made_scene(camera, ROOM.white_w_m2_sr, None), schemes, 0
    )
    size = whole.change_e({"relay": {key: value}}, {}, "hdr_mosaic") / whole.noise_e["hdr_mosaic"][0]
    # Patches and borders lie otherwise in fewer pixels.
    assert of_probe == pytest.approx(size, rel=0.35)


def bar_that_crosses(camera, light, dark, px_per_slot, instants):
    """A bar of 8 pixels over an even ground, W m^-2; each instant is the mean of what it lasts."""
    view, fine = camera.view, 12
    ground = np.full((view.rows, view.cols), dark, np.float32)

    def load(slot):
        left = (slot + (np.arange(fine) + 0.5)[:, None] / fine) * px_per_slot * view.samples_per_pitch
        on_bar = (np.arange(view.cols) + 0.5 - left) % view.cols < 8 * view.samples_per_pitch
        share = on_bar.reshape(instants, -1, 1, view.cols).mean(axis=1)
        excess = np.repeat(share * (light - dark), view.rows, axis=1).astype(np.float32)
        return Segment(ground, ground, (Block(0, 0, excess),), instants)

    return IrradianceVideo(
        view.rows, view.cols, view.samples_per_pitch, camera.slot_s, instants, 1, camera.slots_per_frame, load
    )


@pytest.mark.slow
def test_one_truth_instant_a_slot_errs_by_what_explain_says():
    camera = changed(shrunk(demo()), PLAIN)
    rng = np.random.default_rng(36)
    tiles = SCHEMES["random"].tiles(36, 36, rng)
    shape = camera.panel_rows, camera.panel_cols
    code = ExposureCode(PeriodicCode(tiles, shape).levels(0), np.ones(shape, np.bool_))
    electrons = {row.stage: row.value for row in camera.ledger(1.0)}["electrons a frame"]
    # What fills 0.8 of the well under all-on counts as white.
    white = 0.8 * camera.sensor.most_e * camera.irradiance_per_radiance / electrons

    def frame(bar, speed, instants):
        light = bar_that_crosses(camera, bar * white, 0.05 * white, speed, instants)
        return camera.expected_electrons(light, 0, code, None)[0][8:-8, 8:-8]

    def error(bar, speed, instants):
        fine = frame(bar, speed, 12)
        noise = np.sqrt(fine.mean() + camera.sensor.dark_noise_e**2)
        return np.sqrt(np.mean((frame(bar, speed, instants) - fine) ** 2)) / noise

    assert error(0.18, 3, 1) == pytest.approx(0.06, abs=0.02)
    assert error(1.0, 3, 1) == pytest.approx(0.3, abs=0.05)
    assert error(1.0, 1, 1) < error(1.0, 3, 1)
    assert error(1.0, 3, 4) < 0.3 / 4
    for instants, sizes in ((1, "0.06 of a frame's noise where it is grey, 0.3 where"), (3, "0.02 of")):
        assert sizes in not_planned(instants)
    found = explanation("demo", [])
    assert not_planned(1) in " ".join(shown(found).split())
    assert explanation("demo", ["render.instants_per_slot=12"])["not_planned"] == not_planned(12) == ""
