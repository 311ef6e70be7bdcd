"""The plan: what it leaves out fits the tolerance, follows scene and camera, and is what a run uses."""

from dataclasses import replace

import numpy as np
import pytest
from optsim.camera.plan import SHORT_CUTS, Coarser, plan_camera

from optsim.camera.effect_sizes import effect_sizes
from optsim.camera.effects import ALL, changed, switched, with_effects
from optsim.camera.hardware import demo, prototype
from optsim.camera.parts import Modulator, Objective
from optsim.camera.parts.objective import MOVING_WING_SHARE
from optsim.camera.probe import (
    NOTHING,
    PLAIN,
    Illumination,
    Probe,
    Probes,
    compared_with,
    far_probe,
    make_probes,
    near_probe,
    shrunk,
)
from optsim.camera.probe.made_code import made_code, telling
from optsim.camera.probe.made_scene import made_scene
from optsim.coding import (
    FlutterShutter,
    HdrMosaic,
    MotionAdaptive,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
    ShutterGrid,
)
from optsim.core.errors import ConfigError
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import plan_record
from optsim.experiment.loop import planned
from optsim.experiment.truth import illumination
from optsim.optics.relay import RelayOperator
from optsim.scene import BrightLight, bright_lights, load_scene

ROOM = Illumination(0.1, 90.0, 0.8)
WINDOW = Illumination(0.1, 90.0, 0.8, (BrightLight(25.0, 0.07),))
SCHEMES = load_experiment("demo").schemes
FIXED = {"normal": NormalPhotography()}


def choices(plan):
    return {choice.short_cut: choice for choice in plan.choices}


def largest(probes, *change):
    return max(probes.sizes(*change))[0]


@pytest.mark.parametrize("light", [ROOM, WINDOW])
def test_what_is_left_out_fits_the_tolerance_and_a_larger_one_leaves_out_more(light):
    plans = [plan_camera(demo(), light, SCHEMES, tolerance) for tolerance in (0.01, 0.1, 1.0)]
    for plan, tolerance in zip(plans, (0.01, 0.1, 1.0), strict=True):
        assert 0 <= plan.predicted <= tolerance
        assert set(choices(plan)) == set(SHORT_CUTS)
    assert plans[-1].predicted > 0.1
    for part in ("objective", "relay"):
        for field in ("field_error", "wing_share"):
            taken = [getattr(getattr(plan.camera, part), field) for plan in plans]
            assert taken == sorted(taken)
    assert plans[0].camera.objective.field_error < plans[-1].camera.objective.field_error


def test_nothing_is_left_out_without_a_tolerance():
    plan = plan_camera(demo(), WINDOW, SCHEMES, 0.0)
    assert plan.predicted == 0
    assert all(choice.full for choice in plan.choices)
    for name, cut in SHORT_CUTS.items():
        if not name.endswith("wings"):
            assert changed(plan.camera, cut.steps[0][1]) == plan.camera
    assert plan.camera.objective.moving_wing_share == 0
    # Wings need not reach beyond the panel, here 480 cells wide, and back.
    for lens in (plan.camera.objective, plan.camera.relay):
        assert lens.wing_share == 3e-4


@pytest.mark.parametrize("f_number", [0.7, 16.0])
def test_slow_and_fast_lenses_have_a_plan_and_an_image(f_number):
    camera = demo()
    lens = camera.objective.model_copy(update={"f_number": f_number})
    slow = camera.model_copy(update={"objective": lens})
    for tolerance in (0.0, 0.1):
        plan = plan_camera(slow, WINDOW, SCHEMES, tolerance)
        assert plan.predicted <= tolerance
        assert plan.camera.relay_operator().blur.shape == (360, 480)


def test_beside_a_bright_window_wings_reach_farther():
    room, window = (plan_camera(demo(), light, SCHEMES, 2.0).camera for light in (ROOM, WINDOW))
    for part in ("objective", "relay"):
        assert getattr(window, part).wing_share < getattr(room, part).wing_share


