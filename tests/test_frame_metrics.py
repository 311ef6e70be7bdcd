"""Metrics of whole coded frames against other implementations and closed forms; classes, series, time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from optsim import metrics
from optsim.core.errors import ValueCheckError
from optsim.core.quantities import Reconstruction
from optsim.metrics import (
    CLASSES,
    AfterGainPsnr,
    FrameDifferencePsnr,
    FrameEstimate,
    FrameMetric,
    FrameReference,
    PhotometricScale,
    Pu21MsSsim,
    Pu21Psnr,
    Pu21Ssim,
    ScoreBoard,
    class_masks,
    class_series,
    pixel_errors,
    tally_classes,
    temporal_records,
)
from optsim.metrics.class_scores import VALID
from optsim.metrics.ms_ssim import _WEIGHTS, ms_ssim
from optsim.metrics.pu21 import pu21_decode, pu21_encode
from optsim.metrics.tolerances import READING, TOLERANCES, short_name, tolerance_of

ROWS, COLS, SLOTS = 60, 72, 8
EACH = pytest.mark.parametrize("metric", metrics.FRAME_METRICS, ids=lambda m: m.kind)


def light(seed: int = 0) -> np.ndarray:
    """Luminance of a textured picture that moves a little from slot to slot."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[0:ROWS, 0:COLS]
    slots = [60 + 40 * np.sin((u + slot) / 5) * np.cos(v / 7) for slot in range(SLOTS)]
    return (np.array(slots) + rng.uniform(0, 5, (ROWS, COLS))).astype(np.float32)


def noisy(truth: np.ndarray, sigma: float) -> np.ndarray:
    noise = np.random.default_rng(1).normal(size=truth.shape)
    return (truth * np.exp(sigma * noise)).astype(np.float32)


def moving() -> np.ndarray:
    mask = np.zeros((ROWS, COLS), bool)
    mask[20:40, 10:30] = True
    return mask


def frame(estimate: np.ndarray, truth: np.ndarray, scored: np.ndarray | None = None) -> FrameEstimate:
    everywhere = np.ones((ROWS, COLS), bool)
    reference = FrameReference(truth, class_masks(truth, moving()))
    return FrameEstimate(reference, estimate, everywhere if scored is None else scored)


# --- contract -------------------------------------------------------------------------------------


@EACH
def test_more_noise_is_a_worse_score_in_every_class(metric: FrameMetric) -> None:
    truth = light()
    found = [metric.measure(frame(noisy(truth, sigma), truth)) for sigma in (0.01, 0.05, 0.2)]
    for name in CLASSES:
        values = [each[name] for each in found]
        if None in values:
            assert isinstance(metric, Pu21MsSsim)
            assert name != "all"
        else:
            assert values == sorted(values, reverse=metric.higher_is_better)


@EACH
def test_pixels_that_are_not_scored_change_nothing(metric: FrameMetric) -> None:
    truth, scored = light(), np.ones((ROWS, COLS), bool)
    scored[5:15, 5:15] = False
    estimate = noisy(truth, 0.1)
    spoiled = estimate.copy()
    spoiled[:, ~scored] = 7000
    assert metric.measure(frame(spoiled, truth, scored)) == metric.measure(frame(estimate, truth, scored))
    nothing = metric.measure(frame(estimate, truth, np.zeros_like(scored)))
    assert all(nothing[name] is None for name in CLASSES) or isinstance(metric, Pu21MsSsim)


@EACH
def test_identical_is_the_best_or_none(metric: FrameMetric) -> None:
    value = metric.measure(frame(light(), light()))["all"]
    assert value is None or value == pytest.approx(1.0)


def test_other_sizes_are_an_error() -> None:
    with pytest.raises(ValueCheckError, match="not of one size"):
        frame(light()[1:], light())


def test_names_hold_parameters_and_tolerances_are_of_metrics() -> None:
    assert all("[" in metric.name for metric in metrics.ALL)
    scores = {name for name in TOLERANCES if not name.startswith(READING)}
    assert scores <= {*(short_name(metric.name) for metric in metrics.ALL), VALID}
    assert tolerance_of(Pu21Psnr().name) == 0.1
    assert tolerance_of(metrics.Psnr().name) is None
    assert tolerance_of("time: capture") > 1


# --- one metric at a time -------------------------------------------------------------------------


def wave() -> np.ndarray:
    v, u = np.mgrid[0:96, 0:120]
    return 128 + 60 * np.sin(u / 7) * np.cos(v / 5) + 30 * np.sin(u * v / 400)


def distorted(kind: str) -> np.ndarray:
    v, u = np.mgrid[0:96, 0:120]
    return {
        "ripple": wave() + 12 * np.sin(u * 1.7 + v * 0.9),
        "dim": 0.8 * wave() + 20,
        "drift": wave() + 25 * np.sin(u / 30),
    }[kind]


