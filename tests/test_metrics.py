"""Every metric against closed forms, published numbers and the contract that all of them share."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from pydantic import ValidationError
from skimage.metrics import peak_signal_noise_ratio

from optsim import metrics
from optsim.core.errors import ValueCheckError
from optsim.metrics import (
    LogRmse,
    Metric,
    MuLawPsnr,
    PhotometricScale,
    Psnr,
    Pu21Psnr,
    RelMse,
    Smape,
    luminous_efficacy_lm_w,
)
from optsim.metrics.pu21 import pu21_decode, pu21_encode

WHITE = 340.0
EACH = pytest.mark.parametrize("metric", metrics.SAMPLE_METRICS, ids=lambda m: m.kind)


def scene(seed: int = 0, shape: tuple[int, int, int] = (4, 12, 15)) -> np.ndarray:
    """Luminances over four decades, inside PU21's range."""
    return np.random.default_rng(seed).lognormal(3.0, 1.5, shape).clip(0.02, 8000).astype(np.float32)


def noisy(truth: np.ndarray, sigma: float, seed: int = 1) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=truth.shape)
    return (truth * np.exp(sigma * noise)).astype(np.float32)


def score(
    metric: Metric, estimate: np.ndarray, truth: np.ndarray, where: np.ndarray | None = None
) -> float | None:
    mask = np.ones(truth.shape[1:], bool) if where is None else where
    return metric.finish(*metric.sum_errors(estimate, truth, mask, WHITE))


# --- contract -------------------------------------------------------------------------------------


def test_names_are_unique_and_hold_every_parameter() -> None:
    assert len({m.name for m in metrics.ALL}) == len(metrics.ALL)
    names = [m.name for m in metrics.SAMPLE_METRICS]
    assert names == [
        "PU21-PSNR[banding_glare, peak=256]",
        "log-RMSE[e=0.01 cd/m2] (stops)",
        "PSNR[peak=white]",
        "mu-law-PSNR[mu=5000, H=L/white, peak=1]",
        "relMSE[e=1 cd/m2]",
        "SMAPE[e=0.01 cd/m2]",
    ]
    assert LogRmse(e_cd_m2=0.5).name != LogRmse().name


@EACH
def test_identical_is_a_finite_number_or_none(metric: Metric) -> None:
    value = score(metric, scene(), scene())
    assert value is None if metric.higher_is_better else value == 0.0


@EACH
def test_nothing_compared_is_none(metric: Metric) -> None:
    truth = scene()
    assert metric.sum_errors(truth, truth, np.zeros(truth.shape[1:], bool), WHITE) == (0.0, 0)
    assert metric.finish(0.0, 0) is None


@EACH
def test_more_noise_is_a_worse_score(metric: Metric) -> None:
    truth = scene()
    values = [score(metric, noisy(truth, sigma), truth) for sigma in (0.01, 0.03, 0.1, 0.3)]
    assert None not in values
    assert values == sorted(values, reverse=metric.higher_is_better)
    assert abs(values[0] / values[1] - 1) > 0.1, "and visibly so"


@EACH
def test_streaming_equals_batch(metric: Metric) -> None:
    truth, where = scene(), np.random.default_rng(3).random((4, 12, 15)) < 0.4
    estimate = noisy(truth, 0.1)
    total, count = metric.sum_errors(estimate, truth, where, WHITE)
    parts = [metric.sum_errors(estimate[s : s + 1], truth[s : s + 1], where[s], WHITE) for s in range(4)]
    assert count == sum(n for _, n in parts) == np.count_nonzero(where)
    # one float64 sum split in four: rounding only
    assert math.fsum(t for t, _ in parts) == pytest.approx(total, rel=1e-13)


@EACH
def test_regions_add_up_and_samples_outside_do_not_matter(metric: Metric) -> None:
    truth = scene()
    estimate, where = noisy(truth, 0.1), np.random.default_rng(4).random((12, 15)) < 0.3
    inside, outside = (metric.sum_errors(estimate, truth, m, WHITE) for m in (where, ~where))
    total = metric.sum_errors(estimate, truth, np.ones((12, 15), bool), WHITE)
    assert inside[1] + outside[1] == total[1]
    assert inside[0] + outside[0] == pytest.approx(total[0], rel=1e-13)
    spoiled = estimate.copy()
    spoiled[:, ~where] *= 7
    assert metric.sum_errors(spoiled, truth, where, WHITE) == inside


