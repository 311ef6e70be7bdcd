"""Exposures of a mosaic: what is commanded of an ideal panel, and what leak and response make of it."""

import numpy as np
import pytest

from optsim.camera.effects import changed, with_effects
from optsim.camera.hardware import demo
from optsim.camera.true_calibration import true_calibration
from optsim.coding import HdrMosaic, MotionAdaptive, NormalPhotography, RandomExposure
from optsim.experiment.densities import densities, mosaics
from optsim.experiment.experiment import load_experiment
from optsim.experiment.explain import explanation

IDEAL = with_effects(demo(), {"all": "ideal"})
SLOTS = np.array([1, 3, 11, 36])


def effective(camera, mosaic=None):
    found = densities(camera, mosaic or HdrMosaic())
    assert [each["commanded_slots"] for each in found] == list(SLOTS)
    return np.array([each["effective_slots"] for each in found])


def test_of_an_ideal_panel_they_are_what_is_commanded():
    np.testing.assert_allclose(effective(IDEAL), SLOTS, rtol=1e-6)


def test_leak_adds_while_a_pixel_is_told_to_be_dark():
    leaky = with_effects(demo(), {"all": "ideal", "contrast": "nominal"})
    np.testing.assert_allclose(effective(leaky), SLOTS + (36 - SLOTS) / leaky.contrast, rtol=1e-5)


def test_a_slow_panel_opens_and_closes_late():
    """By (tau_off - tau_on) times a constant: the integral of what a step lacks, whatever its length."""
    slow = changed(IDEAL, {"modulator": {"tau_on_s": 0.5e-3, "tau_off_s": 1.0e-3}})
    step = (0.5e-3) * 180 * _lag()
    np.testing.assert_allclose(effective(slow)[1:3], SLOTS[1:3] + step, atol=2e-3)


def _lag():
    """Integral of sin^2(pi/2 e^-x), x in time constants: what closing adds, and what opening lacks."""
    x = np.linspace(0, 40, 400_001)
    return float(np.trapezoid(np.sin(np.pi / 2 * np.exp(-x)) ** 2, x))


def test_a_calibration_gives_its_frames_these_exposures():
    camera = demo()
    calibration = true_calibration(camera)
    state = HdrMosaic().init(calibration, np.random.default_rng(0))
    panel, sums = None, {int(n): [] for n in SLOTS}
    for index in range(8):
        code, state = HdrMosaic().next(index, [], state)
        weights, panel = calibration.weights(code, panel)
        opened = (code.levels > 0).sum(axis=0)
        if index >= 4:
            for n in SLOTS:
                sums[int(n)].append(weights.sum(axis=0)[opened == n].mean())
    # The whole panel's leak varies over its columns.
    np.testing.assert_allclose([np.mean(each) for each in sums.values()], effective(camera), rtol=5e-3)


def test_explain_lists_them_for_the_methods_that_show_them():
    found = explanation("demo", [])["densities"]
    assert set(found) == {"adaptive", "hdr_mosaic"}
    assert found["adaptive"] == found["hdr_mosaic"] == densities(load_experiment("demo").camera, HdrMosaic())
    experiment = load_experiment("demo")
    schemes = (RandomExposure(), NormalPhotography(), MotionAdaptive(static=NormalPhotography()))
    methods = tuple(
        method.model_copy(update={"scheme": scheme})
        for method, scheme in zip(experiment.methods, schemes, strict=False)
    )
    assert mosaics(experiment.model_copy(update={"methods": methods})) == {}


@pytest.mark.parametrize("overlap", [True, False])
def test_an_exposure_longer_than_what_is_coded_gets_all_of_it(overlap):
    camera = IDEAL.model_copy(update={"overlap": overlap})
    longest = densities(camera, HdrMosaic())[-1]
    assert longest["commanded_slots"] == camera.coded_slots
    assert longest["effective_slots"] == pytest.approx(camera.coded_slots)
