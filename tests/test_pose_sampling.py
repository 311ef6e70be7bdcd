"""How far apart poses and keys may be: densities from what leaving out every other one changes."""

import numpy as np
import pytest

from optsim.render.pose_sampling import Trial, assumed
from optsim.render.trajectories import PoseDensity, Trajectory

N_INSTANTS, N_STEPS, N_KEYS, WAY_PX = 6, 48, 12, 24.0
MASK = np.ones((8, 32), np.bool_)
LEVEL, FLOOR = 2.0, 0.5
ALL = np.ones(MASK.sum(), np.bool_)
BEFORE = PoseDensity(poses=0.01, keys=0.01)


def track() -> Trajectory:
    return Trajectory("mover", WAY_PX, N_STEPS, N_KEYS, MASK)


def trial_of(light, noise: float = 0.0, covered=ALL, seed: int = 7) -> Trial:
    """Add poses of a light that depends on time 0..1 alone; noise is independent in both halves."""
    trial, rng = Trial(track(), N_INSTANTS, FLOOR), np.random.default_rng(seed)
    for step in range(N_STEPS + 1):
        seen = light(step / N_STEPS) + noise * LEVEL * rng.standard_normal((2, MASK.sum()))
        trial.add(step, seen, covered)
    return trial


def test_density_follows_the_error_that_interpolation_would_make():
    """A parabola: the mean of n straight pieces an instant errs by curvature * width^2 / (12 n^2)."""
    curvature = 40.0
    trial = trial_of(lambda t: LEVEL + np.array(curvature / 2 * (t - 0.5) ** 2))
    means = [curvature / 2 * ((edge - 0.5) ** 3) / 3 for edge in np.linspace(0, 1, N_INSTANTS + 1)]
    about = LEVEL + np.diff(means) * N_INSTANTS + FLOOR
    # Twice as far apart than N_STEPS, relative; the law that is assumed for it says 1.5, this light has 2.
    coarse = curvature / 12 * (2 / N_STEPS) ** 2 * (1 - 1 / 4) / (1 - 2**-1.5)
    error = np.sqrt(np.mean((coarse / about) ** 2))
    bound = 0.002
    at_one_px = error * (N_STEPS / 2 / WAY_PX) ** 1.5
    expected = (at_one_px / (0.7 * bound)) ** (1 / 1.5)
    found = trial.density(bound, BEFORE)
    assert found.poses == pytest.approx(expected, rel=0.02)
    assert found.keys == BEFORE.keys, "no key was compared"
    # An eighth of the bound asks for four times as many.
    assert trial.density(bound / 8, BEFORE).poses == pytest.approx(4 * expected, rel=0.02)


def test_an_error_where_a_quarter_is_covered_counts_fourfold_in_squares():
    quarter = np.arange(MASK.sum()) % 4 == 0
    light = lambda t: LEVEL + 5 * np.sin(9 * t) * quarter  # noqa: E731
    some, all_of_it = (trial_of(light, covered=c).density(0.01, BEFORE).poses for c in (quarter, ALL))
    assert some == pytest.approx(all_of_it * 4 ** (0.5 / 1.5), rel=1e-6)


def test_noise_is_not_taken_for_error():
    """Half of what a pose shows is chance, independent from pose to pose."""
    found = [
        trial_of(lambda _: np.array(LEVEL), 0.5, seed=seed).density(0.1, BEFORE).poses for seed in range(40)
    ]
    # A fifth of the poses that the first segment has: an error below a tenth of the bound.
    assert np.mean(found) < 0.2 * assumed(0.1).poses


def test_what_was_dense_becomes_sparse_by_halves_only():
    still = trial_of(lambda _: np.array(LEVEL))
    assert still.density(0.1, PoseDensity(8.0, 8.0)).poses == 4.0


def test_keys_are_as_dense_as_the_changes_between_them_ask_for():
    trial = Trial(track(), N_INSTANTS, FLOOR)
    light, share = np.full((2, MASK.sum()), LEVEL), 0.08
    for _ in range(3):
        trial.compare(light, light + share * (LEVEL + FLOOR), ALL)
    bound = 0.01
    at_one_px = np.sqrt(8 / 15) * share * (N_KEYS / 2 / WAY_PX) ** 1.5
    expected = (at_one_px / (0.7 * bound)) ** (1 / 1.5)
    assert trial.density(bound, BEFORE).keys == pytest.approx(expected, rel=1e-6)
    assert trial.density(bound, PoseDensity(1.0, 10.0)).keys == 5.0


def test_noise_between_keys_is_not_taken_for_change():
    """Half of what a sample shows is chance, and in what it is relative to, too."""
    rng = np.random.default_rng(3)
    found: list[float] = []
    for _ in range(40):
        trial = Trial(track(), N_INSTANTS, FLOOR)
        for _ in range(6):
            seen, coarse = LEVEL * (1 + 0.5 * rng.standard_normal((2, 2, MASK.sum())))
            trial.compare(seen, coarse, ALL)
        found.append(trial.density(0.1, BEFORE).keys)
    # Below a tenth of the keys that the first segment has: an error far below the bound.
    assert np.mean(found) < 0.1 * assumed(0.1).keys


def test_what_nobody_saw_changes_nothing():
    nobody = np.zeros(MASK.sum(), np.bool_)
    trial = trial_of(lambda t: LEVEL + np.array(5 * np.sin(9 * t)), covered=nobody)
    trial.compare(np.ones((2, MASK.sum())), np.ones((2, MASK.sum())), nobody)
    assert trial.density(0.1, BEFORE) == BEFORE


def test_a_tighter_bound_begins_denser():
    dense, sparse = assumed(0.05), assumed(0.4)
    assert dense.poses == pytest.approx(4 * sparse.poses)
    assert dense.keys == pytest.approx(4 * sparse.keys)
