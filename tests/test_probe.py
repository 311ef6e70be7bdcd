"""The probe: a small camera and a made scene that tell the sizes of effects."""

from dataclasses import replace

import numpy as np
import pytest

from optsim.camera.effect_sizes import effect_sizes
from optsim.camera.effects import ALL, changed, switched, with_effects
from optsim.camera.hardware import demo, prototype
from optsim.camera.probe import PLAIN, Illumination, Probe, compared_with, make_probe, shrunk
from optsim.camera.probe.made_code import levels_of, made_code
from optsim.camera.probe.made_scene import made_scene
from optsim.coding import ALL as KINDS
from optsim.coding import (
    ClosedLoopDensity,
    ClosedLoopRate,
    HdrMosaic,
    MotionAdaptive,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
)
from optsim.core.errors import ConfigError
from optsim.experiment.experiment import load_experiment
from optsim.optics.relay import RelayOperator
from optsim.scene import BrightLight

ROOM = Illumination(0.1, 90.0, 0.8)
WINDOW = Illumination(0.1, 90.0, 0.8, (BrightLight(25.0, 0.07),))
SCHEMES = load_experiment("demo").schemes
FIXED = {"normal": NormalPhotography()}


def test_the_predicted_size_is_what_the_probe_shows_in_units_of_its_noise():
    """One short cut by hand: rms of the difference over the noise, pixels that clip left out."""
    probe = make_probe(demo(), ROOM, SCHEMES)
    dark = {"sensor": {"dark_current_e_s": probe.camera.sensor.dark_current_e_s + 50.0}}
    extra, sizes = 50.0 * probe.camera.exposure_s, {name: size for size, name in probe.sizes(dark)}
    assert set(sizes) == set(SCHEMES)
    for name, size in sizes.items():
        whole, usable = probe.frame({}, name)
        assert usable.all()
        noise = np.sqrt(np.mean(whole + probe.camera.sensor.read_noise_e**2))
        # The response bends a little less than 1 electron for 1.
        assert size == pytest.approx(extra / noise, rel=0.02)
    assert all(size == 0 for size, _ in probe.sizes({}))


WIDE = ("objective_glare", "relay_glare", "ghost", "smear")


@pytest.mark.slow
@pytest.mark.parametrize(
    "bright", [None, BrightLight(25.0, 0.07), BrightLight(1000.0, 5e-4), BrightLight(1000.0, 6e-5)]
)
def test_a_probe_tells_what_the_whole_camera_would(bright):
    """Before windows and lamps too, for all schemes, the adaptive one as well, whose size others tell.

    The oracle is the same scene made for all the pixels of the camera.
    """
    camera = changed(demo(), PLAIN)
    probe = make_probe(camera, Illumination(0.1, 90.0, 0.8, (bright,) if bright else ()), SCHEMES)
    density = probe.camera.objective.nd_transmission
    lamp_px = bright.share * 160 * 120 if bright else 0.0
    whole = Probe(camera.with_nd(density), made_scene(camera, 0.1, bright), SCHEMES, lamp_px)
    sizes = {each.effect: each.size for each in effect_sizes(probe)}
    # Along its rim a lamp of fewer pixels has relatively more of them.
    near = ("fringing", "contrast", "relay_blur")
    bounds = dict.fromkeys(WIDE, (1 / 3, 3.0)) | dict.fromkeys(near, (0.8, 2.3))
    for name, (least, most) in bounds.items():
        ideal, against = switched({name: "ideal"}), compared_with(name)
        size = max(whole.change_e(ideal, against, each) / whole.noise_e[each][0] for each in SCHEMES)
        assert least < sizes[name] / size < most, name


def test_a_probe_shows_the_codes_of_the_schemes():
    """Tiles as they are; the adaptive scheme's two codes in turn, both before what moves."""
    camera, schemes = shrunk(demo()), {"adaptive": MotionAdaptive(), **FIXED, "mosaic": HdrMosaic()}
    probe = make_probe(demo(), ROOM, schemes)
    codes = {name: made_code(each, camera, probe.radiance, 0.0).levels for name, each in schemes.items()}
    assert (codes["normal"] == 255).all()
    opened = (codes["adaptive"] == 255).sum(axis=0)
    for stripe in range(8):
        lengths = {3} if stripe % 2 else {1, 3, 11, 36}
        assert set(np.unique(opened[:, 5 * stripe : 5 * stripe + 5])) == lengths
    (block,) = probe.radiance.load(0).blocks
    assert block.col < 60 < block.col + block.excess.shape[2]
    np.testing.assert_array_equal(codes["adaptive"][..., :5], codes["mosaic"][..., :5])


@pytest.mark.parametrize("kind", KINDS)
def test_every_scheme_gives_a_probe_examples_of_its_codes(kind):
    camera = shrunk(demo())
    levels = levels_of(kind(), camera)
    assert levels.shape == (36, camera.panel_rows, camera.panel_cols)
    assert levels.any(axis=0).all()
    chosen = {ClosedLoopDensity: {1, 3, 11, 36}, ClosedLoopRate: {1, 3, 6, 12, 36}}
    lengths = set(np.count_nonzero(levels, axis=0).ravel())
    assert lengths == chosen.get(kind, lengths)