def test_what_is_far_below_a_pixel_or_a_slot_is_skipped_and_what_is_not_is_modelled():
    camera = demo()
    quick = camera.modulator.model_copy(update={"tau_on_s": 2e-7, "tau_off_s": 4e-7})
    sharp = camera.objective.model_copy(update={"aberration_m": 1e-8, "magnification": 1.0, "f_number": 0.7})
    plain = with_effects(camera, {"objective_blur": "ideal"}).objective
    sharp = sharp.model_copy(update={"wavefront": plain.wavefront})
    plan = plan_camera(camera.model_copy(update={"modulator": quick, "objective": sharp}), ROOM, SCHEMES, 0.5)
    assert plan.camera.modulator.tau_on_s == 0
    assert choices(plan)["response"].choice == "skipped"
    nominal = choices(plan_camera(camera, ROOM, SCHEMES, 0.1))
    assert nominal["response"].choice == "modelled"
    assert nominal["relay_blur"].choice == "modelled"


def test_the_predicted_size_is_what_the_probe_shows_in_units_of_its_noise():
    """One short cut by hand: rms of the difference over the noise, pixels that clip left out."""
    probes = make_probes(demo(), ROOM, SCHEMES)
    probe = probes.near
    dark = {"sensor": {"dark_current_e_s": probe.camera.sensor.dark_current_e_s + 50.0}}
    extra, sizes = 50.0 * probe.camera.exposure_s, {name: size for size, name in probes.sizes(dark)}
    assert list(sizes) == ["random", "normal", "hdr_mosaic"]
    for name, size in sizes.items():
        whole, usable = probe.frame({}, name)
        assert usable.all()
        far, usable = probes.far.frame({}, name)
        noise = np.sqrt(np.mean(far[usable] + probe.camera.sensor.read_noise_e**2))
        # The response bends a little less than 1 electron for 1.
        assert size == pytest.approx(extra / noise, rel=0.02)
        # In an even room both see as much light.
        near = np.sqrt(np.mean(whole + probe.camera.sensor.read_noise_e**2))
        assert noise == pytest.approx(near, rel=0.03)
    assert all(size == 0 for size, _ in probes.sizes({}))


WIDE = ("objective_glare", "relay_glare", "ghost", "smear")


@pytest.mark.parametrize(
    "bright", [None, BrightLight(25.0, 0.07), BrightLight(1000.0, 5e-4), BrightLight(1000.0, 6e-5)]
)
def test_probes_tell_what_the_whole_camera_would(bright):
    """Before windows and lamps too, for all schemes, the adaptive one as well, whose size others tell.

    The oracle is the same scene made for all the pixels of the camera.
    """
    camera = changed(demo(), PLAIN)
    probes = make_probes(camera, Illumination(0.1, 90.0, 0.8, (bright,) if bright else ()), SCHEMES)
    density = probes.near.camera.objective.nd_transmission
    lamp_px = bright.share * 160 * 120 if bright else 0.0
    whole = Probe(camera.with_nd(density), made_scene(camera, 0.1, bright), SCHEMES, lamp_px)
    sizes = {each.effect: each.size for each in effect_sizes(probes)}
    # Along its rim a lamp of fewer pixels has relatively more of them.
    near = ("fringing", "contrast", "relay_blur")
    bounds = dict.fromkeys(WIDE, (0.6, 1.35)) | dict.fromkeys(near, (0.8, 2.3))
    for name, (least, most) in bounds.items():
        ideal, against = switched({name: "ideal"}), compared_with(name)
        size = max(whole.change_e(ideal, against, each) / whole.noise_e(each)[0] for each in SCHEMES)
        assert least < sizes[name] / size < most, name


