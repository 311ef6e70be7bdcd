"""The study of the mask over speed x latency: its film, its scores, its picture."""

import math

import numpy as np
import pytest

import benchmarks as benchmark
from benchmarks import mask
from benchmarks.crossing import Crossing
from optsim.coding import MotionAdaptive
from optsim.metrics import MaskAgreement


def test_the_disc_crosses_at_its_speed_and_the_ground_stands_still():
    crossing = Crossing(rows=32, cols=80, radius_px=8, speed_px=1.0, start_px=20, slots=20, seed=1)
    film = np.concatenate([crossing.frame(0), crossing.frame(1)])
    assert film.shape == (40, 32, 80)
    assert 0.05 <= film.min() < film.max() <= 1
    apart = np.abs(film - film[-1]).max(axis=0) > 0
    # From 20 - 8 to 20 + 40 + 8, and nine rows beyond the disc on either side.
    assert not apart[:8].any()
    assert not apart[24:].any()
    assert (np.flatnonzero(apart.any(axis=0)).min(), np.flatnonzero(apart.any(axis=0)).max()) == (12, 67)
    # A pixel a slot: the inside of the disc is the same picture one pixel on, across frames too.
    for slot in (0, 19, 30):
        inside = np.s_[12:20, 17 + slot : 24 + slot]
        on = np.s_[12:20, 18 + slot : 25 + slot]
        np.testing.assert_allclose(film[slot + 1][on], film[slot][inside], atol=1e-6)
        assert np.ptp(film[slot][inside]) > 0.1
    away = Crossing(rows=32, cols=80, radius_px=8, speed_px=1.0, start_px=-99, slots=20, seed=1).frame(0)
    assert (away == away[:1]).all()
    np.testing.assert_allclose(film[0][:, 40:], away[0][:, 40:])


def test_scores_of_several_frames_are_pooled():
    first = mask.Score(MaskAgreement(hits=6, false_alarms=2, misses=2, correct_static=90), 3.0, 1.0)
    second = mask.Score(MaskAgreement(hits=0, false_alarms=0, misses=8, correct_static=92), 1.0, 1.0)
    found = mask.pooled([first, second])
    assert found == pytest.approx(
        {"precision": 6 / 8, "recall": 6 / 16, "iou": 6 / 18, "loss_db": 10 * math.log10(2)}
    )
    assert mask.pooled([second])["precision"] is None


def test_the_study_tells_late_masks_from_grown_ones(monkeypatch):
    options = {name: mask.schemes()[name] for name in ("default", "growth")}
    monkeypatch.setattr(mask, "schemes", lambda: options | {"blind": MotionAdaptive(threshold_sigma=1e6)})
    monkeypatch.setattr(mask, "SPEEDS_PX", (0.5,))
    monkeypatch.setattr(mask, "LATENCIES", (1, 2))
    monkeypatch.setattr(mask, "_SEEDS", (1,))
    found = mask.measure("mask.speed_latency")
    points = {(p["option"], p["latency_frames"]): p for p in found["conditions"]["mask"]}
    assert [points["default", n]["lag_px"] for n in (1, 2)] == [18, 36]
    for n in (1, 2):
        late, ahead, blind = (points[option, n] for option in ("default", "growth", "blind"))
        assert late["recall"] < 0.75 < 0.85 < ahead["recall"]
        assert late["loss_db"] > ahead["loss_db"] + 0.4
        # A mask that covers nearly all of it decodes as full random exposure does, but for what moves and
        # shows no change: that is taken from the merge.
        assert abs(ahead["loss_db"]) < 0.8
        assert (blind["precision"], blind["recall"], blind["iou"]) == (None, 0, 0)
        # Without a mask all is a mosaic, of which the union makes a video too.
        assert blind["loss_db"] > ahead["loss_db"] + 1.5
    assert points["default", 2]["recall"] < points["default", 1]["recall"] - 0.2
    losses = found["conditions"]["mean_loss_db"]
    assert (found["value"], found["peer_value"]) == (losses["growth"], losses["default"])
    assert found["ratio"] == pytest.approx(10 ** ((losses["default"] - losses["growth"]) / 10))
    drawn = benchmark.pictures([found])
    assert set(drawn) == {"mask_against_lag.svg"}
    text = drawn["mask_against_lag.svg"]
    # Four pictures of three options at two lags, but an empty mask has no precision.
    assert (text.count("<polyline"), text.count("<circle")) == (12, 22)
    assert ">blind<" in text
    assert ">IoU<" in text
