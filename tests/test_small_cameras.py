"""What few numbers take another way for, without compiled loops, comes out as the loops have it."""

import numpy as np
import pytest

from optsim.camera.parts import image_formation
from optsim.core.quantities import Block, Segment, Video
from optsim.optics import integrate, relaxation, relay
from optsim.optics.fringing import border_shares
from optsim.optics.panel import PanelResponse, slot_weights

RNG = np.random.default_rng(20)


def both(monkeypatch, module, work):
    """Results of a piece of work without and with compiled loops."""
    monkeypatch.setattr(module, "FEW", np.inf)
    few = work()
    monkeypatch.setattr(module, "FEW", 0)
    return few, work()


@pytest.mark.parametrize(
    ("change", "n_sub"),
    [
        ({}, 1),
        ({"tau_on_s": 0.0, "tau_off_s": 0.0}, 1),
        ({"delay_s": 1e-3, "scan_s": 2e-3}, 3),
        ({"delay_s": -1e-3, "scan_s": 2e-3, "field_drive": (1.03, 1.0, 0.97)}, 3),
        ({"tau_on_s": 0.0, "delay_s": 2e-3}, 2),
        ({"field_drive": (1.03, 1.0, 0.97), "tau_off_s": 4e-3}, 1),
    ],
)
def test_weights_of_few_pixels(monkeypatch, change, n_sub):
    levels = RNG.choice(np.array([0, 100, 255], np.uint8), (12, 5, 7))
    leaks = RNG.uniform(0, 0.02, 7)
    (few, state), (many, last) = both(
        monkeypatch,
        relaxation,
        lambda: slot_weights(levels, None, PanelResponse(**change), 1 / 180, n_sub, leaks),
    )
    np.testing.assert_allclose(few, many, atol=3e-7)
    np.testing.assert_allclose(state.retardance_rad, last.retardance_rad, atol=2e-6)
    np.testing.assert_array_equal(state.levels, last.levels)


def test_a_small_exposure(monkeypatch):
    keys = RNG.uniform(0, 5, (2, 12, 15)).astype(np.float32)
    excess = RNG.normal(0, 1, (8, 5, 7)).astype(np.float32)
    excess[3] = 0
    segment = Segment(keys[0], keys[1], (Block(1, 2, excess), Block(7, 8, excess)), 8)
    video = Video(12, 15, 3, 1 / 180, 1, 8, 8, lambda _: segment)
    weights = RNG.uniform(0, 1, (8, 4, 5)).astype(np.float32)
    few, many = both(
        monkeypatch,
        integrate,
        lambda: integrate.integrate_exposure(video, 0, integrate.Shutter(weights, border_shares(0.1, 3))),
    )
    np.testing.assert_allclose(few, many, rtol=1e-6)


@pytest.mark.parametrize("shift", [0.0, 4.0, -4.0])
def test_the_overlap_of_a_small_panel(monkeypatch, shift):
    geometry = relay.RelayGeometry(
        18, 24, 20, 25, 1.02, 0.681, shift, -shift, 0.01, keystone_y=0.01, distortion=-0.02
    )
    few, many = both(monkeypatch, relay, lambda: relay.overlap_operator(geometry, 0.9))
    assert few.dtype == many.dtype == np.float64
    np.testing.assert_array_equal(few.indptr, many.indptr)
    np.testing.assert_array_equal(few.indices, many.indices)
    np.testing.assert_allclose(few.data, many.data, rtol=1e-12)


def test_far_light_on_a_small_field(monkeypatch):
    key, far = RNG.uniform(0, 5, (12, 15)), RNG.uniform(0, 1, (4, 5))
    factor = RNG.uniform(0.5, 1, (12, 15)).astype(np.float32)
    few, many = both(
        monkeypatch, image_formation, lambda: image_formation._with_far_light(key, far, factor, 0.3, 0.9)
    )
    np.testing.assert_allclose(few, many, rtol=1e-6)
