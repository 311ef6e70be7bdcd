"""Stated uncertainties against the errors made: shares and rms, by method, region and phase."""

from dataclasses import replace

import numpy as np
import pytest

from optsim import metrics
from optsim.core.quantities import Reconstruction

SLOTS, CODED, ROWS, COLS = 5, 4, 60, 80
LATENCY = 1


def drawn(sigma, *, index=5, seed=0, spread=None):
    """Truth of 0.5, an estimate with errors of sigma, and a mask whose left half moves."""
    truth = np.full((SLOTS, ROWS, COLS), 0.5, np.float32)
    error = np.random.default_rng(seed).normal(0, 1, truth.shape) * sigma
    moving = np.zeros((ROWS, COLS), np.bool_)
    moving[:, : COLS // 2] = True
    flat = np.ones((ROWS, COLS), np.bool_)
    stated = np.broadcast_to(np.float32(sigma if spread is None else spread), truth.shape)
    video = Reconstruction(
        index, (truth + error).astype(np.float32), flat, ~flat, moving, np.ascontiguousarray(stated)
    )
    return video, truth, moving


def tallied(video, truth, moving, scored=None):
    scored = video.valid if scored is None else scored
    return metrics.tally_uncertainty("m", video, truth, moving, scored, CODED)


def records(*tallies):
    return {(r.phase, r.region): r for r in metrics.uncertainty_records(tallies, LATENCY)}


def test_right_deviations_hold_in_their_shares_and_wrong_ones_are_told():
    found = records(tallied(*drawn(0.1)))["steady", "all"]
    n = found.n
    assert n == CODED * ROWS * COLS
    # Four standard errors of a share of 19200 samples, and of their rms: false alarms 1 in 1e4.
    assert found.within_one == pytest.approx(0.6827, abs=4 * (0.6827 * 0.3173 / n) ** 0.5)
    assert found.within_two == pytest.approx(0.9545, abs=4 * (0.9545 * 0.0455 / n) ** 0.5)
    assert found.rms == pytest.approx(1, abs=4 / (2 * n) ** 0.5)
    sure, modest = (records(tallied(*drawn(0.1, spread=s)))["steady", "all"] for s in (0.05, 0.2))
    assert sure.rms == pytest.approx(2 * found.rms, rel=1e-5)
    assert modest.within_one == found.within_two


def test_only_what_is_scored_coded_and_has_a_deviation_counts():
    video, truth, moving = drawn(0.1)
    spread, light = video.uncertainty_w_m2.copy(), video.irradiance_w_m2.copy()
    light[CODED:] = 1e6
    light[:, 3, 4] = 1e6
    spread[:, 5, 50] = 0
    scored = video.valid.copy()
    scored[3, 4] = False
    changed = replace(video, uncertainty_w_m2=spread, irradiance_w_m2=light)
    found = records(tallied(changed, truth, moving, scored))
    assert found["steady", "moving"].n == CODED * (ROWS * COLS // 2 - 1)
    assert found["steady", "static"].n == CODED * (ROWS * COLS // 2 - 1)
    assert 0.9 < found["steady", "all"].rms < 1.1
    assert tallied(replace(video, uncertainty_w_m2=None), truth, moving) is None


def test_regions_and_phases_are_kept_apart_and_pooled():
    half, truth, moving = drawn(0.1)
    spread = half.uncertainty_w_m2.copy()
    spread[:, moving] /= 3
    early = tallied(*drawn(0.1, index=0, spread=0.01))
    late = [tallied(replace(half, uncertainty_w_m2=spread, index=k), truth, moving) for k in (5, 6)]
    found = records(late[0], early, late[1])
    assert {phase for phase, _ in found} == {"warm-up", "steady"}
    assert next(iter(found))[0] == "warm-up"
    assert found["warm-up", "all"].rms == pytest.approx(10, rel=0.05)
    assert found["steady", "moving"].rms == pytest.approx(3, rel=0.05)
    assert found["steady", "static"].rms == pytest.approx(1, rel=0.05)
    assert found["steady", "all"].rms == pytest.approx(5**0.5, rel=0.05)
    assert found["steady", "all"].n == 2 * CODED * ROWS * COLS
    nowhere = records(tallied(half, truth, np.ones_like(moving)))["steady", "static"]
    assert (nowhere.n, nowhere.within_one, nowhere.rms) == (0, None, None)