def test_probes_show_the_codes_of_the_schemes():
    """Tiles as they are; the adaptive scheme's two codes in turn, both before what moves."""
    camera, schemes = shrunk(demo()), {"adaptive": MotionAdaptive(), **FIXED, "mosaic": HdrMosaic()}
    probe = near_probe(demo(), ROOM, schemes)
    codes = {name: made_code(each, camera, probe.radiance, 0.0).levels for name, each in schemes.items()}
    assert (codes["normal"] == 255).all()
    opened = (codes["adaptive"] == 255).sum(axis=0)
    for stripe in range(8):
        lengths = {3} if stripe % 2 else {1, 3, 11, 36}
        assert set(np.unique(opened[:, 5 * stripe : 5 * stripe + 5])) == lengths
    (block,) = probe.radiance.load(0).blocks
    assert block.col < 60 < block.col + block.excess.shape[2]
    np.testing.assert_array_equal(codes["adaptive"][..., :5], codes["mosaic"][..., :5])


def test_before_a_lamp_of_a_few_pixels_a_code_has_its_longest_exposure():
    """In some frame of a sequence it has; a window sees codes as they are, larger lamps about their mean."""
    mosaic = {"hdr_mosaic": HdrMosaic()}
    lit = []
    lamps = ((BrightLight(1000.0, share),) for share in (6e-5, 5e-4))
    for light in (ROOM, WINDOW, *(Illumination(0.1, 90.0, 0.8, lamp) for lamp in lamps)):
        probe = near_probe(demo(), light, mosaic)
        code = made_code(mosaic["hdr_mosaic"], probe.camera, probe.radiance, probe.lamp_px).levels
        bright = probe.radiance.load(0).start.reshape(30, 3, 40, 3).max(axis=(1, 3)) > 0.1
        lit.append((code == 255).sum(axis=0)[bright])
    room, window, lamp, larger = lit
    assert room.size == 0
    assert set(window) == {1, 3, 11, 36}
    assert 0 < lamp.size < 8
    assert set(lamp) == {36}
    assert 0 < larger.size < 8
    assert set(larger) == {11}


def test_a_darker_code_has_larger_leaks_and_a_brighter_one_more_stray_light():
    """The same camera in the same light: what is told depends on the experiment's schemes."""
    sizes, changes_e = {}, {}
    for scheme in (RandomExposure(), NormalPhotography(), RandomBinary()):
        probes = make_probes(demo(), ROOM, {scheme.kind: scheme})
        sizes[scheme.kind] = {each.effect: each.size for each in effect_sizes(probes)}
        changes_e[scheme.kind] = sizes[scheme.kind]["contrast"] * probes.noise_e[scheme.kind][0]
    bumps, normal, binary = sizes.values()
    of_bumps_e, open_e, half_e = changes_e.values()
    # Perfect contrast takes light from closed pixels and gives some to open ones, slot by slot.
    closed_e = 2 * half_e + open_e
    assert of_bumps_e == pytest.approx((33 * closed_e - 3 * open_e) / 36, rel=0.05)
    assert bumps["contrast"] > 5 * binary["contrast"]
    assert bumps["objective_glare"] < binary["objective_glare"] < normal["objective_glare"]
    assert normal["fringing"] < 1e-4 < 0.1 < bumps["fringing"]
    assert binary["response"] > bumps["response"] > 10 * normal["response"]


@pytest.mark.parametrize("state", ["nominal", "pessimistic"])
@pytest.mark.parametrize("light", [ROOM, WINDOW, Illumination(0.1, 90.0, 0.8, (BrightLight(1000.0, 5e-4),))])
def test_a_few_schemes_tell_the_largest_sizes_of_all(light, state):
    """All eleven of figure 4, one by one, are the oracle."""
    schemes = load_experiment("figure4").schemes
    camera = changed(with_effects(demo(), {"all": state, "lost_fields": "nominal"}), PLAIN)
    told = telling(schemes, shrunk(camera))
    assert next(iter(told.values())) in (schemes["grid"], schemes["random"], schemes["normal_short"])
    assert {"normal", "normal_short", "flutter"} < set(told)
    assert len(told) <= 6
    different = {each.model_dump_json(): name for name, each in schemes.items()}.values()
    assert len(different) == 11
    sizes = {}
    for name in different:
        alone = {name: schemes[name]}
        probes = Probes(near_probe(camera, light, alone), far_probe(camera, light, alone))
        sizes[name] = {each.effect: each.size for each in effect_sizes(probes)}
    found = {each.effect: each for each in effect_sizes(make_probes(camera, light, schemes))}
    for effect, each in found.items():
        most = max(size[effect] for size in sizes.values())
        if most > 0.1:
            assert 0.75 * most < each.size <= most * (1 + 1e-6), effect
            assert each.scheme in told


