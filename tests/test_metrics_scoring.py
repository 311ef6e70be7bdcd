"""Oracle mask, mask agreement, the score board, pairs and the registered claims."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from optsim import metrics
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Reconstruction
from optsim.metrics import (
    TRUTH_NOISE,
    FrameTally,
    LogRmse,
    MaskTally,
    PairRecord,
    PhotometricScale,
    Psnr,
    Pu21Psnr,
    ScoreBoard,
    Verdict,
    judge_claims,
    mask_agreement,
    measured,
    oracle_moving,
    pair_records,
    pixel_errors,
    pooled_mask_records,
    tally_pair,
)
from optsim.metrics.claims import CLAIMS
from optsim.metrics.pairs import PixelErrors, advantage

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
    with pytest.raises(ValueCheckError, match="half differences"):
        oracle_moving(still(), still(), 0.0, (still(),))


def rendered(rng: np.random.Generator, keys: int, sigma: float, change: float = 0.0) -> tuple[Any, Any]:
    """Mean of two halves of a still truth that is interpolated between noisy key poses, and (A - B) / 2."""
    halves = 1 + sigma * np.sqrt(2) * rng.normal(size=(2, keys, 60, 80))
    at = np.linspace(0, keys - 1, 72)
    before = np.minimum(at.astype(int), keys - 2)
    share = (at - before)[:, None, None]
    a, b = ((1 - share) * half[before] + share * half[before + 1] for half in halves)
    a[36:], b[36:] = a[36:] + change, b[36:] + change
    return ((a + b) / 2).astype(np.float32), ((a - b) / 2).astype(np.float32)


@pytest.mark.parametrize("keys", [2, 3, 9, 72])
def test_noise_of_the_truth_is_no_motion(keys: int) -> None:
    """At most one pixel in 1000; 4 standard deviations of that count more occur once in 30 000 tests."""
    rng, marked = np.random.default_rng(keys), 0
    for _ in range(10):
        light, half = rendered(rng, keys, sigma=0.1)
        marked += np.count_nonzero(oracle_moving(light[36:], light[:36], 0.0, (half[36:], half[:36])))
        # Its range alone would pass for motion nearly everywhere.
        assert oracle_moving(light[36:], light[:36], 0.0).mean() > 0.8
    assert marked <= 48 + 4 * np.sqrt(48)


@pytest.mark.parametrize("keys", [2, 9, 72])
def test_motion_beyond_the_noise_of_the_truth_is_found(keys: int) -> None:
    light, half = rendered(np.random.default_rng(keys), keys, sigma=0.01, change=0.15)
    assert oracle_moving(light[36:], light[:36], 0.0, (half[36:], half[:36])).mean() > 0.99


def test_motion_beside_noise_is_found_where_there_is_none() -> None:
    """The running sum of a box filter ends below 0 there."""
    light, half = np.ones((2, 72, 40, 90), np.float32)
    half[:] = np.random.default_rng(0).normal(0, 1, half.shape) * np.where(np.arange(90) < 20, 1e3, 1e-6)
    light[36:, :, 50:] += np.float32(0.5)
    found = oracle_moving(light[36:], light[:36], 0.0, (half[36:], half[:36]))
    assert found[:, 50:].all()
    assert not found[:, 30:50].any()


def test_a_truth_without_noise_is_judged_as_footage_is() -> None:
    frame, none = still(), np.zeros((SLOTS, ROWS, COLS), np.float32)
    frame[2, 3, 4] += 0.0215
    assert (oracle_moving(frame, None, 0.0, (none,)) == oracle_moving(frame, None, 0.0)).all()


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
    assert warm_up.as_json() == {
        "method": "a",
        "phase": "warm-up",
        "moves": 8 / 40,
        "marked": 1.0,
        "precision": 8 / 40,
        "recall": 1.0,
        "iou": 8 / 40,
    }
    # 7 hits of 9 marked and of 17 that move; means of the frames' shares would be 7/8, 7/12 and 8/15.
    assert (merging.moves, merging.marked) == (17 / 120, 9 / 120)
    assert (merging.precision, merging.recall, merging.iou) == (7 / 9, 7 / 17, 7 / 19)
    assert (steady.moves, steady.marked) == (0, 0)
    assert steady.precision is steady.recall is steady.iou is None
    # Marked where nothing moves, and the other way round: one of the shares has a meaning.
    (alarm,) = pooled_mask_records([MaskTally("a", 9, mask_agreement(one, still))], latency_frames=1)
    assert (alarm.precision, alarm.recall, alarm.iou) == (0, None, 0)
    (missed,) = pooled_mask_records([MaskTally("a", 9, mask_agreement(still, one))], latency_frames=1)
    assert (missed.precision, missed.recall, missed.iou) == (None, 0, 0)
    assert pooled_mask_records([], latency_frames=1) == []


# --- score board ----------------------------------------------------------------------------------


def board(coded_slots: int = SLOTS, latency: int = 1) -> ScoreBoard:
    return ScoreBoard(metrics.SAMPLE_METRICS, SCALE, latency, coded_slots)


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
    found = {(r.metric, r.region, r.phase): r for r in b.records(tallies(b, 7))}
    assert len(found) == 6 * 3 * 3
    for phase, indices in (("warm-up", (0, 1)), ("merging", (2, 3, 4)), ("steady", (5, 6))):
        frames = [frame(i) for i in indices]
        estimate = SCALE.luminance_cd_m2(np.concatenate([f[0].irradiance_w_m2 for f in frames]))
        reference = SCALE.luminance_cd_m2(np.concatenate([f[1] for f in frames]))
        moving, valid = frames[0][2], frames[0][0].valid
        for region, where in (("moving", moving & valid), ("static", ~moving & valid), ("all", valid)):
            for metric in metrics.SAMPLE_METRICS:
                total, n = metric.sum_errors(estimate, reference, where, SCALE.white_cd_m2)
                record = found[metric.name, region, phase]
                assert record.n == n == len(indices) * SLOTS * np.count_nonzero(where)
                assert record.value == pytest.approx(metric.finish(total, n), rel=1e-12)


def test_a_score_has_the_interval_of_its_frames_by_student() -> None:
    """By scipy, from the scores of the frames one by one, about the pooled score."""
    b = board()
    merging = {(r.metric, r.region): r for r in b.records(tallies(b, 7)) if r.phase == "merging"}
    alone = [{(r.metric, r.region): r for r in b.records([b.tally("m", *frame(i))])} for i in (2, 3, 4)]
    for key, pooled in merging.items():
        values = [each[key].value for each in alone]
        half = stats.t.ppf(0.975, 2) * stats.sem(values)
        assert (pooled.low, pooled.high) == pytest.approx((pooled.value - half, pooled.value + half))
        assert (alone[0][key].low, alone[0][key].high) == (None, None)


def test_the_order_of_frames_changes_nothing_at_all() -> None:
    b = board()
    forward = tallies(b, 8)
    shuffled = [forward[i] for i in np.random.default_rng(5).permutation(8)]
    key = lambda r: (r.phase, r.metric, r.region)  # noqa: E731
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
    coverage = {c.region: c for c in b.coverage([b.tally("m", reconstruction, reference, moving)])}
    assert coverage["all"].valid == pytest.approx(3 / 4 * 5 / 6)
    assert coverage["all"].interpolated == pytest.approx(2 / 40)
    assert coverage["static"].interpolated == 0
    assert coverage["moving"].interpolated == pytest.approx(2 / 15)
    assert len(b.slot_series([b.tally("m", reconstruction, reference, moving)], "warm-up")[0].x) == 3


def test_identical_and_empty_are_flagged_and_json_holds_no_infinity() -> None:
    b = board()
    _, reference, moving = frame(0)
    everywhere = np.ones((ROWS, COLS), bool)
    same = Reconstruction(0, reference, everywhere, ~everywhere, moving)
    nothing = Reconstruction(0, reference, ~everywhere, ~everywhere, moving)
    for reconstruction, flag in ((same, "identical"), (nothing, "empty")):
        records = b.records([b.tally("m", reconstruction, reference, moving)])
        assert {r.flag for r in records} == {flag}
        values = {r.metric: r.value for r in records}
        assert values[Pu21Psnr().name] is None
        assert values[Psnr().name] is None
        assert values[LogRmse().name] == (0.0 if flag == "identical" else None)
        json.dumps([r.as_json() for r in records], allow_nan=False)
    tally = b.tally("m", nothing, reference, moving)
    rows = [*b.coverage([tally]), *b.frame_series([tally]), *b.slot_series([tally])]
    json.dumps([r.as_json() for r in rows], allow_nan=False)


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
    by_frame = next(s for s in b.frame_series(found) if s.unit == "stops" and s.region == "all")
    by_slot = next(s for s in b.slot_series(found) if s.unit == "stops" and s.region == "all")
    assert by_frame.x == list(range(8))
    assert int(np.argmax(by_frame.values)) == 6
    assert int(np.argmax(by_slot.values)) == 2
    assert by_slot.values[2] > 5 * by_slot.values[1]


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
    shares = {s.metric: s.clamped_share for s in b.records([b.tally("m", r, reference, ~everywhere)])[::3]}
    assert shares[Pu21Psnr().name] == pytest.approx(5 / 6)
    assert shares[Psnr().name] == shares[LogRmse().name] == 0.0


def test_noise_ceiling_is_the_variance_of_the_half_difference() -> None:
    b = board()
    _, reference, moving = frame(0)
    half = np.random.default_rng(9).normal(0, 1e-4, reference.shape).astype(np.float32)
    records = b.records([b.tally_noise(0, reference, half, moving)])
    assert {r.method for r in records} == {TRUTH_NOISE}
    white = SCALE.white_w_m2_sr * SCALE.irradiance_per_radiance
    for region, where in (("moving", moving), ("static", ~moving)):
        value = next(r.value for r in records if r.metric == Psnr().name and r.region == region)
        expected = -10 * math.log10(np.mean(half[:, where].astype(float) ** 2) / white**2)
        assert value == pytest.approx(expected, abs=0.01)  # float32 light: 1e-7 of 1e-2 against 1e-4


# --- pairs and claims ----------------------------------------------------------------------------


def test_a_pair_is_scored_on_its_own_pixels_window_and_room_apart() -> None:
    """Errors of 1 and 2 PU21 steps; what one of both gives up counts beside, not in the pair."""
    metric = Pu21Psnr()
    valid = np.ones((2, 4), bool)
    gives_up = valid.copy()
    gives_up[0, 0] = False
    window = np.zeros((2, 4), bool)
    window[1] = True
    moving = np.zeros((2, 4), bool)
    moving[:, :2] = True
    ours, theirs = np.full((1, 2, 4), 36.0), np.full((1, 2, 4), 36.0 * 4)
    ours[0, 0, 0] = 1e6  # where the rival holds nothing
    theirs[0, 1] = 36.0
    tally = tally_pair("random", 5, PixelErrors(ours, valid), PixelErrors(theirs, gives_up), moving, window)
    found = {(r.area, r.region): r for r in pair_records([metric], [tally], 36, latency_frames=1)}
    room, outside = found["room", "moving"], found["window", "moving"]
    assert room.ours == pytest.approx(20 * math.log10(256))
    assert advantage(room) == pytest.approx(20 * math.log10(2))
    assert room.excluded == pytest.approx(1 / 2)
    assert room.ours_of_all == pytest.approx(10 * math.log10(256**2 / ((1e6 + 36) / 72)))
    assert advantage(outside) == pytest.approx(0)
    assert outside.excluded == 0
    assert found["room", "all"].excluded == pytest.approx(1 / 4)
    early = replace(tally, index=4)
    assert pair_records([metric], [early], 36, latency_frames=1) == []


def test_pixel_errors_add_up_to_the_scores() -> None:
    b = board()
    reconstruction, reference, moving = frame(0)
    tally = b.tally("x", reconstruction, reference, moving)
    errors = pixel_errors(
        b.metrics, SCALE, reconstruction.irradiance_w_m2, reference, reconstruction.valid, SLOTS
    )
    for r, region in enumerate((moving, ~moving)):
        where = region & reconstruction.valid
        assert errors.sums[:, where].sum(axis=1) == pytest.approx(tally.sums[:, r].sum(axis=1), rel=1e-5)


def draws(*advantages: float, rival: str = "random", claim: int = 0, area: str = "room") -> list[list[Any]]:
    """Runs in which the adaptive method is ahead of a rival by so much, in the metric of a claim."""
    of = CLAIMS[claim]
    return [
        [
            PairRecord(
                rival=rival,
                metric=of.metric,
                unit=of.unit,
                higher_is_better=of.unit == "dB",
                area=area,
                region=of.region,
                ours=20.0 + (value if of.unit == "dB" else -value),
                theirs=20.0,
                excluded=0.1,
                ours_of_all=19.0,
                theirs_of_all=18.0,
            )
        ]
        for value in advantages
    ]


SPREAD = np.array([-1.0, -0.5, 0.5, 1.0, -1.2, 1.2])  # mean 0, SD 1.0392


@pytest.mark.parametrize(
    ("mean", "sd", "verdict"),
    [(0.0, 0.1, "holds"), (-0.29, 0.1, "undecided"), (-0.25, 0.04, "holds"), (-0.5, 0.1, "fails")],
)
def test_a_claim_is_judged_by_its_interval(mean: float, sd: float, verdict: str) -> None:
    values = mean + sd * SPREAD / SPREAD.std(ddof=1)
    found = judge_claims(draws(*values))[0]
    assert found.verdict == verdict
    half = 2.570582 * sd / math.sqrt(6)  # Student's t, 5 degrees of freedom, 97.5 %
    assert found.advantage == pytest.approx(mean)
    assert (found.low, found.high) == (pytest.approx(mean - half), pytest.approx(mean + half))
    assert found.advantage_of_all == pytest.approx(1.0)
    assert f"{mean:+.2f} dB over random" in measured(found)


def test_fewer_than_six_draws_are_too_few_with_their_finding() -> None:
    few = judge_claims(draws(3.0, 3.1, 3.0, 3.1, 3.0))[0]
    assert (few.verdict, few.superior) == ("holds", "holds")
    assert few.said == "too few draws (5 of 6): holds, superior"
    night = judge_claims(draws(-4.05, -4.08, -3.68, -2.68))[0]
    assert night.said == "too few draws (4 of 6): fails"
    theirs = stats.ttest_1samp([-4.05, -4.08, -3.68, -2.68], 0).confidence_interval(0.95)
    assert (night.low, night.high) == pytest.approx((theirs.low, theirs.high))
    alone = judge_claims(draws(3.0))[0]
    assert (alone.said, alone.low, alone.draws) == (
        "too few draws (1 of 6): undecided at these seeds",
        None,
        1,
    )
    assert "one draw" in measured(alone)
    nothing = judge_claims([[]])
    assert [v.verdict for v in nothing] == ["undecided"] * 3
    assert all("not measured" in measured(v) for v in nothing)


@pytest.mark.parametrize(
    ("mean", "said"),
    [
        (0.2, "holds, superior"),
        (-0.02, "holds, superiority undecided"),
        (-0.15, "holds, not superior"),
        (-0.3, "undecided at these seeds, not superior"),
        (-0.5, "fails"),
    ],
)
def test_superior_and_not_inferior_are_both_said(mean: float, said: str) -> None:
    values = mean + 0.1 * SPREAD / SPREAD.std(ddof=1)
    assert judge_claims(draws(*values))[0].said == said


@pytest.mark.parametrize("claim", [0, 1, 2])
def test_each_claim_is_against_the_best_of_all_rivals_with_a_correction(claim: int) -> None:
    unit = CLAIMS[claim].margin

    def judged(near: float, far: float, sd: float) -> Verdict:
        jitter = unit * sd * SPREAD / SPREAD.std(ddof=1)
        both = zip(
            draws(*(unit * near + jitter), claim=claim, rival="normal"),
            draws(*(unit * far + jitter), claim=claim, rival="hdr_mosaic"),
            strict=True,
        )
        return judge_claims([[*a, *b] for a, b in both])[claim]

    assert judged(10, 20, 0.1).rival == "normal"
    assert judged(-0.5, 20, 0.1).verdict == "holds"  # a tie
    assert judged(-2, 20, 0.1).verdict == "fails"
    assert judged(0, 20, 5).verdict == "undecided"
    # Bonferroni: for two rivals Student's t of 98.75 % at 5 degrees of freedom, 3.163381.
    found = judged(10, 20, 1)
    assert found.low == pytest.approx(unit * (10 - 3.163381 / math.sqrt(6)))
    assert found.rivals == 2
    assert "6 draws, 95 % for 2 rivals together (Bonferroni))" in measured(found)


@pytest.mark.parametrize(("near", "said", "rival"), [(0, "undecided", "normal"), (-1, "fails", "random")])
def test_the_rival_that_decides_is_named(near: float, said: str, rival: str) -> None:
    """One is close in all draws; the other is further behind on average, but may be ahead."""
    jitter = SPREAD / SPREAD.std(ddof=1)
    both = zip(
        draws(*(near + 0.01 * jitter), rival="random"),
        draws(*(near + 0.5 + 2 * jitter), rival="normal"),
        strict=True,
    )
    found = judge_claims([[*a, *b] for a, b in both])[0]
    assert (found.verdict, found.rival) == (said, rival)


def test_window_and_room_are_judged_apart() -> None:
    room, window = draws(*(0.1 * SPREAD)), draws(*(-2 + 0.1 * SPREAD), area="window")
    found = judge_claims([[*a, *b] for a, b in zip(room, window, strict=True)])
    # The other claims were not measured, in either area.
    expected = [("room", "holds"), ("window", "fails"), ("room", "undecided"), ("room", "undecided")]
    assert [(v.area, v.verdict) for v in found] == expected


def test_the_adaptive_scheme_need_not_beat_itself_under_another_decoder() -> None:
    rival = draws(*(-1 + 0.001 * SPREAD), claim=2, rival="adaptive_mean")
    assert judge_claims(rival)[2].verdict == "fails"
    assert judge_claims(rival, no_rivals=["adaptive_mean"])[2].advantage is None
