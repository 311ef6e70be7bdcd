"""The benchmark's own arithmetic: families of records, unbiased errors, and the picture of time and error."""

import numpy as np
import pytest

from optsim import benchmark
from optsim.benchmark.curve import time_against_error
from optsim.benchmark.render import _best, _Point, _Reference
from optsim.errors import ConfigError


def record(name="render.x", curve=()):
    return {"name": name, "ratio": 6.25, "conditions": {"curve": list(curve)}}


def test_a_family_is_all_its_records(monkeypatch):
    asked = []
    monkeypatch.setattr(
        benchmark, "import_module", lambda _: type("M", (), {"measure": lambda n, p: asked.append(n)})
    )
    benchmark.measure_all(["render", "omp.k2000"])
    assert asked == ["render.window_room", "render.half_moving", "render.moving_camera", "omp.k2000"]
    with pytest.raises(ConfigError, match="render"):
        benchmark.measure_all(["rendr"])


def test_the_reference_does_not_add_its_own_noise():
    """Of a perfect picture the squared error averages to zero, of one 10 % off to 0.01."""
    rng = np.random.default_rng(4)
    n, noise = 200_000, 0.05
    halves = 2.0 + 2.0 * noise * rng.standard_normal((2, n))
    reference = _Reference(halves, np.arange(n) < n // 2, 1e-6)
    # A product of two halves of relative deviation 0.05 deviates by 0.0025; 5 standard errors of its mean.
    perfect = reference.squared_errors(np.full(n, 2.0))
    assert perfect.shape == (2,)
    assert np.abs(perfect).max() < 5 * noise**2 / np.sqrt(n / 2) < 0.1 * noise**2
    # Off by 10 %, division by the halves' own noisy mean adds about 2 x 0.1 x 0.05^2: 5 % of 0.01.
    off = reference.squared_errors(np.full(n, 2.2))
    np.testing.assert_allclose(off, 0.01, rtol=0.1)


def test_the_shortest_time_and_the_mean_error_count():
    points = [_Point(2.0, 9.0, np.array([0.04, 0.01])), _Point(1.5, 8.0, np.array([0.02, 0.03]))]
    best = _best(points)
    assert (best.seconds, best.once_s) == (1.5, 8.0)
    np.testing.assert_allclose(best.squared, [0.03, 0.02])


def test_the_picture_has_a_line_for_each_method_and_region():
    curve = [
        {"method": m, "setting": s, "seconds": t, "error_movers": e, "error_elsewhere": e / 2}
        for m, s, t, e in (("plain", 16, 0.4, 0.2), ("plain", 64, 1.6, 0.1), ("optsim", 0.1, 0.2, 0.1))
    ]
    text = time_against_error([record(curve=curve), record("omp.k2000")])
    assert text.count("<polyline") == 4
    assert text.count("<circle") == 6
    assert "6.2x the plain loop" in text
    assert "omp" not in text
    assert time_against_error([]).startswith("<svg")