BUMPS = {
    "short": NormalPhotography(open_slots=3),
    "flutter": FlutterShutter(),
    "bumps": RandomExposure(),
}


@pytest.mark.parametrize("light", [ROOM, WINDOW])
def test_codes_that_differ_in_time_alone_tell_fringing_in_whatever_order(light):
    """Bumps are as long everywhere: summed over a frame they are as even as a code that opens all at once."""
    found = []
    for schemes in (BUMPS, dict(reversed(BUMPS.items())), {"bumps": BUMPS["bumps"]}):
        sizes = {each.effect: each for each in effect_sizes(make_probes(demo(), light, schemes))}
        found.append(sizes["fringing"])
    assert found[0].scheme == "bumps"
    assert found[0].size > 0.3
    assert found[0].size == pytest.approx(found[2].size, rel=0.2)
    assert found[0] == found[1]
    plan = plan_camera(demo(), light, BUMPS, 0.1)
    assert plan.camera.modulator.rim_model != "mixed"
    alone = {name: BUMPS[name] for name in ("short", "flutter")}
    assert plan_camera(demo(), light, alone, 0.1).camera.modulator.rim_model == "mixed"


def test_of_schemes_that_are_as_dark_the_same_is_told_in_whatever_order():
    schemes = {"grid": ShutterGrid(), "bumps": RandomExposure()}
    told = [list(telling(each, shrunk(demo()))) for each in (schemes, dict(reversed(schemes.items())))]
    assert told[0] == told[1]
    assert len(told[0]) == 1


def test_codes_of_uneven_exposures_tell_blur():
    """Blur mixes what neighbours gather, of which a mosaic has most; its fringing counts for that."""
    schemes = {
        "third": NormalPhotography(open_slots=12),
        "sparse": RandomBinary(open_share=0.03),
        "mosaic": HdrMosaic(),
    }
    sizes = [
        {each.effect: each.size for each in effect_sizes(make_probes(demo(), ROOM, each_of))}
        for each_of in (schemes, {"mosaic": HdrMosaic()})
    ]
    assert sizes[0]["relay_blur"] == pytest.approx(sizes[1]["relay_blur"], rel=0.2)
    assert sizes[0]["relay_blur"] > 5


@pytest.mark.parametrize("placement", ["collimated", "converging"])
def test_a_probe_that_keeps_what_it_made_tells_what_a_fresh_one_does(placement):
    """Each effect off, one after another on one probe, against a probe that has made nothing."""
    parts = {"splitter": {"placement": placement}}
    camera = changed(with_effects(demo(), {"lost_fields": "pessimistic"}), parts)
    schemes = {"bumps": RandomExposure()}
    for kept in (near_probe(camera, WINDOW, schemes), far_probe(camera, WINDOW, schemes)):
        for name, effect in ALL.items():
            if effect.in_scene or effect.drifts:
                continue
            change = switched({name: "ideal"})
            for ours, fresh in zip(
                kept.frame(change, "bumps"), replace(kept).frame(change, "bumps"), strict=True
            ):
                np.testing.assert_array_equal(ours, fresh, err_msg=name)


def test_of_methods_that_share_a_scheme_one_is_told():
    schemes = {"first": NormalPhotography(), "second": NormalPhotography()}
    assert list(telling(schemes, shrunk(demo()))) == ["first"]
    with pytest.raises(ConfigError, match=r"methods, 'short': bump_slots: got 40"):
        make_probes(demo(), ROOM, {"short": RandomExposure(bump_slots=40)})