@EACH
@pytest.mark.parametrize("which", ["estimate", "reference"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite_is_an_error_with_its_place(metric: Metric, which: str, bad: float) -> None:
    arrays = {"estimate": scene(1), "reference": scene(2)}
    arrays[which][2, 5, 7] = bad
    nowhere = np.zeros((12, 15), bool)  # also outside the mask
    with pytest.raises(ValueCheckError, match=rf"{which}.*not finite.*\(2, 5, 7\)"):
        metric.sum_errors(arrays["estimate"], arrays["reference"], nowhere, WHITE)


@EACH
def test_other_sizes_are_an_error(metric: Metric) -> None:
    truth = scene()
    with pytest.raises(ValueCheckError, match="not of one size"):
        metric.sum_errors(truth[:, :, :14], truth, np.ones((12, 15), bool), WHITE)
    with pytest.raises(ValueCheckError, match="not of one size"):
        metric.sum_errors(truth, truth, np.ones((15, 12), bool), WHITE)
    with pytest.raises(ValueCheckError, match="float64"):
        metric.sum_errors(truth.astype(np.float64), truth, np.ones((12, 15), bool), WHITE)


# --- one metric at a time -------------------------------------------------------------------------


def test_psnr_is_that_of_scikit_image_with_the_same_stated_range() -> None:
    truth = scene()
    estimate = noisy(truth, 0.2)
    theirs = peak_signal_noise_ratio(truth.astype(np.float64), estimate.astype(np.float64), data_range=WHITE)
    assert score(Psnr(), estimate, truth) == pytest.approx(theirs, abs=1e-9)
    assert score(Psnr(), estimate, truth) != pytest.approx(
        peak_signal_noise_ratio(truth, estimate, data_range=float(truth.max())), abs=1
    ), "the peak is the stated white, not the maximum found"


def test_psnr_keeps_its_value_when_scene_and_white_scale_together() -> None:
    truth = scene()
    estimate, everywhere = noisy(truth, 0.1), np.ones((12, 15), bool)
    psnr = Psnr()
    plain = psnr.finish(*psnr.sum_errors(estimate, truth, everywhere, WHITE))
    scaled = psnr.finish(*psnr.sum_errors(4 * estimate, 4 * truth, everywhere, 4 * WHITE))
    assert scaled == pytest.approx(plain, abs=1e-9)
    # four times the peak on the same light: 20 log10 4 more
    higher = psnr.finish(*psnr.sum_errors(estimate, truth, everywhere, 4 * WHITE))
    assert higher - plain == pytest.approx(20 * math.log10(4), abs=1e-9)


def test_negative_reference_light_counts_in_the_linear_error() -> None:
    truth = np.full((1, 1, 2), -1.0, np.float32)
    total, count = Psnr().sum_errors(np.zeros_like(truth), truth, np.ones((1, 2), bool), 2.0)
    assert (total, count) == (0.5, 2)


# Values stated to four decimals: https://github.com/gfxdisp/pu21, banding_glare, as measured on its equation.
GOLDEN = {
    0.1: 5.7171,
    1: 36.5439,
    10: 123.6475,
    100: 256.3839,
    1000: 420.0969,
    4000: 527.4939,
    10000: 595.3939,
}


@pytest.mark.parametrize(("luminance", "encoded"), GOLDEN.items())
def test_pu21_golden_values(luminance: float, encoded: float) -> None:
    assert float(pu21_encode(luminance)) == pytest.approx(encoded, abs=6e-5)
    assert float(pu21_decode(pu21_encode(luminance))) == pytest.approx(luminance, rel=1e-11)


def test_pu21_clamps_where_it_says() -> None:
    assert float(pu21_encode(0.0)) == float(pu21_encode(-3.0)) == float(pu21_encode(0.005))
    assert float(pu21_encode(0.005)) == pytest.approx(0.0, abs=1e-6)
    assert float(pu21_encode(1e6)) == float(pu21_encode(1e4))
    steps = pu21_encode(np.geomspace(0.005, 1e4, 500))
    assert (np.diff(steps) > 0).all()
    assert Pu21Psnr().clamped(np.array([0.0, 0.006, 50.0, 9999.0, 10001.0])) == 2
    assert Psnr().clamped(np.array([0.0, 1e9])) == LogRmse().clamped(np.array([0.0, 1e9])) == 0


def test_pu21_psnr_by_hand() -> None:
    truth, estimate = np.full((1, 1, 1), 100, np.float32), np.full((1, 1, 1), 10, np.float32)
    by_hand = 20 * math.log10(256 / (256.3839 - 123.6475))
    assert score(Pu21Psnr(), estimate, truth) == pytest.approx(by_hand, abs=1e-5)
    # the encoding needs absolute light: the same ratio a thousand times darker is another score
    darker = score(Pu21Psnr(), estimate / 1000, truth / 1000)
    assert darker - by_hand > 10
    # Half of the pixels right: half of the squared error, a mean over all that is compared.
    right = np.repeat(truth, 6, axis=2)
    half = np.where(np.arange(6) < 3, right, 10).astype(np.float32)
    assert score(Pu21Psnr(), half, right) == pytest.approx(by_hand + 10 * math.log10(2), abs=1e-5)


def test_log_error_is_in_stops_and_knows_no_scale_above_its_offset() -> None:
    truth = scene() + 10
    for stops in (-2.0, 0.5, 1.0):
        value = score(LogRmse(), (truth * 2**stops).astype(np.float32), truth)
        assert value == pytest.approx(abs(stops), rel=2e-3)  # e / L <= 0.001 of a stop
    dim, black = np.full((1, 1, 1), 0.01, np.float32), np.zeros((1, 1, 1), np.float32)
    assert score(LogRmse(), dim, black) == pytest.approx(1.0, abs=1e-6), "e alone against 2 e"
    assert score(LogRmse(), -dim, black) == 0.0, "below zero counts as zero"


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan])
def test_log_error_needs_a_positive_offset(bad: float) -> None:
    with pytest.raises(ValidationError):
        LogRmse(e_cd_m2=bad)


