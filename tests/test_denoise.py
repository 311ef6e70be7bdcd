"""Denoising for pictures: it gains, it says what it is, it keeps the raw picture, and it can be missing."""

import sys

import numpy as np
import pytest

from optsim.core.errors import ConfigError, ValueCheckError
from optsim.render.denoise import Denoised, denoised

SHAPE = (64, 96)


def scene(samples: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Truth, noisy radiance, albedo and normals: checks under smooth light, exponential noise as of paths."""
    row, col = np.indices(SHAPE)
    albedo = np.where((row // 16 + col // 16) % 2, 0.7, 0.2).astype(np.float32)
    light = 1 + 0.6 * np.sin(col / 40) + 0.3 * np.cos(row / 25)
    truth = (albedo * light).astype(np.float32)
    noise = np.random.default_rng(seed).gamma(samples, 1 / samples, SHAPE)
    normals = np.zeros((*SHAPE, 3), np.float32)
    normals[..., 2] = 1
    return truth, (truth * noise).astype(np.float32), albedo, normals


def relative_rms(image: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.mean((image / truth - 1) ** 2)))


def test_it_gains_without_a_shift() -> None:
    """Noise of 25 %: at least four times less, mean within 1 %, the checks' edges kept."""
    pytest.importorskip("mitsuba_oidn")
    truth, noisy, albedo, normals = scene(16)
    found = denoised(noisy, albedo, normals)
    assert relative_rms(noisy, truth) == pytest.approx(0.25, rel=0.05)
    assert relative_rms(found.w_m2_sr, truth) < 0.25 / 4
    assert found.w_m2_sr.mean(dtype=np.float64) == pytest.approx(truth.mean(dtype=np.float64), rel=0.01)
    edge = found.w_m2_sr[:, 15] / found.w_m2_sr[:, 16]
    assert np.median(edge / (truth[:, 15] / truth[:, 16])) == pytest.approx(1, abs=0.05)


def test_the_raw_picture_stays_and_the_other_is_labelled() -> None:
    pytest.importorskip("mitsuba_oidn")
    _, noisy, albedo, normals = scene(4)
    noisy[3, 4] = -0.01
    before = noisy.copy()
    found = denoised(noisy, albedo, normals)
    np.testing.assert_array_equal(found.raw_w_m2_sr, before)
    assert found.w_m2_sr.shape == SHAPE
    assert found.w_m2_sr.dtype == np.float32
    assert found.w_m2_sr.min() >= 0
    assert not np.shares_memory(found.w_m2_sr, found.raw_w_m2_sr)
    said = found.attributes()
    assert said["label"] == Denoised.LABEL
    assert said["label"].startswith("denoised")
    assert said["denoiser"].startswith("mitsuba-oidn")


def test_scale_is_kept_over_many_decades() -> None:
    """High dynamic range: the same picture in other units is the same picture."""
    pytest.importorskip("mitsuba_oidn")
    _, noisy, albedo, normals = scene(16)
    one = denoised(noisy, albedo, normals).w_m2_sr
    for factor in (1e-4, 1e4):
        scaled = denoised((noisy * factor).astype(np.float32), albedo, normals).w_m2_sr / factor
        assert np.abs(scaled / one - 1).max() < 0.02


def test_wrong_passes_are_refused() -> None:
    pytest.importorskip("mitsuba_oidn")
    _, noisy, albedo, normals = scene(4)
    with pytest.raises(ValueCheckError, match=r"albedo \(63, 96\)"):
        denoised(noisy, albedo[:-1], normals)
    with pytest.raises(ValueCheckError, match=r"radiance.*float64"):
        denoised(noisy.astype(np.float64), albedo, normals)
    noisy[5, 6] = np.nan
    with pytest.raises(ValueCheckError, match="radiance"):
        denoised(noisy, albedo, normals)


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    _, noisy, albedo, normals = scene(4)
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", None)
    with pytest.raises(ConfigError, match=r"pip install 'optsim\[denoise\]'"):
        denoised(noisy, albedo, normals)
