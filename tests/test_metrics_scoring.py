"""Oracle mask, mask agreement, the score board and the registered hypothesis."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest

from optsim import metrics
from optsim.errors import ValueCheckError
from optsim.metrics import (
    TRUTH_NOISE,
    FrameTally,
    LogRmse,
    MaskTally,
    PhotometricScale,
    Psnr,
    Pu21Psnr,
    ScoreBoard,
    judge_hypothesis,
    mask_agreement,
    oracle_moving,
    pooled_mask_records,
)
from optsim.quantities import Reconstruction

SLOTS, ROWS, COLS = 4, 6, 8
SCALE = PhotometricScale(white_w_m2_sr=0.5, irradiance_per_radiance=0.02)


# --- oracle ---------------------------------------------------------------------------------------


def still(value: float = 1.0) -> np.ndarray:
    return np.full((SLOTS, ROWS, COLS), value, np.float32)


@pytest.mark.parametrize(("change", "moves"), [(0.0, False), (0.019, False), (0.0215, True), (-0.0215, True)])
def test_two_per_cent_within_a_frame_is_motion(change: float, moves: bool) -> None:
    frame = still()
    frame[2, 3, 4] += change
    mask = oracle_moving(frame, None, 0.0)
    assert mask[3, 4] == moves
    assert np.count_nonzero(mask) == int(moves)


@pytest.mark.parametrize(("change", "moves"), [(0.09, False), (0.11, True)])
def test_two_sigma_of_a_slot_is_motion_where_noise_is_larger(change: float, moves: bool) -> None:
    frame, sigma = still(), np.full((ROWS, COLS), 0.05, np.float32)
    frame[:2] += change
    assert (oracle_moving(frame, None, sigma) == moves).all()
    sigma[0, 0] = 0.5
    assert not oracle_moving(frame, None, sigma)[0, 0]


def test_a_change_since_the_previous_frame_is_motion() -> None:
    assert oracle_moving(still(1.05), still(1.0), 0.0).all()
    assert not oracle_moving(still(1.05), None, 0.0).any()
    assert not oracle_moving(still(1.005), still(1.0), 0.0).any()


def test_oracle_refuses_what_it_cannot_compare() -> None:
    frame = still()
    frame[1, 2, 3] = np.nan
    with pytest.raises(ValueCheckError, match=r"not finite.*\(1, 2, 3\)"):
        oracle_moving(frame, None, 0.0)
    with pytest.raises(ValueCheckError, match="different panels"):
        oracle_moving(still(), still()[:, 1:], 0.0)
    with pytest.raises(ValueCheckError, match="noise of a slot"):
        oracle_moving(still(), None, float("nan"))


def test_mask_agreement_counts() -> None:
    mask = np.array([[1, 1, 1, 0, 0, 0]], bool)
    oracle = np.array([[1, 1, 0, 1, 0, 0]], bool)
    a = mask_agreement(mask, oracle)
    assert (a.hits, a.false_alarms, a.misses, a.correct_static) == (2, 1, 1, 2)
    assert (a.precision, a.recall, a.iou) == (2 / 3, 2 / 3, 0.5)
    swapped = mask_agreement(oracle, mask)
    assert (swapped.false_alarms, swapped.misses) == (1, 1)
    none = mask_agreement(np.zeros((1, 6), bool), np.zeros((1, 6), bool))
    assert none.precision is none.recall is none.iou is None
    assert mask_agreement(np.ones((1, 6), bool), np.zeros((1, 6), bool)).precision == 0.0
    with pytest.raises(ValueCheckError, match="of one size"):
        mask_agreement(mask, oracle[:, 1:])


def test_masks_are_pooled_by_pixels_and_by_phase() -> None:
    """Latency 1: frames 0 and 1 are warm-up, 2 to 4 merging, then steady."""
    oracle = np.zeros((4, 10), bool)
    oracle[0, :8] = True
    late = np.roll(oracle, 2, axis=1)  # 6 hits, 2 false alarms, 2 misses
    still = np.zeros_like(oracle)
    one = oracle & (np.arange(10) == 0)
    pairs = {0: (~still, oracle), 2: (late, oracle), 3: (still, oracle), 4: (one, one), 5: (still, still)}
    tallies = [MaskTally("a", k, mask_agreement(*pair)) for k, pair in pairs.items()]
    warm_up, merging, steady = pooled_mask_records(tallies, latency_frames=1)
    assert warm_up == {
        "method": "a",
        "phase": "warm-up",
        "moves": 8 / 40,
        "marked": 1.0,
        "precision": 8 / 40,
        "recall": 1.0,
        "iou": 8 / 40,
    }
    # 7 hits of 9 marked and of 17 that move; means of the frames' shares would be 7/8, 7/12 and 8/15.
    assert (merging["moves"], merging["marked"]) == (17 / 120, 9 / 120)
    assert (merging["precision"], merging["recall"], merging["iou"]) == (7 / 9, 7 / 17, 7 / 19)
    assert (steady["moves"], steady["marked"]) == (0, 0)
    assert steady["precision"] is steady["recall"] is steady["iou"] is None
    # Marked where nothing moves, and the other way round: one of the shares has a meaning.
    (alarm,) = pooled_mask_records([MaskTally("a", 9, mask_agreement(one, still))], latency_frames=1)
    assert (alarm["precision"], alarm["recall"], alarm["iou"]) == (0, None, 0)
    (missed,) = pooled_mask_records([MaskTally("a", 9, mask_agreement(still, one))], latency_frames=1)
    assert (missed["precision"], missed["recall"], missed["iou"]) == (None, 0, 0)
    assert pooled_mask_records([], latency_frames=1) == []


# --- score board ----------------------------------------------------------------------------------


def board(coded_slots: int = SLOTS, latency: int = 1) -> ScoreBoard:
    return ScoreBoard(metrics.ALL, SCALE, latency, coded_slots)


def frame(index: int, sigma: float = 0.05) -> tuple[Reconstruction, np.ndarray, np.ndarray]:
    """Reconstruction, reference and oracle mask of a made-up frame; row 0 is invalid."""
    rng = np.random.default_rng(100 + index)
    reference = rng.lognormal(-6, 1, (SLOTS, ROWS, COLS)).astype(np.float32)
    estimate = (reference * np.exp(sigma * rng.normal(size=reference.shape))).astype(np.float32)
    valid, filled = np.ones((ROWS, COLS), bool), np.zeros((ROWS, COLS), bool)
    valid[0], filled[1, :2] = False, True
    moving = np.zeros((ROWS, COLS), bool)
    moving[:, :3] = True
    return Reconstruction(index, estimate, valid, filled, moving), reference, moving


def tallies(b: ScoreBoard, n: int, method: str = "m") -> list[FrameTally]:
    return [b.tally(method, *frame(i)) for i in range(n)]


@pytest.mark.parametrize(
    ("latency", "phases"),
    [(1, "wwmmmsss"), (3, "wwwwmmms"), (2, "wwwmmmss")],
)
def test_phases_follow_the_latency(latency: int, phases: str) -> None:
    names = {"w": "warm-up", "m": "merging", "s": "steady"}
    assert [board(latency=latency).phase(i) for i in range(8)] == [names[c] for c in phases]


def test_pooled_scores_equal_a_batch_computation() -> None:
    b = board()
    found = {(r["metric"], r["region"], r["phase"]): r for r in b.records(tallies(b, 7))}
    assert len(found) == 3 * 3 * 3
    for phase, indices in (("warm-up", (0, 1)), ("merging", (2, 3, 4)), ("steady", (5, 6))):
        frames = [frame(i) for i in indices]
        estimate = SCALE.luminance_cd_m2(np.concatenate([f[0].irradiance_w_m2 for f in frames]))
        reference = SCALE.luminance_cd_m2(np.concatenate([f[1] for f in frames]))
        moving, valid = frames[0][2], frames[0][0].valid
        for region, where in (("moving", moving & valid), ("static", ~moving & valid), ("all", valid)):
            for metric in metrics.ALL:
                total, n = metric.sum_errors(estimate, reference, where, SCALE.white_cd_m2)
                record = found[metric.name, region, phase]
                assert record["n"] == n == len(indices) * SLOTS * np.count_nonzero(where)
                assert record["value"] == pytest.approx(metric.finish(total, n), rel=1e-12)


def test_the_order_of_frames_changes_nothing_at_all() -> None:
    b = board()
    forward = tallies(b, 8)
    shuffled = [forward[i] for i in np.random.default_rng(5).permutation(8)]
    key = lambda r: (r["phase"], r["metric"], r["region"])  # noqa: E731
    assert sorted(b.records(forward), key=key) == sorted(b.records(shuffled), key=key)
    assert b.frame_series(forward) == b.frame_series(shuffled)
    assert b.slot_series(forward) == b.slot_series(shuffled)


def test_uncoded_slots_are_not_scored_but_counted() -> None:
    b = board(coded_slots=3)
    reconstruction, reference, moving = frame(0)
    spoiled = reference.copy()
    spoiled[3] = 1e3
    assert b.records([b.tally("m", reconstruction, spoiled, moving)]) == b.records(
        [b.tally("m", reconstruction, reference, moving)]
    )
    coverage = {c["region"]: c for c in b.coverage([b.tally("m", reconstruction, reference, moving)])}
    assert coverage["all"]["valid"] == pytest.approx(3 / 4 * 5 / 6)
    assert coverage["all"]["interpolated"] == pytest.approx(2 / 40)
    assert coverage["static"]["interpolated"] == 0
    assert coverage["moving"]["interpolated"] == pytest.approx(2 / 15)
    assert len(b.slot_series([b.tally("m", reconstruction, reference, moving)], "warm-up")[0]["x"]) == 3


def test_identical_and_empty_are_flagged_and_json_holds_no_infinity() -> None:
    b = board()
    _, reference, moving = frame(0)
    everywhere = np.ones((ROWS, COLS), bool)
    same = Reconstruction(0, reference, everywhere, ~everywhere, moving)
    nothing = Reconstruction(0, reference, ~everywhere, ~everywhere, moving)
    for reconstruction, flag in ((same, "identical"), (nothing, "empty")):
        records = b.records([b.tally("m", reconstruction, reference, moving)])
        assert {r["flag"] for r in records} == {flag}
        values = {r["metric"]: r["value"] for r in records}
        assert values[Pu21Psnr().name] is None
        assert values[Psnr().name] is None
        assert values[LogRmse().name] == (0.0 if flag == "identical" else None)
        json.dumps(records, allow_nan=False)
    tally = b.tally("m", nothing, reference, moving)
    json.dumps([b.coverage([tally]), b.frame_series([tally]), b.slot_series([tally])], allow_nan=False)


def test_series_find_the_bad_frame_and_the_bad_slot() -> None:
    b = board()
    frames = [frame(i) for i in range(8)]
    bad = frames[6][0].irradiance_w_m2.copy()
    bad[2] *= 3
    frames[6] = (
        Reconstruction(6, bad, frames[6][0].valid, frames[6][0].interpolated, frames[6][2]),
        *frames[6][1:],
    )
    found = [b.tally("m", *f) for f in frames]
    by_frame = next(s for s in b.frame_series(found) if s["unit"] == "stops" and s["region"] == "all")
    by_slot = next(s for s in b.slot_series(found) if s["unit"] == "stops" and s["region"] == "all")
    assert by_frame["x"] == list(range(8))
    assert int(np.argmax(by_frame["values"])) == 6
    assert int(np.argmax(by_slot["values"])) == 2
    assert by_slot["values"][2] > 5 * by_slot["values"][1]


def test_frames_of_different_size_are_refused() -> None:
    reconstruction, reference, moving = frame(0)
    with pytest.raises(ValueCheckError, match="m, frame 0"):
        board().tally("m", reconstruction, reference[:, :, 1:], moving)


def test_clamped_share_says_where_pu21_is_blind() -> None:
    b = board()
    reference = still(1.0)
    reference[:, 0] = 0.01
    everywhere = np.ones((ROWS, COLS), bool)
    assert SCALE.luminance_cd_m2(reference).max() > 1e4 > SCALE.luminance_cd_m2(reference).min()
    r = Reconstruction(0, reference, everywhere, ~everywhere, ~everywhere)
    shares = {
        s["metric"]: s["clamped_share"] for s in b.records([b.tally("m", r, reference, ~everywhere)])[::3]
    }
    assert shares[Pu21Psnr().name] == pytest.approx(5 / 6)
    assert shares[Psnr().name] == shares[LogRmse().name] == 0.0


def test_noise_ceiling_is_the_variance_of_the_half_difference() -> None:
    b = board()
    _, reference, moving = frame(0)
    half = np.random.default_rng(9).normal(0, 1e-4, reference.shape).astype(np.float32)
    records = b.records([b.tally_noise(0, reference, half, moving)])
    assert {r["method"] for r in records} == {TRUTH_NOISE}
    white = SCALE.white_w_m2_sr * SCALE.irradiance_per_radiance
    for region, where in (("moving", moving), ("static", ~moving)):
        value = next(r["value"] for r in records if r["metric"] == Psnr().name and r["region"] == region)
        expected = -10 * math.log10(np.mean(half[:, where].astype(float) ** 2) / white**2)
        assert value == pytest.approx(expected, abs=0.01)  # float32 light: 1e-7 of 1e-2 against 1e-4


# --- hypothesis -----------------------------------------------------------------------------------


def contest(values: dict[str, tuple[float, float, float]], phase: str = "steady") -> list[Any]:
    """Records: PU21 moving, PU21 static, log error overall of each method."""
    cells = ((Pu21Psnr(), "moving"), (Pu21Psnr(), "static"), (LogRmse(), "all"))
    return [
        {"method": m, "metric": metric.name, "region": region, "phase": phase, "value": v}
        for m, row in values.items()
        for (metric, region), v in zip(cells, row, strict=True)
    ]


@pytest.mark.parametrize(
    ("adaptive", "passed"),
    [
        ((29.71, 39.71, 0.19), [True, True, True]),
        ((29.69, 39.71, 0.19), [False, True, True]),
        ((35.0, 39.69, 0.21), [True, False, False]),
        ((30.0, 40.0, 0.20), [True, True, False]),
    ],
)
def test_hypothesis_bounds(adaptive: tuple[float, float, float], passed: list[bool]) -> None:
    rivals = {"random": (30.0, 35.0, 0.3), "hdr_mosaic": (20.0, 40.0, 0.2), TRUTH_NOISE: (90.0, 90.0, 0.0)}
    verdicts = judge_hypothesis(contest({"adaptive": adaptive, **rivals}))
    assert [v["passed"] for v in verdicts] == passed
    assert verdicts[0]["margin"] == pytest.approx(adaptive[0] - 29.7)
    assert [v["region"] for v in verdicts] == ["moving", "static", "all"]


def test_the_adaptive_scheme_need_not_beat_itself_under_another_decoder() -> None:
    values = {"adaptive": (1, 1, 0.2), "adaptive_mean": (1, 1, 0.1), "hdr_mosaic": (1, 1, 0.3)}
    assert judge_hypothesis(contest(values))[2]["passed"] is False
    verdict = judge_hypothesis(contest(values), no_rivals=["adaptive", "adaptive_mean"])[2]
    assert verdict["passed"] is True
    assert verdict["margin"] == pytest.approx(0.1)
    assert "hdr_mosaic" in verdict["measured"]


def test_hypothesis_is_not_judged_without_a_steady_phase() -> None:
    verdicts = judge_hypothesis(contest({"adaptive": (1, 1, 1), "random": (1, 1, 2)}, phase="merging"))
    assert [v["passed"] for v in verdicts] == [None, None, None]
    assert all("not measured" in v["measured"] for v in verdicts)
