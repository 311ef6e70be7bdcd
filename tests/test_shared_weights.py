"""Which patches share their weights: the period of a code is found, through noise, holes and drift."""

import numpy as np
import pytest
from ideal_camera import SLOTS, film, ideal_calibration

from optsim.coding import (
    CodedRollingShutter,
    FlutterShutter,
    HdrMosaic,
    NormalPhotography,
    RandomBinary,
    RandomExposure,
    RandomLengths,
    ShutterGrid,
)
from optsim.coding.static_schemes import STATIC_SCHEMES
from optsim.core.quantities import CodedFrame, ExposureCode
from optsim.decoding import GaussianMixture, SparseCoding, shared_weights
from optsim.decoding.patch_grid import patch_corners
from optsim.decoding.shared_weights import code_period
from optsim.optics.panel import PanelResponse

ROWS, COLS = 70, 84
TOLERANCE = 0.02
EVERYWHERE = np.ones((ROWS, COLS), np.bool_)
PERIODS = [
    (NormalPhotography(), (1, 1)),
    (FlutterShutter(), (1, 1)),
    (HdrMosaic(), (2, 4)),
    (HdrMosaic(shifts=False), (2, 2)),
    (RandomExposure(), (8, 8)),
    (RandomExposure(tile_px=16), (16, 16)),
    (RandomLengths(tile_px=7), (7, 7)),
    (RandomBinary(tile_px=4), (4, 4)),
    (RandomBinary(open_share=1 / 28, tile_px=11), (11, 11)),
    (CodedRollingShutter(), (4, 1)),
    (CodedRollingShutter(group_rows=9), (9, 1)),
    (ShutterGrid(grid_px=3), (3, 3)),
]


def weights_of(scheme, calibration=None, mask=EVERYWHERE):
    """Weights (v, u, slot) that a scheme's first code has."""
    calibration = calibration or ideal_calibration(*mask.shape, leak=0.01, tau_s=5e-4)
    code, _ = scheme.next(0, [], scheme.init(calibration, np.random.default_rng(5)))
    weights, _ = calibration.weights(code, None)
    return np.ascontiguousarray(np.moveaxis(weights, 0, -1))


def found(weights, mask=EVERYWHERE, stride=1, patch=8):
    corners = patch_corners(mask, patch, stride)
    return shared_weights.shared_weights(weights, mask, corners, patch, TOLERANCE), corners


@pytest.mark.parametrize(("scheme", "period"), PERIODS)
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_the_period_of_every_scheme_is_found(scheme, period, noise):
    rng = np.random.default_rng(3)
    weights = weights_of(scheme)
    # Of each pixel's gain, and of each weight by itself: a difference of pairs has twice the variance, and
    # a thousand of them in 128 directions pass 0.08 once in 10^3 such tests.
    for shape in ((ROWS, COLS, 1), weights.shape):
        weights = weights * (1 + noise * rng.standard_normal(shape)).astype(np.float32)
    mask = rng.random((ROWS, COLS)) > 0.1
    mask[20:34, 10:60] = False
    weights[~mask] = 0
    assert code_period(weights, mask, TOLERANCE) == period


def test_no_scheme_is_forgotten():
    assert {type(scheme) for scheme, _ in PERIODS} == set(STATIC_SCHEMES)


def test_strangers_and_one_odd_pixel_of_a_tile_are_told_apart():
    """Some pixels out of another code leave a period as it is; one pixel of each tile makes a longer one."""
    rng = np.random.default_rng(4)
    weights = weights_of(FlutterShutter())
    odd = weights.copy()
    odd[::8, ::8] = 0.2
    assert code_period(odd, EVERYWHERE, TOLERANCE) == (8, 8)
    strange = weights_of(RandomExposure())
    strange[rng.random((ROWS, COLS)) < 0.05] = 0.2
    assert code_period(strange, EVERYWHERE, TOLERANCE) == (8, 8)
    shared, corners = found(strange)
    np.testing.assert_allclose(shared.weights(0), weights_of(RandomExposure())[:8, :8].reshape(64, -1))
    touched = [(strange[v : v + 8, u : u + 8] == 0.2).any() for v, u in corners]
    np.testing.assert_array_equal(shared.phase < 0, touched)


def test_small_regions_are_judged_by_their_own_pixels():
    """Of regions 10 pixels wide less than half have a partner 8 pixels away; around them is another code."""
    weights, mask = weights_of(HdrMosaic()), np.zeros_like(EVERYWHERE)
    for v, u in ((3, 5), (21, 40), (44, 18), (52, 66)):
        mask[v : v + 10, u : u + 10] = True
    weights[mask] = weights_of(RandomExposure())[mask]
    assert code_period(weights, mask, TOLERANCE) == (8, 8)