@pytest.mark.parametrize(("share", "expected"), [(1e-7, 15.0), (0.07, 1.0)])
def test_lamps_of_a_near_probe_do_as_much_to_a_frame(share, expected):
    """A point that brings a 15th of a 15th of the camera's light does a 15th of what that does, rms."""
    camera, bright = prototype(), BrightLight(1e4, share)
    near = near_probe(camera, Illumination(0.1, 90.0, 0.8, (bright,) if bright else ()), SCHEMES)
    lit, as_it_is = (
        video.load(0).start.astype(float) for video in (near.radiance, made_scene(near.camera, 0.1, bright))
    )
    brighter = np.where(lit > 0.1, lit, 0).sum() / np.where(as_it_is > 0.1, as_it_is, 0).sum()
    assert camera.panel_cols == 15 * near.camera.panel_cols
    assert brighter == pytest.approx(expected, rel=0.2)


def test_beside_bright_light_wings_that_no_probe_tells_are_modelled():
    """Those that begin within a pixel of the far probe, however large the tolerance."""
    wings = {
        light: choices(plan_camera(prototype(), light, SCHEMES, 1e4))["objective_wings"].choice
        for light in (ROOM, WINDOW)
    }
    assert list(wings.values()) == ["within 3 %", "within 0.1 %"]


@pytest.mark.parametrize(("state", "bound"), [("nominal", 0.2), ("pessimistic", 0.35)])
@pytest.mark.parametrize("light", [ROOM, WINDOW])
def test_what_plain_probes_leave_out_changes_sizes_by_far_less_than_the_factor_that_plans_add(
    light, state, bound
):
    """Even PSFs and mixed rims save most of a plan's time; the oracle has fields of PSFs and fine rims."""
    # Of periods that are no whole rounds of the panel's fields (28 slots) rims show more: there it is 0.4.
    camera = with_effects(demo(), {"all": state, "lost_fields": "nominal"})
    fine = changed(
        camera, compared_with("objective_blur") | compared_with("relay_blur") | compared_with("fringing_rims")
    )
    exact, quick = (
        {each.effect: each.size for each in effect_sizes(make_probes(each_camera, light, SCHEMES))}
        for each_camera in (fine, changed(camera, PLAIN))
    )
    large = {name for name, size in exact.items() if size > 0.05}
    assert len(large) > 12
    # Sensors bend just below the full well, where a probe before a window has few pixels.
    bounds = dict.fromkeys(large, bound) | {"bend": max(bound, 0.3)}
    for name in large:
        assert quick[name] == pytest.approx(exact[name], rel=bounds[name]), name


def test_steps_are_compared_with_the_full_model_of_what_they_make_coarser():
    probe = make_probes(changed(demo(), PLAIN), ROOM, SCHEMES)
    for name in ("fringing_rims", "objective_field", "relay_field"):
        (_, full), *_, (_, cheapest) = SHORT_CUTS[name].steps
        assert largest(probe, full, compared_with(name)) == 0
        assert largest(probe, cheapest, compared_with(name)) > 0.1
        assert largest(probe, cheapest) == 0
    for lens in ("objective", "relay"):
        assert compared_with(f"{lens}_blur") == compared_with(f"{lens}_field")


@pytest.mark.parametrize("lens", ["objective", "relay"])
def test_a_probe_makes_one_image_for_all_errors_that_have_as_many_nodes(monkeypatch, lens):
    """Nodes double from grid to grid, so of steps that are closer together some share one."""
    probe = near_probe(changed(demo(), PLAIN), ROOM, SCHEMES)
    taken = []
    whole = type(probe.camera).panel_energy

    def panel_energy(camera, *rest):
        taken.append(getattr(camera, lens).field_error)
        return whole(camera, *rest)

    monkeypatch.setattr(type(probe.camera), "panel_energy", panel_energy)
    operators = []
    monkeypatch.setattr(
        "optsim.optics.relay.RelayOperator.apply",
        lambda operator, image, real=RelayOperator.apply: operators.append(1) or real(operator, image),
    )
    errors = (0.02, 0.0199, 0.005, 0.1)
    frames = [probe.frame({lens: {"field_error": error}}, "normal")[0] for error in errors]
    assert len(operators) == 3
    if lens == "objective":
        assert taken == [0.02, 0.005, 0.1]
    np.testing.assert_array_equal(frames[0], frames[1])
    assert (frames[0] != frames[2]).any()
    assert (frames[0] != frames[3]).any()