def test_mu_law_psnr_is_that_of_scikit_image_behind_the_curve() -> None:
    truth = scene()
    estimate = noisy(truth, 0.2)
    curve = [
        np.log(1 + 5000 * light.astype(np.float64) / WHITE) / np.log(5001) for light in (truth, estimate)
    ]
    assert score(MuLawPsnr(), estimate, truth) == pytest.approx(
        peak_signal_noise_ratio(*curve, data_range=1), abs=1e-6
    )
    assert float(MuLawPsnr().encode(np.array(WHITE), WHITE)) == pytest.approx(1.0)
    black = np.zeros((1, 1, 1), np.float32)
    assert score(MuLawPsnr(), black - 5, black) is None, "below zero counts as zero"


def test_relative_errors_by_hand() -> None:
    truth = np.array([[[10.0, 0.0, 2.0]]], np.float32)
    estimate = np.array([[[12.0, 3.0, 2.0]]], np.float32)
    assert score(RelMse(), estimate, truth) == pytest.approx((4 / 101 + 9 / 1 + 0) / 3)
    assert score(Smape(e_cd_m2=1), estimate, truth) == pytest.approx((2 / 23 + 3 / 4 + 0) / 3)
    # Any error at all: a sample of the symmetric one never counts more than 1.
    assert score(Smape(), 1e6 * estimate, truth) < 1 < score(RelMse(), 1e6 * estimate, truth)


# --- photometric scale ----------------------------------------------------------------------------


def test_photometric_scale() -> None:
    # CIE 1924 photopic V(550 nm) = 0.995 in its printed table of three decimals
    assert luminous_efficacy_lm_w() == pytest.approx(683 * 0.995, rel=5e-4)
    scale = PhotometricScale(white_w_m2_sr=0.1, irradiance_per_radiance=0.005)
    assert scale.white_cd_m2 == pytest.approx(68, abs=0.1)  # the ledger's anchor: 0.1 W m^-2 sr^-1
    irradiance = np.array([[0.0005, 0.0]], np.float32)
    luminance = scale.luminance_cd_m2(irradiance)
    assert luminance.dtype == np.float32
    assert luminance[0].tolist() == pytest.approx([scale.white_cd_m2, 0.0], rel=1e-6)
    with pytest.raises(ValidationError):
        PhotometricScale(white_w_m2_sr=0.0, irradiance_per_radiance=1.0)


# --- validation -----------------------------------------------------------------------------------


def load_check(effect: str) -> ModuleType:
    path = Path(__file__).parents[1] / "validation" / effect / "check.py"
    spec = importlib.util.spec_from_file_location(f"check_{effect}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_metric_is_scored_by_another_program_too() -> None:
    program = (Path(__file__).parents[1] / "validation" / "scores" / "reference.py").read_text()
    assert [m.kind for m in metrics.ALL if f'"{m.kind}": ' not in program] == []


def test_pu21_validation_holds_and_can_fail() -> None:
    check = load_check("pu21")
    assert abs(check.measure()) <= check.TOLERANCE < abs(check.perturbed())
    assert {"CLAIM", "ORACLE", "SOURCE", "FILES"} <= set(vars(check))