def test_a_code_that_never_repeats_is_shared_by_nobody():
    rng = np.random.default_rng(6)
    weights = rng.integers(0, 2, (ROWS, COLS, SLOTS)).astype(np.float32)
    assert code_period(weights, EVERYWHERE, TOLERANCE) == (ROWS, COLS)
    shared, corners = found(weights)
    assert (shared.phase == -1).all()
    assert shared.matrices == len(corners)
    nothing = np.zeros_like(EVERYWHERE)
    assert found(weights, nothing)[0].matrices == 0


def test_rows_in_no_order_are_shared_along_the_columns():
    rng = np.random.default_rng(7)
    weights = np.repeat(rng.random((ROWS, 1, SLOTS), np.float32), COLS, axis=1)
    shared, corners = found(weights)
    assert shared.tile.shape[:2] == (ROWS, 1)
    np.testing.assert_array_equal(shared.phase, corners[:, 0])
    np.testing.assert_allclose(shared.weights(9), weights[9:17, :8].reshape(64, -1))


@pytest.mark.parametrize("axis", [0, 1])
def test_weights_that_drift_over_the_panel_are_shared_across_the_drift(axis):
    """Rows are written one after the other, late ones when a third of the slot has passed."""
    response = PanelResponse(leak=0.01, scan_s=2e-3)
    calibration = ideal_calibration(240, 240, response=response)
    weights = weights_of(RandomExposure(), calibration)
    if axis:
        weights = np.ascontiguousarray(weights.swapaxes(0, 1))
    mask = np.ones((240, 240), np.bool_)
    assert code_period(weights, mask, TOLERANCE) == (8, 8)
    shared, corners = found(weights, mask, stride=2)
    assert shared.tile.shape[axis] == 240
    assert shared.tile.shape[1 - axis] == 8
    assert (shared.phase >= 0).all()
    assert shared.matrices == 4 * len(np.unique(corners[:, axis]))
    # Without drift, or with less of it than the tolerance, the small tile stays.
    little = ideal_calibration(240, 240, response=PanelResponse(leak=0.01, scan_s=2e-4))
    assert found(weights_of(RandomExposure(), little), mask, stride=2)[0].tile.shape[:2] == (8, 8)


# Mixtures are slow at patches of their own: fewer of these, at 2 x 2 phases of a grid with those at the edge.
SPARSE, MIXTURE = SparseCoding(), GaussianMixture(stride_px=3)


@pytest.mark.parametrize(
    ("decoder", "scheme", "matrices", "patches"),
    [
        (SPARSE, ShutterGrid(grid_px=3), 9, 17 * 21),
        (SPARSE, CodedRollingShutter(), 4, 17 * 21),
        (MIXTURE, ShutterGrid(grid_px=3), 4, 7 * 8),
        (MIXTURE, CodedRollingShutter(), 4, 7 * 8),
    ],
)
def test_shared_weights_give_the_picture_of_own_ones(decoder, scheme, matrices, patches, monkeypatch):
    rng = np.random.default_rng(8)
    calibration = ideal_calibration(24, 28, leak=0.01)
    texture = rng.random((24, 28 + SLOTS), np.float32)
    light = np.stack([texture[:, t : t + 28] for t in range(SLOTS)])
    frames = film(calibration, scheme, [light], rng)
    asked, real = [], shared_weights.shared_weights

    def spied(*arguments):
        asked.append(real(*arguments))
        return asked[-1]

    monkeypatch.setattr(f"{type(decoder).__module__}.shared_weights", spied)
    (together,) = decoder.decode(frames, calibration)
    monkeypatch.setattr(shared_weights, "code_period", lambda weights, *_: weights.shape[:2])
    (alone,) = decoder.decode(frames, calibration)
    assert [shared.matrices for shared in asked] == [matrices, patches]
    scale = np.abs(together.irradiance_w_m2).max()
    np.testing.assert_allclose(alone.irradiance_w_m2, together.irradiance_w_m2, atol=1e-3 * scale)


def test_a_random_code_of_each_pixel_is_decoded():
    rng = np.random.default_rng(9)
    calibration = ideal_calibration(24, 24)
    light = 0.5 + 0.3 * np.sin(np.arange(24) / 4) * np.ones((24, 1), np.float32)
    levels = (255 * (rng.random((SLOTS, 24, 24)) < 0.5)).astype(np.uint8)
    signal = (levels / 255 * light).sum(axis=0) * 270 + 64
    frame = CodedFrame(
        0, np.rint(signal).astype(np.uint16), ExposureCode(levels, np.ones((24, 24), np.bool_))
    )
    for kind in (SparseCoding, GaussianMixture):
        (result,) = kind(stride_px=2).decode([frame], calibration)
        error = np.sqrt(np.square(result.irradiance_w_m2 - light).mean())
        assert error < 0.2 * light.std()