def test_wings_of_moving_light_count_in_each_part_of_the_frame():
    """As in every instant, against lines in time; the near probe moves something in one part of two."""
    plan = plan_camera(demo(), WINDOW, SCHEMES, 0.1)
    found, share = choices(plan)["moving_wings"], plan.camera.objective.moving_wing_share
    assert plan.probes.near.parts == 2
    assert share > 0
    seen, coarser = (
        largest(plan.probes, {"objective": {"moving_wing_share": each}}, compared_with("moving_wings"))
        for each in (share, 2 * share)
    )
    assert found.size == pytest.approx(2 * 2 * seen)
    assert 0 < seen < coarser < 0.1
    still = plan.probes.near.radiance.load(1)
    assert not still.blocks
    assert still.start is still.stop


@pytest.mark.parametrize("share", [1e-4, 0.015, 0.03])
def test_beside_a_small_lamp_moving_light_has_all_of_its_wings_and_rims(share):
    """What covers it is not in the probe, so its size is not known; a window's is."""
    lamp = Illumination(0.1, 90.0, 0.8, (BrightLight(400.0, share),))
    plan = plan_camera(demo(), lamp, SCHEMES, 0.1)
    assert choices(plan)["moving_wings"].full
    assert choices(plan)["fringing_rims"].full
    assert plan.camera.objective.moving_wing_share == 0
    assert not choices(plan_camera(demo(), WINDOW, SCHEMES, 0.1))["moving_wings"].full


def test_a_second_lamp_may_be_hidden_too():
    """Beside a window that brings more light; one that brings next to nothing matters to no plan."""
    for over_white, full in ((5000.0, True), (10.0, False)):
        lights = (*WINDOW.lights, BrightLight(over_white, 3e-4))
        plan = plan_camera(demo(), Illumination(0.1, 90.0, 0.8, lights), SCHEMES, 0.1)
        assert choices(plan)["moving_wings"].full == full


def test_a_far_probe_sees_all_of_a_panel_of_any_size():
    for cols in (39, 41, 64, 79, 80, 600):
        camera = demo().model_copy(update={"panel_cols": cols})
        far = far_probe(camera, ROOM, SCHEMES).camera
        assert far.panel_cols <= 40
        assert far.panel_cols * far.modulator.pitch_m > 0.94 * cols * camera.modulator.pitch_m


@pytest.mark.parametrize("f_number", [4.0, 32.0])
def test_a_near_probe_has_no_wider_wings_than_room(f_number):
    camera = changed(demo(), {"objective": {"f_number": f_number, "wing_share": 1e-4}})
    near = near_probe(camera, ROOM, SCHEMES).camera
    kernel = near.objective.psf(near.objective.working_f_number, near.modulator.pitch_m / 3, (90, 120)).kernel
    assert len(kernel) // 2 == pytest.approx({4.0: 101, 32.0: 120}[f_number], abs=2)
    assert camera.objective.wing_share < near.objective.wing_share