def test_before_a_lamp_of_a_few_pixels_a_code_has_its_longest_exposure():
    """In some frame of a sequence it has; a window sees codes as they are, larger lamps about their mean."""
    mosaic = {"hdr_mosaic": HdrMosaic()}
    lit = []
    lamps = ((BrightLight(1000.0, share),) for share in (6e-5, 5e-4))
    for light in (ROOM, WINDOW, *(Illumination(0.1, 90.0, 0.8, lamp) for lamp in lamps)):
        probe = make_probe(demo(), light, mosaic)
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
        probe = make_probe(demo(), ROOM, {scheme.kind: scheme})
        sizes[scheme.kind] = {each.effect: each.size for each in effect_sizes(probe)}
        changes_e[scheme.kind] = sizes[scheme.kind]["contrast"] * probe.noise_e[scheme.kind][0]
    bumps, normal, binary = sizes.values()
    of_bumps_e, open_e, half_e = changes_e.values()
    # Perfect contrast takes light from closed pixels and gives some to open ones, slot by slot.
    closed_e = 2 * half_e + open_e
    assert of_bumps_e == pytest.approx((33 * closed_e - 3 * open_e) / 36, rel=0.05)
    assert bumps["contrast"] > 5 * binary["contrast"]
    assert bumps["objective_glare"] < binary["objective_glare"] < normal["objective_glare"]
    assert normal["fringing"] < 1e-4 < 0.1 < bumps["fringing"]
    assert binary["response"] > bumps["response"] > 10 * normal["response"]


@pytest.mark.slow
@pytest.mark.parametrize("placement", ["collimated", "converging"])
def test_a_probe_that_keeps_what_it_made_tells_what_a_fresh_one_does(placement):
    """Each effect off, one after another on one probe, against a probe that has made nothing."""
    parts = {"splitter": {"placement": placement}}
    camera = changed(with_effects(demo(), {"lost_fields": "pessimistic"}), parts)
    schemes = {"bumps": RandomExposure()}
    kept = make_probe(camera, WINDOW, schemes)
    for name, effect in ALL.items():
        if effect.in_scene or effect.drifts:
            continue
        change = switched({name: "ideal"})
        for ours, fresh in zip(
            kept.frame(change, "bumps"), replace(kept).frame(change, "bumps"), strict=True
        ):
            np.testing.assert_array_equal(ours, fresh, err_msg=name)


def test_methods_that_share_a_scheme_have_one_frame():
    schemes = {"first": NormalPhotography(), "second": NormalPhotography()}
    assert list(make_probe(demo(), ROOM, schemes).schemes) == ["first"]
    with pytest.raises(ConfigError, match=r"methods, 'short': bump_slots: got 40"):
        make_probe(demo(), ROOM, {"short": RandomExposure(bump_slots=40)})


@pytest.mark.parametrize(("share", "expected"), [(1e-7, 15.0), (0.07, 1.0)])
def test_lamps_of_a_probe_do_as_much_to_a_frame(share, expected):
    """A point that brings a 15th of a 15th of the camera's light does a 15th of what that does, rms."""
    camera, bright = prototype(), BrightLight(1e4, share)
    near = make_probe(camera, Illumination(0.1, 90.0, 0.8, (bright,) if bright else ()), SCHEMES)
    lit, as_it_is = (
        video.load(0).start.astype(float) for video in (near.radiance, made_scene(near.camera, 0.1, bright))
    )
    brighter = np.where(lit > 0.1, lit, 0).sum() / np.where(as_it_is > 0.1, as_it_is, 0).sum()
    assert camera.panel_cols == 15 * near.camera.panel_cols
    assert brighter == pytest.approx(expected, rel=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("state", "bound"), [("nominal", 0.2), ("pessimistic", 0.35)])
@pytest.mark.parametrize("light", [ROOM, WINDOW])
def test_a_plain_probe_changes_sizes_by_less_than_a_third(light, state, bound):
    """Even PSFs and mixed weights save most of the time; the oracle has fields of PSFs and fine edges."""
    # Of periods that are no whole rounds of the panel's fields (28 slots) edges show more: there it is 0.4.
    camera = with_effects(demo(), {"all": state, "lost_fields": "nominal"})
    fine = changed(
        camera,
        compared_with("objective_blur")
        | compared_with("relay_blur")
        | {"modulator": {"fringe_model": "fine"}},
    )
    exact, quick = (
        {each.effect: each.size for each in effect_sizes(make_probe(each_camera, light, SCHEMES))}
        for each_camera in (fine, changed(camera, PLAIN))
    )
    large = {name for name, size in exact.items() if size > 0.05}
    assert len(large) > 12
    # Sensors bend just below the full well, where a probe before a window has few pixels: 0.45 measured.
    bounds = dict.fromkeys(large, bound) | {"bend": 0.5}
    for name in large:
        assert quick[name] == pytest.approx(exact[name], rel=bounds[name]), name


@pytest.mark.parametrize("lens", ["objective", "relay"])
def test_a_probe_makes_one_image_for_all_errors_that_have_as_many_nodes(monkeypatch, lens):
    """Nodes double from grid to grid, so of steps that are closer together some share one."""
    probe = make_probe(changed(demo(), PLAIN), ROOM, SCHEMES)
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


@pytest.mark.parametrize("f_number", [4.0, 32.0])
def test_a_probe_has_no_wider_wings_than_room(f_number):
    camera = changed(demo(), {"objective": {"f_number": f_number, "tail_share": 1e-4}})
    near = make_probe(camera, ROOM, SCHEMES).camera
    kernel = near.objective.psf(near.objective.working_f_number, near.modulator.pitch_m / 3, (90, 120)).kernel
    assert len(kernel) // 2 == pytest.approx({4.0: 101, 32.0: 120}[f_number], abs=2)
    assert camera.objective.tail_share < near.objective.tail_share