# MS-SSIM of three scales and SSIM by sewar 0.4.10 (window 11, sigma 1.5, range 256). It halves pictures
# between other pairs of rows: 1e-4.
SEWAR = {
    "ripple": (0.9728701679258749, 0.8104276829542367),
    "dim": (0.9767904820435228, 0.9792566566128912),
    "drift": (0.9917957956680094, 0.988361298384302),
}


@pytest.mark.parametrize("kind", SEWAR)
def test_ms_ssim_is_that_of_sewar(kind: str) -> None:
    assert ms_ssim(wave(), distorted(kind), _WEIGHTS) == pytest.approx(SEWAR[kind][0], abs=1.2e-4)


@pytest.mark.parametrize("kind", SEWAR)
def test_ssim_is_that_of_sewar_within_the_window(kind: str) -> None:
    """Luminance made from PU21 values; sewar leaves out windows that reach beyond the picture."""
    truth, estimate = (pu21_decode(each)[None].astype(np.float32) for each in (wave(), distorted(kind)))
    inner = np.zeros(truth.shape[1:], bool)
    inner[5:-5, 5:-5] = True
    whole = np.ones_like(inner)
    everything = FrameEstimate(FrameReference(truth, {"all": inner}), estimate, whole)
    # Float32 luminance: 1e-6.
    assert Pu21Ssim().measure(everything)["all"] == pytest.approx(SEWAR[kind][1], abs=1e-5)