def test_wings_of_slow_lenses_are_told_by_the_probe_that_has_room_for_them():
    """Those of moving light, and before a bright light, wherever it lies, those of all light count twice."""
    share = {"objective": {"moving_wing_share": MOVING_WING_SHARE}}
    for f_number, far in ((4.0, False), (8.0, True)):
        camera = changed(demo(), {"objective": {"f_number": f_number}})
        plan = plan_camera(camera, WINDOW, SCHEMES, 3.0)
        on = ("near", "far") if far else ("near",)
        seen = max(plan.probes.sizes(share, compared_with("moving_wings"), on))[0]
        assert choices(plan)["moving_wings"].size == pytest.approx(2 * 2 * seen)
    blue = demo().model_copy(update={"wavelength_m": 450e-9})
    for light, times in ((ROOM, 2), (WINDOW, 2 * 2)):
        plan = plan_camera(blue, light, SCHEMES, 0.5)
        lens = {"objective": {"wing_share": plan.camera.objective.wing_share}}
        near = plan.probes.near.camera.objective.wing_share < plan.camera.objective.wing_share
        seen = max(plan.probes.sizes(lens, NOTHING, ("near", "far") if near else ("far",)))[0]
        assert choices(plan)["objective_wings"].size == pytest.approx(times * seen) != 0


def test_numbers_set_by_hand_stay():
    by_hand = changed(demo(), {"relay": {"wing_share": 0.02}, "objective": {"field_error": 0.5}})
    plan = plan_camera(by_hand, WINDOW, SCHEMES, 0.1)
    assert plan.camera.relay.wing_share == 0.02
    assert plan.camera.objective.field_error == 0.5
    assert {"relay_wings", "objective_field"}.isdisjoint(choices(plan))


def test_the_far_probe_sees_the_whole_panel_at_the_same_fill():
    camera = demo()
    far, near = far_probe(camera, WINDOW, SCHEMES).camera, near_probe(camera, WINDOW, SCHEMES).camera
    side = far.panel_cols * far.modulator.pitch_m
    assert side == pytest.approx(camera.panel_cols * camera.modulator.pitch_m, rel=0.03)
    assert far.view.tan_half_width == pytest.approx(camera.view.tan_half_width, rel=0.03)
    fills = [
        {row.stage: row.value for row in probe.ledger(0.1)}["electrons a frame"] for probe in (far, near)
    ]
    assert fills[0] == pytest.approx(fills[1], rel=0.1)


def test_a_run_models_what_the_plan_says():
    experiment = load_experiment("demo", ["tolerance=0.3"])
    modelled, plan = planned(experiment)
    assert modelled.camera == plan.camera
    assert plan.tolerance == 0.3
    record = plan_record(plan)
    assert record["predicted"] == pytest.approx(sum(row["size"] for row in record["choices"]))
    assert modelled.camera.view == experiment.camera.view


def test_lamps_in_the_picture_are_found_from_the_scene_alone():
    view = demo().view
    shape = (view.tan_half_width, view.rows / view.cols)
    window = bright_lights(load_scene("window_room").in_band(), *shape)[0]
    assert window.over_white == pytest.approx(11.2 / 0.4)
    assert 0.05 < window.share < 0.1
    assert not bright_lights(load_scene("wheel").in_band(), *shape)
    lamp = bright_lights(load_scene("night_street").in_band(), *shape)[0]
    assert lamp.over_white == pytest.approx(500 / 0.02)
    assert lamp.share < 1e-3
    assert illumination(load_experiment("demo")).bright == window


def test_a_lamp_that_faces_away_or_is_off_is_not_seen():
    scene = load_scene("window_room").in_band()
    shape = (demo().view.tan_half_width, 0.75)
    window = scene.lamps["window"]
    for update in ({"edge_u_m": (-1.2, 0.0, 0.0)}, {"lit": False}, {"center_m": (30.0, 7.66, 1.7)}):
        lamps = {"window": window.model_copy(update=update)}
        assert not bright_lights(scene.model_copy(update={"lamps": lamps}), *shape)


def test_every_default_of_a_short_cut_is_one_of_its_steps_or_between_them():
    """Without a plan, a camera by itself is modelled about as finely as a plan would."""
    for name, cut in SHORT_CUTS.items():
        if name == "fringing_rims":
            assert isinstance(cut, Coarser)
            assert cut.values[0] == Modulator.model_fields[cut.field].default
        elif isinstance(cut, Coarser):
            assert cut.values == tuple(sorted(cut.values)), name
            assert cut.values[0] <= Objective.model_fields[cut.field].default <= cut.values[-1]
