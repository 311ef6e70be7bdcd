"""Errors against luminance, and the place where they are largest."""

from __future__ import annotations

import numpy as np
import pytest

from optsim.metrics import LogRmse, error_by_luminance, worst_place

SHAPE = (3, 12, 16)


def test_errors_are_sorted_by_the_true_luminance() -> None:
    metric = LogRmse(e_cd_m2=1e-9)
    truth = np.full(SHAPE, 3.0, np.float32)
    truth[:, :6] = 40.0
    truth[:, 11] = 0.0  # nothing below the offset is told apart
    estimate = truth.copy()
    estimate[0, :6] *= 2  # one stop too bright in one of three slots
    estimate[:, 6:11] *= np.float32(2**-0.5)
    where = np.ones(SHAPE[1:], np.bool_)
    where[:, 0] = False
    dark, mid, bright = error_by_luminance("m", estimate, truth, where, metric)
    assert dark.low_cd_m2 <= 1e-9 < dark.high_cd_m2
    assert (dark.n, dark.rms_stops) == (3 * 15, 0)
    assert (mid.low_cd_m2, mid.high_cd_m2, mid.n) == (2, 4, 3 * 5 * 15)
    assert (mid.bias_stops, mid.rms_stops) == (pytest.approx(-0.5), pytest.approx(0.5))
    assert (bright.low_cd_m2, bright.high_cd_m2, bright.n) == (32, 64, 3 * 6 * 15)
    assert (bright.bias_stops, bright.rms_stops) == (pytest.approx(1 / 3), pytest.approx(3**-0.5))
    assert error_by_luminance("m", estimate, truth, np.zeros_like(where), metric) == []


def test_the_worst_place_is_found_among_pixels_that_count() -> None:
    metric = LogRmse(e_cd_m2=1e-9)
    truth = np.ones(SHAPE, np.float32)
    estimate = truth.copy()
    estimate[1, 7:9, 9:12] = 0.5
    estimate[:, :2, :3] = 1e-3  # far worse, and given up
    where = np.ones(SHAPE[1:], np.bool_)
    where[:2, :3] = False
    place = worst_place("m", 4, estimate, truth, where, metric, size=(2, 3))
    assert place is not None
    assert (place.row, place.col, place.height, place.width) == (7, 9, 2, 3)
    assert (place.method, place.frame, place.slot) == ("m", 4, 1)
    assert place.bias_stops == pytest.approx(-1 / 3)
    assert place.rms_stops == pytest.approx(3**-0.5)
    assert worst_place("m", 4, estimate, truth, np.zeros_like(where), metric, size=(2, 3)) is None