def test_ssim_of_a_class_is_the_mean_of_the_map_there() -> None:
    truth = light()
    estimate = noisy(truth, 0.1)
    _, values = structural_similarity(
        pu21_encode(truth[4]),
        pu21_encode(estimate[4]),
        data_range=256,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    one = FrameReference(truth[4:5], class_masks(truth[4:5], moving()))
    found = Pu21Ssim().measure(FrameEstimate(one, estimate[4:5], np.ones((ROWS, COLS), bool)))
    assert found["moving"] == pytest.approx(values[moving()].mean(), abs=1e-9)


def test_small_pictures_have_no_structure() -> None:
    truth = light()[:, :10, :10]
    tiny = FrameEstimate(
        FrameReference(truth, {"all": np.ones((10, 10), bool)}), truth, np.ones((10, 10), bool)
    )
    assert Pu21Ssim().measure(tiny) == Pu21MsSsim().measure(tiny) == {"all": None}


def test_difference_psnr_is_that_of_scikit_image_and_blind_to_a_constant() -> None:
    truth = light()
    estimate = noisy(truth, 0.1)
    theirs = peak_signal_noise_ratio(
        *(np.diff(pu21_encode(each), axis=0) for each in (truth, estimate)), data_range=256
    )
    assert FrameDifferencePsnr().measure(frame(estimate, truth))["all"] == pytest.approx(theirs, abs=1e-9)
    lifted = pu21_decode(pu21_encode(truth) + 5).astype(np.float32)
    assert FrameDifferencePsnr().measure(frame(lifted, truth))["all"] > 100
    flicker = truth.copy()
    flicker[::2] *= 1.1
    assert FrameDifferencePsnr().measure(frame(flicker, truth))["all"] < 40


def test_one_gain_is_forgiven_and_nothing_else() -> None:
    truth = light()
    estimate = noisy(truth, 0.1)
    plain, gained = (
        AfterGainPsnr().measure(frame(each, truth))["all"] for each in (estimate, 1.4 * estimate)
    )
    assert gained == pytest.approx(plain, abs=0.01)
    half = truth.copy()
    half[:, :, : COLS // 2] *= 1.4
    assert AfterGainPsnr().measure(frame(half, truth))["all"] < 30
    # Without a level error it is PU21-PSNR.
    slots = frame(estimate, truth).reference.slots
    total = Pu21Psnr().sum_errors(estimate[slots], truth[slots], np.ones((ROWS, COLS), bool), 100.0)
    assert plain == pytest.approx(Pu21Psnr().finish(*total), abs=0.05)


# --- classes and series ---------------------------------------------------------------------------


def test_classes_split_the_picture() -> None:
    masks = class_masks(light(), moving())
    assert set(masks) == set(CLASSES)
    for parts in (("moving", "static"), ("dark", "mid", "bright")):
        assert (sum(masks[name].astype(int) for name in parts) == 1).all()
    assert masks["dark"].mean() == pytest.approx(1 / 3, abs=0.01)
    mean = light().mean(axis=0)
    assert mean[masks["dark"]].max() <= mean[masks["mid"]].min() <= mean[masks["bright"]].min()
    rim = masks["rim"]
    assert rim[18:22, 15].all()
    assert not rim[17, 15]
    assert not rim[22:38, 13:27][1:-1, 1:-1].any()
    assert not class_masks(light(), np.ones((ROWS, COLS), bool))["rim"].any(), "no rim at the picture's edge"


SCALE = PhotometricScale(white_w_m2_sr=0.5, irradiance_per_radiance=0.02)


def tallies(n: int = 3) -> list[metrics.ClassTally]:
    found = []
    for index in range(n):
        reference = (light(index) / SCALE.cd_m2_per_w_m2).astype(np.float32)
        estimate = (noisy(light(index), 0.05 * (index + 1)) / SCALE.cd_m2_per_w_m2).astype(np.float32)
        valid = np.ones((ROWS, COLS), bool)
        valid[:, : COLS // 4] = False
        errors = pixel_errors(metrics.SAMPLE_METRICS, SCALE, estimate, reference, valid, SLOTS)
        truth = SCALE.luminance_cd_m2(reference)
        one = FrameEstimate(
            FrameReference(truth, class_masks(truth, moving())), SCALE.luminance_cd_m2(estimate), valid
        )
        found.append(tally_classes("m", index, metrics.ALL, errors, one))
    return found


def test_series_of_classes_agree_with_the_board_and_state_their_share() -> None:
    series = {(s.metric, s.region): s for s in class_series(metrics.ALL, tallies())}
    assert series[VALID, "all"].values == [0.75] * 3
    assert series[VALID, "moving"].values == series[Pu21Psnr().name, "moving"].scored == [0.6] * 3
    values = series[Pu21Psnr().name, "all"].values
    assert values[0] > values[1] > values[2]
    board = ScoreBoard(metrics.SAMPLE_METRICS, SCALE, 1, SLOTS)
    reference = (light() / SCALE.cd_m2_per_w_m2).astype(np.float32)
    estimate = (noisy(light(), 0.05) / SCALE.cd_m2_per_w_m2).astype(np.float32)
    valid = np.ones((ROWS, COLS), bool)
    valid[:, : COLS // 4] = False
    r = Reconstruction(0, estimate, valid, ~valid, moving())
    theirs = {
        (s.metric, s.region): s.value for s in board.records([board.tally("m", r, reference, moving())])
    }
    for key, value in theirs.items():
        assert series[key].values[0] == pytest.approx(value, rel=1e-6)


def test_time_names_the_worst_slot() -> None:
    board = ScoreBoard(metrics.SAMPLE_METRICS, SCALE, 1, SLOTS)
    found = []
    for index in range(5, 8):
        reference = (light(index) / SCALE.cd_m2_per_w_m2).astype(np.float32)
        estimate = reference * np.float32(1.02 + 0.001 * index)
        if index == 6:
            estimate[3] *= 2
            estimate[5] *= 1.6
        everywhere = np.ones((ROWS, COLS), bool)
        r = Reconstruction(index, estimate, everywhere, ~everywhere, moving())
        found.append(board.tally("m", r, reference, moving()))
    rows = {(t.metric, t.region): t for t in temporal_records(metrics.SAMPLE_METRICS, found, 1)}
    worst = rows[Pu21Psnr().name, "all"]
    assert (worst.worst_frame, worst.worst_slot, worst.phase) == (6, 3, "steady")
    assert worst.worst < worst.worst_twentieth < worst.mean
    stops = next(t for (name, region), t in rows.items() if name.startswith("log-RMSE") and region == "all")
    assert stops.worst > stops.worst_twentieth > stops.mean
    slots = [
        metrics.SAMPLE_METRICS[1].finish(t.sums[1, :, s].sum(), t.counts[:, s].sum())
        for t in found
        for s in range(SLOTS)
    ]
    assert stops.mean == pytest.approx(np.mean(slots))
    assert stops.worst_twentieth == pytest.approx(np.quantile(slots, 0.95))


def test_scores_carry_the_interval_of_their_frames() -> None:
    board = ScoreBoard(metrics.SAMPLE_METRICS, SCALE, 1, SLOTS)
    found = []
    for index in range(5, 9):
        reference = (light(index) / SCALE.cd_m2_per_w_m2).astype(np.float32)
        everywhere = np.ones((ROWS, COLS), bool)
        estimate = (reference * np.float32(1 + 0.02 * index)).astype(np.float32)
        found.append(
            board.tally(
                "m", Reconstruction(index, estimate, everywhere, ~everywhere, moving()), reference, moving()
            )
        )
    row = next(s for s in board.records(found) if s.metric == Pu21Psnr().name and s.region == "all")
    frames = next(s for s in board.frame_series(found) if s.metric == row.metric and s.region == "all").values
    half = 3.182446 * np.std(frames, ddof=1) / math.sqrt(4)
    assert (row.low, row.high) == pytest.approx((row.value - half, row.value + half), rel=1e-6)
    alone = board.records(found[:1])[0]
    assert alone.low is None is alone.high
